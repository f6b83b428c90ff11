"""GLB with Gaussian splats: KHR_gaussian_splatting, plain or with SPZ inside.

Profile "khronos" is the extension as it was ratified: an accessor for each attribute of a splat. Profile "cesium" is
what CesiumJS reads, the draft KHR_gaussian_splatting_compression_spz_2: a buffer view with an SPZ file, and accessors
without data. Both are read and written. Facts: extensions/2.0/Khronos/ of KhronosGroup/glTF.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...model.gaussian import normalized_quat
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...model.transforms import Transform
from ...support.errors import FormatError, NotSplatsError
from ...support.parallel import blocks_of, ordered_map
from ...support.progress import Progress, silent
from ...support.untrusted import quoted_value
from .. import quantize, spz
from ..clamps import SPZ, CodeRange
from ..content import Content, Source, Target
from ..file_notes import note_of, read_note
from ..options import CESIUM, DEFAULTS, KHRONOS, WriteOptions
from ..stream import Positioned, encode_rows
from .glb_container import FLOAT, TYPES, Accessor, GlbFile, check_length, head_of
from .placement import TURNS, is_turn_of, placement_of, rotation_of_up

EXTENSION, COMPRESSION = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"

#: glTF's number for primitives of points, and the target of vertex attributes.
POINTS, ARRAY_BUFFER = 0, 34962

#: What the values of the extension mean, as they are written, and what other ones that are read mean for a picture.
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}

SIGNED, UNSIGNED = (5120, 5122), (5121, 5123)
Coding = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Attribute:
    """An attribute of a splat.

    Attributes:
        semantic: its name in the file.
        type: of its accessor.
        integers: component types besides float that are read.
        column: of `Splats`.
        decode, encode: between values of the file and of the column.
        term: number of the coefficient of SH; None for other columns.
    """

    semantic: str
    type: str
    integers: tuple[int, ...]
    column: str
    decode: Coding = np.asarray
    encode: Coding = np.asarray
    term: int | None = None

    def part_of(self, splats: Splats) -> FloatArray:
        """Return the view of a column that it fills."""
        column: FloatArray = getattr(splats, self.column)
        return column if self.term is None else column[:, self.term]


#: The attributes of every splat.
ATTRIBUTES = (
    Attribute("POSITION", "VEC3", (*SIGNED, *UNSIGNED), "center"),
    Attribute(f"{EXTENSION}:ROTATION", "VEC4", SIGNED, "quat_xyzw", normalized_quat),
    Attribute(f"{EXTENSION}:SCALE", "VEC3", SIGNED, "scale"),
    Attribute(f"{EXTENSION}:OPACITY", "SCALAR", UNSIGNED, "opacity"),
    Attribute(f"{EXTENSION}:SH_DEGREE_0_COEF_0", "VEC3", (), "rgb", quantize.decode_dc, quantize.encode_dc),
)


def sh_attributes(degree: int) -> list[Attribute]:
    """Return the attributes of SH from degree 1 to a degree, each one coefficient."""
    return [
        Attribute(f"{EXTENSION}:SH_DEGREE_{each}_COEF_{order}", "VEC3", (), "sh", term=each * each - 1 + order)
        for each in range(1, degree + 1)
        for order in range(2 * each + 1)
    ]


def open_content(source: Source) -> Content:
    """Open a GLB with one primitive of splats, in one node, whose transform is applied; y is up, as glTF demands.

    A file of sparklod that notes the axis which points up is read in the axes of its splats, without the turn of the
    node that makes that axis y. In one without that note, the axis is unknown, as it was when the file was written.

    Raises:
        FormatError: the file is no GLB, has no splats or several primitives of them, or is cut short or corrupt.
    """
    file = GlbFile(source.file)
    mesh, primitive = _primitive(file)
    extension = primitive["extensions"][EXTENSION]
    transform, asset = placement_of(file, mesh), file.root.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    extras = asset.get("extras")
    noted = read_note({**(extras if isinstance(extras, dict) else {}), "generator": asset.get("generator")})
    up = None if noted.is_ours else "y"
    if noted.up is not None:
        is_turn = is_turn_of(transform, noted.up)
        transform, up = (Transform(), noted.up) if is_turn else (transform, "y")
    inner = extension.get("extensions")
    packed = inner.get(COMPRESSION) if isinstance(inner, dict) else None
    if packed is not None:
        if not isinstance(packed, dict):
            raise FormatError(f"{COMPRESSION} is {quoted_value(packed)}, not an object")
        data = io.BytesIO(file.bytes_of(packed.get("bufferView")))
        content = spz.open_content(dataclasses.replace(source, file=data, open_companion=None))
        content = dataclasses.replace(content, format=f"GLB {content.format}", up=None)
        if content.has_tree:
            raise FormatError("the SPZ in it has a Level-of-Detail tree, which no glTF has")
    else:
        content = _plain_content(file, primitive, source)
    notes = content.notes + noted.problems
    notes += tuple(
        f"its {name} {quoted_value(extension[name])} is read as {usual}"
        for name, usual in PROPERTIES.items()
        if extension.get(name, usual) != usual
    )
    antialiased = content.antialiased or noted.antialiased
    content = dataclasses.replace(content, notes=notes, antialiased=antialiased, up=up)
    return content if transform.is_identity else placed(content, transform)


def _primitive(file: GlbFile) -> tuple[int, dict[str, Any]]:
    """Return the primitive with splats, and the number of its mesh."""
    found = []
    for number, mesh in enumerate(file.items("meshes")):
        primitives = mesh.get("primitives", [])
        for primitive in primitives if isinstance(primitives, list) else ():
            extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
            if isinstance(extensions, dict) and isinstance(extensions.get(EXTENSION), dict):
                found.append((number, primitive))
    if not found:
        raise NotSplatsError(f"a glTF without splats: no primitive has the extension {EXTENSION}")
    if len(found) > 1:
        raise FormatError(f"{len(found)} primitives have splats; only one is read")
    if found[0][1].get("mode", 4) != POINTS:
        raise FormatError("its splats are no points: the mode of their primitive is not 0")
    return found[0]


def _plain_content(file: GlbFile, primitive: dict[str, Any], source: Source) -> Content:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise FormatError("its splats have no attributes")
    missing = [each.semantic for each in ATTRIBUTES if each.semantic not in attributes]
    if missing:
        raise FormatError(f"its splats have no {', '.join(missing)}")
    degree = 0
    while degree < 3 and all(each.semantic in attributes for each in sh_attributes(degree + 1)):
        degree += 1
    listed = [each.semantic for each in sh_attributes(3) if each.semantic in attributes]
    if len(listed) != COEFFICIENTS[degree]:
        raise FormatError(f"SH of degree {degree + 1} are incomplete: {len(listed)} coefficients in all")
    accessors = [
        (each, file.accessor(attributes[each.semantic], each.type, (FLOAT, *each.integers)))
        for each in (*ATTRIBUTES, *sh_attributes(degree))
    ]
    count = accessors[0][1].count
    if any(accessor.count != count for _, accessor in accessors):
        raise FormatError(f"its attributes have different numbers of values, not all {count:,}")
    positioned = Positioned(source.file)

    def fill(target: Target, threads: int, progress: Progress) -> None:
        parts = blocks_of(len(target.splats))

        @np.errstate(over="ignore", invalid="ignore")  # whether numbers are valid is for others to say
        def read(item: tuple[slice, Attribute, Accessor]) -> slice:
            part, attribute, accessor = item
            out = attribute.part_of(target.splats)[part]
            values = accessor.read(positioned, target.start + part.start, target.start + part.stop)
            out[...] = attribute.decode(values).reshape(out.shape)
            return part

        items = [(part, *each) for part in parts for each in accessors]
        for part in ordered_map(read, items, threads):
            progress("reading", part.stop, len(target.splats), "splat")

    return Content(count, degree, "GLB", fill, header={"bytes": file.size})


def placed(content: Content, transform: Transform) -> Content:
    """Return the content with its splats transformed as they are read; its `up` is that of the transformed ones."""
    axes = ("center", "scale", "quat_xyzw", "sh")

    def fill(target: Target, threads: int, progress: Progress) -> None:
        content.fill(target, threads, progress)
        turned = transform.apply(target.splats)
        for name in axes:
            column = getattr(target.splats, name)
            if getattr(turned, name) is not column:
                column[...] = getattr(turned, name)

    return dataclasses.replace(content, fill=fill)


def profile_of(options: WriteOptions) -> str:
    """Return the profile that is written, which nobody has to choose."""
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
    color = Attribute("COLOR_0", "VEC4", UNSIGNED, "rgb")
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
