"""RAD files written without sparklod that can break any rule of the format, and a table of such files.

A file is built from parts whose fields can be replaced: columns, chunks of columns, and the header. What is not
replaced follows from the parts, so that each fault stands alone.
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


# --- Faults -----------------------------------------------------------------------------------------------------------

#: Sound files: chunks of all nodes, two chunks, with spherical harmonics, with a palette of them, with both.
SMALL, TWO = tree(24), tree()
SH, PALETTE = tree(24, max_sh=2), tree(24, max_sh=2, palette=True)
LATER = tree(CHUNK + 8, max_sh=1, palette=True)


def column(rad: Rad, name: str, number: int = 0, /, **changes: object) -> Rad:
    """A file with one column of a chunk changed."""
    return with_chunk(rad, number, lambda chunk: chunk.changed(name, lambda each: replace(each, **changes)))  # type: ignore[arg-type]


def property_fields(rad: Rad, name: str, number: int = 0, /, **changes: object) -> Rad:
    """A file with wrong fields of one property of a chunk."""
    return with_chunk(rad, number, lambda chunk: chunk.changed(name, lambda each: with_fields(each, **changes)))


def chunk_fields(rad: Rad, number: int, /, **changes: object) -> Rad:
    """A file with wrong fields in the header of a chunk."""
    return with_chunk(rad, number, lambda chunk: with_fields(chunk, **changes))


def chunk_with(rad: Rad, number: int, /, **changes: object) -> Rad:
    """A file with other parts of a chunk."""
    return with_chunk(rad, number, lambda chunk: replace(chunk, **changes))  # type: ignore[arg-type]


def with_columns(rad: Rad, names: str) -> Rad:
    """A small file with the columns of these names, in this order."""
    (chunk,) = rad.chunks
    known = {each.name: each for each in chunk.columns}
    return chunk_with(rad, 0, columns=tuple(known[name] for name in names.split()))


def without(rad: Rad, name: str) -> Rad:
    """A small file without one of its columns."""
    return with_columns(rad, " ".join(each.name for each in rad.chunks[0].columns if each.name != name))


RGB = next(each.data for each in SMALL.chunks[0].columns if each.name == "rgb")
NO_LOD_OPACITY = RANGES | {"lodOpacity": False}

#: Files with faults, and the codes of their findings.
FAULTS: dict[str, tuple[Rad, set[str]]] = {
    "another type": (with_fields(SMALL, type="mesh"), {"file.not-splats"}),
    "another version": (with_fields(SMALL, version=2), {"container.version"}),
    "a degree that does not exist": (chunk_fields(with_fields(SMALL, maxSh=4), 0, maxSh=4), {"container.version"}),
    "no count": (with_fields(SMALL, count=None), {"container.corrupt"}),
    "a chunk too many": (with_fields(SMALL, count=CHUNK + 1), {"rad.chunks"}),
    "a chunk too few": (with_fields(TWO, count=CHUNK), {"rad.chunks"}),
    "chunks of nothing": (with_fields(SMALL, chunkSize=0), {"rad.chunks"}),
    "chunks of another size": (tree(48, chunk=24), {"rad.chunk-size"}),
    "one splat less in the header": (with_fields(TWO, count=CHUNK + 7), {"rad.bases"}),
    "one splat less in a chunk": (chunk_fields(TWO, 1, count=7), {"rad.bases"}),
    "another base": (chunk_fields(TWO, 1, base=0), {"rad.bases"}),
    "chunks that overlap": (replace(TWO, entries={1: {"offset": 0}}), {"rad.offsets"}),
    "a gap between chunks": (replace(TWO, entries={1: {"offset": 1 << 20}}), {"rad.offsets"}),
    "an offset in a file of its own": (
        replace(SMALL, stem="a", entries={0: {"offset": 8}}),
        {"rad.offsets", "rad.chunk-files"},
    ),
    "another sum": (with_fields(TWO, allChunkBytes=1), {"rad.total"}),
    "bytes behind the last chunk": (replace(TWO, more=bytes(8)), {"container.trailing"}),
    "an entry that is too large": (
        replace(SMALL, entries={0: {"bytes": 1 << 20}}),
        {"container.cut-short", "rad.total"},
    ),
    "no file of a chunk": (replace(SMALL, entries={0: {"filename": "b.radc"}}), {"rad.chunk-files"}),
    "a file of a chunk elsewhere": (replace(SMALL, entries={0: {"filename": "../b.radc"}}), {"rad.chunk-files"}),
    "a short file of a chunk": (
        replace(SMALL, stem="a", entries={0: {"bytes": 1 << 20}}, fields=SMALL.fields | {"allChunkBytes": 1 << 20}),
        {"rad.chunk-files"},
    ),
    "another magic of a chunk": (chunk_with(TWO, 1, magic=b"RADX"), {"rad.chunk-header"}),
    "another version of a chunk": (chunk_fields(TWO, 1, version=2), {"rad.chunk-header"}),
    "a chunk without a base": (chunk_fields(TWO, 1, base=None), {"rad.chunk-header"}),
    "another degree in a chunk": (chunk_fields(SH, 0, maxSh=1), {"rad.kind"}),
    "a chunk without a tree": (chunk_fields(SMALL, 0, lodTree=None), {"rad.kind"}),
    "other ranges in a chunk": (chunk_fields(SMALL, 0, splatEncoding=RANGES | {"rgbMax": 2.0}), {"rad.ranges"}),
    "another size of the payload in JSON": (chunk_fields(SMALL, 0, payloadBytes=8), {"rad.sizes"}),
    "another size before the payload": (chunk_with(SMALL, 0, payload_bytes=8), {"rad.sizes"}),
    "bytes behind the properties": (chunk_with(SMALL, 0, more=bytes(16)), {"rad.sizes"}),
    "a property elsewhere": (property_fields(SMALL, "alpha", offset=0), {"rad.offsets"}),
    "a property that is unknown": (column(SMALL, "rgb", name="hue"), {"rad.properties"}),
    "a property less": (without(SMALL, "rgb"), {"rad.properties"}),
    "no children": (without(SMALL, "child_count"), {"rad.properties", "tree.orphan", "tree.leaf-start"}),
    "no degree 2": (without(SH, "sh2"), {"rad.properties"}),
    "a property twice": (
        with_columns(SMALL, "center alpha rgb scales orientation child_count child_start rgb"),
        {"rad.properties"},
    ),
    "a degree too many": (chunk_fields(with_fields(SH, maxSh=1), 0, maxSh=1), {"rad.properties"}),
    "children without a tree": (chunk_fields(with_fields(SMALL, lodTree=False), 0, lodTree=False), {"rad.properties"}),
    "another order": (
        with_columns(SMALL, "center alpha scales rgb orientation child_count child_start"),
        {"rad.order"},
    ),
    "an encoding of another property": (property_fields(SMALL, "center", encoding="s8"), {"rad.encoding"}),
    "an encoding that is unknown": (property_fields(SMALL, "center", encoding="f8"), {"rad.encoding"}),
    "a compression that is unknown": (property_fields(SMALL, "center", compression="br"), {"rad.encoding"}),
    "no end of a range": (property_fields(SMALL, "rgb", max=None), {"rad.encoding"}),
    "a range that is empty": (property_fields(SMALL, "rgb", max=0.0), {"rad.encoding"}),
    "a range of SH that is empty": (property_fields(SH, "sh1", max=0.0), {"rad.encoding"}),
    "a property that is too short": (column(SMALL, "rgb", data=bytes(3)), {"container.cut-short"}),
    "a property that is too long": (column(SMALL, "rgb", data=bytes(73)), {"container.too-long"}),
    "a property that is not deflated": (column(SMALL, "rgb", stored=b"\xff" * 9), {"container.corrupt"}),
    "a deflate stream that does not end": (column(SMALL, "rgb", stored=deflated(RGB)[:-3]), {"container.cut-short"}),
    "a palette of another size": (with_fields(PALETTE, shCodeCount=8), {"rad.palette"}),
    "a palette that is shorter": (column(PALETTE, "sh1_code", data=b"\x10" * 9 * 8), {"container.cut-short"}),
    "a palette in a later chunk": (
        chunk_with(LATER, 1, columns=(LATER.chunks[0].columns[5], *LATER.chunks[1].columns)),
        {"rad.palette", "rad.order"},
    ),
    "a label beyond the palette": (column(PALETTE, "sh_label", data=b"\x20\0" * 24), {"rad.palette"}),
    "no labels": (without(PALETTE, "sh_label"), {"rad.palette", "rad.properties"}),
    "labels without a palette": (with_fields(PALETTE, shCodeCount=None), {"rad.palette"}),
    "labels and coefficients": (
        chunk_with(PALETTE, 0, columns=(*PALETTE.chunks[0].columns, SH.chunks[0].columns[5])),
        {"rad.palette", "rad.order"},
    ),
    "a large header": (with_fields(SMALL, comment="c" * (1 << 16)), {"rad.header-large"}),
    "a header that is too large": (with_fields(SMALL, comment="c" * (1 << 20)), {"rad.header-limit"}),
    "opacities that are not of a tree": (
        chunk_fields(with_fields(SMALL, splatEncoding=NO_LOD_OPACITY), 0, splatEncoding=NO_LOD_OPACITY),
        {"rad.opacity"},
    ),
    "padding of the header": (replace(SMALL, pad=b"x"), {"rad.padding"}),
    "padding of a chunk": (chunk_with(SMALL, 0, pad=b"x"), {"rad.padding"}),
}
