"""Inflating: what was deflated, by whichever writer, and never more than asked for."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import tracemalloc
import zlib
from collections.abc import Iterable

import numpy as np
import pytest
from zlib_ng import zlib_ng

from sparklod_cli.codecs import compression, inflate, spz
from sparklod_cli.codecs.compression import BLOCK, MIXED
from sparklod_cli.codecs.inflate import Inflate
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import ChecksumError, FormatError, TruncatedError
from sparklod_cli.system.progress import silent
from tests.scenes import random_splats

LIBRARIES = (inflate._library, zlib_ng)

#: End of an empty stored block, which a flush writes, and which data may hold, too.
FLUSHED = b"\0\0\xff\xff"

#: Flushes of zlib that Python has no names for: they end no block on a byte boundary, or with an empty fixed block.
Z_PARTIAL_FLUSH, Z_BLOCK = 1, 5


@pytest.fixture(params=LIBRARIES, ids=lambda library: library.__name__, autouse=True)
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library that is installed, and the one that replaces it elsewhere."""
    monkeypatch.setattr(inflate, "_library", request.param)


def sample(size: int) -> bytes:
    """Bytes that compress to two thirds."""
    rng = np.random.default_rng(9)
    return (rng.integers(0, 256, size) & rng.integers(0, 256, size)).astype(np.uint8).tobytes()


def flushed(blocks: Iterable[bytes], flush: int) -> bytes:
    """A member whose blocks end with a flush, after which they may refer to what is before (Z_SYNC_FLUSH) or not."""
    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    return b"".join(packer.compress(block) + packer.flush(flush) for block in blocks) + packer.flush()


def member_of(stream: bytes, data: bytes) -> bytes:
    """A member with a deflate stream of the data."""
    return gzip.compress(b"")[:10] + stream + struct.pack("<II", zlib.crc32(data), len(data))


def ended_by_a_stored_block(data: bytes, level: int = 6) -> bytes:
    """A member whose stream ends with an empty stored block right behind the data, as that of Go's compress/gzip."""
    packer = zlib.compressobj(level, zlib.DEFLATED, -15)
    stream = packer.compress(data) + packer.flush(zlib.Z_SYNC_FLUSH)
    for bit in range(11):  # the flag of the last block is one of the bits before its length
        ended = bytearray(stream)
        ended[-5 - bit // 8] |= 128 >> bit % 8
        unpacker = zlib.decompressobj(-15)
        try:
            if unpacker.decompress(ended) == data and unpacker.eof and not unpacker.unused_data:
                return member_of(bytes(ended), data)
        except zlib.error:
            continue
    raise AssertionError("no bit ends the stream")


def mixed(data: bytes) -> bytes:
    """A member whose blocks have sizes, kinds and codes of their own, as optimizers such as zopfli choose them."""
    rng, parts, at = np.random.default_rng(3), [], 0
    while at < len(data):
        size = int(rng.integers(1, 1 << int(rng.integers(1, 18))))
        packer = zlib.compressobj(int(rng.integers(0, 10)), zlib.DEFLATED, -15, 9, int(rng.integers(0, 5)))
        parts.append(packer.compress(data[at : at + size]) + packer.flush(zlib.Z_SYNC_FLUSH))
        at += size
    return member_of(b"".join(parts) + b"\x03\0", data)


def ours(data: bytes, comment: bytes = b"") -> bytes:
    return b"".join(compression.gzip_member([data], [(len(data), MIXED)], 5, 1, silent, comment=comment))


@functools.cache
def members(size: int = 2 * BLOCK + 7) -> dict[str, bytes]:
    """Members of the same data by different writers."""
    data = sample(size)
    blocks = [data[at : at + BLOCK] for at in range(0, len(data), BLOCK)]
    many = [data[at : at + 999] for at in range(0, len(data), 999)]
    made = gzip.compress(data, 0)
    fields = made[:3] + b"\x1e" + made[4:10] + b"\5\0extra" + (b"n" * (1 << 17) + b"\0") * 2  # a name, a comment
    words = [(data[:20_000] * 30)[:BLOCK]] * 3  # which refer to each other
    return {
        "ours": ours(data),
        "commented": ours(data, b"a comment"),
        "python": gzip.compress(data, 1),
        "go": ended_by_a_stored_block(data),
        "go, stored": ended_by_a_stored_block(data, 0),
        "two endings": flushed([data, b"", b""], zlib.Z_FULL_FLUSH),
        "full flush": flushed(blocks, zlib.Z_FULL_FLUSH),
        "sync flush": flushed(blocks, zlib.Z_SYNC_FLUSH),
        "many flushes": flushed(many, zlib.Z_FULL_FLUSH),
        "partial flushes": flushed(many, Z_PARTIAL_FLUSH),
        "blocks": flushed(many, Z_BLOCK),
        "mixed": mixed(data),
        "stored": made,
        "looks flushed": gzip.compress(data[:BLOCK] + FLUSHED * 50 + data[BLOCK:], 0),
        "dictionaries": flushed(words, zlib.Z_SYNC_FLUSH),
        "zeros": ours(bytes(20 * BLOCK)),
        "named": made[:3] + b"\x08" + made[4:10] + b"name\0" + made[10:],
        "all fields": fields + struct.pack("<H", zlib.crc32(fields) & 0xFFFF) + made[10:],
        "empty": ours(b""),
    }


def assert_reads(packed: bytes) -> None:
    """Assert that a member is read to its end, whatever is behind it."""
    expected = gzip.decompress(packed)
    for behind in (b"", b"some more", packed):
        reader = Inflate(io.BytesIO(packed + behind))
        found = b"".join(bytes(reader.read(size)) for size in [16, 0, 5, *[300_000] * (len(expected) // 300_000 + 1)])
        assert found == expected
        reader.finish()
        assert reader.end == len(packed)
        assert reader.behind == behind[:2]


@pytest.mark.parametrize("kind", list(members(0)))
def test_all_writers_are_read_to_the_end(kind: str) -> None:
    assert_reads(members()[kind])


@pytest.mark.parametrize("step", [1 << 10, 1 << 13, 1 << 17])
@pytest.mark.parametrize("write", [ended_by_a_stored_block, mixed, ours], ids=lambda write: write.__name__)
def test_members_of_any_size_are_read_to_the_end(write: object, step: int) -> None:
    """Around the bytes that are read at a time, so that a block, the end or the checksum is cut by them."""
    assert callable(write)
    for size in {*range(8), *range(step - 3, step + 4), 3 * step // 2}:
        assert_reads(write(sample(size)))


@pytest.mark.parametrize("splats", [100, 2_000, 40_000])
@pytest.mark.parametrize("write", [ended_by_a_stored_block, mixed, gzip.compress], ids=lambda write: write.__name__)
def test_a_scene_is_the_same_by_any_writer_and_on_any_number_of_threads(write: object, splats: int) -> None:
    assert callable(write)
    made = b"".join(spz.encode(Scene(random_splats(splats, sh_degree=1)), WriteOptions(spz_version=2)))
    expected = decode_file(spz, io.BytesIO(made)).splats
    packed = write(gzip.decompress(made))
    for threads in (1, 2, 5):
        found = decode_file(spz, io.BytesIO(packed), threads=threads).splats
        for column in COLUMNS:
            np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), column)


@pytest.mark.parametrize("size", [1, inflate.MOST_COMMENT - 1, inflate.MOST_COMMENT, 1 << 17])
def test_a_comment_is_read_up_to_a_size(size: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"c" * size)))
    assert reader.comment == (b"c" * size if size < inflate.MOST_COMMENT else None)
    assert reader.read(9) == b"data"
    reader.finish()


@pytest.mark.parametrize("cut", range(10, 20))
def test_a_member_that_ends_in_its_comment_is_cut_short(cut: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"a comment")[:cut]))
    assert reader.read(9) == b""
    with pytest.raises(TruncatedError):
        reader.finish()


