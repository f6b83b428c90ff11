"""The container: chunks of a binary glTF, its JSON, and accessors, whose bounds are checked before they are read.

Facts: the glTF 2.0 specification, sections 3.6 (binary data), 3.5 (nodes) and 4.4 (the GLB layout).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray
from ...support.errors import FormatError, NotSplatsError, TruncatedError, VersionError
from ...support.untrusted import parse_json, quoted, quoted_value
from ..stream import Positioned, size_of

#: The header of a file, magic, version and length, and of a chunk, length and type.
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAGIC, VERSION = b"glTF", 2
JSON, BIN = b"JSON", b"BIN\0"

#: Largest file, bytes: its length has 32 bits.
LARGEST = (1 << 32) - 1

#: Largest JSON chunk, bytes. That of splats takes some thousands; the meshes beside them may take more.
MAX_JSON = 1 << 22

#: Component types: their numpy types.
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
FLOAT = 5126

#: Components of each type of accessor that splats have.
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

#: Largest stride of a buffer view, bytes.
MAX_STRIDE = 252


@dataclass(frozen=True)
class Accessor:
    """Values of an attribute in a file.

    Attributes:
        offset: of the first, in the file.
        stride: bytes from one to the next.
        count: number of splats.
        width: components of each.
        dtype: of a component.
        normalized: integers mean 0..1, or -1..1.
    """

    offset: int
    stride: int
    count: int
    width: int
    dtype: np.dtype[Any]
    normalized: bool

    @property
    def size(self) -> int:
        """Bytes of one value."""
        return self.width * self.dtype.itemsize

    def read(self, file: Positioned, start: int, stop: int) -> FloatArray:
        """Return (stop - start, width) float32 values.

        Raises:
            TruncatedError: the file has become shorter.
        """
        length = (stop - start - 1) * self.stride + self.size
        data = file.read(self.offset + start * self.stride, length)
        if len(data) < length:
            raise TruncatedError(f"cut short inside the values of splats {start:,} to {stop:,}")
        strides = self.stride, self.dtype.itemsize
        codes: NDArray[Any] = np.ndarray((stop - start, self.width), self.dtype, data, strides=strides)
        values = codes.astype(np.float32)
        if self.normalized:
            values = np.maximum(values / np.float32(np.iinfo(self.dtype).max), np.float32(-1))
        return values


class GlbFile:
    """Chunks of a binary glTF.

    Attributes:
        size: bytes of the file.
        root: its JSON.

    Raises:
        FormatError: the file is no binary glTF 2, or cut short.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.size = file, size_of(file)
        head = file.read(HEADER.size)
        if len(head) < HEADER.size or head[:4] != MAGIC:
            raise NotSplatsError("not a binary glTF file")
        _, version, length = HEADER.unpack(head)
        if version != VERSION:
            raise VersionError(f"binary glTF version {version} is unknown, only {VERSION} is read")
        if length > self.size:
            raise TruncatedError(f"cut short: its header announces {length:,} bytes, and it has {self.size:,}")
        self._start = self._length = 0
        at, text = HEADER.size, b""
        for expected in (JSON, BIN):
            if at == length and expected == BIN:
                break
            file.seek(at)
            head = file.read(CHUNK.size)
            size, kind = CHUNK.unpack(head) if len(head) == CHUNK.size else (0, b"")
            if kind != expected:
                raise FormatError(f"its {expected.decode().rstrip(chr(0))} chunk is missing")
            at += CHUNK.size
            if at + size > length:
                raise TruncatedError(f"cut short inside its {expected.decode().rstrip(chr(0))} chunk")
            if kind == JSON:
                if size > MAX_JSON:
                    raise FormatError(f"its JSON of {size:,} bytes is larger than the {MAX_JSON:,} that are read")
                text = file.read(size)
            else:
                self._start, self._length = at, size
            at += size
        try:
            self.root = parse_json(text)
        except ValueError as error:
            raise FormatError(f"its JSON is broken: {quoted(error)}") from None
        if not isinstance(self.root, dict):
            raise FormatError("its JSON is no object")

    def items(self, name: str) -> Iterator[dict[str, Any]]:
        """Yield the objects of an array of the JSON, such as "nodes"."""
        found = self.root.get(name, [])
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise FormatError(f"{name} of its JSON is no array of objects")
        yield from found

    def item(self, name: str, index: Any) -> dict[str, Any]:
        """Return an object of an array of the JSON by its number."""
        found = list(self.items(name))
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(found):
            raise FormatError(f"there is no {quoted_value(index)} among the {len(found):,} {name} of its JSON")
        return found[index]

    def view(self, index: Any) -> tuple[int, int, int | None]:
        """Return offset in the file, bytes and stride of a buffer view, which lies within the BIN chunk."""
        view = self.item("bufferViews", index)
        buffer = self.item("buffers", view.get("buffer"))
        if view["buffer"] != 0 or "uri" in buffer:
            raise FormatError("its splats are in another file; only those in its BIN chunk are read")
        offset, length = whole(view, "byteOffset", 0), whole(view, "byteLength")
        if offset + length > min(self._length, whole(buffer, "byteLength")):
            raise FormatError(f"buffer view {index} ends beyond its buffer")
        stride = whole(view, "byteStride") if "byteStride" in view else None
        return self._start + offset, length, stride

    def accessor(self, index: Any, kind: str, components: tuple[int, ...]) -> Accessor:
        """Return an accessor, all of whose values lie within its buffer view.

        Args:
            index: in the JSON, whatever it is there.
            kind: its type, such as "VEC3".
            components: possible component types.

        Raises:
            FormatError: it is of another type, or reaches beyond its buffer view.
        """
        accessor = self.item("accessors", index)
        component, normalized = accessor.get("componentType"), accessor.get("normalized", False)
        if accessor.get("type") != kind or component not in components:
            raise FormatError(
                f"accessor {index} is {quoted_value(accessor.get('type'))} of {quoted_value(component)}, not {kind} of"
                f" {' or '.join(map(str, components))}"
            )
        if "sparse" in accessor or "bufferView" not in accessor:
            raise FormatError(f"accessor {index} is sparse, or has no buffer view; such ones are not read")
        dtype = np.dtype(COMPONENTS[component])
        offset, length, stride = self.view(accessor["bufferView"])
        count, inside = whole(accessor, "count"), whole(accessor, "byteOffset", 0)
        size = TYPES[kind] * dtype.itemsize
        step = size if stride is None else stride
        if not size <= step <= max(MAX_STRIDE, size):
            raise FormatError(f"the stride of accessor {index} is {step}, not {size} to {MAX_STRIDE}")
        if count and inside + (count - 1) * step + size > length:
            raise FormatError(f"accessor {index} has {count:,} values, more than its buffer view holds")
        is_integer = component != FLOAT
        return Accessor(offset + inside, step, count, TYPES[kind], dtype, is_integer and normalized is True)

    def bytes_of(self, index: Any) -> bytes:
        """Return the content of a buffer view."""
        offset, length, _ = self.view(index)
        self._file.seek(offset)
        return self._file.read(length)


def whole(record: Mapping[str, Any], name: str, default: int | None = None) -> int:
    """Return a whole number of at least 0 of a JSON object.

    Raises:
        FormatError: there is none.
    """
    value = record.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST:
        raise FormatError(f"{name} is {quoted_value(value)}, not a whole number up to {LARGEST:,}")
    return value


def head_of(root: Mapping[str, Any], length: int) -> bytes:
    """Return all that comes before the content of the BIN chunk.

    Args:
        length: bytes of that content, a multiple of 4.

    Raises:
        FormatError: the file would be too large for its header.
    """
    text = json.dumps(root, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = HEADER.size + 2 * CHUNK.size + len(text) + length
    check_length(total)
    return HEADER.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON) + text + CHUNK.pack(length, BIN)


def check_length(total: int) -> None:
    """Raise `FormatError` where a file would have too many bytes for its header."""
    if total > LARGEST:
        raise FormatError(f"{total:,} bytes are more than the {LARGEST:,} of a GLB; write fewer splats")
