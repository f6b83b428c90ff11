"""Limits of a process: open files, memory, the size of files."""

from __future__ import annotations

import re
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


#: Runs a command and prints the peak of its address space in kB, with the thread that every command starts.
BASELINE = """
import re, sys
from sparklod_cli.support import interrupts
from sparklod_cli.cli import one_thread_of_blas, run
one_thread_of_blas()
interrupts.handle()  # starts a thread, whose stack and heap count
code = run(sys.argv[1:])
text = open("/proc/self/status").read()
print("peak", re.search(r"VmPeak:\\s*(\\d+) kB", text)[1], code)
"""


#: Threads that allocate reserve an arena of up to 128 MB of address space each, of which they use little.
ONE_ARENA = {**ENVIRONMENT, "MALLOC_ARENA_MAX": "1"}


def address_space(*arguments: object) -> int:
    """Returns the address space of a run, in kB."""
    done = subprocess.run(
        [sys.executable, "-c", BASELINE, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        env=ONE_ARENA,
    )
    found = re.search(r"^peak (\d+) 0$", done.stdout, re.MULTILINE)
    assert found, done.stdout + done.stderr
    return int(found[1])


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
    small = tmp_path / "small.splat"
    small.write_bytes(large.read_bytes()[: 32 * 100])
    lines: dict[str, list[object]] = {
        "build-lod": ["build-lod", "SCENE", "-o", tmp_path / "out.spz", "--overwrite"],
        "inspect": ["inspect", "SCENE", "--stats", "--json"],
        "render a scene": ["render", "SCENE", "--size", "16x12", "-o", tmp_path / "out.png", "--overwrite"],
        "render a picture": ["render", "SCENE", "--size", "SIZE", "-o", tmp_path / "out.png", "--overwrite"],
    }

    def line(scene: Path, size: str) -> list[object]:
        return [{"SCENE": scene, "SIZE": size}.get(str(word), word) for word in [*lines[name], "--threads", "1"]]

    # Less than any column of the large scene takes, so that an array is what fails: neither LLVM nor Python itself can
    # report that a few bytes are lacking.
    most = address_space(*line(small, "16x12")) + 3_000
    for path in tmp_path.glob("out.*"):
        path.unlink()
    subject = small if name == "render a picture" else large
    done = shell(f'ulimit -v {most}; "$@"', *line(subject, "8000x8000"), env=ONE_ARENA)
    assert done.returncode == 1, done.stderr
    assert "memory" in said_one_error(done.stderr)
    assert list(tmp_path.glob("*")) == [small]
