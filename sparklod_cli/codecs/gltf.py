"""glTF with Gaussian splats: KHR_gaussian_splatting, plain or with SPZ inside, as GLB or as JSON.

Profile "khronos" is the extension as it was ratified: an accessor for each attribute of a splat. Profile "cesium" is
what CesiumJS reads, the draft KHR_gaussian_splatting_compression_spz_2: a buffer view with an SPZ file, and accessors
without data. Both are read and written. Facts: extensions/2.0/Khronos/ of KhronosGroup/glTF.

All primitives of splats are one scene, each placed by the nodes with its mesh.
"""

from __future__ import annotations

import dataclasses
import io
import re
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ..model import MAX_SH_DEGREE
from ..model.gaussian import normalized_quat
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS, notes_on_degree, width_of
from ..model.splats import FloatArray, Splats
from ..model.transforms import Transform
from ..system.errors import FormatError, NotSplatsError, UnsupportedError
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, ordered_map
from ..system.units import count_of
from ..system.untrusted import quoted_value
from . import quantize, spz
from .compression import check_promise
from .encoder import SPZ_RANGES, CodeRange
from .formats import CESIUM, DEFAULTS, WriteOptions
from .gltf_container import (
    COMPRESSION,
    EXTENSION,
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
from .merging import FillMerged, Placed, copy_rows, placed
from .reader import FileNote, OpenFile, Reader, RowBuffer, encode_rows, left_out, note_of, read_note

#: An extension before the current ones, of primitives, with an SPZ file as `COMPRESSION`.
OLD_COMPRESSION = "KHR_spz_gaussian_splats_compression"

#: Extensions that a file may require, and prefixes of those that change no splats: materials and lights are ignored.
READ = (EXTENSION, COMPRESSION, OLD_COMPRESSION, "KHR_mesh_quantization")
INDIFFERENT = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")

#: Written properties of the extension, the only ones that are read without a note.
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}

#: Another name of the usual colour space, in drafts of the extension, and linear colours.
DRAFT_COLORS, LINEAR_COLORS = "BT.709-sRGB", "lin_rec709_display"

#: glTF's number for primitives of points, and the target of vertex attributes.
POINTS, ARRAY_BUFFER = 0, 34962

#: Prefix of the names of attributes; "_" in the draft that CesiumJS 1.130 read.
PREFIX, DRAFT_PREFIX = f"{EXTENSION}:", "_"

#: Component types of integers.
SIGNED, UNSIGNED = (5120, 5122), (5121, 5123)

Coding = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Attribute:
    """Attribute of a splat, named `semantic` in the file; `type` is that of its accessor.

    Attributes:
        integers: component types besides float that are read.
        column: column of `Splats`.
        decode, encode: conversions between values of the file and of the column.
        term: number of the SH coefficient; None for other columns.
        components: the first component of the accessor that belongs to the column, and the one after the last.
    """

    semantic: str
    type: str
    integers: tuple[int, ...]
    column: str
    decode: Coding = np.asarray
    encode: Coding = np.asarray
    term: int | None = None
    components: tuple[int, int | None] = (0, None)

    def part_of(self, splats: Splats) -> FloatArray:
        """Return the view of the column that the attribute fills."""
        column: FloatArray = getattr(splats, self.column)
        return column if self.term is None else column[:, self.term]


#: Attributes of every splat. Integers of scales are unsigned in the extension, signed in drafts of it.
POSITION, ROTATION, SCALE, OPACITY, COLOR = ATTRIBUTES = (
    Attribute("POSITION", "VEC3", (*SIGNED, *UNSIGNED), "center"),
    Attribute(f"{PREFIX}ROTATION", "VEC4", SIGNED, "quat_xyzw", normalized_quat),
    Attribute(f"{PREFIX}SCALE", "VEC3", (*SIGNED, *UNSIGNED), "scale"),
    Attribute(f"{PREFIX}OPACITY", "SCALAR", UNSIGNED, "opacity"),
    Attribute(f"{PREFIX}SH_DEGREE_0_COEF_0", "VEC3", (), "rgb", quantize.decode_dc, quantize.encode_dc),
)

