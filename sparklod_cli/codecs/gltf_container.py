"""Containers of glTF, binary or JSON: buffers, accessors, whose bounds are checked before they are read, and nodes.

Buffers are the BIN chunk, data within the JSON, or files beside it. Facts: the glTF 2.0 specification, sections 3.6
(binary data), 3.5 (nodes) and 4.4 (the GLB layout).
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import io
import json
import math
import posixpath
import re
import struct
import urllib.parse
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import rotation_matrices
from ..model.splats import FloatArray
from ..model.transforms import LARGEST, Transform, scale_of
from ..system.errors import FormatError, TruncatedError, UnsupportedError, VersionError
from ..system.untrusted import Json, Origin, quoted_value
from .format_rules import leads_away
from .reader import OpenFile, size_of

#: Extensions of splats: plain, and with SPZ inside.
EXTENSION, COMPRESSION = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"

#: Header of a binary file: magic, version and length; and of a chunk: length and type.
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAGIC, VERSION = b"glTF", 2
JSON, BIN = b"JSON", b"BIN\0"

#: Largest binary file, and largest number of bytes in the JSON: lengths have 32 bits.
MAX_BYTES = (1 << 32) - 1

#: Largest JSON in bytes, without the data within it. Splats take some thousands, meshes beside them may take more.
MAX_JSON = 1 << 22

#: Largest JSON in bytes, with the data within it; all of it is in memory. Chosen.
MAX_TEXT = 1 << 30

#: Data within the JSON: base64 needs no escapes.
_DATA = re.compile(rb'"data:[^"\\]*"')

#: numpy types of component types.
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
FLOAT = 5126

#: Number of components of the types of accessors that splats have.
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

#: Largest stride of a buffer view in bytes.
MAX_STRIDE = 252


@dataclass(frozen=True)
class Buffer:
    """Bytes that buffer views divide: a part of a file, or `data` within the JSON.

    Attributes:
        name: path relative to the folder of the JSON; None for the file with the JSON.
    """

    start: int
    length: int
    name: str | None = None
    data: bytes | None = None


#: Open buffers by their numbers.
Readers = Mapping[int, OpenFile]


@dataclass(frozen=True)
class Accessor:
    """`count` values of `width` components in a buffer.

    Attributes:
        offset: position of the first value in the file of the buffer.
        stride: bytes from one value to the next.
        normalized: integers mean 0..1, or -1..1.
    """

    buffer: int
    offset: int
    stride: int
    count: int
    width: int
    dtype: np.dtype[Any]
    normalized: bool

    def read(self, readers: Readers, start: int, stop: int) -> FloatArray:
        """Read (stop - start, width) float32 values."""
        length = (stop - start - 1) * self.stride + self.width * self.dtype.itemsize
        data = readers[self.buffer].read_at(self.offset + start * self.stride, length)
        if len(data) < length:
            raise TruncatedError(f"cut short inside the values of splats {start:,} to {stop:,}")
        strides = self.stride, self.dtype.itemsize
        codes: NDArray[Any] = np.ndarray((stop - start, self.width), self.dtype, data, strides=strides)
        values = codes.astype(np.float32)
        if self.normalized:
            values = np.maximum(values / np.float32(np.iinfo(self.dtype).max), np.float32(-1))
        return values


class GltfFile:
    """glTF file: `root`, its JSON, and buffers, which are opened on demand; `FormatError` if it is no glTF 2."""

    def __init__(self, source: OpenFile) -> None:
        self._file, self._open_companion = source.file, source.open_companion
        self._size = size_of(self._file)
        self._chunk: Buffer | None = None
        self._buffers: dict[int, Buffer] = {}
        self._arrays: dict[str, list[dict[str, Any]]] = {}
        self._data: list[memoryview] = []
        head = self._file.read(HEADER.size)
        self.is_binary = head[:4] == MAGIC
        if self.is_binary:
            text = self._chunks(head)
        else:
            self._file.seek(0)
            text = self._file.read(MAX_TEXT + 1)
        self.root = self._parsed(text)
        if not isinstance(self.root, dict):
            raise FormatError("its JSON is no object")
        asset = self.root.get("asset")
        version = asset.get("version") if isinstance(asset, dict) else None
        if not self.is_binary and not str(version).startswith(f"{VERSION}."):
            raise VersionError(f"glTF version {quoted_value(version)} is unknown, only {VERSION} is read")

    def _chunks(self, head: bytes) -> bytes:
        """Return the JSON of a GLB, and set the place of its BIN chunk."""
        if len(head) < HEADER.size:
            raise TruncatedError("cut short inside its header")
        _, version, length = HEADER.unpack(head)
        if version != VERSION:
            raise VersionError(f"binary glTF version {version} is unknown, only {VERSION} is read")
        if length > self._size:
            raise TruncatedError(f"cut short: its header announces {length:,} bytes, and it has {self._size:,}")
        at, text = HEADER.size, b""
        for expected, name in ((JSON, "JSON"), (BIN, "BIN")):
            if at == length and expected == BIN:
                break
            self._file.seek(at)
            head = self._file.read(CHUNK.size)
            size, kind = CHUNK.unpack(head) if len(head) == CHUNK.size else (0, b"")
            if kind != expected:
                raise FormatError(f"its {name} chunk is missing")
            at += CHUNK.size
            if at + size > length:
                raise TruncatedError(f"cut short inside its {name} chunk")
            if kind == JSON:
                text = self._file.read(min(size, MAX_TEXT + 1))
            else:
                self._chunk = Buffer(at, size)
            at += size
        return text

    def _parsed(self, text: bytes) -> Any:
        """Parse a JSON text whose data are taken out to `_data`, and replaced by their number there."""
        if len(text) > MAX_TEXT:
            reason = f"its JSON has more than the {MAX_TEXT:,} bytes that are read"
            raise UnsupportedError(f"{reason}; write it as GLB, or its buffers as files")
        view = memoryview(text)

        def number_of(match: re.Match[bytes]) -> bytes:
            self._data.append(view[match.start() + 1 : match.end() - 1])
            return b'"data:%d"' % (len(self._data) - 1)

        short = _DATA.sub(number_of, text)
        if len(short) > MAX_JSON:
            raise UnsupportedError(f"its JSON of {len(short):,} bytes is larger than the {MAX_JSON:,} that are read")
        return Json.parse(short, Origin("its content", FormatError)).value

    @property
    def size(self) -> int:
        """Size of the file and of the buffer files that were opened so far, in bytes."""
        named = {each.name: each.length for each in self._buffers.values() if each.name is not None}
        return self._size + sum(named.values())

    def items(self, name: str) -> list[dict[str, Any]]:
        """Return the objects of an array of the JSON, such as "nodes"."""
        if name not in self._arrays:
            found = self.root.get(name, [])
            if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
                raise FormatError(f"{name} of its JSON is no array of objects")
            self._arrays[name] = found
        return self._arrays[name]

    def item(self, name: str, index: Any) -> Json:
        """Return an object of an array of the JSON by its number."""
        found = self.items(name)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(found):
            raise FormatError(f"there is no {quoted_value(index)} among the {len(found):,} {name} of its JSON")
        return Json(found[index], Origin(f"{name}[{index}]", FormatError))

    def names(self) -> Iterator[str]:
        """Yield the paths of its buffer files, relative to its folder."""
        for buffer in self.items("buffers"):
            uri = buffer.get("uri")
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield _name_of(uri)

    def buffer(self, index: Any) -> Buffer:
        """Find a buffer; `FormatError` if some of its bytes are missing."""
        record = self.item("buffers", index)
        if index not in self._buffers:
            found = self._found(index, record.value)
            length = record.whole("byteLength", most=MAX_BYTES)
            if found.length < length:
                where = "the file" if found.name is None else quoted_value(found.name)
                raise TruncatedError(f"buffer {index} has {length:,} bytes, of which {where} holds {found.length:,}")
            self._buffers[index] = found
        return self._buffers[index]

    def _found(self, index: int, record: Mapping[str, Any]) -> Buffer:
        uri, extensions = record.get("uri"), record.get("extensions")
        if uri is None:
            if isinstance(extensions, dict) and extensions:
                text = f"buffer {index} has no data but those of the extension {quoted_value(next(iter(extensions)))}"
                raise UnsupportedError(f"{text}, which is not read")
            if index or self._chunk is None:
                raise FormatError(f"buffer {index} has no data: it is neither a BIN chunk nor names a file")
            return self._chunk
        if not isinstance(uri, str):
            raise FormatError(f"the uri of buffer {index} is {quoted_value(uri)}, not a text")
        if uri.startswith("data:"):
            number = uri.removeprefix("data:")
            known = number.isdecimal() and int(number) < len(self._data)
            data = _unpacked(bytes(self._data[int(number)]) if known else uri.encode(), index)
            return Buffer(0, len(data), data=data)
        name = _name_of(uri)
        if leads_away(name):
            raise FormatError(f"buffer {index} is {quoted_value(uri)}, which is not a file below its folder")
        with self._opened(name) as file:
            return Buffer(0, size_of(file), name)

    def _opened(self, name: str) -> BinaryIO:
        if self._open_companion is None:
            raise FormatError(f"its buffer is {quoted_value(name)}, but other files cannot be opened here")
        return self._open_companion(name)

    @contextlib.contextmanager
    def readers(self, indices: Collection[int]) -> Iterator[Readers]:
        """Open buffers until the end of the context."""
        with contextlib.ExitStack() as stack:

            def opened(buffer: Buffer) -> BinaryIO:
                if buffer.data is not None:
                    return io.BytesIO(buffer.data)
                return self._file if buffer.name is None else stack.enter_context(self._opened(buffer.name))

            yield {index: OpenFile(opened(self.buffer(index))) for index in indices}

    def view(self, index: Any) -> tuple[int, int, int, int | None]:
        """Return the buffer of a view, the offset in its file, size and stride in bytes; `FormatError` if outside."""
        view = self.item("bufferViews", index)
        number = view.whole("buffer", most=MAX_BYTES)
        buffer = self.buffer(number)
        offset, length = view.optional("byteOffset", _bytes, 0), _bytes(view.get("byteLength"))
        if offset + length > self.item("buffers", number).whole("byteLength", most=MAX_BYTES):
            raise FormatError(f"buffer view {index} ends beyond its buffer")
        return number, buffer.start + offset, length, view.optional("byteStride", _bytes)

    def accessor(self, index: Any, kind: str, components: tuple[int, ...]) -> Accessor:
        """Return an accessor by its number in the JSON; `FormatError` for other types or values outside of its view.

        Args:
            kind: expected type, such as "VEC3".
            components: expected component types.
        """
        record = self.item("accessors", index)
        accessor = record.value
        component, normalized = accessor.get("componentType"), accessor.get("normalized", False)
        if accessor.get("type") != kind or component not in components:
            text = f"accessor {index} is {quoted_value(accessor.get('type'))} of {quoted_value(component)}"
            raise FormatError(f"{text}, not {kind} of {' or '.join(map(str, components))}")
        if "sparse" in accessor or "bufferView" not in accessor:
            text = f"accessor {index} is sparse, or has no buffer view"
            raise UnsupportedError(f"{text}; only values in a buffer view are read")
        dtype = np.dtype(COMPONENTS[component])
        buffer, offset, length, stride = self.view(accessor["bufferView"])
        count, inside = record.whole("count", most=MAX_BYTES), record.optional("byteOffset", _bytes, 0)
        size = TYPES[kind] * dtype.itemsize
        step = size if stride is None else stride
        if not size <= step <= max(MAX_STRIDE, size):
            raise FormatError(f"the stride of accessor {index} is {step}, not {size} to {MAX_STRIDE}")
        if count and inside + (count - 1) * step + size > length:
            raise FormatError(f"accessor {index} has {count:,} values, more than its buffer view holds")
        is_integer = component != FLOAT
        return Accessor(buffer, offset + inside, step, count, TYPES[kind], dtype, is_integer and normalized is True)

    def bytes_of(self, index: Any) -> bytes:
        """Read the content of a buffer view."""
        buffer, offset, length, _ = self.view(index)
        with self.readers([buffer]) as readers:
            return readers[buffer].read_at(offset, length)


def _name_of(uri: str) -> str:
    """Return the path of a relative address from the folder of the JSON on, which it may leave."""
    return posixpath.normpath(urllib.parse.unquote(uri)) if uri else uri


def _unpacked(uri: bytes, index: int) -> bytes:
    """Decode the data in an address, data:TYPE;base64,DATA."""
    kind, _, text = uri.partition(b",")
    data = urllib.parse.unquote_to_bytes(text) if b"%" in text else text
    try:
        return base64.b64decode(data, validate=True) if kind.endswith(b";base64") else data
    except binascii.Error as error:
        raise FormatError(f"the data of buffer {index} are no base64: {error}") from None


def _bytes(value: Json) -> int:
    return value.whole(most=MAX_BYTES)


def head_of(root: Mapping[str, Any], length: int) -> bytes:
    """Encode everything before the content of the BIN chunk, which has `length` bytes, a multiple of 4."""
    text = json.dumps(root, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = HEADER.size + 2 * CHUNK.size + len(text) + length
    check_length(total)
    return HEADER.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON) + text + CHUNK.pack(length, BIN)


def check_length(total: int) -> None:
    """Raise `FormatError` if a file has too many bytes for its header."""
    if total > MAX_BYTES:
        raise FormatError(f"{total:,} bytes are more than the {MAX_BYTES:,} of a GLB; write fewer splats")


Matrix = NDArray[np.float64]
T = TypeVar("T")

#: Rotations x y z w that turn an axis to +y: about x, so that right stays right; the x axis itself about z.
HALF = math.sqrt(0.5)
TURNS = {
    "y": (0.0, 0.0, 0.0, 1.0),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "z": (-HALF, 0.0, 0.0, HALF),
    "-z": (HALF, 0.0, 0.0, HALF),
    "x": (0.0, 0.0, HALF, HALF),
    "-x": (0.0, 0.0, -HALF, HALF),
}

#: Allowed deviation of a node's axes from right angles and from equal lengths: float32 leaves 1e-7. Chosen.
SKEW = 1e-5


class GltfNodes:
    """Nodes of a glTF and their transforms to the scene."""

    def __init__(self, file: GltfFile) -> None:
        self.records = file.items("nodes")
        self._parent: dict[int, int] = {}
        for number, node in enumerate(self.records):
            children = node.get("children", [])
            for child in children if isinstance(children, list) else ():
                if isinstance(child, int) and 0 <= child < len(self.records):
                    self._parent[child] = number
        self._shown = _roots_of_scene(file)
        self._is_shown: dict[int, bool] = {}
        self._matrices: dict[int, Matrix] = {}

    def having(self, meshes: Collection[int]) -> tuple[list[int], int]:
        """Return the nodes with these meshes that a viewer shows, in order, and the number of hidden nodes.

        If the file has no scene, or one without any of them, all count as shown.
        """
        nodes = enumerate(self.records)
        having = [number for number, node in nodes if type(node.get("mesh")) is int and node["mesh"] in meshes]
        shown = [number for number in having if self._inherited(number, self._is_shown, self._shows)]
        return (shown, len(having) - len(shown)) if shown else (having, 0)

    def matrix(self, number: int) -> Matrix:
        """Return the (4, 4) matrix of a node to the scene, for column vectors."""
        return self._inherited(number, self._matrices, self._placed)

    def _shows(self, number: int, above: bool | None) -> bool:
        return number in self._shown if above is None else above

    def _placed(self, number: int, above: Matrix | None) -> Matrix:
        own = _matrix(self.records[number])
        return own if above is None else product(above, own)

    def _inherited(self, number: int, known: dict[int, T], derive: Callable[[int, T | None], T]) -> T:
        """Return the value of a node, derived from that of its parent, None without one; `known` keeps values."""
        line, at = dict[int, None](), number
        while at not in known:
            if at in line:
                raise FormatError("its nodes are linked in a circle")
            line[at] = None
            if at not in self._parent:
                break
            at = self._parent[at]
        for each in reversed(line):
            parent = self._parent.get(each)
            known[each] = derive(each, None if parent is None else known[parent])
        return known[number]


def _roots_of_scene(file: GltfFile) -> frozenset[int]:
    """Return the roots of the scene that a viewer shows, by default the first."""
    scenes = file.items("scenes")
    number = file.root.get("scene", 0)
    if type(number) is not int or not 0 <= number < len(scenes):
        return frozenset()
    roots = scenes[number].get("nodes", [])
    return frozenset(each for each in roots if type(each) is int) if isinstance(roots, list) else frozenset()


def product(outer: Matrix, inner: Matrix) -> Matrix:
    """Multiply two (4, 4) matrices; `FormatError` if a number of the product is not finite or beyond `LARGEST`."""
    with np.errstate(all="ignore"):
        matrix = outer @ inner
        if not (np.abs(matrix) <= LARGEST).all():
            raise FormatError(f"transforms multiply to numbers beyond {LARGEST:g}")
    return matrix


def _matrix(node: dict[str, Any]) -> Matrix:
    """Return the (4, 4) matrix of a node for column vectors."""
    if "matrix" in node:
        return _numbers(node, "matrix", 16, ()).reshape(4, 4).T
    matrix = np.eye(4)
    turn = _numbers(node, "rotation", 4, (0, 0, 0, 1))
    length = np.linalg.norm(turn)
    if not 0.5 < length < 2:
        raise FormatError("the rotation of a node is no unit quaternion")
    matrix[:3, :3] = rotation_matrices((turn / length)[None])[..., 0] * _numbers(node, "scale", 3, (1, 1, 1))
    matrix[:3, 3] = _numbers(node, "translation", 3, (0, 0, 0))
    return matrix


def _numbers(node: dict[str, Any], name: str, count: int, default: tuple[float, ...]) -> Matrix:
    if name not in node:
        return np.array(default, np.float64)
    return np.array(Json(node, Origin("a node", FormatError)).get(name).numbers(count, most=LARGEST))


def transform_of(matrix: Matrix) -> Transform:
    """Split a (4, 4) matrix into rotation, uniform scale and translation; `FormatError` if that is impossible."""
    axes = matrix[:3, :3]
    with np.errstate(all="ignore"):
        determinant = float(np.linalg.det(axes))
    if not (matrix[3] == (0, 0, 0, 1)).all() or not math.isfinite(determinant):
        raise FormatError("the transform of its splats is not affine, or not of finite numbers")
    if determinant == 0:
        raise FormatError("the transform of its splats is singular: it makes their volume 0")
    scale = scale_of(matrix, SKEW)
    if scale is None:
        raise UnsupportedError(
            "a transform stretches, shears or mirrors its splats; only rotations and uniform scales are read"
        )
    if abs(scale - 1) <= SKEW:
        scale = 1.0
    left, _, right = np.linalg.svd(axes)
    rotation = np.rint(left @ right) if np.abs(left @ right - np.rint(left @ right)).max() < SKEW else left @ right
    try:
        return Transform(rotation, scale, matrix[:3, 3])
    except ValueError as error:
        raise FormatError(f"the transform of its splats: {error}") from None


def rotation_of_up(up: str | None) -> Matrix:
    """Return the exact (3, 3) turn of an axis to +y; the identity for an unknown axis."""
    return np.rint(rotation_matrices(np.array([TURNS[up or "y"]]))[..., 0]) + 0.0  # no -0


def is_turn_of(transform: Transform, up: str) -> bool:
    """Return whether a transform is just the turn of an axis to +y."""
    at_rest = transform.scale == 1 and not transform.translation.any()
    return at_rest and bool(np.abs(transform.rotation - rotation_of_up(up)).max() <= SKEW)
