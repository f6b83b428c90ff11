"""Processes that fail from outside: full disks, read-only folders, limits, closed streams, kill -9, shared caches.

However a run ends, files with a final name are whole, and its failure is one error of one line.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.codecs.rad import rad_header
from sparklod_cli.io.reading import read_scene
from sparklod_cli.system.machine_code import SUFFIX
from tests.conftest import FIXTURES, ROOT

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has other processes")]

DEMO, SMALL, TREE = FIXTURES / "demo.ply", FIXTURES / "sh3.ply", FIXTURES / "golden" / "tree-v3.spz"

#: Modules in this folder replace packages that take seconds to load.
WITHOUT = Path(__file__).parent / "without"
ENVIRONMENT = {**os.environ, "NO_COLOR": "1", "PYTHONPATH": f"{WITHOUT}{os.pathsep}{ROOT}"}

#: Command lines of each command, and the name of the output, which is added to them.
WRITERS = {
    "build-lod": (f"build-lod {DEMO} -o", "demo.spz"),
    "build-lod in chunks": (f"build-lod {DEMO} --format rad-chunked -o", "demo.rad"),
    "traverse": (f"traverse {TREE} --orbit 300 --no-timing -o", "table.csv"),
    "render": (f"render {TREE} --size 320x200 -o", "picture.npy"),
    "inspect": (f"inspect {TREE} -q --html", "page.html"),
}


def command(line: str) -> list[str]:
    return [sys.executable, "-m", "sparklod_cli", *line.split()]


def sparklod(line: str, script: str = "", **how: Any) -> subprocess.CompletedProcess[str]:
    """Run sparklod to its end; in a shell where a script is given, with "$@" in place of the command line."""
    words = ["bash", "-c", script, "bash", *command(line)] if script else command(line)
    settings = {"capture_output": True, "text": True, "check": False, "env": ENVIRONMENT, "timeout": 300} | how
    return subprocess.run(words, **settings)


def error_of(done: subprocess.CompletedProcess[str]) -> str:
    """Return the one error of a run that failed; messages about compilation and progress may precede it."""
    assert done.returncode == 1, done.stderr
    check_quiet(done)
    (line,) = (line for line in done.stderr.splitlines() if line.lower().startswith("error: "))
    return line


def check_quiet(done: subprocess.CompletedProcess[str]) -> None:
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr, done.stderr


def check_whole(path: Path) -> None:
    """Assert that an output is complete."""
    if path.suffix == ".radc":
        with path.open("rb") as file:
            header = rad_header.read_chunk_header(file)
        assert path.stat().st_size == header.bytes + header.payload_bytes
    elif path.suffix in (".spz", ".rad"):
        scene = read_scene(path)
        assert scene.tree is not None
        scene.tree.validate()
    elif path.suffix in (".png", ".webp"):
        with Image.open(path) as image:
            image.load()
    elif path.suffix == ".npy":
        assert np.load(path).ndim
    elif path.suffix == ".html":
        assert path.read_text().rstrip().endswith("</html>")
    else:
        text = path.read_text()
        assert text.endswith("\n") and len({line.count(",") for line in text.splitlines()}) == 1


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """Mount a file system in memory; skip the test if this process may not mount one."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, check=False)
    except OSError:
        pytest.skip("there is no mount here")
    if done.returncode:
        pytest.skip("this process may not mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


# --- Disks and devices ------------------------------------------------------------------------------------------------

OLD = {"demo-0.radc": b"old chunk", "demo-7.radc": b"old chunk", "demo.rad": b"old header"}


@pytest.mark.parametrize(
    ("name", "options", "before", "reason"),
    [
        *((name, "size=8k", {}, "no space left") for name in WRITERS),
        *((name, "size=64k,ro", {}, "read-only") for name in ("build-lod", "build-lod in chunks", "traverse")),
        ("build-lod", "size=16k", {"demo.spz": TREE.read_bytes()}, "no space left"),
        ("build-lod in chunks", "size=64k", OLD, "no space left"),
    ],
)
def test_a_full_or_read_only_disk_is_one_error_and_keeps_its_files(
    name: str, options: str, before: dict[str, bytes], reason: str, tmp_path: Path
) -> None:
    line, output = WRITERS[name]
    with mounted(tmp_path / "disk", options) as disk:
        for file, data in before.items():
            (disk / file).write_bytes(data)
        said = error_of(sparklod(f"{line} {disk / output} --overwrite"))
        assert reason in said and str(disk) in said
        assert {path.name: path.read_bytes() for path in disk.iterdir()} == before


def test_folders_that_cannot_be_made_are_one_error(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=64k,ro") as disk:
        indices = f"traverse {TREE} --orbit 2 -o {tmp_path}/t.csv --overwrite --indices-out {disk}/new"
        for line in (f"build-lod {SMALL} --output-dir {disk}/new", indices):
            assert "read-only" in error_of(sparklod(line))


def test_frames_that_are_written_before_the_disk_is_full_are_whole(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=64k") as disk:
        done = sparklod(f"render {TREE} --orbit 40 --size 160x120 -o {disk}/out.%04d.npy")
        assert "no space left" in error_of(done)
        assert all(path.name.startswith("out.") for path in disk.iterdir())
        assert len({path.stat().st_size for path in disk.iterdir()}) <= 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("name", ["build-lod", "inspect", "traverse"])
def test_a_full_device_is_one_error_that_names_it(name: str) -> None:
    said = error_of(sparklod(f"{WRITERS[name][0]} /dev/full"))
    assert "no space left" in said and "/dev/full" in said


# --- Limits of a process; those of memory are in tests/commands/test_console.py ---------------------------------------


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        # Without bytecode, because Python 3.11 leaves incomplete .pyc files if it cannot write all of a module.
        *((name, "ulimit -f 1; export PYTHONDONTWRITEBYTECODE=1") for name in WRITERS),
        *(("build-lod", "ulimit -n 10"), ("traverse", "ulimit -n 16"), ("render", "ulimit -n 10")),
        ("inspect", "ulimit -n 16"),
    ],
)
def test_a_limit_of_sizes_or_open_files_is_one_error_or_none(name: str, limit: str, tmp_path: Path) -> None:
    line, output = WRITERS[name]
    done = sparklod(f"{line} {tmp_path / output}", f'{limit}; "$@"')
    check_quiet(done)
    if done.returncode == 0:
        check_whole(tmp_path / output)
        assert "-f" not in limit or (tmp_path / output).stat().st_size <= 1024
    else:
        assert "file too large" in error_of(done) or "-n" in limit
        assert list(tmp_path.iterdir()) == []


def test_many_files_are_not_open_at_a_time(tmp_path: Path) -> None:
    done = sparklod(f"render {TREE} --orbit 40 --size 16x12 -o {tmp_path}/out.%04d.png", 'ulimit -n 32; "$@"')
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.iterdir())) == 40