#: Colour of points for viewers without splats. In drafts it was that of the splats, and their opacity.
POINT_COLOR = Attribute("COLOR_0", "VEC4", UNSIGNED, "rgb", components=(0, 3))
POINT_OPACITY = dataclasses.replace(POINT_COLOR, column="opacity", components=(3, 4))


def sh_attributes(degree: int) -> list[Attribute]:
    """Return the attributes of SH up to a degree, one for each coefficient."""
    return [
        Attribute(f"{PREFIX}SH_DEGREE_{each}_COEF_{order}", "VEC3", (), "sh", term=each * each - 1 + order)
        for each in range(1, degree + 1)
        for order in range(2 * each + 1)
    ]


def attributes_of(names: Mapping[str, Any]) -> tuple[list[Attribute], int]:
    """Choose the attributes that splats are read from among those of a primitive; return them and the SH degree."""

    def named(attribute: Attribute) -> Attribute | None:
        for name in (attribute.semantic, attribute.semantic.replace(PREFIX, DRAFT_PREFIX)):
            if name in names:
                return dataclasses.replace(attribute, semantic=name)
        draft = {OPACITY: POINT_OPACITY, COLOR: POINT_COLOR}.get(attribute)
        return draft if draft is not None and draft.semantic in names else None

    chosen = [found for each in ATTRIBUTES if (found := named(each)) is not None]
    if len(chosen) < len(ATTRIBUTES):
        missing = [each.semantic for each in ATTRIBUTES if named(each) is None]
        raise FormatError(f"its splats have no {', '.join(missing)}")
    terms = [found for each in sh_attributes(MAX_SH_DEGREE) if (found := named(each)) is not None]
    degree = 0
    while degree < MAX_SH_DEGREE and all(named(each) for each in sh_attributes(degree + 1)):
        degree += 1
    if len(terms) != COEFFICIENTS[degree]:
        raise FormatError(f"SH of degree {degree + 1} are incomplete: {len(terms)} coefficients in all")
    return [*chosen, *terms], degree


#: Names of SH coefficients.
_SH_NAME = re.compile(rf"(?:{PREFIX}|{DRAFT_PREFIX})SH_DEGREE_(\d)_COEF_\d+", re.ASCII)


def _unread_attributes(names: Mapping[str, Any], read: Sequence[Attribute]) -> tuple[str, ...]:
    """Return notes on the attributes of a primitive that are not read."""
    others = [name for name in names if name not in {each.semantic for each in read}]
    degrees = {name: int(match[1]) for name in others if (match := _SH_NAME.fullmatch(name))}
    cut = notes_on_degree(max(degrees.values(), default=0))
    return cut + left_out("attribute", "attributes", (name for name in others if name not in degrees))


#: Programs that wrote logarithms in place of scales, as drafts of the extension had them until April 2026: gsbox up to
#: version 4, and splat-transform before version 2.7, of June 2026. The extension demands linear scales.
WRITERS = re.compile(r"gsbox v?[0-4]\.|splat-transform v?(?:1\.|2\.[0-6]\.)", re.ASCII)

#: Share of splats with a scale below 0 from which on scales are logarithms, since broken files have a few; and how far
#: below 0 half of these must be, since linear scales of mirrored splats are small. Chosen.
NEGATIVE, BELOW = 0.1, 0.1

#: Largest ratio of the 99th to the first percentile of positive values that may be logarithms. That of linear scales of
#: real scenes is above 100, that of their logarithms below 10. Chosen.
NARROW = 20.0

#: Fewest splats of which positive values are judged. Chosen.
LEAST = 100

#: Largest linear scale as a multiple of the distance of splats; in real scenes it is 0.8 to 3 times that. Chosen.
WIDE = 8.0

READ_AS_LOGS = (
    "its scales are logarithms, as gsbox and splat-transform before version 2.7 write them, and are read as such"
)


