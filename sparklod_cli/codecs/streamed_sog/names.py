"""The names of the files of Streamed SOG, below the folder of the manifest."""

from __future__ import annotations

import re
from collections.abc import Collection

from ..sog.names import META, number_of

#: The name of a manifest.
MANIFEST = "lod-meta.json"

#: The folder of the environment, and its file: a bundled SOG, the only form that both PlayCanvas and Babylon.js read.
#: Former outputs have it unpacked in the same folder.
ENVIRONMENT = "env"
ENVIRONMENT_FILE = f"{ENVIRONMENT}/env.sog"

_CHUNK = re.compile(r"(?:0|[1-9]\d{0,8})_(?:0|[1-9]\d{0,8})", re.ASCII)


def chunk_name(level: int, number: int) -> str:
    """The folder of a chunk of a detail level."""
    return f"{level}_{number}"


def is_ours(name: str) -> bool:
    """Return True if a file could be of an output: named by its manifest, or an image in a folder of it."""
    folder, _, file = name.partition("/")
    return is_named(name) or (is_folder(folder) and number_of(file) is not None)


def is_named(name: str) -> bool:
    """Return True if the manifest of an output could name a file: the meta.json of a chunk, or the environment."""
    folder, _, file = name.partition("/")
    return name == ENVIRONMENT_FILE or (is_folder(folder) and file == META)


def is_folder(name: str) -> bool:
    """Whether a folder is called as one of an output."""
    return name == ENVIRONMENT or _CHUNK.fullmatch(name) is not None


def folders_of(names: Collection[str]) -> list[str]:
    """The folders that files are in, by their names."""
    return sorted({folder for folder, mark, _ in (name.partition("/") for name in names) if mark})
