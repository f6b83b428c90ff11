"""Reports to hold to expectations, and files of expectations."""

from __future__ import annotations

from pathlib import Path

from tests.conftest import FIXTURES

TREE, PLAIN = FIXTURES / "golden" / "hand-tree-v3.spz", FIXTURES / "golden" / "sh3-v3.spz"
#: The tree has nine nodes, of which six are leaves, and two edges from the root to the deepest.
NODES, LEAVES, DEPTH = 9, 6, 2


def written(folder: Path, text: str, name: str = "expect.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path
