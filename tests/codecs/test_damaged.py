"""Damaged bytes: a decoder gives a scene or a `FormatError`, and nothing else, quickly and in little memory."""

from __future__ import annotations

import functools
import gzip
import io
import time
import tracemalloc

import numpy as np
import pytest

from fixtures import by_hand
from sparklod_cli.codecs.formats import FORMATS, sniff
from sparklod_cli.errors import FormatError
from sparklod_cli.scene import Scene

from ..conftest import FIXTURES

#: Files to damage: small ones of every kind that is read.
FILES = (
    "one.ply",
    "sh1.ply",
    "sh1-ascii.ply",
    "sh1-big-endian.ply",
    *(f"golden/hand-{name}.spz" for name in ("v1", "v2", "v3", "v4", "v4-sh4")),
    *(f"golden/tree-v{version}.spz" for version in (2, 3)),
)
GZIPPED = tuple(name for name in FILES if name.endswith(".spz") and "v4" not in name)
MEMORY, SECONDS = 2e8, 2.0  # a gzipped header may promise 64 MiB without being doubted

pytestmark = pytest.mark.filterwarnings("error")  # they would go to standard error


@functools.cache
def content(name: str) -> bytes:
    return (FIXTURES / name).read_bytes()


def attempt(data: bytes) -> str:
    """What comes of it: "scene" or the error's text."""
    form = sniff(data[:16])
    if form is None:
        return "unknown"
    start = time.perf_counter()
    try:
        scene = form.codec().decode(io.BytesIO(data))
    except FormatError as error:
        assert "\n" not in str(error)
        result = str(error)
    else:
        assert isinstance(scene, Scene)
        if scene.tree:
            scene.tree.validate()
        result = "scene"
    assert time.perf_counter() - start < SECONDS
    return result


def test_the_files_are_of_every_format() -> None:
    forms = {sniff(content(name)[:16]) for name in FILES}
    assert forms == set(FORMATS)
    assert [attempt(content(name)) for name in FILES] == ["scene"] * len(FILES)


def header_size(data: bytes) -> int:
    return data.index(b"end_header\n") + 11 if data.startswith(b"ply") else 120


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_is_refused_wherever_it_is_cut(name: str) -> None:
    data = content(name)
    places = {
        *range(header_size(data)),
        *range(0, len(data), max(1, len(data) // 97)),
        *range(len(data) - 9, len(data)),
    }
    # Without its last newline, or a digit before it, an ascii file is still one of numbers.
    harmless = set(range(data.rindex(b" ") + 2, len(data))) if "ascii" in name else set()
    for end in sorted(places - harmless):
        if end < len(data):
            assert attempt(data[:end]) != "scene", end


@pytest.mark.parametrize("name", FILES)
def test_single_bits(name: str) -> None:
    data = content(name)
    head = header_size(data)
    rng = np.random.default_rng(10)
    every = 8 * min(head, len(data))
    bits = set(rng.choice(every, min(every, 400), replace=False)) | set(rng.integers(0, 8 * len(data), 200))
    changed = bytearray(data)
    refused = 0
    if name.endswith(".spz"):  # a bit of the count is a promise of billions; tracing plyfile would take long
        tracemalloc.start()
    for bit in sorted(bits):
        changed[bit // 8] ^= 1 << bit % 8
        refused += attempt(bytes(changed)) != "scene"
        changed[bit // 8] ^= 1 << bit % 8
    peak = tracemalloc.get_traced_memory()[1]  # 0 if nothing is traced
    tracemalloc.stop()
    assert peak < MEMORY
    if name in GZIPPED:
        assert refused >= len(bits) - 8 * 7  # unseen: the header's time, system, level and a flag; padding
    else:
        assert refused > 0.1 * len(bits)


@pytest.mark.parametrize("name", GZIPPED)
def test_bits_under_a_right_checksum(name: str) -> None:
    """What a faulty writer could make: gzip finds nothing wrong with it."""
    data = gzip.decompress(content(name))
    changed = bytearray(data)
    for bit in range(8 * min(len(data), 400)):
        changed[bit // 8] ^= 1 << bit % 8
        attempt(gzip.compress(bytes(changed), 1))
        changed[bit // 8] ^= 1 << bit % 8


WORDS = (
    *(b"element ", b"vertex", b"property ", b"list uchar int ", b"format ascii 1.0\n", b"comment ", b"end_header\n"),
    *(
        b"\n",
        b"\r",
        b" ",
        b"-",
        b"x",
        b"f_rest_0",
        b"99999999999999999999",
        b"4294967295",
        b"\0",
        b"\xff",
        b"nan",
        b"inf",
    ),
)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("seed", range(2))
def test_worse_damage(name: str, seed: int) -> None:
    rng = np.random.default_rng([11, seed, len(name)])
    raw = gzip.decompress(content(name)) if name in GZIPPED else content(name)
    reach = [header_size(raw), len(raw)]
    for _ in range(150):
        data = bytearray(raw)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(0, min(len(data), reach[rng.integers(2)]) + 1))
            start = int(rng.integers(0, len(data) + 1))
            width = int(rng.choice([1, 2, 5, 20]))
            kind = rng.integers(4)
            if kind == 0:
                data[at:at] = WORDS[rng.integers(len(WORDS))]
            elif kind == 1:
                del data[at : at + width]
            elif kind == 2:
                data[at : at + width] = data[start : start + width]
            else:
                data[at : at + width] = rng.bytes(width)
        damaged = bytes(data)
        attempt(gzip.compress(damaged, 1) if name in GZIPPED else damaged)


@pytest.mark.parametrize("magic", [magic for form in FORMATS for magic in form.magics])
def test_random_bytes_with_a_magic(magic: bytes) -> None:
    rng = np.random.default_rng(12)
    for size in (0, 1, 12, 40, 1000, 100_000):
        for _ in range(10):
            data = magic + rng.bytes(size)
            assert attempt(data) != "scene"
            assert attempt(data.replace(b"\n", b" ") if magic.startswith(b"ply") else gzip.compress(data)) != "scene"


def test_a_header_alone() -> None:
    for version in (1, 2, 3):
        for count in (0, 1, 1_000_000, 4_294_967_295):
            result = attempt(by_hand.spz_gzip(version, count, 3, 12, 0, []))
            assert result == "scene" if count == 0 else result != "scene"
    assert attempt(by_hand.spz_zstd(4_294_967_295, 3, 12, 0, [b""] * 6)) != "scene"
