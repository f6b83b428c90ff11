"""Inflating: what was deflated, by whichever writer and with any number of threads, and never more than asked for."""

from __future__ import annotations

import functools
import gzip
import io
import tracemalloc
import zlib
from collections.abc import Iterable

import numpy as np
import pytest
from zlib_ng import zlib_ng

from sparklod_cli.codecs import compression, inflate
from sparklod_cli.codecs.compression import BLOCK, DataRun
from sparklod_cli.codecs.inflate import FLUSHED, Inflate
from sparklod_cli.support.errors import ChecksumError, FormatError, TruncatedError
from sparklod_cli.support.progress import silent

THREADS = (1, 2, 5)
LIBRARIES = (inflate._library, zlib_ng)


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


def ours(data: bytes, comment: bytes = b"") -> bytes:
    return b"".join(compression.gzip_member([data], [DataRun(len(data))], 5, 1, silent, comment=comment))


@functools.cache
def members(size: int = 2 * BLOCK + 7) -> dict[str, bytes]:
    """Members of the same data by different writers."""
    data = sample(size)
    blocks = [data[at : at + BLOCK] for at in range(0, len(data), BLOCK)]
    words = [(data[:20_000] * 30)[:BLOCK]] * 3  # which refer to each other
    return {
        "ours": ours(data),
        "commented": ours(data, b"a comment"),
        "python": gzip.compress(data, 1),
        "full flush": flushed(blocks, zlib.Z_FULL_FLUSH),
        "sync flush": flushed(blocks, zlib.Z_SYNC_FLUSH),
        "many flushes": flushed([data[at : at + 999] for at in range(0, len(data), 999)], zlib.Z_FULL_FLUSH),
        "stored": (made := gzip.compress(data, 0)),
        "looks flushed": gzip.compress(data[:BLOCK] + FLUSHED * 50 + data[BLOCK:], 0),
        "dictionaries": flushed(words, zlib.Z_SYNC_FLUSH),
        "zeros": ours(bytes(20 * BLOCK)),
        "named": made[:3] + b"\x08" + made[4:10] + b"name\0" + made[10:],
        "empty": ours(b""),
    }


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("kind", list(members(0)))
def test_all_writers_are_read_to_the_end(kind: str, threads: int) -> None:
    packed = members()[kind]
    expected = gzip.decompress(packed)
    for behind in (b"", b"some more", packed):
        reader = Inflate(io.BytesIO(packed + behind), threads)
        found = b"".join(bytes(reader.read(size)) for size in [16, 0, 5, *[300_000] * (len(expected) // 300_000 + 1)])
        assert found == expected
        reader.finish(allow_more=False)
        assert reader.end() == len(packed)
        assert reader.behind() == behind[:2]


@pytest.mark.parametrize("size", [1, inflate.MOST_COMMENT - 1, inflate.MOST_COMMENT, 1 << 17])
def test_a_comment_is_read_up_to_a_size(size: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"c" * size)))
    assert reader.comment == (b"c" * size if size < inflate.MOST_COMMENT else b"")
    assert reader.read(9) == b"data"
    reader.finish(allow_more=False)


@pytest.mark.parametrize("cut", range(10, 20))
def test_a_member_that_ends_in_its_comment_is_cut_short(cut: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"a comment")[:cut]))
    assert reader.read(9) == b""
    with pytest.raises(TruncatedError):
        reader.finish(allow_more=False)


def test_only_what_refers_to_itself_is_inflated_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many parts as blocks, and of the last one no flush tells the end."""
    alone: list[bool] = []
    true = inflate._alone

    def counted(part: bytes) -> tuple[int, bytes | None]:
        size, data = true(part)
        alone.append(data is not None)
        return size, data

    monkeypatch.setattr(inflate, "_alone", counted)
    every = members()
    expected = {"ours": [True] * 2, "commented": [True] * 2, "full flush": [True] * 2, "python": [], "stored": [False]}
    for kind, parts in expected.items():
        alone.clear()
        reader = Inflate(io.BytesIO(every[kind]), 2)
        while reader.read(BLOCK):
            pass
        assert alone == parts
    alone.clear()
    reader = Inflate(io.BytesIO(every["dictionaries"]), 2)
    while reader.read(BLOCK):
        pass
    assert not all(alone)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("kind", ["ours", "python", "full flush", "named"])
def test_every_damage_is_found(kind: str, threads: int) -> None:
    packed = members(BLOCK + 5000)[kind]
    rng = np.random.default_rng(1)
    for at in [*rng.integers(20, len(packed), 12), *range(len(packed) - 8, len(packed))]:
        damaged = bytearray(packed)
        damaged[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(FormatError):
            read_all(bytes(damaged), threads)
    for at in rng.integers(0, len(packed), 8):
        with pytest.raises(TruncatedError):
            read_all(packed[:at], threads)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("kind", ["ours", "python", "named"])
def test_a_wrong_checksum_is_told_apart(kind: str, threads: int) -> None:
    packed = bytearray(members()[kind])
    packed[-6] ^= 1
    with pytest.raises(ChecksumError, match="checksum is wrong"):
        read_all(bytes(packed), threads)


def read_all(packed: bytes, threads: int) -> None:
    reader = Inflate(io.BytesIO(packed), threads)
    while reader.read(100_000):
        pass
    reader.finish(allow_more=False)


@pytest.mark.parametrize("sizes", [[10], [1, 2, 3], [0, 10_000, 0, 1], [20_000]])
def test_inflating_gives_what_is_asked_for(sizes: list[int]) -> None:
    data = bytes(range(256)) * 100
    inflate = Inflate(io.BytesIO(gzip.compress(data)))
    at = 0
    for size in sizes:
        assert inflate.read(size) == data[at : at + size]
        at += size
    with pytest.raises(FormatError, match="more data"):
        inflate.finish(allow_more=False)
    inflate.finish(allow_more=True)


def test_inflating_beyond_the_end_gives_less() -> None:
    inflate = Inflate(io.BytesIO(gzip.compress(b"some")))
    assert inflate.read(10) == b"some"
    inflate.finish(allow_more=False)


@pytest.mark.parametrize("cut", range(1, 9))
def test_a_truncated_checksum_is_refused(cut: int) -> None:
    inflate = Inflate(io.BytesIO(gzip.compress(b"some")[:-cut]))
    inflate.read(4)
    with pytest.raises(FormatError, match="checksum is missing"):
        inflate.finish(allow_more=False)


def test_a_bomb_is_never_inflated_whole() -> None:
    bomb = gzip.compress(bytes(50_000_000), 9)
    tracemalloc.start()
    try:
        inflate = Inflate(io.BytesIO(bomb))
        assert inflate.read(1000) == bytes(1000)
        with pytest.raises(FormatError, match="more data"):
            inflate.finish(allow_more=False)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
