"""Damaged bytes: a decoder gives a scene or a `FormatError`, and nothing else, quickly and in little memory."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from fixtures import by_hand, by_hand_sog
from sparklod_cli.codecs.formats import FORMATS, HEAD, Format, sniff
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES

#: Files to damage: small ones of every kind that is read.
FILES = (
    "one.ply",
    "sh1.ply",
    "sh1-ascii.ply",
    "sh1-big-endian.ply",
    "golden/sh3-compressed.ply",
    "golden/sh1-compressed-old.ply",
    *(f"golden/hand-{name}.spz" for name in ("v1", "v2", "v3", "v4", "v4-sh4")),
    *(f"golden/tree-v{version}.spz" for version in (2, 3)),
    "golden/sh3-v2.sog",
    "golden/sh2-v1.sog",
    "golden/sh1-streamed-sog/lod-meta.json",
    "golden/sh1-tiles/tileset.json",
    *(f"golden/sh2-level{level}.ksplat" for level in (0, 1, 2)),
    "golden/sh0.splat",
    *("golden/sh1.hier", "golden/sh3-half.hier"),
    *("golden/sh2-gsplat.pt", "golden/sh1-nerfstudio.ckpt"),
    "golden/sh1-tree.rad",
    *(f"golden/{name}.glb" for name in ("sh2", "sh1-quantized", "hand-spz", "sh1-draft", "parts")),
    *("golden/sh2.gltf", "golden/sh1-gltf/scene.gltf"),
)
GZIPPED = tuple(name for name in FILES if name.endswith(".spz") and "v4" not in name)
ZIPPED = tuple(name for name in FILES if name.endswith(".sog"))
#: Bytes, and seconds of a processor, which are no fewer where other processes want it, too. A header may promise 64 MiB
#: without being doubted.
MEMORY, SECONDS = 2e8, 2.0

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error")]  # they would go to standard error


@functools.cache
def content(name: str) -> bytes:
    return (FIXTURES / name).read_bytes()


@functools.cache
def files_of(name: str) -> dict[str, bytes]:
    """All files of the folder of a manifest, and of the folders there."""
    folder = (FIXTURES / name).parent
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.glob("*/*") if path.is_file()}


def format_of(name: str, data: bytes) -> Format | None:
    return sniff(data[:HEAD], Path(name).suffix)


@functools.cache
def _compile_kernels() -> None:
    """Decodes a file of the format that needs kernels, which may have to be compiled: nothing that a file can help."""
    form = format_of("golden/sh3-v2.sog", content("golden/sh3-v2.sog"))
    assert form is not None
    decode_file(form.codec(), io.BytesIO(content("golden/sh3-v2.sog")))


def attempt(name: str, data: bytes, *, files: Mapping[str, bytes] | None = None, threads: int = 1) -> str:
    """What comes of bytes in a file of this name, among others if need be: "scene" or the error's text."""
    form = format_of(name, data)
    if form is None:
        return "unknown"

    def open_companion(other: str) -> BinaryIO:
        if other not in among:
            raise FormatError("there is no such file")
        return io.BytesIO(among[other])

    among = files_of(name) if name and files is None and form.folders else files or {}

    more = {"open_companion": open_companion} if form.companions else {}
    _compile_kernels()
    start = time.process_time()
    try:
        scene = decode_file(form.codec(), io.BytesIO(data), threads=threads, **more)
    except FormatError as error:
        assert "\n" not in str(error)
        result = str(error)
    else:
        assert isinstance(scene, Scene)
        if scene.tree:
            scene.tree.validate()
        result = "scene"
    assert time.process_time() - start < SECONDS
    return result


def test_the_files_are_of_every_format() -> None:
    assert {format_of(name, content(name)) for name in FILES} == set(FORMATS)
    assert [attempt(name, content(name)) for name in FILES] == ["scene"] * len(FILES)