@pytest.mark.parametrize("kind", ["ours", "python", "go", "full flush", "named"])
def test_every_damage_is_found(kind: str) -> None:
    packed = members(BLOCK + 5000)[kind]
    rng = np.random.default_rng(1)
    for at in [*rng.integers(20, len(packed), 12), *range(len(packed) - 8, len(packed))]:
        damaged = bytearray(packed)
        damaged[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(FormatError):
            read_all(bytes(damaged))
    for at in [*rng.integers(0, len(packed), 8), *range(len(packed) - 9, len(packed))]:
        with pytest.raises(TruncatedError):
            read_all(packed[:at])


@pytest.mark.parametrize("kind", ["ours", "python", "go", "named"])
def test_a_wrong_checksum_is_told_apart(kind: str) -> None:
    packed = bytearray(members()[kind])
    packed[-6] ^= 1
    with pytest.raises(ChecksumError, match="checksum is wrong"):
        read_all(bytes(packed))


def read_all(packed: bytes) -> None:
    reader = Inflate(io.BytesIO(packed))
    while reader.read(100_000):
        pass
    reader.finish()


@pytest.mark.parametrize("sizes", [[10], [1, 2, 3], [0, 10_000, 0, 1], [20_000]])
def test_inflating_gives_what_is_asked_for(sizes: list[int]) -> None:
    data = bytes(range(256)) * 100
    inflate = Inflate(io.BytesIO(gzip.compress(data)))
    at = 0
    for size in sizes:
        assert inflate.read(size) == data[at : at + size]
        at += size
    with pytest.raises(FormatError, match="more data"):
        inflate.finish()


def test_inflating_beyond_the_end_gives_less() -> None:
    inflate = Inflate(io.BytesIO(gzip.compress(b"some")))
    assert inflate.read(10) == b"some"
    inflate.finish()


@pytest.mark.parametrize("cut", range(1, 9))
def test_a_truncated_checksum_is_refused(cut: int) -> None:
    inflate = Inflate(io.BytesIO(gzip.compress(b"some")[:-cut]))
    inflate.read(4)
    with pytest.raises(FormatError, match="checksum is missing"):
        inflate.finish()


def test_a_bomb_is_never_inflated_whole() -> None:
    bomb = gzip.compress(bytes(50_000_000), 9)
    tracemalloc.start()
    try:
        inflate = Inflate(io.BytesIO(bomb))
        assert inflate.read(1000) == bytes(1000)
        with pytest.raises(FormatError, match="more data"):
            inflate.finish()
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
