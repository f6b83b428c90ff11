"""Tilesets of 3D Tiles as they are read: one file, and a file with the nested ones that it names.

What reading needs is checked when a file is parsed; every other rule is for `tileset_rules` to tell of. Facts: the
specification of 3D Tiles 1.1 (OGC 22-025r4), sections 5 and 6.
"""

from __future__ import annotations

import posixpath
import urllib.parse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...system.errors import FormatError, VersionError
from ...system.untrusted import Json, quoted_value
from ..file_names import TILESET
from ..file_notes import FileNote, read_note
from ..json_trees import nodes_of, parse_manifest, place_of
from ..reader import OpenCompanion
from ..validation import error_of

#: The version that is written, and the one before it, which is read, too.
VERSION, OLD_VERSION = "1.1", "1.0"

#: How the children of a tile refine it, the one way that is read and written.
REPLACE = "REPLACE"

#: The extension that tells which extensions of glTF the tiles use.
CONTENT_GLTF = "3DTILES_content_gltf"

#: Largest tileset file, bytes: that of 100,000 tiles.
MAX_TILESET = 1 << 25

#: Most tiles, and files of tilesets, of one scene: a hundred thousand tiles hold ten billion splats. Chosen.
MAX_TILES, MAX_FILES = 1 << 17, 1 << 12

#: Suffixes of the content of tiles that is read: nested tilesets, and splats.
NESTED, SPLATS = ".json", (".glb", ".gltf")

#: Keys of a tile for what is not read, and of extensions of tiles.
UNREAD = ("implicitTiling", "contents")


@dataclass(frozen=True)
class TileRecord:
    """A tile as a file has it.

    Attributes:
        record: its JSON object.
        uri: of its content; None without.
        children: numbers of tiles, ascending.
        parent: number of the tile above, -1 of a root.
        file: the tileset file that it is in, by its path from the folder of the first one on; empty for that.
    """

    record: Mapping[str, Any]
    uri: str | None
    children: tuple[int, ...] = ()
    parent: int = -1
    file: str = ""

    @property
    def name(self) -> str | None:
        """Path of its content from the folder of the first tileset file on; None without content."""
        if self.uri is None:
            return None
        path = urllib.parse.unquote(self.uri)
        return posixpath.normpath(posixpath.join(posixpath.dirname(self.file), path)) if path else path

    @property
    def is_nested(self) -> bool:
        """Whether its content is a tileset file."""
        return self.uri is not None and self.uri.lower().endswith(NESTED)


@dataclass(frozen=True)
class Tileset:
    """Contents of a tileset file, or of one and the nested ones.

    Attributes:
        head: everything but the tiles, as the first file has it: "asset", "geometricError", "extensions".
        tiles: root first, each after its parent; that with a nested tileset has the root of that as its child.
        heads: `head` of each file, by its path; empty for the first one.
        bytes: of all files.
    """

    head: Mapping[str, Any]
    tiles: tuple[TileRecord, ...]
    heads: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    bytes: int = 0

    @property
    def noted(self) -> FileNote:
        """Note of sparklod in the first file."""
        return read_note(self.head["asset"].get("extras"))

    def place(self, number: int) -> str:
        """Return where a tile is: "root.children[0]", in a nested file with its name before that."""
        file = self.tiles[number].file

        def parent_of(each: int) -> int:
            parent = self.tiles[each].parent
            return parent if parent >= 0 and self.tiles[parent].file == file else -1

        place = place_of("root", number, parent_of, lambda each: self.tiles[each].children)
        return f"{quoted_value(file)} {place}" if file else place

    def names(self) -> Iterator[str]:
        """Yield the files that its tiles name, from its folder on."""
        return (name for tile in self.tiles if (name := tile.name) is not None)


def parse(data: bytes, file: str = "") -> Tileset:
    """Parse the bytes of a tileset file, without the nested ones that it names.

    Args:
        file: path of it, for messages and for what it names; empty for the first one.

    Raises:
        VersionError: it is of another version than 1.0 or 1.1.
        FormatError: it is not JSON, or lacks what reading needs; names the value and its place.
    """
    called = quoted_value(file) if file else TILESET
    root = parse_manifest(data, called, MAX_TILESET)
    version = root.get("asset", "version").value
    if version not in (VERSION, OLD_VERSION):
        text = f"3D Tiles version {quoted_value(version)} is unknown, only {OLD_VERSION} and {VERSION}"
        raise VersionError(f"{text} are read")
    tiles = _tiles(root.get("root"), file)
    head = {key: value.value for key, value in root.entries() if key != "root"}
    return Tileset(head, tiles, {file: head}, len(data))


def _tiles(root: Json, file: str) -> tuple[TileRecord, ...]:
    """Return the tiles of a file, root first and depth first."""
    rows = []
    for tile, parent, children in nodes_of(root, MAX_TILES):
        record = {key: value for key, value in tile.value.items() if key != "children" and value is not None}
        uri = tile.text("content", "uri") if "content" in record else None
        rows.append((record, uri, children, parent))
    return tuple(TileRecord(record, uri, tuple(children), parent, file) for record, uri, children, parent in rows)


def read_whole(data: bytes, open_companion: OpenCompanion | None) -> Tileset:
    """Return a tileset with all tiles of the nested ones. Nested files that cannot be opened are named by an error.

    Raises:
        FormatError: as `parse`; or nested tilesets are too many, or name each other in a circle.
    """
    first = parse(data)
    tiles, heads, size = list(first.tiles), dict(first.heads), first.bytes
    number = 0
    while number < len(tiles):
        tile = tiles[number]
        name = tile.name
        if tile.is_nested and name is not None and not tile.children:
            if name in heads or name == TILESET:
                raise FormatError(f"it names the tileset {quoted_value(name)} twice")
            if len(heads) == MAX_FILES:
                raise FormatError(f"it has more than {MAX_FILES:,} tileset files")
            inner = _opened(name, open_companion)
            heads[name] = inner.head
            size += inner.bytes
            offset = len(tiles)
            if offset + len(inner.tiles) > MAX_TILES:
                raise FormatError(f"it has more than {MAX_TILES:,} tiles")
            tiles[number] = TileRecord(tile.record, tile.uri, (offset,), tile.parent, tile.file)
            for each in inner.tiles:
                below = tuple(child + offset for child in each.children)
                parent = number if each.parent < 0 else each.parent + offset
                tiles.append(TileRecord(each.record, each.uri, below, parent, name))
        number += 1
    return Tileset(first.head, tuple(tiles), heads, size)


def _opened(name: str, open_companion: OpenCompanion | None) -> Tileset:
    if open_companion is None:
        raise FormatError(f"{TILESET} names {quoted_value(name)}, but other files cannot be opened here")
    try:
        with open_companion(name) as file:
            return parse(file.read(MAX_TILESET + 1), name)
    except FormatError as error:  # which names it
        raise error_of("tiles.files", str(error)) from None