def _are_logs(scales: FloatArray, generator: object) -> bool:
    """Return whether (n, 3) scales, sampled all over a file, are logarithms beyond doubt."""
    if isinstance(generator, str) and WRITERS.match(generator):
        return True
    negative = scales[scales < 0]
    share = float((scales < 0).any(axis=1).mean()) if len(scales) else 0.0
    return share >= NEGATIVE and float((negative < -BELOW).mean()) >= 0.5


def _doubt_about(scales: FloatArray, centers: FloatArray, count: int) -> str | None:
    """Return a note if positive (n, 3) scales, sampled in a file of `count` splats, may be logarithms; else None."""
    if count < LEAST or not (np.isfinite(scales).all() and np.isfinite(centers).all() and (scales > 0).all()):
        return None
    low, middle, high = np.quantile(scales.astype(np.float64), (0.01, 0.5, 0.99))
    sides = np.sort(np.subtract(*np.quantile(centers.astype(np.float64), (0.9, 0.1), axis=0)))
    distance = float(np.sqrt(sides[1] * sides[2] / (0.64 * count)))  # of splats on surfaces, without outliers
    if high > NARROW * low or high - low < 1e-3 or not distance > 0 or middle < 0.1:
        return None
    as_scale, as_log = np.log(middle / distance), middle - np.log(distance)
    if as_scale <= np.log(WIDE) and abs(as_log) > abs(as_scale) - 1:
        return None
    return (
        f"its scales, {low:.3g} to {high:.3g}, look like logarithms, as gsbox and splat-transform before version 2.7"
        " write them, but are read as linear ones; if they are logarithms, write the file anew by a newer version"
    )


#: Most primitives of splats that nodes place. Chosen.
MAX_PARTS = 1 << 14

#: Places of an accessor that are sampled, and values at each, to tell logarithms from scales. Chosen.
PLACES, PLACE_ROWS = 64, 1 << 10

#: Number of a mesh, and of a primitive of it.
Key = tuple[int, int]


