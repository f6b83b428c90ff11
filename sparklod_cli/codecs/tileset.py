"""Tilesets of 3D Tiles, a file with the nested ones that it names, and their rules.

Parsing checks what reading needs; all other rules, of the files, the tiles and their splats, are checked apart. z is up
in a tileset and its volumes, y in the glTF content of its tiles, which a viewer turns when it loads it: (x, y, z)
becomes (x, -z, y). Facts: the specification of 3D Tiles 1.1 (OGC 22-025r4), sections 5 and 6, and "glTF transforms".
"""

from __future__ import annotations

import functools
import itertools
import math
import posixpath
import urllib.parse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.instances import Bounds
from ..model.splats import Splats
from ..system.errors import FormatError, UnsupportedError, VersionError
from ..system.progress import Progress, silent
from ..system.units import count_of
from ..system.untrusted import quoted_value
from .format_rules import (
    LOOSE_BOUND,
    RuleViolation,
    count_outside,
    error_of,
    leads_away,
    nodes_of,
    parse_manifest,
    place_of,
    violation,
)
from .formats import TILESET
from .gltf_container import COMPRESSION, EXTENSION, product, rotation_of_up
from .merging import Chunk, SceneFiles, not_finite
from .reader import FileNote, OpenCompanion, read_note

#: Version that is written, and an older one that is also read.
VERSION, OLD_VERSION = "1.1", "1.0"

#: Refinement of a tile by its children, the only one that is read and written.
REPLACE = "REPLACE"

#: Extension that lists the glTF extensions of the tiles.
CONTENT_GLTF = "3DTILES_content_gltf"

#: Largest tileset file in bytes; fits 100,000 tiles.
MAX_TILESET = 1 << 25

#: Most tiles and tileset files of one scene: a hundred thousand tiles hold ten billion splats. Chosen.
MAX_TILES, MAX_FILES = 1 << 17, 1 << 12

#: Suffixes of readable contents of tiles: nested tilesets, and splats.
NESTED, SPLATS = ".json", (".glb", ".gltf")

#: Keys of a tile for content that is not read.
UNREAD = ("implicitTiling", "contents")


@dataclass(frozen=True)
class TileRecord:
    """Unchecked tile of a file.

    Attributes:
        record: its JSON object without children.
        uri: address of its content; None without content.
        children: numbers of the child tiles, ascending.
        parent: number of the parent, -1 for a root.
        file: path of its tileset file from the folder of the first one on; empty for the first one.
    """

    record: Mapping[str, Any]
    uri: str | None
    children: tuple[int, ...] = ()
    parent: int = -1
    file: str = ""

    @property
    def name(self) -> str | None:
        """Path of the content, relative to the folder of the root tileset; None if there is no content."""
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
    """Contents of a tileset file and of its nested ones.

    Attributes:
        head: everything but the tiles in the first file: "asset", "geometricError", "extensions".
        tiles: all tiles, parents first; the child of a tile with a nested tileset is the root of that tileset.
        heads: `head` of each file by its path, which is empty for the first file.
        bytes: size of all files.
    """

    head: Mapping[str, Any]
    tiles: tuple[TileRecord, ...]
    heads: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    bytes: int = 0

    @property
    def noted(self) -> FileNote:
        return read_note(self.head["asset"].get("extras"))

    def place(self, number: int) -> str:
        """Return the place of a tile, such as "root.children[0]", after the name of a nested file."""
        file = self.tiles[number].file

        def parent_of(each: int) -> int:
            parent = self.tiles[each].parent
            return parent if parent >= 0 and self.tiles[parent].file == file else -1

        place = place_of("root", number, parent_of, lambda each: self.tiles[each].children)
        return f"{quoted_value(file)} {place}" if file else place

    def root_of(self, number: int) -> int:
        """Return the root of its nested tileset for a tile that has one, else the tile itself."""
        while self.tiles[number].is_nested and self.tiles[number].children:
            (number,) = self.tiles[number].children
        return number

    def names(self) -> Iterator[str]:
        """Yield the paths of the contents of tiles, relative to the folder of the first file."""
        return (name for tile in self.tiles if (name := tile.name) is not None)


