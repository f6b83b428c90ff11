"""Names of the files that formats write beside each other: those that Spark and PlayCanvas's tools give them.

Imports nothing heavy: the command line knows them.
"""

from __future__ import annotations

import re
from collections.abc import Collection

#: Suffixes of a RAD file, and of a chunk that is a file of its own.
RAD_SUFFIX, RAD_CHUNK_SUFFIX = ".rad", ".radc"

#: The file of an unpacked SOG that names its images, and these by texture, in the order in which it names them.
META = "meta.json"
SOG_IMAGES = {
    "means": ("means_l.webp", "means_u.webp"),
    "scales": ("scales.webp",),
    "quats": ("quats.webp",),
    "sh0": ("sh0.webp",),
    "shN": ("shN_centroids.webp", "shN_labels.webp"),
}

#: The manifest of a Streamed SOG. Its other files are in folders beside it.
MANIFEST = "lod-meta.json"

#: The folder of the environment of a Streamed SOG, and its file: a bundled SOG, the only form that both PlayCanvas and
#: Babylon.js read. Former outputs have it unpacked in the same folder.
ENVIRONMENT = "env"
ENVIRONMENT_FILE = f"{ENVIRONMENT}/env.sog"

#: The manifest of 3D Tiles, and the folder of its other files: tiles, by level and number, and nested tilesets.
TILESET, TILES = "tileset.json", "tiles"

#: Files that name all others of a scene in a folder, or in a zip, which stands for it.
FIRST_FILES = (MANIFEST, TILESET, META)

_ALL_IMAGES = [name for names in SOG_IMAGES.values() for name in names]
_TILE = re.compile(re.escape(TILES) + r"/(?:0|[1-9]\d{0,8})-(?:0|[1-9]\d{0,8})\.(?:glb|json)", re.ASCII)
_CHUNK_FOLDER = re.compile(r"(?:0|[1-9]\d{0,8})_(?:0|[1-9]\d{0,8})", re.ASCII)


def rad_chunk_name(stem: str, number: int) -> str:
    """Return the name of the file of a chunk."""
    return f"{stem}-{number}{RAD_CHUNK_SUFFIX}"


def rad_chunk_number(name: str, stem: str) -> int | None:
    """Return the number of the chunk whose file has this name; None if `rad_chunk_name` gives no such name."""
    match = re.fullmatch(r"(0|[1-9][0-9]{0,8})" + re.escape(RAD_CHUNK_SUFFIX), name.removeprefix(f"{stem}-"))
    return int(match[1]) if match and name.startswith(f"{stem}-") else None


def sog_image_number(name: str) -> int | None:
    """Return the number of the image of a SOG whose file has this name, over all textures; None for other names."""
    return _ALL_IMAGES.index(name) if name in _ALL_IMAGES else None


def chunk_folder(level: int, number: int) -> str:
    """Return the folder of a chunk of a detail level of a Streamed SOG."""
    return f"{level}_{number}"


def is_chunk_folder(name: str) -> bool:
    """Return True if a folder has the name of one of a Streamed SOG."""
    return name == ENVIRONMENT or _CHUNK_FOLDER.fullmatch(name) is not None


def is_in_manifest(name: str) -> bool:
    """Return True if the manifest of an output could name a file: the meta.json of a chunk, or the environment."""
    folder, _, file = name.partition("/")
    return name == ENVIRONMENT_FILE or (is_chunk_folder(folder) and file == META)


def is_of_streamed_sog(name: str) -> bool:
    """Return True if a file could be of an output: named by its manifest, or an image in a folder of it."""
    folder, _, file = name.partition("/")
    return is_in_manifest(name) or (is_chunk_folder(folder) and sog_image_number(file) is not None)


def is_of_tileset(name: str) -> bool:
    """Return True if a file could be of an output of 3D Tiles: a tile or a nested tileset in their folder."""
    return _TILE.fullmatch(name) is not None


def folders_of(names: Collection[str]) -> list[str]:
    """Return the folders of files, by their names."""
    return sorted({folder for folder, mark, _ in (name.partition("/") for name in names) if mark})
