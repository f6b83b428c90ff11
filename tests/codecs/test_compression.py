"""gzip: one member, the same for any number of threads, that anyone can read. zstd: never more than asked for."""

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
from sparklod_cli.codecs.compression import MIXED, Way
from sparklod_cli.codecs.unzstd import Unzstd
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.progress import silent

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
    return b"".join(compression.gzip_member([data], [(data.size, MIXED)], level, threads, silent))


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


def blocks_of(made: bytes) -> list[bytes]:
    """The blocks of a member, each inflated by itself."""
    parts = [part + b"\0\0\xff\xff" for part in made[10:-8].split(b"\0\0\xff\xff")]
    return [zlib.decompressobj(-15).decompress(part) for part in parts]


def test_blocks_are_inflated_by_themselves_in_any_order() -> None:
    data = np.tile(sample(BLOCK // 4, "noise"), 9)  # which repeats further back than blocks may look
    data = np.concatenate([data, data[-compression.TRIED :]])
    found = blocks_of(packed(data))
    assert [len(block) for block in found] == [BLOCK, BLOCK, BLOCK // 4 + compression.TRIED]
    assert b"".join(found) == data.tobytes()


def test_blocks_end_where_a_run_does_unless_all_fit_into_one() -> None:
    data = sample(BLOCK + 30)
    sizes = {BLOCK + 30: [BLOCK, 30], 20: [20, BLOCK, 10], 0: [BLOCK, 30]}
    for first, expected in sizes.items():
        runs = [(first, compression.NOISE), (len(data) - first, MIXED)]
        made = b"".join(compression.gzip_member([data[:7], data[7:]], runs, 5, 2, silent))
        assert [len(block) for block in blocks_of(made)] == expected
        assert gzip.decompress(made) == data.tobytes()
    small = [(20, compression.NOISE), (30, MIXED)]
    assert len(blocks_of(b"".join(compression.gzip_member([data[:50]], small, 5, 1, silent)))) == 1


@pytest.mark.parametrize("missing", [-1, 1])
def test_pieces_hold_what_the_runs_say(missing: int) -> None:
    data = sample(BLOCK + 30)
    with pytest.raises(ValueError, match="of a block are missing" if missing > 0 else "more data than blocks"):
        list(compression.gzip_member([data], [(data.size + missing, MIXED)], 5, 1, silent))


def patterns() -> dict[str, np.ndarray]:
    """Data on which ways differ: bytes that repeat by chance, triples that repeat, runs, and distant repetitions."""
    rng, size = np.random.default_rng(3), BLOCK + 10_000
    triples = rng.integers(0, 256, (300, 3))[rng.integers(0, 300, size // 3)]
    runs = np.repeat(rng.integers(0, 3, size // 40), rng.integers(30, 50, size // 40))
    found = {
        "chance": rng.normal(128, 20, size).astype(np.uint8),
        "triples": triples.ravel(),
        "runs": runs,
        "words": np.tile(rng.integers(0, 256, 1 << 12), size >> 12),
    }
    return {name: np.resize(values, size).astype(np.uint8) for name, values in found.items()}


@pytest.mark.parametrize("ways", [compression.NOISE, compression.TRIPLES, compression.RUNS])
@pytest.mark.parametrize("kind", ["chance", "triples", "runs", "words"])
def test_of_several_ways_the_smallest_is_taken(kind: str, ways: tuple[Way, ...]) -> None:
    data = patterns()[kind]

    def size_of(*some: Way) -> int:
        made = b"".join(compression.gzip_member([data], [(data.size, some)], 5, 1, silent))
        assert gzip.decompress(made) == data.tobytes()
        return len(made)

    assert size_of(*ways) <= 1.001 * min(map(size_of, ways))


def test_each_way_is_the_smallest_for_some_data() -> None:
    kinds = patterns()
    for ways, kind, first in [
        (compression.NOISE, "chance", True),
        (compression.NOISE, "words", False),
        (compression.TRIPLES, "triples", True),
        (compression.RUNS, "words", False),
    ]:
        sizes = [len(packed_by(way, kinds[kind])) for way in ways]
        assert (sizes[0] < sizes[1]) == first, kind


def packed_by(way: Way, data: np.ndarray) -> bytes:
    return b"".join(compression.gzip_member([data], [(data.size, (way,))], 5, 1, silent))


@pytest.mark.parametrize("level", [1, 4])
def test_a_low_level_means_haste_whatever_the_data_are(level: int) -> None:
    data = patterns()["triples"]
    for ways in (compression.TRIPLES, compression.LINKS):
        run = (data.size, ways)
        assert b"".join(compression.gzip_member([data], [run], level, 1, silent)) == packed(data, level=level)


def test_progress_ends_at_the_end() -> None:
    said: list[tuple[str, int, int, str]] = []
    data = sample(3 * BLOCK + 7)
    list(compression.gzip_member([data], [(data.size, MIXED)], 1, 2, lambda *args: said.append(args)))
    assert said == [("writing", min(BLOCK * (i + 1), len(data)), len(data), "B") for i in range(4)]


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


def unzstd(data: bytes, packed: int | None = None) -> Unzstd:
    return Unzstd(io.BytesIO(data), len(data) if packed is None else packed, "sh")


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
        reader = Unzstd(file, len(packed), "sh")
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