def header(name: str, data: bytes) -> list[int]:
    """Where the bytes of a file are that say what the others mean."""
    if name.endswith(".ply"):
        return list(range(data.index(b"end_header\n") + 11))
    if name.endswith(".ksplat"):
        return [base + place for base in (0, 4096, 5120, 6144) for place in range(44)]
    if name.endswith(".sog"):  # the end is the directory, which decides
        return [*range(120), *range(len(data) - 400, len(data))]
    if name.endswith(".glb"):
        return list(range(28 + struct.unpack_from("<I", data, 12)[0]))
    if name.endswith(".rad"):  # the file's, and that of the first chunk
        return list(range(data.index(b"RADC") + 1200))
    if name.endswith(".hier"):  # the number of splats, and the nodes without their boxes
        count = struct.unpack_from("<i", data)[0]
        nodes, node = (4 + 236 * count, 28) if count > 0 else (4 - 124 * count, 20)
        return [*range(4), *range(nodes, nodes + 4 + node * struct.unpack_from("<i", data, nodes)[0])]
    return list(range(len(data) if name.endswith(".json") else min(120, len(data))))


@pytest.mark.parametrize("name", FILES)
def test_a_file_truncated_anywhere_is_refused(name: str) -> None:
    data = content(name)
    places = {
        *header(name, data),
        *range(0, len(data), max(1, len(data) // 97)),
        *range(len(data) - 9, len(data)),
    }
    harmless: Iterable[int] = ()
    if "ascii" in name:  # without its last newline, or a digit before it, it is still one of numbers
        harmless = range(data.rindex(b" ") + 2, len(data))
    elif name.endswith(".splat"):  # nothing says how many there should be
        harmless = range(0, len(data), 32)
    for end in sorted(places - set(harmless)):
        assert attempt(name, data[:end]) != "scene", end


@pytest.mark.parametrize("name", FILES)
def test_a_flipped_bit_gives_a_scene_or_a_format_error(name: str) -> None:
    data = content(name)
    rng = np.random.default_rng(10)
    every = [8 * place + bit for place in header(name, data) for bit in range(8)]
    tries = 150 if name in ZIPPED else 400  # images take longer
    bits = set(rng.choice(every, min(len(every), tries), replace=False)) | set(
        rng.integers(0, 8 * len(data), tries // 2)
    )
    changed = bytearray(data)
    refused = 0
    if not name.endswith(".ply"):  # a bit of the count is a promise of billions; tracing plyfile would take long
        tracemalloc.start()
    for bit in sorted(bits):
        changed[bit // 8] ^= 1 << bit % 8
        refused += attempt(name, bytes(changed)) != "scene"
        changed[bit // 8] ^= 1 << bit % 8
    peak = tracemalloc.get_traced_memory()[1]  # 0 if nothing is traced
    tracemalloc.stop()
    assert peak < MEMORY
    if name in GZIPPED:
        assert refused >= len(bits) - 8 * 7  # unseen: the header's time, system, level and a flag; padding
    elif not name.endswith(".splat"):  # all bits of which are numbers
        assert refused > 0.1 * len(bits)


def insides(name: str) -> list[tuple[bytes, Callable[[bytes], bytes]]]:
    """What lies under a file's checksums, part by part, and what puts the file together again around another part."""
    if name in GZIPPED:
        return [(gzip.decompress(content(name)), lambda data: gzip.compress(data, 1))]
    if name in ZIPPED:
        files = members(name)
        return [
            (data, lambda other, part=part: by_hand_sog.zipped(files | {part: other})) for part, data in files.items()
        ]
    return [(content(name), bytes)]


@functools.cache
def members(name: str) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content(name))) as archive:
        return {part: archive.read(part) for part in archive.namelist()}


@pytest.mark.parametrize("name", [*GZIPPED, *ZIPPED])
def test_flipped_bits_under_a_valid_checksum_give_a_scene_or_a_format_error(name: str) -> None:
    """What a faulty writer could make: gzip or zip find nothing wrong with it."""
    rng = np.random.default_rng(15)
    for data, packed in insides(name):
        changed = bytearray(data)
        first = range(8 * min(len(data), 400 if name in GZIPPED else 6))
        for bit in {*first, *(rng.integers(0, 8 * len(data), 30) if name in ZIPPED else ())}:
            changed[bit // 8] ^= 1 << bit % 8
            attempt(name, packed(bytes(changed)))
            changed[bit // 8] ^= 1 << bit % 8


WORDS = (
    *(b"element ", b"vertex", b"property ", b"list uchar int ", b"format ascii 1.0\n", b"comment ", b"end_header\n"),
    *(b"\n", b" ", b"-1", b"0", b"99999999999999999999", b"4294967295", b"1e999", b"\0", b"\xff", b"nan", b"inf"),
    *(b"NaN", b"-Infinity", b"null", b"true", b'"', b"{", b"}", b"[", b"]", b",", b":", b'"count":', b'"files":["'),
)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("seed", range(2))
def test_inserted_deleted_or_changed_bytes_give_a_scene_or_a_format_error(name: str, seed: int) -> None:
    rng = np.random.default_rng([11, seed, len(name)])
    raw, packed = insides(name)[0]  # of SOG, meta.json
    reach = [len(header(name, raw)), len(raw)]
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
        attempt(name, packed(bytes(data)), threads=2)


NUMBERS = (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 0.0, -1.0)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(("splat", "compressed.ply", "old.ply"))])
def test_invalid_numbers_are_passed_on_without_a_warning(name: str, threads: int) -> None:
    """Whether they are an error is for `selection` to say; numpy must not warn of them, on any thread."""
    raw = content(name)
    begin = len(header(name, raw)) if name.endswith(".ply") else 6144 if name.endswith(".ksplat") else 0
    places = np.arange(begin, len(raw) - 3, 4)
    if name.endswith(".ksplat"):
        places = np.concatenate([[36, 40, 4096 + 16, 5120 + 16], places])  # the range of SH bytes, the size of buckets
    rng = np.random.default_rng(16)
    for number in NUMBERS:
        for chosen in (places, places[:4], *(rng.choice(places, 20) for _ in range(5))):
            data = bytearray(raw)
            for place in chosen:
                data[place : place + 4] = struct.pack("<f", number)
            result = attempt(name, bytes(data), threads=threads)
            assert result == "scene" or name.endswith(".ksplat")


MAGICS = (
    *(b"ply\n", b"ply\r", b"ply\nelement chunk 1\nelement vertex 1\nproperty uint packed_position\n"),
    *(b"\x1f\x8b\x08\0", b"NGSP", b"PK\x03\x04", b'{"quats":1, "means":', b'{"lodLevels":'),
    b'{"asset":{},"geometricError":',
    b'{"asset":{"version":"2.0"},"accessors":[',
    b"PK\x03\x04" + bytes(26) + b"archive/data.pkl",
    *(b"\0\1\0\0\1\0\0\0", b"\0\1\0\0\3" + bytes(4091)),
    *(b"RAD0", b"RAD0\40\0\0\0{", b"RADC"),
    *(b"glTF", b"glTF\2\0\0\0"),
)


def test_every_format_with_a_magic_is_tried() -> None:
    assert {sniff(magic, "") for magic in MAGICS} == {form for form in FORMATS if not form.unmarked}


@pytest.mark.parametrize("magic", MAGICS)
def test_random_bytes_after_a_magic_give_a_scene_or_a_format_error(magic: bytes) -> None:
    rng = np.random.default_rng(12)
    for size in (0, 1, 12, 40, 1000, 100_000):
        for _ in range(10):
            data = magic + rng.bytes(size)
            assert attempt("", data) != "scene"
            other = data.replace(b"\n", b" ") if magic.startswith(b"ply") else gzip.compress(data)
            assert attempt("", other) != "scene"


@pytest.mark.parametrize("suffix", sorted({suffix for form in FORMATS for suffix in form.suffixes}))
def test_random_bytes_with_a_suffix_give_a_scene_or_a_format_error(suffix: str) -> None:
    rng = np.random.default_rng(14)
    for size in (0, 1, 12, 31, 33, 1000, 4097, 100_001):
        for _ in range(10):
            assert attempt(f"scene{suffix}", rng.bytes(size)) != "scene" or (size == 0 and suffix == ".splat")


def test_a_header_without_its_splats_is_refused() -> None:
    for version in (1, 2, 3):
        for count in (0, 1, 1_000_000, 4_294_967_295):
            result = attempt("", by_hand.spz_gzip(version, count, 3, 12, 0, []))
            assert result == "scene" if count == 0 else result != "scene"
    assert attempt("", by_hand.spz_zstd(4_294_967_295, 3, 12, 0, [b""] * 6)) != "scene"
