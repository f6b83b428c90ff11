"""A writer of RAD files that can get any of their promises wrong; it uses nothing of sparklod.

A file is built from parts whose fields tests replace: columns, chunks of columns, and the header. What a test does not
replace follows from the parts, so that each fault stands alone.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fixtures import by_hand_rad

CHUNK = 65_536

#: What a viewer assumes of the codes of a tree; every header repeats it.
RANGES = by_hand_rad.RANGES | {"lodOpacity": True}

#: Coefficients of each SH degree, with three colours each.
COEFFICIENTS = {1: 9, 2: 15, 3: 21}


def deflated(data: bytes) -> bytes:
    """A raw deflate stream."""
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def padded(data: bytes, zero: bytes = b"\0") -> bytes:
    return data + zero * (-len(data) % 8)


def text(fields: dict[str, Any]) -> bytes:
    """JSON of the fields that are not None."""
    return json.dumps({key: value for key, value in fields.items() if value is not None}).encode()


@dataclass(frozen=True)
class Column:
    """A property of a chunk: its numbers as the encoding has them, and fields that are wrong."""

    name: str
    encoding: str
    data: bytes
    fields: dict[str, Any] = field(default_factory=dict)
    stored: bytes | None = None  # in place of the deflated data

    @property
    def packed(self) -> bytes:
        return deflated(self.data) if self.stored is None else self.stored


@dataclass(frozen=True)
class Chunk:
    """A chunk, and fields of its header that are wrong."""

    base: int
    count: int
    columns: tuple[Column, ...]
    max_sh: int = 0
    fields: dict[str, Any] = field(default_factory=dict)
    magic: bytes = b"RADC"
    pad: bytes = b"\0"
    payload_bytes: int | None = None  # in place of the number before the payload
    more: bytes = b""

    def packed(self) -> bytes:
        payload, properties = b"", []
        for column in self.columns:
            entry = {
                "offset": len(payload),
                "bytes": len(column.packed),
                "property": column.name,
                "encoding": column.encoding,
                "compression": "gz",
            }
            properties.append({key: value for key, value in (entry | column.fields).items() if value is not None})
            payload += padded(column.packed, self.pad)
        payload += self.more
        fields = {
            "version": 1,
            "base": self.base,
            "count": self.count,
            "payloadBytes": len(payload),
            "maxSh": self.max_sh,
            "lodTree": True,
            "splatEncoding": RANGES,
            "properties": properties,
        }
        data = text(fields | self.fields)
        size = len(payload) if self.payload_bytes is None else self.payload_bytes
        return struct.pack("<4sI", self.magic, len(data)) + padded(data, self.pad) + struct.pack("<Q", size) + payload

    def changed(self, name: str, change: Callable[[Column], Column]) -> Chunk:
        """With one of its columns changed."""
        return replace(self, columns=tuple(change(each) if each.name == name else each for each in self.columns))

    def without(self, name: str) -> Chunk:
        """With one column less."""
        return replace(self, columns=tuple(each for each in self.columns if each.name != name))


@dataclass(frozen=True)
class Rad:
    """A file, and what is wrong with its header; as files of its own, where it has a stem."""

    chunks: tuple[Chunk, ...]
    max_sh: int = 0
    fields: dict[str, Any] = field(default_factory=dict)
    entries: dict[int, dict[str, Any]] = field(default_factory=dict)  # wrong fields of entries of chunks
    pad: bytes = b" "
    more: bytes = b""
    stem: str | None = None

    def packed(self) -> tuple[bytes, list[bytes]]:
        """The header, and each chunk."""
        chunks = [chunk.packed() for chunk in self.chunks]
        entries, at = [], 0
        for number, data in enumerate(chunks):
            entry: dict[str, Any] = {"offset": at, "bytes": len(data)}
            if self.stem is not None:
                entry = {"offset": 0, "bytes": len(data), "filename": f"{self.stem}-{number}.radc"}
            entries.append(entry | self.entries.get(number, {}))
            at += len(data)
        fields = {
            "version": 1,
            "type": "gsplat",
            "count": sum(chunk.count for chunk in self.chunks),
            "maxSh": self.max_sh,
            "lodTree": True,
            "chunkSize": CHUNK,
            "allChunkBytes": at,
            "chunks": entries,
            "splatEncoding": RANGES,
        }
        data = text(fields | self.fields)
        while len(data) % 8 == 0:  # so that there is padding, which can be wrong
            data += b" "
        return struct.pack("<4sI", b"RAD0", len(data)) + padded(data, b"\0" if self.pad == b" " else self.pad), chunks

    def write(self, path: Path) -> Path:
        """Writes the file, or the header with the chunks beside it."""
        header, chunks = self.packed()
        if self.stem is None:
            path.write_bytes(header + b"".join(chunks) + self.more)
            return path
        for number, data in enumerate(chunks):
            (path.parent / f"{self.stem}-{number}.radc").write_bytes(data)
        path.write_bytes(header + self.more)
        return path


def tree(count: int = CHUNK + 8, *, max_sh: int = 0, palette: bool = False, chunk: int = CHUNK) -> Rad:
    """A sound tree: a root with two inner nodes, the leaves of the first, and those of the second.

    Args:
        count: of nodes, at least 9.
        max_sh: SH degree.
        palette: spherical harmonics as a palette with an entry for each splat of chunk 0, and labels.
        chunk: nodes of a chunk.
    """
    first = (count - 3) // 2
    counts = np.zeros(count, "<u2")
    starts = np.zeros(count, "<u4")
    counts[:3], starts[:3] = (2, first, count - 3 - first), (1, 3, 3 + first)
    inner = counts > 0
    numbers = {
        "center": (np.stack([np.arange(count) % 997, np.arange(count) % 7, np.zeros(count)]) / 8).astype("<f4"),
        "alpha": np.where(inner, 1, 0.5).astype("<f2")[None],
        "rgb": np.tile(np.where(inner, 128, 200).astype(np.uint8), (3, 1)),
        "scales": np.tile(np.where(inner, 160, 150).astype(np.uint8), (3, 1)),
    }
    encodings = {"center": "f32", "alpha": "f16", "rgb": "r8", "scales": "ln_0r8"}
    ranges = {"rgb": {"min": 0.0, "max": 1.0}, "scales": {"min": -12.0, "max": 9.0}}
    chunks = []
    for base in range(0, count, chunk):
        part = slice(base, min(count, base + chunk))
        size = part.stop - part.start
        columns = [
            Column(name, encodings[name], values[:, part].tobytes(), ranges.get(name, {}))
            for name, values in numbers.items()
        ]
        columns.append(Column("orientation", "oct88r8", b"\xff\x80\0" * size))
        columns += _sh(size, max_sh, base, palette=palette)
        columns.append(Column("child_count", "u16", counts[part].tobytes()))
        columns.append(Column("child_start", "u32", starts[part].tobytes()))
        chunks.append(Chunk(base, size, tuple(columns), max_sh))
    fields: dict[str, Any] = {"chunkSize": chunk}
    if palette:
        fields["shCodeCount"] = chunks[0].count
    return Rad(tuple(chunks), max_sh, fields)


def _sh(count: int, max_sh: int, base: int, *, palette: bool) -> list[Column]:
    ends = {"min": -1.0, "max": 1.0}
    degrees = range(1, max_sh + 1)
    if not palette:
        return [Column(f"sh{each}", "s8", b"\x10" * count * COEFFICIENTS[each], ends) for each in degrees]
    codes = [Column(f"sh{each}_code", "s8", b"\x10" * count * COEFFICIENTS[each], ends) for each in degrees]
    labels = Column("sh_label", "u16", (np.arange(count) % 8).astype("<u2").tobytes())
    return [*(codes if base == 0 else []), labels]


def with_chunk(rad: Rad, number: int, change: Callable[[Chunk], Chunk]) -> Rad:
    """A file with one of its chunks changed."""
    return replace(rad, chunks=tuple(change(chunk) if at == number else chunk for at, chunk in enumerate(rad.chunks)))


def with_fields(part: Any, **fields: Any) -> Any:
    """A file, chunk or column with wrong fields of its header."""
    return replace(part, fields=part.fields | fields)
