"""3D Tiles: a tileset.json and a GLB for each tile, whose children replace it by more splats.

Read as a scene, it is full detail, the tiles without children; `decode_parts` reads all tiles. Tilesets of other
programs are read if their tiles are listed one by one, replace their parents, and have glTF with splats.
"""

from __future__ import annotations

import itertools
import json
import posixpath
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.instances import TileScene
from ..model.scene import Scene, common_axis, facts_of
from ..system.errors import FormatError
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..system.untrusted import quoted_value
from . import gltf
from .format_rules import check_rules, error_of
from .formats import CESIUM, TILES, TILESET, WriteOptions
from .gltf_container import transform_of
from .merging import Chunk, SceneFiles, placed
from .reader import Note, OpenCompanion, OpenFile, Reader, note_of
from .tileset import (
    CONTENT_GLTF,
    LARGEST,
    MAX_TILESET,
    REPLACE,
    VERSION,
    Tileset,
    Volume,
    matrices_of,
    matrix_of,
    read_violations,
    read_whole,
    to_tileset,
    turned,
    violations,
    volumes_of,
)

#: Note on scenes whose tileset has a transform.
NOT_PLACED = Note("the transform of the tileset, its place on the Earth, is not applied")

Matrix = NDArray[np.float64]


def open_content(source: OpenFile) -> Reader:
    """Open the tiles without children, one after the other; reading blocks keeps one tile in memory.

    The transform of the root, which places the scene on the Earth, is not applied.
    """
    tileset = _read(source.file, source.open_companion)
    wanted = [number for number, tile in enumerate(tileset.tiles) if not tile.children and tile.uri is not None]
    return _open(source, tileset, wanted)[0]


def decode_parts(
    file: BinaryIO, *, threads: int = 1, progress: Progress = silent, open_companion: OpenCompanion | None = None
) -> TileScene:
    """Read all tiles by level, their depth in the tree; a tile with a nested tileset is one with the nested root."""
    source = OpenFile(file, open_companion, threads=threads)
    tileset = _read(file, open_companion)
    order, parent, level = _hierarchy(tileset)
    held = [number for number in order if tileset.tiles[number].uri is not None]
    content, chunks = _open(source, tileset, held)
    scene = replace(content, threads=threads).scene(progress=progress)
    files = dict(zip(held, ((chunk.rows, chunk.bytes) for chunk in chunks), strict=True))
    counts, sizes = np.array([files.get(number, (0, 0)) for number in order], np.int64).T
    check_rules(violations(tileset))
    volumes = volumes_of(tileset)
    boxes = [volume.bounds() for number in order if isinstance(volume := volumes[number], Volume)]
    if len(boxes) < len(order):
        raise error_of("tiles.volumes", "a bounding volume of it is a region, of which no box is made")
    errors = np.array([float(tileset.tiles[number].record["geometricError"]) for number in order])
    return TileScene(
        scene.splats,
        parent,
        level,
        np.ascontiguousarray(counts),
        errors,
        turned(np.array(boxes), to_tileset(scene.up).T),
        np.ascontiguousarray(sizes),
        _root_transform(tileset),
        **facts_of(scene),
    )


def names_of(data: bytes, open_companion: OpenCompanion) -> list[str]:
    """Return the paths of all files of a tileset, relative to its folder, except buffers without splats."""
    names = dict.fromkeys(read_whole(data, open_companion).names())
    for name in [each for each in names if each.lower().endswith(".gltf")]:
        opened = list[str]()

        def open_buffer(buffer: str, folder: str = posixpath.dirname(name), opened: list[str] = opened) -> BinaryIO:
            opened.append(posixpath.join(folder, buffer))
            return open_companion(opened[-1])

        with open_companion(name) as file:
            gltf.open_content(OpenFile(file, open_buffer))
        names |= dict.fromkeys(opened)
    return list(names)


