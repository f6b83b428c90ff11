"""kill -9 at any moment: files with a final name are whole, and the next run leaves only its outputs."""

from __future__ import annotations

import contextlib
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.faults.runs import CHUNKED, ENVIRONMENT, TREE, WRITERS, check_whole, command, sparklod

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="there is no kill -9 on Windows")]

#: Commands with one output, and with many.
CASES = {
    "build-lod": [*WRITERS["build-lod"][0], "demo.spz"],
    "build-lod in chunks": [*CHUNKED, "demo.rad"],
    "many cuts": ["traverse", TREE, "--orbit", "80", "--indices-out", "cuts", "-o", "table.csv"],
    "many pictures": ["render", TREE, "--orbit", "16", "--size", "96x64", "-o", "out.%04d.png"],
}


def run_again(arguments: list[object], folder: Path) -> None:
    """Asserts that files are whole, and that the next run succeeds and leaves nothing but whole outputs."""
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        hidden = any(name.startswith(".") for name in path.relative_to(folder).parts)  # as is a folder of files to come
        if not hidden and not path.name.endswith(".part"):
            check_whole(path)
    done = sparklod(*arguments, "--overwrite", cwd=folder)
    assert done.returncode == 0, done.stderr
    left = [path for path in folder.rglob("*") if path.name.startswith(".") or path.name.endswith(".part")]
    assert not left
    for path in folder.rglob("*"):
        if path.is_file():
            check_whole(path)


@pytest.mark.parametrize("name", ["build-lod", "many cuts", "many pictures"])
def test_a_run_killed_at_random_leaves_only_whole_files(name: str, tmp_path: Path) -> None:
    start = time.perf_counter()
    assert sparklod(*CASES[name], cwd=tmp_path).returncode == 0
    took = time.perf_counter() - start
    for path in [*tmp_path.rglob("*")]:
        if path.is_file():
            path.unlink()
    moments = random.Random(name)
    for _ in range(2):
        process = subprocess.Popen(
            command(*CASES[name], "--overwrite", "-q"), cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.DEVNULL
        )
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(moments.uniform(0.4, 1) * took)
        process.kill()
        process.wait()
    run_again(CASES[name], tmp_path)


def is_writing(process: int, folder: Path) -> bool:
    """Whether a process has a file of a folder open, even one without a name."""
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                if str(descriptor.readlink()).startswith(f"{folder}/"):
                    return True
    return False


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="this system does not tell which files are open")
@pytest.mark.parametrize("name", ["build-lod", "build-lod in chunks", "many cuts"])
def test_a_run_killed_while_it_writes_leaves_only_whole_files(name: str, tmp_path: Path) -> None:
    caught = 0
    for _ in range(4):
        process = subprocess.Popen(
            command(*CASES[name], "--overwrite", "-q"), cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.DEVNULL
        )
        while process.poll() is None and not is_writing(process.pid, tmp_path.resolve()):
            pass
        caught += process.poll() is None
        process.kill()
        process.wait()
        if caught:
            break
    if not caught:
        pytest.skip("it was quicker than this test every time")
    run_again(CASES[name], tmp_path)
