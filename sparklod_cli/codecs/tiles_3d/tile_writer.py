"""Writes 3D Tiles: a GLB for each tile, nested tilesets where there are many tiles, and tileset.json."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ...model.scene import Scene
from ...model.tile_scene import TileScene
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from ...system.threads import ordered_map
from ..file_names import TILES, TILESET
from ..file_notes import note_of
from ..glb import codec as glb
from ..options import CESIUM, WriteOptions
from .tileset import CONTENT_GLTF, REPLACE, VERSION
from .volumes import LARGEST, to_tileset, turned

#: Tiles of a tileset file from which on its subtrees go to files of their own, each of at most as many; and the least
#: tiles for which such a file is made. A tile takes some 300 bytes of JSON. Chosen.
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
    """Return the files of a scene by name, tiles first ("tiles/2-17.glb") and tileset.json last.

    The bytes are the same for any number of threads.

    Args:
        scene: whose splats are valid, with opacities of at most 1.
        options: the profile of the GLBs is "cesium" unless they say otherwise.
        most_tiles: of a tileset file; more are in nested ones.

    Raises:
        FormatError: the tiles cannot hold the splats, or JSON not the extent of the scene.
    """
    if not (np.abs(scene.bounds) <= LARGEST).all() or not (scene.errors <= LARGEST).all():
        raise FormatError("its splats reach beyond what float32 holds, in which viewers draw; scale it down")
    options = replace(options, glb_profile=options.glb_profile or CESIUM)
    names, together, done = tile_names(scene), max(1, min(threads, scene.tiles)), 0

    def encoded(tile: int) -> bytes:
        one = Scene(scene.splats.rows(scene.run(tile)), antialiased=scene.antialiased, up=scene.up)
        return b"".join(glb.encode(one, options, threads=max(1, threads // together)))

    for tile, data in enumerate(ordered_map(encoded, range(scene.tiles), together)):
        yield f"{TILES}/{names[tile]}.glb", [data]
        done += int(scene.counts[tile])
        progress("writing", done, len(scene.splats), "splat")
    yield from _tilesets(scene, options, names, most_tiles)


def tile_names(scene: TileScene) -> list[str]:
    """Return the name of each tile, its level and its number there, without a suffix."""
    numbers = defaultdict[int, Iterator[int]](itertools.count)
    return [f"{level}-{next(numbers[level])}" for level in scene.level.tolist()]


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
    in_folder = is_nested.copy()  # tiles that a nested tileset describes
    for tile in range(1, scene.tiles):
        in_folder[tile] |= in_folder[scene.parent[tile]]
    children: list[list[JsonObject]] = [[] for _ in range(scene.tiles)]
    for tile in reversed(range(scene.tiles)):
        described: JsonObject = {
            "boundingVolume": {"box": box_of(boxes[tile])},
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


def box_of(corners: Any) -> list[float]:
    """Return the numbers of a bounding volume "box": its middle, and half of its sides."""
    (a, b, c), (d, e, f) = (corners.mean(axis=0).tolist(), ((corners[1] - corners[0]) / 2).tolist())
    return [a, b, c, d, 0.0, 0.0, 0.0, e, 0.0, 0.0, 0.0, f]


def _tileset(scene: TileScene, options: WriteOptions, root: JsonObject, error: float) -> JsonObject:
    """Return a tileset.

    Args:
        error: the geometric error where nothing of it is drawn.
    """
    extensions = glb.extensions_of(options.glb_profile or CESIUM)
    return {
        "asset": {"version": VERSION, "extras": note_of(antialiased=scene.antialiased, up=scene.up)},
        "geometricError": error,
        "extensionsUsed": [CONTENT_GLTF],
        "extensions": {CONTENT_GLTF: {"extensionsUsed": extensions, "extensionsRequired": extensions}},
        "root": {"refine": REPLACE} | root,
    }


def _json(value: JsonObject) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
