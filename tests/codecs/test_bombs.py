"""Headers that promise gigabytes and files that unfold to them, through the real command line."""

from __future__ import annotations

import gzip
import re
import struct
import subprocess
import sys
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import pytest

from fixtures import by_hand

from ..scenes import splat_columns

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does")

PLY = by_hand.ply(splat_columns(20))
GIGABYTES = 8
BILLIONS = 4_000_000_000


def gzip_bomb(beginning: bytes) -> bytes:
    """A gzip member of a beginning and gigabytes of zeros: deflate blocks that refer to nothing can be repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = packer.compress(beginning) + packer.flush(zlib.Z_FULL_FLUSH)
    megabyte = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + head + megabyte * (1024 * GIGABYTES)


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


ASCII = by_hand.ply(splat_columns(20), text=True)
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
}

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
from sparklod_cli.cli import run
code = run(["build-lod", *sys.argv[1:], "--threads", "2"])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
sys.exit(code)
"""


@dataclass(frozen=True)
class Run:
    """What came of all bombs at once, for numba takes longer to load than they take to be refused."""

    directory: Path
    code: int
    lines: list[str]
    kilobytes: int
    seconds: float

    def lines_about(self, name: str) -> list[str]:
        start = f"error: {self.directory / name}.bin: "
        return [line.removeprefix(start) for line in self.lines if line.startswith(start)]


@pytest.fixture(scope="module")
def all_bombs(tmp_path_factory: pytest.TempPathFactory) -> Run:
    directory = tmp_path_factory.mktemp("bombs")
    sources = [directory / f"{name}.bin" for name in BOMBS]
    for source, content in zip(sources, BOMBS.values(), strict=True):
        source.write_bytes(content)
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", LIMITED, *sources], capture_output=True, text=True, timeout=120)
    seconds = time.perf_counter() - start
    return Run(directory, done.returncode, done.stderr.splitlines(), int(done.stdout or -1), seconds)


@pytest.mark.parametrize("name", BOMBS)
def test_each_is_refused_for_what_is_wrong_with_it(name: str, all_bombs: Run) -> None:
    (reason,) = all_bombs.lines_about(name)
    assert "memory" not in reason  # "does not fit into memory" would send people shopping


def test_all_are_refused_in_little_memory_and_time(all_bombs: Run) -> None:
    assert all_bombs.code == 1
    assert len(all_bombs.lines) == len(BOMBS), all_bombs.lines
    assert 0 < all_bombs.kilobytes < 600_000  # numba takes most of it
    assert all_bombs.seconds < 60
    assert {path.name for path in all_bombs.directory.iterdir()} == {f"{name}.bin" for name in BOMBS}