# --- Streams ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def pipe() -> Iterator[int]:
    """The writing end of a pipe whose reading end is closed."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


@pytest.mark.parametrize("line", [f"build-lod {SMALL} -o -", f"traverse {TREE} --orbit 3", f"inspect {TREE} --json"])
def test_a_pipe_without_a_reader_is_exit_status_1(line: str, pipe: int) -> None:
    done = sparklod(line, stdout=pipe, stderr=-1, capture_output=False)
    assert done.returncode == 1
    check_quiet(done)
    assert sum(text.startswith("error: ") for text in done.stderr.splitlines()) <= 1


@pytest.mark.parametrize(
    ("name", "closed"),
    [("build-lod", "2>&-"), ("build-lod", "<&- >&- 2>&-"), ("traverse", ">&-"), ("render", ">&- 2>&-")],
)
def test_a_run_that_writes_a_file_needs_no_streams(name: str, closed: str, tmp_path: Path) -> None:
    line, output = WRITERS[name]
    done = sparklod(f"{line} {tmp_path / output}", f'"$@" {closed}')
    assert (done.returncode, done.stdout) == (0, "")
    check_quiet(done)
    assert [path.name for path in tmp_path.iterdir()] == [output]
    check_whole(tmp_path / output)


def test_errors_without_a_stream_to_print_them_are_exit_statuses(tmp_path: Path) -> None:
    for line, code in ((f"build-lod {tmp_path}/absent.ply", 1), ("inspect", 2), (f"render {TREE} --x", 2)):
        done = sparklod(line, '"$@" 2>&-')
        assert (done.returncode, done.stdout) == (code, ""), line


def test_a_standard_error_without_a_reader_spoils_no_output(pipe: int, tmp_path: Path) -> None:
    target = tmp_path / "demo.spz"
    done = sparklod(f"build-lod {DEMO} -o {target}", stdout=-1, stderr=pipe, capture_output=False)
    assert done.returncode in (0, 1)
    assert [path for path in tmp_path.iterdir() if path != target] == []
    if target.exists():
        check_whole(target)


# --- kill -9 ----------------------------------------------------------------------------------------------------------

#: Command lines with one output, and with many.
KILLED = {
    "build-lod": f"build-lod {DEMO} -o demo.spz",
    "build-lod in chunks": f"build-lod {DEMO} --format rad-chunked -o demo.rad",
    "many cuts": f"traverse {TREE} --orbit 80 --indices-out cuts -o table.csv",
    "many pictures": f"render {TREE} --orbit 16 --size 96x64 -o out.%04d.png",
}


def start(name: str, folder: Path) -> subprocess.Popen[bytes]:
    words = command(f"{KILLED[name]} --overwrite -q")
    return subprocess.Popen(words, cwd=folder, env=ENVIRONMENT, stderr=subprocess.DEVNULL)


def run_again(name: str, folder: Path) -> None:
    """Assert that files are whole, and that the next run succeeds and leaves nothing but whole outputs."""
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)  # as is a folder of files to come
        if not hidden and not path.name.endswith(".part"):
            check_whole(path)
    done = sparklod(f"{KILLED[name]} --overwrite", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert not [path for path in folder.rglob("*") if path.name.startswith(".") or path.name.endswith(".part")]
    for path in folder.rglob("*"):
        if path.is_file():
            check_whole(path)


@pytest.mark.parametrize("name", ["build-lod", "many cuts", "many pictures"])
def test_a_run_killed_at_random_leaves_only_whole_files(name: str, tmp_path: Path) -> None:
    begin = time.perf_counter()
    assert sparklod(KILLED[name], cwd=tmp_path).returncode == 0
    took = time.perf_counter() - begin
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    moments = random.Random(name)
    for _ in range(2):
        process = start(name, tmp_path)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(moments.uniform(0.4, 1) * took)
        process.kill()
        process.wait()
    run_again(name, tmp_path)


def is_writing(process: int, folder: Path) -> bool:
    """Return whether a process has a file of a folder open, even one without a name."""
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                if str(descriptor.readlink()).startswith(f"{folder}/"):
                    return True
    return False


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="this system does not tell which files are open")
@pytest.mark.parametrize("name", ["build-lod", "build-lod in chunks", "many cuts"])
def test_a_run_killed_while_it_writes_leaves_only_whole_files(name: str, tmp_path: Path) -> None:
    for _ in range(4):
        process = start(name, tmp_path)
        while process.poll() is None and not is_writing(process.pid, tmp_path.resolve()):
            pass
        is_caught = process.poll() is None
        process.kill()
        process.wait()
        if is_caught:
            run_again(name, tmp_path)
            return
    pytest.skip("it was quicker than this test every time")


# --- Empty caches -----------------------------------------------------------------------------------------------------

#: Calls a few kernels that call each other; prints the cache folder, the number of compilations, and the results.
SCRIPT = """
import numpy as np
from sparklod_cli.system import jit
from sparklod_cli.lod.kernels.geometry import find_bounds
from sparklod_cli.render.kernels.shade import add_sh