def parse(data: bytes, file: str = "") -> Tileset:
    """Parse a tileset file without nested ones; `file` is its path from the folder of the first one on."""
    called = quoted_value(file) if file else TILESET
    root = parse_manifest(data, called, MAX_TILESET)
    version = root.get("asset", "version").value
    if version not in (VERSION, OLD_VERSION):
        text = f"3D Tiles version {quoted_value(version)} is unknown, only {OLD_VERSION} and {VERSION}"
        raise VersionError(f"{text} are read")
    tiles = list[TileRecord]()
    for tile, parent, children in nodes_of(root.get("root"), MAX_TILES):
        record = {key: value for key, value in tile.value.items() if key != "children" and value is not None}
        uri = tile.text("content", "uri") if "content" in record else None
        tiles.append(TileRecord(record, uri, tuple(children), parent, file))
    head = {key: value.value for key, value in root.entries() if key != "root"}
    return Tileset(head, tuple(tiles), {file: head}, len(data))


def read_whole(data: bytes, open_companion: OpenCompanion | None) -> Tileset:
    """Parse a tileset and all nested ones; errors name nested files that cannot be opened."""
    first = parse(data)
    tiles, heads, size = list(first.tiles), dict(first.heads), first.bytes
    for number, tile in enumerate(tiles):  # which grows
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
            tiles[number] = replace(tile, children=(offset,))
            for each in inner.tiles:
                below = tuple(child + offset for child in each.children)
                parent = number if each.parent < 0 else each.parent + offset
                tiles.append(replace(each, children=below, parent=parent))
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
    """Box or sphere around (3,) `center`; a box has a radius of 0.

    Attributes:
        axes: (3, 3) half sides of a box as rows; (0, 3) for a sphere.
    """

    center: Vector
    axes: Vector
    radius: float = 0.0

    def reach(self, directions: Vector) -> Vector:
        """Return (n,) extents from the centre along (n, 3) unit directions."""
        return np.abs(directions @ self.axes.T).sum(axis=1) + self.radius

    def directions(self) -> Vector:
        """Return (3, 3) unit directions of the sides of a box as rows, perpendicular ones for sides of length 0."""
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
        """Return (2, 3) corners of its axis-aligned bounding box."""
        half = self.reach(np.eye(3))
        return np.stack([self.center - half, self.center + half])

    def moved(self, matrix: Vector) -> Volume:
        """Return the volume after a (4, 4) transform; a sphere grows by the largest scale."""
        scale = float(np.linalg.norm(matrix[:3, :3], axis=0).max())
        return Volume(matrix[:3, :3] @ self.center + matrix[:3, 3], self.axes @ matrix[:3, :3].T, scale * self.radius)

    def holds(self, other: Volume, loose: float) -> bool:
        """Return whether another volume is inside, or outside by at most `loose`."""
        if not len(self.axes):
            if len(other.axes):
                corners = other.center + np.array(list(itertools.product((-1.0, 1.0), repeat=3))) @ other.axes
                far = float(np.linalg.norm(corners - self.center, axis=1).max())
            else:
                far = float(np.linalg.norm(other.center - self.center)) + other.radius
            return far <= self.radius + loose
        sides = self.directions()
        return bool(
            (np.abs(sides @ (other.center - self.center)) + other.reach(sides) <= self.reach(sides) + loose).all()
        )

    @property
    def size(self) -> float:
        """Largest coordinate of its bounds, the unit of rounding errors."""
        return float(np.abs(self.center).max() + self.reach(np.eye(3)).max())


def volume_of(value: Any) -> Volume | str | None:
    """Parse a "boundingVolume": the volume, None for a region, whose numbers are angles, or what is wrong with it."""
    kind = next((kind for kind in KINDS if isinstance(value, dict) and kind in value), None)
    if kind is None:
        return "none of box, sphere and region"
    numbers = value[kind]
    if not isinstance(numbers, list) or len(numbers) != KINDS[kind]:
        return f"a {kind} that has not {KINDS[kind]} numbers"
    if not all(type(each) in (int, float) and abs(each) <= LARGEST for each in numbers):
        return f"a {kind} with something else than finite numbers"
    found = np.array(numbers, np.float64)
    if kind == "box":
        return Volume(found[:3], found[3:].reshape(3, 3))
    if kind == "region":
        return None
    if found[3] < 0:
        return "a sphere with a radius below 0"
    return Volume(found[:3], np.empty((0, 3)), float(found[3]))


