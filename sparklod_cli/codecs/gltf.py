"""glTF with Gaussian splats: KHR_gaussian_splatting, plain or with SPZ inside, as GLB or as JSON.

Profile "khronos" is the extension as it was ratified: an accessor for each attribute of a splat. Profile "cesium" is
what CesiumJS reads, the draft KHR_gaussian_splatting_compression_spz_2: a buffer view with an SPZ file, and accessors
without data. Both are read and written. Facts: extensions/2.0/Khronos/ of KhronosGroup/glTF.

All primitives of splats are one scene, each where the nodes with its mesh put it.
"""

from __future__ import annotations

import dataclasses
import io
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np

from ..model.scene import Scene
from ..model.sh import width_of
from ..model.splats import FloatArray, Splats
from ..model.transforms import Transform
from ..system.errors import FormatError, NotSplatsError, UnsupportedError
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, ordered_map
from ..system.units import count_of
from ..system.untrusted import quoted_value
from . import spz
from .compression import check_promise
from .encoder import SPZ_RANGES, CodeRange
from .formats import CESIUM, DEFAULTS, KHRONOS, WriteOptions
from .gltf_attributes import (
    ATTRIBUTES,
    COMPRESSION,
    EXTENSION,
    OLD_COMPRESSION,
    POINT_COLOR,
    POSITION,
    READ_AS_LOGS,
    SCALE,
    UNSIGNED,
    Attribute,
    are_logs,
    attributes_of,
    doubt_about,
    notes_on,
    sh_attributes,
)
from .gltf_container import (
    FLOAT,
    TURNS,
    TYPES,
    Accessor,
    GltfFile,
    GltfNodes,
    check_length,
    head_of,
    is_turn_of,
    rotation_of_up,
    transform_of,
)
from .merging import copy_rows
from .reader import FileNote, OpenFile, Reader, RowBuffer, encode_rows, left_out, note_of, read_note

#: Extensions that a file may require, and how those begin that change no splats: materials and lights are ignored.
READ = (EXTENSION, COMPRESSION, OLD_COMPRESSION, "KHR_mesh_quantization")
INDIFFERENT = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")

#: Another name for the usual colour space, in drafts of the extension, and linear colours.
DRAFT_COLORS, LINEAR_COLORS = "BT.709-sRGB", "lin_rec709_display"

#: Most primitives of splats that nodes place. Chosen.
MAX_PARTS = 1 << 14

#: Places of an accessor that are sampled, and values at each, to tell logarithms from scales. Chosen.
PLACES, PLACE_ROWS = 64, 1 << 10

#: Number of a mesh, and of a primitive of it; and a primitive with the transform to the scene that its node has.
Key = tuple[int, int]
PlacedPrimitive = tuple[Key, Transform]


def open_content(source: OpenFile) -> Reader:
    """Open a glTF with primitives of splats, each placed by its nodes; y is up, as glTF demands.

    A file of sparklod that notes the axis which points up is read in the axes of its splats, without the turn of the
    node that makes that axis y. In one without that note, the axis is unknown, as it was when the file was written.

    Raises:
        FormatError: the file is no glTF, has no splats, uses something of glTF that is not read, or is cut short or
            corrupt.
    """
    file = GltfFile(source)
    primitives = _primitives(file)
    required = file.root.get("extensionsRequired", [])
    for name in required if isinstance(required, list) else [required]:
        if name not in READ and not str(name).startswith(INDIFFERENT):
            raise UnsupportedError(f"it requires the extension {quoted_value(name)}, which is not read")
    parts, notes = _parts(file, primitives)
    asset = file.root.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    extras = asset.get("extras")
    noted = read_note({**(extras if isinstance(extras, dict) else {}), "generator": asset.get("generator")})
    if noted.up is not None:
        if all(is_turn_of(transform, noted.up) for _, transform in parts):
            parts = [(key, Transform()) for key, _ in parts]
        else:
            noted = FileNote(noted.antialiased, problems=noted.problems)  # another program has turned it
    up, up_by = noted.axis_of("glTF")
    opened, contents, total = dict[Key, Reader](), list[Reader](), 0
    for key, transform in parts:
        if key not in opened:
            opened[key] = _opened(file, primitives[key], source, asset.get("generator"), alone=len(parts) == 1)
        contents.append(placed(opened[key], transform))
        total += contents[-1].count * 4 * width_of(contents[-1].sh_degree)
        check_promise(total, file.size)
    content = contents[0] if len(contents) == 1 else _joined(contents)
    check_promise(content.count * 4 * width_of(content.sh_degree), file.size)
    return dataclasses.replace(
        content,
        format=("GLB" if file.is_binary else "glTF") + f" {content.format}" * bool(content.format),
        antialiased=content.antialiased or noted.antialiased,
        notes=tuple(dict.fromkeys([*notes, *content.notes, *noted.problems])),
        header=ChainMap({"bytes": file.size}, cast("dict[str, int]", content.header)),  # to which reading adds
        up=up,
        up_by=up_by,
    )


