"""Names of the files that hold a chunk of a RAD file each, beside its header: those that Spark gives them."""

from __future__ import annotations

import re

SUFFIX, CHUNK_SUFFIX = ".rad", ".radc"


def chunk_name(stem: str, number: int) -> str:
    """The name of a chunk's file.

    Args:
        stem: the name of the header's file without its suffix.
        number: of the chunk, from 0.
    """
    return f"{stem}-{number}{CHUNK_SUFFIX}"


def number_of(name: str, stem: str) -> int | None:
    """The chunk whose file would be called this; None if that is no name of `chunk_name`."""
    found = re.fullmatch(r"(0|[1-9][0-9]{0,8})" + re.escape(CHUNK_SUFFIX), name.removeprefix(f"{stem}-"))
    return int(found[1]) if found and name.startswith(f"{stem}-") else None