def open_content(source: OpenFile) -> Reader:
    """Open a glTF with primitives of splats, each placed by its nodes; y is up, as glTF demands.

    In a file of sparklod that notes its up axis, the node turns that axis to y; it is read without that turn. If such a
    file has no note, the axis is unknown, as it was when the file was written.

    Raises:
        FormatError: the file is no glTF with splats, is damaged, or uses a part of glTF that is not read.
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
    extras, generator = asset.get("extras"), asset.get("generator")
    noted = read_note({**(extras if isinstance(extras, dict) else {}), "generator": generator})
    if noted.up is not None:
        if all(is_turn_of(transform, noted.up) for _, transform in parts):
            parts = [(key, Transform()) for key, _ in parts]
        else:
            noted = FileNote(noted.antialiased, problems=noted.problems)  # another program has turned it
    up, up_by = noted.axis_of("glTF")
    opened, contents, total = dict[Key, Reader](), list[Placed](), 0
    for key, transform in parts:
        if key not in opened:
            opened[key] = _opened(file, primitives[key], source, generator, alone=len(parts) == 1)
        contents.append(Placed(opened[key], "", transform))
        total += opened[key].count * 4 * width_of(opened[key].sh_degree)
        check_promise(total, file.size)
    content = _joined(contents) if len(contents) > 1 else placed(contents[0].reader, contents[0].transform)
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


def _joined(parts: Sequence[Placed]) -> Reader:
    """Join several primitives to one scene; SH coefficients that a primitive does not have become 0."""
    readers = [part.reader for part in parts]
    return Reader(
        sum(reader.count for reader in readers),
        max(reader.sh_degree for reader in readers),
        readers[0].format,
        FillMerged(tuple(parts)),
        any(reader.antialiased for reader in readers),
        tuple(note for reader in readers for note in reader.notes),
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
    """Return the extensions of an object of the JSON that are objects themselves."""
    found = record.get("extensions")
    return {name: each for name, each in found.items() if isinstance(each, dict)} if isinstance(found, dict) else {}


def _parts(file: GltfFile, primitives: Mapping[Key, dict[str, Any]]) -> tuple[list[tuple[Key, Transform]], list[str]]:
    """Place primitives by their nodes; return them with their transforms, and notes on everything left out."""
    nodes, by_mesh, notes = GltfNodes(file), dict[int, list[Key]](), list[str]()
    for key in primitives:
        by_mesh.setdefault(key[0], []).append(key)
    having, hidden = nodes.having(by_mesh)
    placing = [nodes.records[node] for node in having]
    if max(len(primitives), sum(len(by_mesh[record["mesh"]]) for record in placing)) > MAX_PARTS:
        raise UnsupportedError(f"it has more than {MAX_PARTS:,} primitives of splats, counted once for each node")
    parts = list[tuple[Key, Transform]]()
    for node, record in zip(having, placing, strict=True):
        transform = transform_of(nodes.matrix(node))
        parts += [(key, transform) for key in by_mesh[record["mesh"]]]
    if hidden:
        notes.append(f"left out: {count_of(hidden, 'node')} with splats outside of the scene that viewers show")
    unplaced = len(by_mesh) - len({record["mesh"] for record in placing})
    if having and unplaced:
        notes.append(f"left out: {count_of(unplaced, 'mesh', 'meshes')} of splats that no node places")
    others = sum(len(mesh["primitives"]) for mesh in file.items("meshes") if isinstance(mesh.get("primitives"), list))
    if others > len(primitives):
        notes.append(f"left out: {count_of(others - len(primitives), 'primitive')} without splats")
    if file.root.get("animations"):
        notes.append("left out: its animations")
    if any(primitive.get("targets") for primitive in primitives.values()):
        notes.append("left out: the morph targets of its splats")
    own = [_extensions(primitive) for primitive in primitives.values()]
    inner = [_extensions(each.get(EXTENSION, {})) for each in own]
    names = (name for each in (*map(_extensions, placing), *own, *inner) for name in each)
    unread = (name for name in names if name not in READ and not name.startswith(INDIFFERENT))
    notes += left_out("extension", "extensions", unread)
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
    notes = list(_unread_attributes(names, attributes))
    by_column = {each.column: accessor for each, accessor in accessors}
    scales, centers = (_sampled(file, by_column[each.column]) for each in (SCALE, POSITION))
    if _are_logs(scales, generator):
        notes.append(READ_AS_LOGS)
        accessors = [
            (dataclasses.replace(each, decode=np.exp) if each.column == SCALE.column else each, accessor)
            for each, accessor in accessors
        ]
    elif doubt := _doubt_about(scales, centers, count):
        notes.append(doubt)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        with file.readers({accessor.buffer for _, accessor in accessors}) as readers:

            @np.errstate(over="ignore", invalid="ignore")  # callers check the numbers
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
    """Read a sample of values from all over an accessor."""
    rows = min(PLACE_ROWS, accessor.count)
    starts = sorted({(accessor.count - rows) * place // (PLACES - 1) for place in range(PLACES)}) if rows else []
    with file.readers([accessor.buffer]) as readers, np.errstate(over="ignore", invalid="ignore"):
        values = [accessor.read(readers, start, start + rows) for start in starts]
    return np.concatenate([np.empty((0, accessor.width), np.float32), *values])


def _reopened(opened: Callable[[], Reader]) -> Reader:
    """Return a reader that decodes all splats at the first read, and keeps them until it has read the last row."""
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


def extensions_of(profile: str | None) -> list[str]:
    """Return the extensions of glTF that the files of a profile use."""
    return [EXTENSION, COMPRESSION] if profile == CESIUM else [EXTENSION]


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open, also of SPZ inside; `FormatError` if glTF cannot hold the scene."""
    if scene.tree is not None:
        raise FormatError("GLB holds no Level-of-Detail tree")
    splats = scene.splats
    most = float(splats.opacity.max(initial=0))
    if most > 1:
        raise FormatError(f"GLB holds no opacity above 1, and a splat has {most:g}; extract the leaves, or simplify")
    if options.glb_profile == CESIUM:
        return spz.settled(scene, options)
    check_length(4 * len(splats) * (14 + 3 * splats.sh.shape[1]) + (1 << 16))
    return options