def _primitives(file: GltfFile) -> dict[Key, dict[str, Any]]:
    found = dict[Key, dict[str, Any]]()
    for number, mesh in enumerate(file.items("meshes")):
        primitives = mesh.get("primitives", [])
        for order, primitive in enumerate(primitives if isinstance(primitives, list) else ()):
            if isinstance(primitive, dict) and {EXTENSION, OLD_COMPRESSION} & _extensions(primitive).keys():
                found[number, order] = primitive
    if not found:
        raise NotSplatsError(f"a glTF without splats: no primitive has the extension {EXTENSION}")
    if any(primitive.get("mode", 4) != POINTS for primitive in found.values()):
        raise FormatError("its splats are no points: the mode of their primitive is not 0")
    return found


def _extensions(record: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the extensions of an object of the JSON whose values are objects, too."""
    found = record.get("extensions")
    return {name: each for name, each in found.items() if isinstance(each, dict)} if isinstance(found, dict) else {}


def _parts(file: GltfFile, primitives: Mapping[Key, dict[str, Any]]) -> tuple[list[PlacedPrimitive], list[str]]:
    """Return the placed primitives, and notes on the rest of the file, which is left out."""
    nodes, by_mesh, notes = GltfNodes(file), dict[int, list[Key]](), list[str]()
    for key in primitives:
        by_mesh.setdefault(key[0], []).append(key)
    having, hidden = nodes.having(by_mesh)
    if max(len(primitives), sum(len(by_mesh[nodes.records[node]["mesh"]]) for node in having)) > MAX_PARTS:
        raise UnsupportedError(f"it has more than {MAX_PARTS:,} primitives of splats, counted once for each node")
    parts, unknown = list[PlacedPrimitive](), dict[str, None]()
    for node in having:
        record = nodes.records[node]
        transform = transform_of(nodes.matrix(node))
        parts += [(key, transform) for key in by_mesh[record["mesh"]]]
        unknown |= dict.fromkeys(_extensions(record))
    if hidden:
        notes.append(f"left out: {count_of(hidden, 'node')} with splats outside of the scene that viewers show")
    unplaced = len(by_mesh) - len({nodes.records[node]["mesh"] for node in having})
    if having and unplaced:
        notes.append(f"left out: {count_of(unplaced, 'mesh', 'meshes')} of splats that no node places")
    others = sum(len(mesh["primitives"]) for mesh in file.items("meshes") if isinstance(mesh.get("primitives"), list))
    others -= len(primitives)
    if others:
        notes.append(f"left out: {count_of(others, 'primitive')} without splats")
    if file.root.get("animations"):
        notes.append("left out: its animations")
    if any(primitive.get("targets") for primitive in primitives.values()):
        notes.append("left out: the morph targets of its splats")
    for primitive in primitives.values():
        unknown |= dict.fromkeys([*_extensions(primitive), *_extensions(_extensions(primitive).get(EXTENSION, {}))])
    notes += left_out(
        "extension", "extensions", (name for name in unknown if name not in READ and not name.startswith(INDIFFERENT))
    )
    return parts or [(key, Transform()) for key in primitives], notes


def _opened(file: GltfFile, primitive: dict[str, Any], source: OpenFile, generator: object, *, alone: bool) -> Reader:
    """Open a primitive in the axes of its mesh; `alone` if it is the whole scene, so that its rows are read once."""
    extensions = _extensions(primitive)
    extension = extensions.get(EXTENSION, {})
    packed = _extensions(extension).get(COMPRESSION, extensions.get(OLD_COMPRESSION))
    if packed is None:
        content = _plain_content(file, primitive, generator)
    else:
        view = packed.get("bufferView")

        def unpacked(*, whole: bool = False) -> Reader:
            data = io.BytesIO(file.bytes_of(view))
            scratch = None if whole else source.scratch
            found = spz.open_content(OpenFile(data, scratch=scratch, threads=source.threads))
            if found.has_tree:
                raise UnsupportedError("the SPZ in it has a Level-of-Detail tree, which no glTF has")
            return found

        content = unpacked() if alone else _reopened(lambda: unpacked(whole=True))
    notes = tuple(
        f"its {name} {quoted_value(extension[name])} is read as {usual}"
        + ", which makes its colours too dark" * (extension[name] == LINEAR_COLORS)
        for name, usual in PROPERTIES.items()
        if extension.get(name, usual) not in (usual, DRAFT_COLORS)
    )
    return dataclasses.replace(content, notes=content.notes + notes)


def _plain_content(file: GltfFile, primitive: dict[str, Any], generator: object) -> Reader:
    names = primitive.get("attributes")
    if not isinstance(names, dict):
        raise FormatError("its splats have no attributes")
    attributes, degree = attributes_of(names)
    accessors = [(each, file.accessor(names[each.semantic], each.type, (FLOAT, *each.integers))) for each in attributes]
    count = accessors[0][1].count
    if any(accessor.count != count for _, accessor in accessors):
        raise FormatError(f"its attributes have different numbers of values, not all {count:,}")
    notes = list(notes_on(names, attributes))
    scales, centers = (
        _sampled(file, accessor)
        for wanted in (SCALE, POSITION)
        for each, accessor in accessors
        if each.column == wanted.column
    )
    if are_logs(scales, generator):
        notes.append(READ_AS_LOGS)
        accessors = [
            (dataclasses.replace(each, decode=np.exp) if each.column == SCALE.column else each, accessor)
            for each, accessor in accessors
        ]
    elif doubt := doubt_about(scales, centers, count):
        notes.append(doubt)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        with file.readers({accessor.buffer for _, accessor in accessors}) as readers:

            @np.errstate(over="ignore", invalid="ignore")  # whether numbers are valid is for others to say
            def read(item: tuple[slice, Attribute, Accessor]) -> slice:
                part, attribute, accessor = item
                out = attribute.part_of(target.splats)[part]
                values = accessor.read(readers, target.start + part.start, target.start + part.stop)
                out[...] = attribute.decode(values[:, slice(*attribute.components)]).reshape(out.shape)
                return part

            items = [(part, *each) for part in blocks_of(len(target.splats)) for each in accessors]
            for part in ordered_map(read, items, threads):
                progress("reading", part.stop, len(target.splats), "splat")

    return Reader(count, degree, "", fill, notes=tuple(notes))


def _sampled(file: GltfFile, accessor: Accessor) -> FloatArray:
    """Return values from all over an accessor."""
    rows = min(PLACE_ROWS, accessor.count)
    starts = sorted({(accessor.count - rows) * place // (PLACES - 1) for place in range(PLACES)}) if rows else []
    with file.readers([accessor.buffer]) as readers, np.errstate(over="ignore", invalid="ignore"):
        values = [accessor.read(readers, start, start + rows) for start in starts]
    return np.concatenate([np.empty((0, accessor.width), np.float32), *values])


def _reopened(opened: Callable[[], Reader]) -> Reader:
    """Return a content that decodes all splats at the first read, and keeps them until the last row was read."""
    content, held = opened(), list[Splats]()

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        if not held:
            splats = Splats.empty(content.count, content.sh_degree)
            opened().fill(RowBuffer(splats), threads, progress)
            held.append(splats)
        copy_rows(held[0].take(slice(target.start, target.stop)), target.splats)
        if target.stop == content.count:
            held.clear()

    return dataclasses.replace(content, fill=fill)


def _joined(contents: Sequence[Reader]) -> Reader:
    """Return the splats of several contents as one; SH coefficients that one does not have become 0."""
    degree = max(content.sh_degree for content in contents)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        done = 0
        for number, part, rows in target.shares(content.count for content in contents):
            content = contents[number]
            own = rows if content.sh_degree == degree else Splats.empty(len(rows), content.sh_degree)
            content.fill(RowBuffer(own, part.start, columns=target.columns), threads, silent)
            if own is not rows:
                copy_rows(own, rows)
            done += len(rows)
            progress("reading", done, len(target.splats), "splat")

    first, notes = contents[0], [note for content in contents for note in content.notes]
    antialiased = any(content.antialiased for content in contents)
    return Reader(sum(content.count for content in contents), degree, first.format, fill, antialiased, tuple(notes))


def placed(content: Reader, transform: Transform) -> Reader:
    """Return the content with its splats transformed as they are read; its `up` is that of the transformed ones."""
    if transform.is_identity:
        return content
    axes = ("center", "scale", "quat_xyzw", "sh")

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        content.fill(target, threads, progress)
        turned = transform.apply(target.splats)
        for name in axes:
            column = getattr(target.splats, name)
            if getattr(turned, name) is not column:
                column[...] = getattr(turned, name)

    return dataclasses.replace(content, fill=fill)


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
    return SPZ_RANGES if profile_of(options) == CESIUM else ()


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
