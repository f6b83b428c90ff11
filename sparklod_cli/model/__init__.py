"""Data model: splats, scenes and Level-of-Detail trees, independent of file formats."""