begun = []
jit.listeners.append((begun.append, lambda seconds: None, print))
center = np.arange(12, dtype=np.float32).reshape(4, 3)
rgb, low, high = np.zeros((4, 3), np.float32), np.zeros((1, 4)), np.zeros((1, 4))
add_sh(4, center, np.ones((4, 3, 3), np.float32), np.zeros(3, np.float32), 1, rgb)
find_bounds(1, center, center + 1, low, high)
print(jit.CACHE_FOLDER, len(begun), rgb.sum(), low.sum() + high.sum())
"""


def test_first_runs_side_by_side_share_an_empty_cache(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    how: dict[str, Any] = {"cwd": ROOT, "env": {**ENVIRONMENT, "NUMBA_CACHE_DIR": str(cache)}, "text": True}

    def finished(count: int) -> list[list[str]]:
        """Return the folder of the cache, the number of compilations, and the results of processes side by side."""
        words, pipes = [sys.executable, "-c", SCRIPT], {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        processes = [subprocess.Popen(words, **pipes, **how) for _ in range(count)]
        ends = [(process.communicate(timeout=300), process.returncode) for process in processes]
        assert all((err, code) == ("", 0) for (_, err), code in ends), ends
        return [out.strip().split(" ", 2) for (out, _), _ in ends]

    ends = finished(3)
    assert len({(folder, results) for folder, _, results in ends}) == 1
    assert Path(ends[0][0]).parent == cache and any(int(count) for _, count, _ in ends)
    assert finished(1) == [[ends[0][0], "0", ends[0][2]]]  # the cache that they left is complete
    assert not [path for path in cache.rglob("*") if path.suffix != SUFFIX and path.is_file()]
