"""Headers that promise gigabytes and files that unfold to them, through the real command line."""

from __future__ import annotations

import gzip
import json
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Mapping, Sequence

import pytest

from fixtures import by_hand, by_hand_sog
from tests.conftest import FIXTURES
from tests.scenes import splat_columns

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does"),
]

PLY = by_hand.ply(splat_columns(20))
GIGABYTES = 8
BILLIONS = 4_000_000_000


def deflate_bomb(beginning: bytes) -> bytes:
    """A beginning and gigabytes of zeros: deflate blocks that refer to nothing can be repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = packer.compress(beginning) + packer.flush(zlib.Z_FULL_FLUSH)
    megabyte = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return head + megabyte * (1024 * GIGABYTES)


def gzip_bomb(beginning: bytes) -> bytes:
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + deflate_bomb(beginning)


def zstd_bomb() -> bytes:
    """A zstd frame of unknown size, of blocks that are one byte, repeated 2 ** 17 times."""
    block = struct.pack("<I", 1 << 1 | (1 << 17) << 3)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x38" + block * (8192 * GIGABYTES) + b"\x01\0\0"


def spz_with_bomb(count: int) -> bytes:
    """A version 4 file of whose five streams the first is a bomb."""
    frames = [zstd_bomb(), *[b""] * 4]
    table = b"".join(struct.pack("<QQ", len(f), size * count) for f, size in zip(frames, (9, 1, 3, 3, 4), strict=True))
    return struct.pack("<IIIBBBBI12x", by_hand.MAGIC, 4, count, 0, 12, 0, 5, 32) + table + b"".join(frames)


def gzip_header(count: int) -> bytes:
    return struct.pack("<IIIBBBB", by_hand.MAGIC, 3, count, 0, 12, 0, 0)


def counted(element: str, count: int, data: bytes) -> bytes:
    return re.sub(rf"element {element} \d+".encode(), f"element {element} {count}".encode(), data)


def ksplat(**fields: int) -> bytes:
    """A fixture whose headers say something else; u4 at these places of the file."""
    data = bytearray((FIXTURES / "golden" / "sh2-level1.ksplat").read_bytes())
    for name, value in fields.items():
        struct.pack_into("<I", data, KSPLAT[name], value)
    return bytes(data)


KSPLAT = {"sections": 4, "max_splats": 12, "splats": 16}
KSPLAT |= {f"section_{name}": 4096 + at for name, at in (("splats", 0), ("room", 4), ("buckets", 12), ("partial", 36))}


def raw_zip(members: Mapping[str, tuple[int, bytes, int]]) -> bytes:
    """A zip of members as (method, packed bytes, the size that is said of them); the checksums are of the packed."""
    files, directory = b"", b""
    for name, (method, data, size) in members.items():
        about = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 33, zlib.crc32(data), len(data), size, len(name), 0)
        directory += b"PK\1\2" + struct.pack("<H", 20) + about + struct.pack("<HHHII", 0, 0, 0, 0, len(files))
        directory += name.encode()
        files += b"PK\3\4" + about + name.encode() + data
    count = len(members)
    return files + directory + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(files), 0)


SOG = {path.name: path.read_bytes() for path in sorted((FIXTURES / "golden" / "sh1-sog").iterdir())}


def sog(changes: Mapping[str, bytes | tuple[int, bytes, int]]) -> bytes:
    """A good SOG but for these members."""
    every = SOG | changes
    return raw_zip({name: (0, data, len(data)) if isinstance(data, bytes) else data for name, data in every.items()})


def meta(**changes: object) -> dict[str, bytes]:
    return {"meta.json": json.dumps(json.loads(SOG["meta.json"]) | changes).encode()}


def all_images(side: int, **changes: object) -> dict[str, bytes]:
    """Images of so many rows and columns, and no SH."""
    flat = by_hand_sog.flat_webp(side, side)
    return {name: flat for name in SOG if name.endswith(".webp")} | meta(shN=None, **changes)


def manifest(levels: int = 1, filenames: Sequence[str] = ("0_0/meta.json",), **tree: object) -> bytes:
    return json.dumps({"lodLevels": levels, "filenames": filenames, "tree": tree}).encode()


ASCII = by_hand.ply(splat_columns(20), text=True)
COMPRESSED = (FIXTURES / "golden" / "sh3-compressed.ply").read_bytes()
ZIP_BOMB, META_BOMB = deflate_bomb(SOG["means_l.webp"]), deflate_bomb(b'{"version":2')
FLAT = by_hand_sog.flat_webp(16383, 16383)
FACES = b"element face 1\nproperty list uchar int v\n"
BOMBS: dict[str, bytes] = {
    "PLY that promises billions": counted("vertex", BILLIONS, PLY),
    "PLY that promises billions of faces": counted("face", BILLIONS, PLY.replace(b"end_header", FACES + b"end_header")),
    "ascii PLY that promises billions": counted("vertex", BILLIONS, ASCII),
    "ascii PLY with billions before": counted("face", BILLIONS, ASCII.replace(b"element v", FACES + b"element v")),
    "SPZ that promises billions": gzip.compress(gzip_header(BILLIONS)),
    "SPZ 4 that promises billions": by_hand.spz_zstd(BILLIONS, 0, 12, 0, [b""] * 5, sizes=[9 * BILLIONS] * 5),
    "gzip bomb": gzip_bomb(gzip_header(100)),
    "gzip bomb that keeps its promise": gzip_bomb(gzip_header(GIGABYTES * 2**30 // 20)),
    "gzip bomb of nothing": gzip_bomb(b""),
    "zstd bomb": spz_with_bomb(100),
    "zstd bomb that keeps its promise": spz_with_bomb(GIGABYTES * 2**30 // 9),
    "compressed PLY that promises billions": counted("vertex", BILLIONS, COMPRESSED),
    "compressed PLY that promises billions of chunks": counted("chunk", BILLIONS, COMPRESSED),
    "compressed PLY that promises billions of SH": counted("sh", BILLIONS, COMPRESSED),
    "compressed PLY that promises billions of all": counted(
        "chunk", BILLIONS // 256, counted("vertex", BILLIONS, counted("sh", BILLIONS, COMPRESSED))
    ),
    "KSPLAT that promises billions": ksplat(splats=BILLIONS, max_splats=BILLIONS),
    "KSPLAT that promises billions of sections": ksplat(sections=BILLIONS),
    "KSPLAT section that promises billions": ksplat(section_splats=BILLIONS, section_room=BILLIONS),
    "KSPLAT section with room for billions": ksplat(section_room=BILLIONS),
    "KSPLAT section of billions of buckets": ksplat(section_buckets=BILLIONS),
    "KSPLAT section of billions of small buckets": ksplat(section_partial=BILLIONS),
    "zip bomb": sog({"means_l.webp": (8, ZIP_BOMB, 2**32 - 2)}),
    "zip bomb that says it is small": sog({"means_l.webp": (8, ZIP_BOMB, 1000)}),
    "zip bomb of meta": sog({"meta.json": (8, META_BOMB, 2**32 - 2)}),
    "zip bomb of meta that says it is small": sog({"meta.json": (8, META_BOMB, 1000)}),
    "zip that says it is large": sog({"means_l.webp": (0, SOG["means_l.webp"], 2**32 - 2)}),
    "WebP bomb": sog(all_images(16383)),
    "WebP bomb of as many splats": sog(all_images(16383, count=16383**2)),
    "WebP bomb in a large file": sog(all_images(12000) | {"padding": bytes(6_000_000)}),
    "WebP that says it is large": sog({"means_l.webp": FLAT[:25] + SOG["means_l.webp"][25:]}),
    "SOG that promises billions": sog(meta(count=BILLIONS)),
    "SOG that promises more than there is": sog(meta(count=10**30)),
    "SOG with a palette of billions": sog(meta(shN=json.loads(SOG["meta.json"])["shN"] | {"count": BILLIONS})),
    "meta.json of a deep nest": b'{"means":' + b"[" * 1_000_000,
    "meta.json of a deep nest of objects": b'{"a":' * 500_000,
    "meta.json of a long number": b'{"version":2,"count":' + b"9" * 1_000_000 + b"}",
    "meta.json of a long text": b'{"version":2,"asset":"' + b"x" * 50_000_000 + b'"}',
    "manifest of a deep tree": b'{"lodLevels":1,"filenames":[],"tree":' + b'{"children":[' * 300_000,
    "manifest of many nodes": manifest(children=[{"lods": {}}] * 200_000),
    "manifest of many levels": manifest(levels=2**31, lods={}),
    "manifest of billions of splats": manifest(lods={"0": {"file": 0, "offset": 0, "count": 1 << 28}}),
    "manifest of many chunks": manifest(lods={"0": {"file": 0, "offset": 0, "count": 1}}, filenames=["x"] * 500_000),
    "manifest of many chunks of billions": manifest(
        children=[{"lods": {"0": {"file": file, "offset": 0, "count": 1 << 28}}} for file in range(20_000)],
        filenames=[f"{file}/meta.json" for file in range(20_000)],
    ),
    "meta.json of many numbers": b'{"version":2,"count":1,"means":{"mins":[' + b"0," * 1_500_000 + b"0]}}",
}

LIMITED = """
import re, resource, sys, time
from pathlib import Path
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
from sparklod_cli.cli import run
code = run(["build-lod", *sys.argv[1:], "--threads", "2"])
status = Path("/proc/self/status")  # what a child is told of itself by `getrusage` counts its parent's memory, too
taken = re.search(r"VmHWM:\\s*(\\d+)", status.read_text())[1] if status.exists() else None
print(taken or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time())
sys.exit(code)
"""


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Refuses all bombs at once, for numba takes longer to load than they take; returns the errors of each."""
    directory = tmp_path_factory.mktemp("bombs")
    sources = [directory / f"{name}.bin" for name in BOMBS]
    for source, content in zip(sources, BOMBS.values(), strict=True):
        source.write_bytes(content)
    done = subprocess.run([sys.executable, "-c", LIMITED, *sources], capture_output=True, text=True, timeout=500)
    assert done.returncode == 1
    kilobytes, seconds = map(float, done.stdout.split())
    assert 0 < kilobytes < 600_000  # numba takes most of it
    assert 0 < seconds < 60  # of a processor, which are no more where other processes want it, too
    assert {*directory.iterdir()} == {*sources}
    lines = done.stderr.splitlines()
    assert len(lines) == len(BOMBS), lines
    return {source.stem: [line for line in lines if line.startswith(f"error: {source}: ")] for source in sources}


@pytest.mark.parametrize("name", BOMBS)
def test_each_bomb_is_refused_for_its_own_reason_in_little_memory_and_time(
    name: str, refused: dict[str, list[str]]
) -> None:
    (reason,) = refused[name]
    assert "memory" not in reason  # "does not fit into memory" would send people shopping