#: Rotation of column vectors from the axes of glTF to those of tilesets.
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def to_tileset(up: str | None) -> NDArray[np.float64]:
    """Return the (3, 3) rotation from the axes of splats in a GLB, by their up axis, to those of the tileset.

    Its entries are 0, 1 and -1, so that boxes stay boxes.
    """
    return Y_TO_Z @ rotation_of_up(up)


def turned(bounds: Bounds, rotation: NDArray[np.float64]) -> Bounds:
    """Return the (..., 2, 3) corners of the boxes around boxes after a (3, 3) rotation of column vectors."""
    middle, half = bounds.mean(axis=-2), (bounds[..., 1, :] - bounds[..., 0, :]) / 2
    center, reach = middle @ rotation.T, half @ np.abs(rotation).T
    return np.stack([center - reach, center + reach], axis=-2)


#: Meaning of each code; the text of a violation has the values. Values that the parser refuses have the codes
#: "container.corrupt" and "container.version", as in other formats.
ERRORS = {
    "tiles.unread": "a tile has content, or children, of a kind that is not read",
    "tiles.refine": "the children of a tile do not replace it",
    "tiles.required": "a property that the specification demands is missing",
    "tiles.transform": "a transform is not 16 numbers of an affine transform, or several multiply to too large ones",
    "tiles.volumes": "a bounding volume is none, or is not of finite numbers",
    "tiles.inside": "the bounding volume of a tile is not inside that of its parent",
    "tiles.extents": "splats of a tile lie outside of its bounding volume",
    "tiles.errors": "a geometric error is below 0, not finite, or larger than that of the tile above",
    "tiles.unrefined": "the geometric error of a tile with children is 0, so that no viewer refines it",
    "tiles.files": "the file of a tile is missing, damaged or no glTF of splats, or its name leads elsewhere",
    "tiles.shared": "two tiles have the same file",
    "tiles.sh": "the SH degrees of tiles differ, and viewers take that of one for all",
    "tiles.kind": "the axes that point up in tiles differ",
    "tiles.extensions": "the tileset does not name the extensions that its tiles use, by which viewers know splats",
}
WARNINGS = {
    "tiles.old": "the version is 1.0, which has no tiles of glTF without an extension",
    "tiles.leaf-error": "the geometric error of a tile without children is not 0, though nothing refines it",
    "tiles.empty": "a tile without children has no splats",
    "tiles.decreasing": "the children of a tile have fewer splats than it",
    "tiles.large": "a tile has more splats than a viewer should load at once",
}

#: Rules that a readable file may break.
READABLE = {
    *WARNINGS,
    *(f"tiles.{name}" for name in ("required", "inside", "extents", "unrefined", "sh", "extensions")),
}
broken = functools.partial(violation, READABLE, "tiles")

#: Largest number of splats of a tile without `tiles.large`, ten times the default of tiles that are written. Chosen.
LARGE = 1_000_000

#: Allowed distance of a bounding volume outside that of its parent, as a share of its largest number.
ROUNDING = 1e-5

#: Extensions of glTF that mark a tile as splats, see `gltf`.
SPLAT_EXTENSIONS = (EXTENSION, COMPRESSION)


def read_violations(tileset: Tileset) -> Iterator[RuleViolation]:
    """Yield the broken rules that keep the splats of a tileset from being read."""
    for name, head in tileset.heads.items():
        required = head.get("extensionsRequired", [])
        others = [each for each in required if each != CONTENT_GLTF] if isinstance(required, list) else [required]
        if others:
            where = f"{quoted_value(name)} requires" if name else "it requires"
            yield broken("unread", f"{where} the extension {quoted_value(others[0])}, which is not read")
    for number, tile in enumerate(tileset.tiles):
        yield from _unread(tileset, number, tile)
    try:
        matrices_of(tileset, of_root=True)
    except FormatError as error:
        yield RuleViolation(error.code, str(error))


