"""gzip: one member, the same for any number of threads, that anyone can read. Inflating: never more than asked for."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import zstandard

from sparklod_cli.codecs import compression
from sparklod_cli.support.errors import FormatError
from sparklod_cli.support.progress import silent

BLOCK = compression.BLOCK
SIZES = (0, 1, 2, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK, 3 * BLOCK, 3 * BLOCK + 7)


@functools.cache
def sample(size: int, kind: str = "mixed") -> np.ndarray:
    """Bytes that compress a little, not at all, or to nearly nothing."""
    rng = np.random.default_rng(9)
    kinds = {
        "mixed": lambda: rng.integers(0, 256, size) & rng.integers(0, 256, size),
        "noise": lambda: rng.integers(0, 256, size),
        "zeros": lambda: np.zeros(size),
    }
    return kinds[kind]().astype(np.uint8)


def packed(data: np.ndarray, *, level: int = 5, threads: int = 1) -> bytes:
    return b"".join(compression.gzip_member([data], data.size, level, threads, silent))


@pytest.mark.parametrize("size", SIZES)
def test_gzip_is_one_member_without_a_time_that_python_reads(size: int) -> None:
    data = sample(size)
    made = packed(data)
    assert made[:10] == bytes([0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 0, 0xFF])  # deflate, no flags, no time, unknown system
    assert gzip.decompress(made) == data.tobytes()
    reader = zlib.decompressobj(wbits=31)  # stops at the end of the first member
    assert reader.decompress(made) == data.tobytes()
    assert (reader.eof, reader.unused_data) == (True, b"")
    assert made[-8:] == struct.pack("<II", zlib.crc32(data.tobytes()), size)


@pytest.mark.parametrize("kind", ["mixed", "noise", "zeros"])
@pytest.mark.parametrize("size", SIZES)
def test_threads_do_not_change_a_byte_of_gzip(size: int, kind: str) -> None:
    data = sample(size, kind)
    one = packed(data)
    assert gzip.decompress(one) == data.tobytes()
    assert packed(data, threads=2) == one
    assert packed(data, threads=5) == one


@pytest.mark.parametrize("level", range(1, 10))
def test_every_level_is_read_back(level: int) -> None:
    data = sample(BLOCK + 1)
    assert gzip.decompress(packed(data, level=level, threads=2)) == data.tobytes()


def test_blocks_refer_to_the_block_before() -> None:
    """Noise that repeats across a block boundary costs next to nothing the second time."""
    noise = sample(BLOCK, "noise")
    tail = noise[-compression.WINDOW // 2 :]
    alone, after = (len(packed(data)) for data in (noise, np.concatenate([noise, tail])))
    assert after - alone < 0.1 * len(tail)


def test_progress_ends_at_the_end() -> None:
    said: list[tuple[str, int, int, str]] = []
    data = sample(3 * BLOCK + 7)
    list(compression.gzip_member([data], data.size, 1, 2, lambda *args: said.append(args)))
    assert said == [("writing", min(BLOCK * (i + 1), len(data)), len(data), "B") for i in range(4)]


@pytest.mark.parametrize("sizes", [[10], [1, 2, 3], [0, 10_000, 0, 1], [20_000]])
def test_inflating_gives_what_is_asked_for(sizes: list[int]) -> None:
    data = bytes(range(256)) * 100
    inflate = compression.Inflate(io.BytesIO(gzip.compress(data)))
    at = 0
    for size in sizes:
        assert inflate.read(size) == data[at : at + size]
        at += size
    with pytest.raises(FormatError, match="more data"):
        inflate.finish(allow_more=False)
    inflate.finish(allow_more=True)


def test_inflating_beyond_the_end_gives_less() -> None:
    inflate = compression.Inflate(io.BytesIO(gzip.compress(b"some")))
    assert inflate.read(10) == b"some"
    inflate.finish(allow_more=False)


@pytest.mark.parametrize("cut", range(1, 9))
def test_a_truncated_checksum_is_refused(cut: int) -> None:
    inflate = compression.Inflate(io.BytesIO(gzip.compress(b"some")[:-cut]))
    inflate.read(4)
    with pytest.raises(FormatError, match="checksum is missing"):
        inflate.finish(allow_more=False)


def test_a_bomb_is_never_inflated_whole() -> None:
    bomb = gzip.compress(bytes(50_000_000), 9)
    tracemalloc.start()
    try:
        inflate = compression.Inflate(io.BytesIO(bomb))
        assert inflate.read(1000) == bytes(1000)
        with pytest.raises(FormatError, match="more data"):
            inflate.finish(allow_more=False)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


PROMISED = 10 * compression.MAX_RATIO * compression.TRUSTED_SIZE


@pytest.mark.parametrize(
    ("total", "file_size", "allowed"),
    [
        (compression.TRUSTED_SIZE, 30, True),
        (compression.TRUSTED_SIZE + 1, 30, False),
        (PROMISED, PROMISED // compression.MAX_RATIO, True),
        (PROMISED, PROMISED // compression.MAX_RATIO - 1, False),
    ],
)
def test_a_promised_size_is_bounded_by_the_size_of_the_file(total: int, file_size: int, allowed: bool) -> None:
    if allowed:
        compression.check_promise(total, file_size)
    else:
        with pytest.raises(FormatError, match="its header announces"):
            compression.check_promise(total, file_size)


def frame(data: bytes, *, with_size: bool = True) -> bytes:
    return zstandard.ZstdCompressor(write_content_size=with_size).compress(data)


def unzstd(data: bytes, packed: int | None = None) -> compression.Unzstd:
    return compression.Unzstd(io.BytesIO(data), len(data) if packed is None else packed, "sh")


@pytest.mark.parametrize("with_size", [True, False])
def test_a_zstd_frame_gives_what_is_asked_for_and_must_end_there(with_size: bool) -> None:
    data = bytes(range(100))
    packed = frame(data, with_size=with_size)
    for sizes in ([100], [1, 2, 97], [0, 100, 0], [100, 1], [1 << 20]):
        reader, at = unzstd(packed), 0
        for size in sizes:
            assert reader.read(size) == data[at : at + size]
            at += size
        reader.finish()
    for size in (0, 99):
        reader = unzstd(packed)
        reader.read(size)
        with pytest.raises(FormatError, match="stream sh is longer than its table announces"):
            reader.finish()


def test_a_zstd_frame_ends_where_its_bytes_do() -> None:
    first, second = (frame(bytes([value]) * 1000) for value in (1, 2))
    file = io.BytesIO(first + second)
    for value, packed in ((1, first), (2, second)):
        reader = compression.Unzstd(file, len(packed), "sh")
        assert reader.read(1000) == bytes([value]) * 1000
        reader.finish()
    assert len(unzstd(first + second, len(first)).read(2000)) == 1000
    assert len(unzstd(first, len(first) - 5).read(1000)) < 1000
    with pytest.raises(FormatError, match="corrupt zstd data in stream sh"):
        unzstd(b"something else that is long").read(10)


@pytest.mark.parametrize("with_size", [True, False])
def test_a_zstd_bomb_is_never_inflated_whole(with_size: bool) -> None:
    bomb = frame(bytes(50_000_000), with_size=with_size)
    tracemalloc.start()
    try:
        reader = unzstd(bomb)
        assert reader.read(1000) == bytes(1000)
        with pytest.raises(FormatError):
            reader.finish()
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
