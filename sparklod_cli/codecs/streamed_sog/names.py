"""The names of the files of Streamed SOG, below the folder of the manifest."""

from __future__ import annotations

import re
from collections.abc import Collection

from ..sog.names import META, number_of

#: The name of a manifest.
MANIFEST = "lod-meta.json"

#: The folder of the environment.
ENVIRONMENT = "env"

_CHUNK = re.compile(r"(?:0|[1-9]\d{0,8})_(?:0|[1-9]\d{0,8})", re.ASCII)


def chunk_name(level: int, number: int) -> str:
    """The folder of a chunk of a detail level."""
    return f"{level}_{number}"


def is_ours(name: str) -> bool:
    """Whether a file could be of an output: a file of an unpacked SOG, in the folder of a chunk or the environment."""
    folder, _, file = name.partition("/")
    return is_folder(folder) and (file == META or number_of(file) is not None)


def is_folder(name: str) -> bool:
    """Whether a folder is called as one of an output."""
    return name == ENVIRONMENT or _CHUNK.fullmatch(name) is not None


def folders_of(names: Collection[str]) -> list[str]:
    """The folders that files are in, by their names."""
    return sorted({folder for folder, mark, _ in (name.partition("/") for name in names) if mark})
