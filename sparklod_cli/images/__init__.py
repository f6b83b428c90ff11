"""Pictures: pixels and files of them, contact sheets, animations, and how alike two are."""
