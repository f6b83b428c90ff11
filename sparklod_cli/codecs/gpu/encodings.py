"""The table of layouts in which viewers hold splats in memory: adding one is a module and a row here."""

from __future__ import annotations

from importlib import import_module
from typing import Any

#: By the name that --encoding takes, a module of this package. Its `arrays(scene, *, threads)` gives the words of a
#: tree as uint32 arrays by name; docs/formats.md lays them out.
ENCODINGS = {"packed": "packed_splats", "ext": "ext_splats", "lodtree": "lod_tree", "texture": "data_texture"}

#: What a file of these arrays is called, and one of their words alone; the latter may have no suffix, too.
NPZ, RAW_SUFFIXES = ".npz", (".bin", ".raw")


def layout(name: str) -> Any:
    """The module of an encoding, imported when it is needed."""
    return import_module(f".{ENCODINGS[name]}", __package__)