def held(options: WriteOptions, sh_degree: int) -> Sequence[CodeRange]:
    """Return the ranges of values that a profile clamps: those of SPZ, or none."""
    return SPZ_RANGES if options.glb_profile == CESIUM else ()


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Encode a GLB piece by piece, whose root node turns a known up axis to y; raises as `settled`.

    The same scene and options give the same bytes for any number of threads.
    """
    options = settled(scene, options)
    splats, count = scene.splats, len(scene.splats)
    if options.glb_profile == CESIUM:
        plain = dataclasses.replace(scene, up=None)  # `asset` notes the axis
        data = b"".join(spz.encode(plain, options, threads=threads, progress=progress))
        attributes = [POSITION, POINT_COLOR, SCALE, ROTATION, *sh_attributes(splats.sh_degree)]
        accessors = [_accessor(each, splats) for each in attributes]
        accessors[1] |= {"componentType": UNSIGNED[0], "normalized": True}  # as CesiumJS unpacks colours and opacities
        views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(data)}]
        data += bytes(-len(data) % 4)
        yield _head(scene, attributes, accessors, views, len(data), cesium=True)
        yield data
        return
    attributes = [*ATTRIBUTES, *sh_attributes(splats.sh_degree)]
    views, accessors, offset = [], [], 0
    for number, each in enumerate(attributes):
        size = 4 * TYPES[each.type] * count
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, "target": ARRAY_BUFFER})
        accessors.append({"bufferView": number, **_accessor(each, splats)})
        offset += size
    yield _head(scene, attributes, accessors, views, offset, cesium=False)
    for each in attributes:
        column = each.part_of(splats)

        def rows(part: slice, each: Attribute = each, column: FloatArray = column) -> bytes:
            return np.ascontiguousarray(each.encode(column[part]), "<f4").tobytes()

        yield from encode_rows(rows, count, threads, progress)


def _accessor(attribute: Attribute, splats: Splats) -> dict[str, Any]:
    """Describe an attribute; positions need bounds, whose float32 values JSON holds to the last bit."""
    accessor = {"componentType": FLOAT, "count": len(splats), "type": attribute.type}
    if attribute is not POSITION or not len(splats):
        return accessor
    return accessor | {"min": splats.center.min(axis=0).tolist(), "max": splats.center.max(axis=0).tolist()}


def _head(
    scene: Scene,
    attributes: Sequence[Attribute],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    length: int,
    *,
    cesium: bool,
) -> bytes:
    """Encode everything before `length` bytes of content."""
    note = note_of(antialiased=scene.antialiased, up=scene.up)
    asset = {"version": "2.0", "generator": note.pop("generator")} | ({"extras": note} if note else {})
    extensions = extensions_of(CESIUM if cesium else None)
    primitive = {
        "attributes": {each.semantic: number for number, each in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {
            EXTENSION: PROPERTIES | ({"extensions": {COMPRESSION: {"bufferView": 0}}} if cesium else {}),
        },
    }
    root = {
        "asset": asset,
        "extensionsUsed": extensions,
        **({"extensionsRequired": extensions} if cesium else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | _turn(scene.up, as_matrix=cesium)],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }
    return head_of(root, length)


def _turn(up: str | None, *, as_matrix: bool) -> dict[str, Any]:
    """Return the turn of a node that makes an axis y. In the content of a tile, CesiumJS reads nothing but a matrix."""
    if as_matrix:
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_of_up(up)
        return {"matrix": matrix.T.ravel().tolist()}
    turn = TURNS[up or "y"]
    return {} if turn == TURNS["y"] else {"rotation": turn}