def _read(file: BinaryIO, open_companion: OpenCompanion | None) -> Tileset:
    tileset = read_whole(file.read(MAX_TILESET + 1), open_companion)
    check_rules(read_violations(tileset))
    return tileset


def _hierarchy(tileset: Tileset) -> tuple[list[int], NDArray[np.int32], NDArray[np.int32]]:
    """Return the tiles without nested tilesets by depth, and the places of their parents and depths."""
    order, parent, level = list[int](), list[int](), list[int]()
    frontier = [(0, -1)]
    while frontier:
        following = list[tuple[int, int]]()
        depth = level[-1] + 1 if level else 0
        for number, above in frontier:
            tile = tileset.root_of(number)
            following += [(child, len(order)) for child in tileset.tiles[tile].children]
            order.append(tile)
            parent.append(above)
            level.append(depth)
        frontier = following
    return order, np.array(parent, np.int32), np.array(level, np.int32)


def _open(source: OpenFile, tileset: Tileset, wanted: Sequence[int]) -> tuple[Reader, list[Chunk]]:
    """Return a reader of tiles, one after the other, and their files."""
    if not wanted:
        raise FormatError("no tile of it has splats")
    matrices, files = matrices_of(tileset), dict[str, int]()
    for number in wanted:
        name = tileset.tiles[number].name
        assert name is not None
        if name in files:
            text = f"two tiles have the content {quoted_value(name)}; such tilesets are not read"
            raise error_of("tiles.shared", text)
        files[name] = number
    beside = tile_files(source.open_companion, {name: matrices[number] for name, number in files.items()})
    chunks, row = list[Chunk](), 0
    for name in files:
        chunks.append(beside.open(name, row=row))
        row += chunks[-1].rows
    form = f"3D Tiles {tileset.head['asset']['version']} of {chunks[0].format}"
    content = beside.reader(chunks, form, {"tiles": len(chunks)}, tileset.bytes, (), source.threads)
    if len({chunk.up for chunk in chunks}) > 1:
        raise error_of("tiles.kind", "the axes that point up in its tiles differ; such tilesets are not read")
    notes = content.notes if np.array_equal(_root_transform(tileset), np.eye(4)) else (*content.notes, NOT_PLACED)
    up, by = common_axis(chunk.up for chunk in chunks), common_axis(chunk.up_by for chunk in chunks) or ""
    return replace(content, notes=notes, up=up, up_by=by), chunks


def tile_files(open_companion: OpenCompanion | None, matrices: dict[str, Matrix]) -> SceneFiles:
    """Return the glTF files of tiles; reading applies their (4, 4) transforms, `matrices` by name."""

    def open_tile(name: str, source: OpenFile) -> Reader:
        content = gltf.open_content(source)
        matrix = matrices.get(name)
        if matrix is None or np.array_equal(matrix, np.eye(4)):
            return content
        turn = np.eye(4)
        turn[:3, :3] = to_tileset(content.up)
        return placed(content, transform_of(turn.T @ matrix @ turn))

    return SceneFiles(open_companion, TILESET, "tiles.files", open_tile)


def _root_transform(tileset: Tileset) -> Matrix:
    return matrix_of(tileset.tiles[0].record)


#: Most tiles of a tileset file; larger trees have nested files, each of at most as many tiles, and of at least
#: `LEAST_NESTED`. A tile takes some 300 bytes of JSON. Chosen.
MOST_TILES, LEAST_NESTED = 1_000, 16

JsonObject = dict[str, Any]


