"""gzip: one member that anyone can read; inflating what any writer deflated; zstd. Never more than is asked for."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterable

import numpy as np
import pytest
import zstandard
from zlib_ng import zlib_ng

from sparklod_cli.codecs import compression
from sparklod_cli.codecs.compression import BLOCK, MIXED, Inflate, Unzstd, Way
from sparklod_cli.system.errors import ChecksumError, FormatError, TruncatedError
from sparklod_cli.system.progress import silent

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


def gzipped(data: np.ndarray, *, level: int = 5, threads: int = 1, comment: bytes = b"") -> bytes:
    runs = [(data.size, MIXED)]
    return b"".join(compression.gzip_member([data], runs, level, threads, silent, comment=comment))


@pytest.mark.parametrize("kind", ["mixed", "noise", "zeros"])
@pytest.mark.parametrize("size", SIZES)
def test_gzip_is_one_member_without_a_time_and_the_same_for_any_threads(size: int, kind: str) -> None:
    data = sample(size, kind)
    made = gzipped(data)
    assert made[:10] == bytes([0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 0, 0xFF])  # deflate, no flags, no time, unknown system
    reader = zlib.decompressobj(wbits=31)  # stops at the end of the first member
    assert reader.decompress(made) == data.tobytes()
    assert (reader.eof, reader.unused_data) == (True, b"")
    assert gzipped(data, threads=2) == gzipped(data, threads=5) == made


@pytest.mark.parametrize("level", range(1, 10))
def test_every_level_is_read_back(level: int) -> None:
    data = sample(BLOCK + 1)
    assert gzip.decompress(gzipped(data, level=level, threads=2)) == data.tobytes()


def blocks_of(made: bytes) -> list[bytes]:
    """The blocks of a member, each inflated by itself."""
    parts = [part + b"\0\0\xff\xff" for part in made[10:-8].split(b"\0\0\xff\xff")]
    return [zlib.decompressobj(-15).decompress(part) for part in parts]


def test_blocks_are_inflated_by_themselves_in_any_order() -> None:
    data = np.tile(sample(BLOCK // 4, "noise"), 9)  # which repeats further back than blocks may look
    data = np.concatenate([data, data[-compression.TRIED :]])
    found = blocks_of(gzipped(data))
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


@pytest.mark.parametrize("level", [1, 4])
def test_a_low_level_means_haste_whatever_the_data_are(level: int) -> None:
    data = patterns()["triples"]
    for ways in (compression.TRIPLES, compression.LINKS):
        run = (data.size, ways)
        assert b"".join(compression.gzip_member([data], [run], level, 1, silent)) == gzipped(data, level=level)


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


# --- Inflating --------------------------------------------------------------------------------------------------------

LIBRARIES = (compression._library, zlib_ng)

WITH_EACH_LIBRARY = pytest.mark.usefixtures("library")

#: End of an empty stored block, which a flush writes, and which data may hold, too.
FLUSHED = b"\0\0\xff\xff"

#: Flushes of zlib that Python has no names for: they end no block on a byte boundary, or with an empty fixed block.
Z_PARTIAL_FLUSH, Z_BLOCK = 1, 5


@pytest.fixture(params=LIBRARIES, ids=lambda library: library.__name__)
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library that is installed, and the one that replaces it elsewhere."""
    monkeypatch.setattr(compression, "_library", request.param)


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
    return gzipped(np.frombuffer(data, np.uint8), comment=comment)


@functools.cache
def members(size: int = 2 * BLOCK + 7) -> dict[str, bytes]:
    """Members of the same data by different writers."""
    data = sample(size).tobytes()
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


@WITH_EACH_LIBRARY
@pytest.mark.parametrize("kind", list(members(0)))
def test_all_writers_are_read_to_the_end(kind: str) -> None:
    assert_reads(members()[kind])


@WITH_EACH_LIBRARY
@pytest.mark.parametrize("step", [1 << 10, 1 << 13, 1 << 17])
@pytest.mark.parametrize("write", [ended_by_a_stored_block, mixed, ours], ids=lambda write: write.__name__)
def test_members_of_any_size_are_read_to_the_end(write: Callable[[bytes], bytes], step: int) -> None:
    """Around the bytes that are read at a time, so that a block, the end or the checksum is cut by them."""
    for size in {*range(8), *range(step - 3, step + 4), 3 * step // 2}:
        assert_reads(write(sample(size).tobytes()))


@WITH_EACH_LIBRARY
@pytest.mark.parametrize("size", [1, compression.MOST_COMMENT - 1, compression.MOST_COMMENT, 1 << 17])
def test_a_comment_is_read_up_to_a_size(size: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"c" * size)))
    assert reader.comment == (b"c" * size if size < compression.MOST_COMMENT else None)
    assert reader.read(9) == b"data"
    reader.finish()


@WITH_EACH_LIBRARY
@pytest.mark.parametrize("cut", range(10, 20))
def test_a_member_that_ends_in_its_comment_is_cut_short(cut: int) -> None:
    reader = Inflate(io.BytesIO(ours(b"data", b"a comment")[:cut]))
    assert reader.read(9) == b""
    with pytest.raises(TruncatedError):
        reader.finish()


@WITH_EACH_LIBRARY
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


@WITH_EACH_LIBRARY
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


@WITH_EACH_LIBRARY
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


# --- zstd -------------------------------------------------------------------------------------------------------------


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
