"""Tilesets of 3D Tiles as they are read: one file, and a file with the nested ones that it names.

Parsing checks what reading needs; all other rules are in `tileset_rules`. z is up in a tileset and its volumes, y in
the glTF content of its tiles, which a viewer turns when it loads it: (x, y, z) becomes (x, -z, y). Facts: the
specification of 3D Tiles 1.1 (OGC 22-025r4), sections 5 and 6, and "glTF transforms".
"""

from __future__ import annotations

import math
import posixpath
import urllib.parse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.traversed import Bounds
from ...system.errors import FormatError, VersionError
from ...system.untrusted import Json, quoted_value
from ..formats import TILESET
from ..glb.glb_container import rotation_of_up
from ..reader import FileNote, OpenCompanion, read_note
from ..rules import error_of, nodes_of, parse_manifest, place_of

#: The version that is written, and the one before it, which is read, too.
VERSION, OLD_VERSION = "1.1", "1.0"

#: How the children of a tile refine it, the one way that is read and written.
REPLACE = "REPLACE"

#: The extension that names the extensions of glTF which the tiles use.
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
    """A tile of a file, not checked.

    Attributes:
        record: its JSON object.
        uri: of its content; None without.
        children: numbers of tiles, ascending.
        parent: number of the tile above, -1 of a root.
        file: path of its tileset file from the folder of the first one on; empty for the first one.
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
        head: everything but the tiles in the first file: "asset", "geometricError", "extensions".
        tiles: each after its parent; the child of one with a nested tileset is the root of that.
        heads: `head` of each file, by its path; empty for the first one.
        bytes: of all files.
    """

    head: Mapping[str, Any]
    tiles: tuple[TileRecord, ...]
    heads: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    bytes: int = 0

    @property
    def noted(self) -> FileNote:
        return read_note(self.head["asset"].get("extras"))

    def place(self, number: int) -> str:
        """Return the place of a tile: "root.children[0]", in a nested file with its name before that."""
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
    """Parse a tileset file, without nested ones; `file` is its path from the folder of the first one on."""
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
    tiles = list[TileRecord]()
    for tile, parent, children in nodes_of(root, MAX_TILES):
        record = {key: value for key, value in tile.value.items() if key != "children" and value is not None}
        uri = tile.text("content", "uri") if "content" in record else None
        tiles.append(TileRecord(record, uri, tuple(children), parent, file))
    return tuple(tiles)


def read_whole(data: bytes, open_companion: OpenCompanion | None) -> Tileset:
    """Return a tileset with all tiles of the nested ones; errors name nested files that cannot be opened."""
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


Vector = NDArray[np.float64]

#: Numbers of each kind of bounding volume.
KINDS = {"box": 12, "sphere": 4, "region": 6}

#: Largest magnitude of a number: that of float32, in which viewers draw.
LARGEST = 3.4e38


@dataclass(frozen=True, eq=False)
class Volume:
    """A box or a sphere around (3,) `center`; a box has a radius of 0.

    Attributes:
        axes: (3, 3) halves of the sides of a box as rows; (0, 3) of a sphere.
    """

    center: Vector
    axes: Vector
    radius: float = 0.0

    def reach(self, directions: Vector) -> Vector:
        """Return (n,) extents from its centre along (n, 3) directions of length 1."""
        return np.abs(directions @ self.axes.T).sum(axis=1) + self.radius

    def corners(self) -> Vector:
        """Return (n, 3) corners of a box."""
        signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], np.float64)
        return self.center + signs @ self.axes

    def directions(self) -> Vector:
        """Return (3, 3) directions of the sides of a box as rows; sides of length 0 get perpendicular directions."""
        found = list[Vector]()
        for axis in self.axes[np.argsort(-np.linalg.norm(self.axes, axis=1), kind="stable")]:
            length = float(np.linalg.norm(axis))
            if length > 0:
                found.append(axis / length)
        for unit in np.eye(3):
            rest = unit - sum((unit @ each * each for each in found), np.zeros(3))
            if len(found) < 3 and np.linalg.norm(rest) > 0.5:
                found.append(rest / np.linalg.norm(rest))
        return np.array(found)

    def bounds(self) -> Vector:
        """Return (2, 3) corners of the box along the axes around it."""
        half = self.reach(np.eye(3))
        return np.stack([self.center - half, self.center + half])

    def moved(self, matrix: Vector) -> Volume:
        """Return the volume after a (4, 4) transform; a sphere grows by the largest scale."""
        scale = float(np.linalg.norm(matrix[:3, :3], axis=0).max())
        return Volume(matrix[:3, :3] @ self.center + matrix[:3, 3], self.axes @ matrix[:3, :3].T, scale * self.radius)

    def holds(self, other: Volume, loose: float) -> bool:
        """Return whether another volume is inside, or at most `loose` outside."""
        if not len(self.axes):
            if len(other.axes):
                far = float(np.linalg.norm(other.corners() - self.center, axis=1).max())
            else:
                far = float(np.linalg.norm(other.center - self.center)) + other.radius
            return far <= self.radius + loose
        sides = self.directions()
        return bool(
            (np.abs(sides @ (other.center - self.center)) + other.reach(sides) <= self.reach(sides) + loose).all()
        )

    @property
    def size(self) -> float:
        """Largest number in it, by which rounding is measured."""
        return float(np.abs(self.center).max() + self.reach(np.eye(3)).max())


def volume_of(value: Any) -> Volume | str | None:
    """Return the volume of a "boundingVolume"; None for a region, whose numbers are angles; a text if it is invalid."""
    kind = next((kind for kind in KINDS if isinstance(value, dict) and kind in value), None)
    if kind is None:
        return "none of box, sphere and region"
    numbers = value[kind]
    if not isinstance(numbers, list) or len(numbers) != KINDS[kind]:
        return f"a {kind} that has not {KINDS[kind]} numbers"
    if not all(type(each) in (int, float) and math.isfinite(each) and abs(each) <= LARGEST for each in numbers):
        return f"a {kind} with something else than finite numbers"
    found = np.array(numbers, np.float64)
    if kind == "box":
        return Volume(found[:3], found[3:].reshape(3, 3))
    if kind == "region":
        return None
    if found[3] < 0:
        return "a sphere with a radius below 0"
    return Volume(found[:3], np.empty((0, 3)), float(found[3]))


#: The turn from the axes of glTF to those of tilesets, of column vectors.
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def to_tileset(up: str | None) -> NDArray[np.float64]:
    """Return the (3, 3) rotation from the axes of splats in a GLB of ours, of which `up` is up, to the tileset's.

    Its entries are 0, 1 and -1, so that boxes stay boxes.
    """
    return Y_TO_Z @ rotation_of_up(up)


def turned(bounds: Bounds, rotation: NDArray[np.float64]) -> Bounds:
    """Return (..., 2, 3) corners of the boxes around boxes turned by a (3, 3) rotation of column vectors."""
    middle, half = bounds.mean(axis=-2), (bounds[..., 1, :] - bounds[..., 0, :]) / 2
    center, reach = middle @ rotation.T, half @ np.abs(rotation).T
    return np.stack([center - reach, center + reach], axis=-2)