def encode_files(
    scene: TileScene,
    options: WriteOptions,
    *,
    threads: int = 1,
    progress: Progress = silent,
    most_tiles: int = MOST_TILES,
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files of a scene by path, tiles first ("tiles/2-17.glb") and tileset.json last.

    The bytes are the same for any number of threads.

    Args:
        scene: scene with opacities of at most 1.
        options: options of the GLBs, whose profile is "cesium" by default.
        most_tiles: most tiles of a tileset file; more are in nested ones.
    """
    if not (np.abs(scene.bounds) <= LARGEST).all() or not (scene.errors <= LARGEST).all():
        raise FormatError("its splats reach beyond what float32 holds, in which viewers draw; scale it down")
    options = replace(options, glb_profile=options.glb_profile or CESIUM)
    numbers = defaultdict[int, Iterator[int]](itertools.count)
    names = [f"{level}-{next(numbers[level])}" for level in scene.level.tolist()]
    together, done = max(1, min(threads, scene.tiles)), 0

    def encoded(tile: int) -> bytes:
        one = Scene(scene.splats.take(scene.run(tile)), antialiased=scene.antialiased, up=scene.up)
        return b"".join(gltf.encode(one, options, threads=max(1, threads // together)))

    for tile, data in enumerate(ordered_map(encoded, range(scene.tiles), together)):
        yield f"{TILES}/{names[tile]}.glb", [data]
        done += int(scene.counts[tile])
        progress("writing", done, len(scene.splats), "splat")
    yield from _tilesets(scene, options, names, most_tiles)


def _tilesets(
    scene: TileScene, options: WriteOptions, names: list[str], most_tiles: int
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the nested tilesets, and tileset.json last."""
    boxes = turned(scene.bounds, to_tileset(scene.up))
    under = np.ones(scene.tiles, np.int64)
    for tile in reversed(range(1, scene.tiles)):
        under[scene.parent[tile]] += under[tile]
    nested = (under[1:] <= most_tiles) & (under[scene.parent[1:]] > most_tiles) & (under[1:] >= LEAST_NESTED)
    is_nested = np.concatenate([[False], nested])
    in_folder = is_nested.copy()  # tiles in nested tilesets
    for tile in range(1, scene.tiles):
        in_folder[tile] |= in_folder[scene.parent[tile]]
    children: list[list[JsonObject]] = [[] for _ in range(scene.tiles)]
    for tile in reversed(range(scene.tiles)):
        half_x, half_y, half_z = ((boxes[tile, 1] - boxes[tile, 0]) / 2).tolist()
        sides = [half_x, 0.0, 0.0, 0.0, half_y, 0.0, 0.0, 0.0, half_z]
        described: JsonObject = {
            "boundingVolume": {"box": boxes[tile].mean(axis=0).tolist() + sides},
            "geometricError": float(scene.errors[tile]),
            "content": {"uri": f"{'' if in_folder[tile] else TILES + '/'}{names[tile]}.glb"},
        }
        if children[tile]:
            described["children"] = children[tile][::-1]
            children[tile] = []
        if is_nested[tile]:
            inner = _tileset(scene, options, described, described["geometricError"])
            yield f"{TILES}/{names[tile]}.json", [_json(inner)]
            described = {key: described[key] for key in ("boundingVolume", "geometricError")}
            described["content"] = {"uri": f"{TILES}/{names[tile]}.json"}
        if tile:
            children[int(scene.parent[tile])].append(described)
        else:
            diagonal = float(np.linalg.norm(boxes[0, 1] - boxes[0, 0]))
            matrix = scene.transform.T.ravel().tolist()
            root = described | ({} if np.array_equal(scene.transform, np.eye(4)) else {"transform": matrix})
            yield TILESET, [_json(_tileset(scene, options, root, max(diagonal, float(scene.errors[0]))))]


def _tileset(scene: TileScene, options: WriteOptions, root: JsonObject, error: float) -> JsonObject:
    """Return a tileset file; `error` is the geometric error of drawing nothing of it."""
    extensions = gltf.extensions_of(options.glb_profile)
    return {
        "asset": {"version": VERSION, "extras": note_of(antialiased=scene.antialiased, up=scene.up)},
        "geometricError": error,
        "extensionsUsed": [CONTENT_GLTF],
        "extensions": {CONTENT_GLTF: {"extensionsUsed": extensions, "extensionsRequired": extensions}},
        "root": {"refine": REPLACE} | root,
    }


def _json(value: JsonObject) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
