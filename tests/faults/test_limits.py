"""Limits of a process: open files, memory, the size of files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.faults.runs import ENVIRONMENT, TREE, WRITERS, check_whole, said_one_error, shell

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ulimit")]


@pytest.mark.parametrize("name", WRITERS)
def test_a_limit_of_file_size_is_one_error_or_a_small_file(name: str, tmp_path: Path) -> None:
    arguments, output = WRITERS[name]
    # Without bytecode, because Python 3.11 leaves incomplete .pyc files if it cannot write all of a module.
    done = shell('ulimit -f 1; PYTHONDONTWRITEBYTECODE=1 "$@"', *arguments, tmp_path / output)
    if done.returncode == 0:  # the output is small
        check_whole(tmp_path / output)
        assert (tmp_path / output).stat().st_size <= 1024
        return
    assert done.returncode == 1
    line = said_one_error(done.stderr)
    assert "file too large" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "most"), [("build-lod", 10), ("traverse", 16), ("render", 10), ("inspect", 16)])
def test_too_few_open_files_are_one_error_or_none(name: str, most: int, tmp_path: Path) -> None:
    arguments, output = WRITERS[name]
    done = shell(f'ulimit -n {most}; "$@"', *arguments, tmp_path / output)
    assert done.returncode in (0, 1), done.stderr
    if done.returncode:
        assert "Traceback" not in done.stderr
        said_one_error(done.stderr)
        assert list(tmp_path.iterdir()) == []
    else:
        check_whole(tmp_path / output)


def test_many_files_are_not_open_at_a_time(tmp_path: Path) -> None:
    arguments = ["render", TREE, "--orbit", "40", "--size", "16x12", "-o", tmp_path / "out.%04d.png"]
    done = shell('ulimit -n 32; "$@"', *arguments)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.iterdir())) == 40


#: Runs a command, limits memory to what the process takes then and 3 MB, and runs another one. The first one loads all
#: that is needed, since neither Python nor LLVM can report that memory is lacking for a few bytes of their own.
LIMITED = """
import json, re, resource, sys
from sparklod_cli.support import interrupts
from sparklod_cli.cli import one_thread_of_blas, run
one_thread_of_blas()
interrupts.handle()
first, second = json.loads(sys.argv[1])
assert run(first) == 0
taken = re.search(r"VmSize:\\s*(\\d+) kB", open("/proc/self/status").read())
limit = (int(taken[1]) + 3_000) << 10
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(run(second))
"""

#: Arrays come from the system and go back to it, and threads share one arena: others reserve up to 128 MB each.
ARRAYS_ON_THEIR_OWN = {**ENVIRONMENT, "MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_THRESHOLD_": "65536"}


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A million splats, 32 MB."""
    rows = np.zeros(1_000_000, [("center", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    rows["center"] = np.arange(1_000_000)[:, None] % [100, 101, 103]
    rows["scale"], rows["rgba"], rows["quat"] = 0.01, 200, [255, 128, 128, 128]
    path = tmp_path_factory.mktemp("large") / "scene.splat"
    path.write_bytes(rows.tobytes())
    return path


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not tell what a process takes")
@pytest.mark.parametrize("name", ["build-lod", "inspect", "render a scene", "render a picture"])
def test_too_little_memory_is_one_error_in_every_command(name: str, large: Path, tmp_path: Path) -> None:
    lines: dict[str, list[object]] = {
        "build-lod": ["build-lod", large, "-o", tmp_path / "out.spz"],
        "inspect": ["inspect", large, "--stats", "--json"],
        "render a scene": ["render", large, "--size", "16x12", "-o", tmp_path / "out.png"],
        "render a picture": ["render", TREE, "--size", "2000x2000", "-o", tmp_path / "out.png"],
    }
    first = [*map(str, lines[name]), "--threads", "1", "-q"]
    second = [*first, *(["--overwrite"] if "-o" in first else [])]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, json.dumps([first, second])],
        capture_output=True, text=True, check=False, env=ARRAYS_ON_THEIR_OWN, timeout=300,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "memory" in said_one_error(done.stderr)
    assert {path.name for path in tmp_path.iterdir()} <= {"out.spz", "out.png"}