def _unread(tileset: Tileset, number: int, tile: TileRecord) -> Iterator[RuleViolation]:
    extensions = tile.record.get("extensions")
    implicit = isinstance(extensions, dict) and "3DTILES_implicit_tiling" in extensions
    for key in (*(each for each in UNREAD if each in tile.record), *(["implicit tiling"] if implicit else [])):
        text = f"{tileset.place(number)} has {key}, which is not read; only tiles listed one by one are"
        yield broken("unread", text)
    refine = tile.record.get("refine", REPLACE)
    if refine != REPLACE:
        yield broken("refine", f"{tileset.place(number)} has refine {quoted_value(refine)}; only {REPLACE} is read")
    name = tile.name
    if name is not None and (leads_away(name) or ":" in (tile.uri or "")):
        text = f"{tileset.place(number)} has the content {quoted_value(tile.uri)}, which is not a file below its folder"
        yield broken("files", text)
    elif name is not None and not tile.is_nested and posixpath.splitext(name)[1].lower() not in SPLATS:
        text = f"{tileset.place(number)} has the content {quoted_value(tile.uri)}"
        yield broken("unread", f"{text}; only {', '.join(SPLATS)} and tilesets are read")
    elif tile.is_nested and (len(tile.children) != 1 or tileset.tiles[tile.children[0]].file == tile.file):
        text = f"{tileset.place(number)} has a nested tileset and children beside it, which is not read"
        yield broken("unread", text)
    if "transform" in tile.record and _numbers(tile.record) is None:
        text = f"the transform of {tileset.place(number)} is {quoted_value(tile.record['transform'])}"
        yield broken("transform", f"{text}, not 16 finite numbers that end with 1")


def _numbers(record: Mapping[str, object]) -> list[float] | None:
    """Return the numbers of the "transform" of a tile; None if they are invalid or missing."""
    numbers = record.get("transform")
    if not isinstance(numbers, list) or len(numbers) != 16:
        return None
    if not all(type(each) in (int, float) and math.isfinite(each) for each in numbers):
        return None
    return numbers if numbers[3::4] == [0, 0, 0, 1] else None


