"""Writes GLB: an accessor for each attribute of a splat, or an SPZ file inside, by the profile."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ...model.scene import Scene
from ...model.splats import FloatArray, Splats
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from .. import spz
from ..clamps import SPZ, CodeRange
from ..file_notes import note_of
from ..options import CESIUM, DEFAULTS, KHRONOS, WriteOptions
from ..reader import encode_rows
from .attributes import ATTRIBUTES, COMPRESSION, EXTENSION, POINT_COLOR, UNSIGNED, Attribute, sh_attributes
from .glb_container import FLOAT, TYPES, check_length, head_of
from .placement import TURNS, rotation_of_up

#: glTF's number for primitives of points, and the target of vertex attributes.
POINTS, ARRAY_BUFFER = 0, 34962

#: What the values of the extension mean, as they are written.
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}


def profile_of(options: WriteOptions) -> str:
    """Return the profile that is written, `KHRONOS` unless an option names another."""
    return options.glb_profile or KHRONOS


def extensions_of(profile: str) -> list[str]:
    """Return the extensions of glTF that the files of a profile use."""
    return [EXTENSION, COMPRESSION] if profile == CESIUM else [EXTENSION]


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open, those of SPZ, too, which the profile "cesium" has inside.

    Raises:
        FormatError: the scene is a tree, has an opacity above 1, which glTF forbids, or does not fit.
    """
    if scene.tree is not None:
        raise FormatError("GLB holds no Level-of-Detail tree")
    splats = scene.splats
    most = float(splats.opacity.max(initial=0))
    if most > 1:
        raise FormatError(f"GLB holds no opacity above 1, and a splat has {most:g}; extract the leaves, or simplify")
    if profile_of(options) == CESIUM:
        return spz.settled(scene, options)
    check_length(4 * len(splats) * (14 + 3 * splats.sh.shape[1]) + (1 << 16))
    return options


def held(options: WriteOptions, sh_degree: int) -> Sequence[CodeRange]:
    """Return the values that the profile holds without clamping them: all, or those of SPZ."""
    return SPZ if profile_of(options) == CESIUM else ()


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Return the bytes of a GLB, piece by piece; its root node turns the axis that points up, where known, to y.

    The same scene and options give the same bytes for any number of threads.

    Raises:
        FormatError: see `settled`.
    """
    options = settled(scene, options)
    yield from (_encode_spz if profile_of(options) == CESIUM else _encode_plain)(scene, options, threads, progress)


def _encode_plain(scene: Scene, options: WriteOptions, threads: int, progress: Progress) -> Iterator[bytes]:
    splats, count = scene.splats, len(scene.splats)
    attributes = [*ATTRIBUTES, *sh_attributes(splats.sh_degree)]
    views, accessors, offset = [], [], 0
    for number, each in enumerate(attributes):
        size = TYPES[each.type]
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": 4 * size * count, "target": ARRAY_BUFFER})
        accessors.append({"bufferView": number, **_accessor(each.type, count), **_bounds(each, splats)})
        offset += 4 * size * count
    root = _root(scene, attributes, accessors, views, offset, PROPERTIES, required=False)
    yield head_of(root, offset)
    for each in attributes:
        column = each.part_of(splats)

        def rows(part: slice, each: Attribute = each, column: FloatArray = column) -> bytes:
            return np.ascontiguousarray(each.encode(column[part]), "<f4").tobytes()

        yield from encode_rows(rows, count, threads, progress)


def _encode_spz(scene: Scene, options: WriteOptions, threads: int, progress: Progress) -> Iterator[bytes]:
    # The axis that points up is noted in `asset`.
    plain = dataclasses.replace(scene, up=None)
    data = b"".join(spz.encode(plain, options, threads=threads, progress=progress))
    splats, count = scene.splats, len(scene.splats)
    position, rotation, scale, *_ = ATTRIBUTES
    color = Attribute(POINT_COLOR, "VEC4", UNSIGNED, "rgb")
    attributes = [position, color, scale, rotation, *sh_attributes(splats.sh_degree)]
    accessors = [{**_accessor(each.type, count), **_bounds(each, splats)} for each in attributes]
    accessors[1] |= {"componentType": UNSIGNED[0], "normalized": True}  # as CesiumJS unpacks colours and opacities
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(data)}]
    properties = {**PROPERTIES, "extensions": {COMPRESSION: {"bufferView": 0}}}
    padding = bytes(-len(data) % 4)
    root = _root(scene, attributes, accessors, views, len(data) + len(padding), properties, required=True)
    yield head_of(root, len(data) + len(padding))
    yield data + padding


def _accessor(kind: str, count: int) -> dict[str, Any]:
    return {"componentType": FLOAT, "count": count, "type": kind}


def _bounds(attribute: Attribute, splats: Splats) -> dict[str, Any]:
    """Return the bounds of positions, which glTF demands; JSON has their float32 values to the last bit."""
    if attribute.column != "center" or not len(splats):
        return {}
    return {"min": splats.center.min(axis=0).tolist(), "max": splats.center.max(axis=0).tolist()}


def _root(
    scene: Scene,
    attributes: Sequence[Attribute],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    length: int,
    properties: dict[str, Any],
    *,
    required: bool,
) -> dict[str, Any]:
    """Return the JSON of a file with one mesh of one primitive, in one node."""
    note = note_of(antialiased=scene.antialiased, up=scene.up)
    asset = {"version": "2.0", "generator": note.pop("generator")} | ({"extras": note} if note else {})
    extensions = extensions_of(CESIUM if required else KHRONOS)
    return {
        "asset": asset,
        "extensionsUsed": extensions,
        **({"extensionsRequired": extensions} if required else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | _turn(scene.up, as_matrix=required)],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {each.semantic: number for number, each in enumerate(attributes)},
                        "mode": POINTS,
                        "extensions": {EXTENSION: properties},
                    }
                ]
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


def _turn(up: str | None, *, as_matrix: bool) -> dict[str, Any]:
    """Return the turn of a node that makes an axis y. As content of a tile, CesiumJS reads nothing but a matrix."""
    if as_matrix:
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_of_up(up)
        return {"matrix": matrix.T.ravel().tolist()}
    turn = TURNS[up or "y"]
    return {} if turn == TURNS["y"] else {"rotation": turn}