def matrix_of(record: Mapping[str, object]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a tile for column vectors, by default the identity."""
    numbers = _numbers(record)
    return np.eye(4) if numbers is None else np.array(numbers, np.float64).reshape(4, 4).T


def matrices_of(tileset: Tileset, *, of_root: bool = False) -> list[NDArray[np.float64]]:
    """Return the (4, 4) transform of each tile to the axes of the tileset; `of_root` includes that of the root."""
    matrices = list[NDArray[np.float64]]()
    for number, tile in enumerate(tileset.tiles):
        matrix = matrices[tile.parent] if tile.parent >= 0 else np.eye(4)
        if "transform" in tile.record and (tile.parent >= 0 or of_root):
            try:
                matrix = product(matrix, matrix_of(tile.record))
            except FormatError as error:
                raise error_of("tiles.transform", f"{tileset.place(number)}: {error}") from None
        matrices.append(matrix)
    return matrices


def depths_of(tileset: Tileset) -> list[int]:
    """Return the depth of each tile; a tile with a nested tileset has the depth of the nested root."""
    depths = list[int]()
    for tile in tileset.tiles:
        above = None if tile.parent < 0 else tileset.tiles[tile.parent]
        depths.append(0 if above is None else depths[tile.parent] + (not above.is_nested))
    return depths


def volumes_of(tileset: Tileset) -> list[Volume | str | None]:
    """Return the bounding volume of each tile in the axes of the tileset, or the other results of `volume_of`."""
    volumes = (volume_of(tile.record.get("boundingVolume")) for tile in tileset.tiles)
    return [
        volume.moved(matrix) if isinstance(volume, Volume) else volume
        for volume, matrix in zip(volumes, matrices_of(tileset), strict=True)
    ]


def violations(tileset: Tileset) -> Iterator[RuleViolation]:
    """Yield the rules that tileset files break, apart from `read_violations`."""
    yield from _heads(tileset)
    yield from _volumes(tileset)
    yield from _errors(tileset)
    seen = set[str]()
    for number, tile in enumerate(tileset.tiles):
        name = tile.name
        if name is not None and name in seen:
            yield broken("shared", f"{tileset.place(number)} has the file {quoted_value(name)}, as a tile before it")
        seen |= set() if name is None else {name}
        if name is None and not tile.children:
            yield broken("empty", f"{tileset.place(number)} has neither children nor content")


def _heads(tileset: Tileset) -> Iterator[RuleViolation]:
    for name, head in tileset.heads.items():
        where = f"{quoted_value(name)} " if name else ""
        version, error = head["asset"].get("version"), head.get("geometricError")
        if version == OLD_VERSION:
            yield broken("old", f"{where}has the version {OLD_VERSION}, not {VERSION}")
        if _number(error) is None:
            text = f"the geometricError of {where or 'the tileset '}is {quoted_value(error)}, not a number from 0 on"
            yield broken("required", text)
    for number, tile in enumerate(tileset.tiles):
        is_root = tile.parent < 0 or tileset.tiles[tile.parent].file != tile.file
        if is_root and "refine" not in tile.record:
            yield broken("required", f"{tileset.place(number)} has no refine, which a root must have")
    root, error = (_number(each.get("geometricError")) for each in (tileset.tiles[0].record, tileset.head))
    if root is not None and error is not None and root > error * (1 + ROUNDING):
        text = f"the geometricError of root is {root:g}, more than that of the tileset, {error:g}"
        yield broken("errors", text, fatal=False)


def _number(value: object) -> float | None:
    """Return a geometric error; None if it is not a finite number from 0 on."""
    is_error = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
    return float(value) if is_error else None  # type: ignore[arg-type]


def _volumes(tileset: Tileset) -> Iterator[RuleViolation]:
    volumes = volumes_of(tileset)
    for number, (tile, own) in enumerate(zip(tileset.tiles, volumes, strict=True)):
        if isinstance(own, str):
            yield broken("volumes", f"the bounding volume of {tileset.place(number)} is {own}")
            continue
        above = volumes[tile.parent] if tile.parent >= 0 else None
        if own is None or not isinstance(above, Volume) or above.holds(own, ROUNDING * max(own.size, above.size)):
            continue
        yield broken("inside", f"the bounding volume of {tileset.place(number)} reaches out of that of the tile above")


def _errors(tileset: Tileset) -> Iterator[RuleViolation]:
    for number, tile in enumerate(tileset.tiles):
        value, place = tile.record.get("geometricError"), f"the geometricError of {tileset.place(number)}"
        error = _number(value)
        if error is None:
            yield broken("errors", f"{place} is {quoted_value(value)}, not a number from 0 on")
            continue
        above = _number(tileset.tiles[tile.parent].record.get("geometricError")) if tile.parent >= 0 else None
        if above is not None and error > above * (1 + ROUNDING):
            yield broken("errors", f"{place} is {error:g}, more than that of the tile above, {above:g}", fatal=False)
        if not tile.children and error:
            yield broken("leaf-error", f"{place} is {error:g}, but it has no children")
        # A tile with a nested tileset, or without splats, is refined whatever its error is.
        if tile.children and not error and tile.uri is not None and not tile.is_nested:
            yield broken("unrefined", f"{place} is 0, but it has children")


def scan_files(tileset: Tileset, files: SceneFiles) -> tuple[dict[int, Chunk], list[RuleViolation]]:
    """Read the header of each tile; return the readable ones by the number of the tile, and the broken rules."""
    chunks, found = dict[int, Chunk](), list[RuleViolation]()
    for number, tile in enumerate(tileset.tiles):
        name = tile.name
        if name is None or tile.is_nested:
            continue
        try:
            chunks[number] = files.open(name)
        except UnsupportedError as error:
            found.append(RuleViolation(error.code, str(error)))
        except FormatError as error:
            found.append(broken("files", str(error)))
    return chunks, [*found, *_kinds(tileset, chunks), *_counts(tileset, chunks)]


def _kinds(tileset: Tileset, chunks: Mapping[int, Chunk]) -> Iterator[RuleViolation]:
    first = next(iter(chunks.values()), None)
    if first is None:
        return
    for chunk in chunks.values():
        if chunk.sh_degree != first.sh_degree:
            text = f"{quoted_value(chunk.name)} has SH degree {chunk.sh_degree}; the first tile has {first.sh_degree}"
            yield broken("sh", text)
        if chunk.up != first.up:
            ups = [f"{each.up} up" if each.up else "no axis noted that points up" for each in (chunk, first)]
            yield broken("kind", f"{quoted_value(chunk.name)} has {ups[0]}; the first tile has {ups[1]}")
    # The name of the format says whether there is an SPZ in a GLB, see `gltf`.
    needed = SPLAT_EXTENSIONS if any("SPZ" in chunk.format for chunk in chunks.values()) else SPLAT_EXTENSIONS[:1]
    for name, head in tileset.heads.items():
        where = f"{quoted_value(name)} does not list" if name else "it does not list"
        if CONTENT_GLTF not in _list(head.get("extensionsUsed")):
            yield broken("extensions", f"{where} {CONTENT_GLTF} in extensionsUsed")
        extensions = head.get("extensions")
        held = extensions.get(CONTENT_GLTF) if isinstance(extensions, dict) else None
        for key in ("extensionsUsed", "extensionsRequired"):
            missing = [each for each in needed if each not in _list(held.get(key) if isinstance(held, dict) else None)]
            if missing:
                yield broken("extensions", f"{where} {' and '.join(missing)} in {key} of {CONTENT_GLTF}")


def _list(value: object) -> Sequence[object]:
    return value if isinstance(value, list) else ()


def _counts(tileset: Tileset, chunks: Mapping[int, Chunk]) -> Iterator[RuleViolation]:
    for number, chunk in chunks.items():
        if chunk.count > LARGE:
            text = f"{quoted_value(chunk.name)} has {count_of(chunk.count, 'splat')}, more than {LARGE:,}"
            yield broken("large", f"{text}, which take long to load")
        below = [tileset.root_of(child) for child in tileset.tiles[number].children]
        if below and all(child in chunks for child in below):
            total = sum(chunks[child].count for child in below)
            if total < chunk.count:
                text = f"the children of {tileset.place(number)} have {count_of(total, 'splat')}"
                yield broken("decreasing", f"{text}, and it has {chunk.count:,}")


def scan_splats(
    tileset: Tileset, files: SceneFiles, chunks: Mapping[int, Chunk], *, threads: int = 1, progress: Progress = silent
) -> Iterator[RuleViolation]:
    """Yield the rules that the splats of tiles break; `chunks` are by tile number, see `SceneFiles.violations`."""
    volumes, numbers = volumes_of(tileset), {chunk.name: number for number, chunk in chunks.items()}

    def broken_by(chunk: Chunk, splats: Splats) -> Iterator[RuleViolation]:
        if (unusable := not_finite(chunk, splats)) is not None:
            yield unusable
            return
        volume, place = volumes[numbers[chunk.name]], tileset.place(numbers[chunk.name])
        outside = _outside(splats, volume, to_tileset(chunk.up)) if isinstance(volume, Volume) else 0
        if outside:
            yield broken("extents", f"{count_of(outside, 'splat')} of {place} lie outside of its bounding volume")

    return files.violations(list(chunks.values()), broken_by, threads, progress)


def _outside(splats: Splats, volume: Volume, rotation: NDArray[np.float64]) -> int:
    """Count the splats outside of a volume; `rotation` is (3, 3), from their axes to those of the volume."""
    if not len(volume.axes):
        far = np.linalg.norm(splats.center @ rotation.T - volume.center, axis=1)
        return int(np.count_nonzero(far > volume.radius * (1 + LOOSE_BOUND)))
    sides = volume.directions()
    middle, half = sides @ volume.center, volume.reach(sides)
    return count_outside(splats, np.stack([middle - half, middle + half]), directions=sides @ rotation)
