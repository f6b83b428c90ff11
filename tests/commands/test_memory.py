"""Memory that runs out is one line that says so, in every command; never a traceback, never half a file."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import OutOfMemoryError, memory_errors_translated, out_of_memory
from sparklod_cli.system.threads import ordered_map
from tests.conftest import FIXTURES, ROOT, Capture

#: Runs a command twice: with something small HERE, so that all code is loaded and compiled, then with something large
#: and no room but for some megabytes more.
LIMITED = """
import re, resource, sys
from pathlib import Path
from sparklod_cli.cli import run
room, small, large, *command = sys.argv[1:]
assert run([small if word == "HERE" else word for word in command]) == 0
sys.stderr.write("---\\n")
sys.stderr.flush()
taken = int(re.search(r"VmSize:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1]) << 10
resource.setrlimit(resource.RLIMIT_AS, (taken + (int(room) << 20),) * 2)
sys.exit(run([large if word == "HERE" else word for word in command] + ["--overwrite"] * ("-o" in command)))
"""

COUNT = 1_500_000


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A .splat file and a tree of very many nodes; their floats take more than eighty megabytes."""
    folder = tmp_path_factory.mktemp("large")
    plain, tree = folder / "plain.splat", folder / "tree.spz"
    rows = np.zeros((COUNT, 32), np.uint8)
    rows[:, :24].view("<f4")[:] = np.random.default_rng(1).random((COUNT, 6), np.float32) + 0.1
    rows[:, 24:] = 200
    plain.write_bytes(rows.tobytes())
    splats = Splats.empty(COUNT, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    fan = 1500
    count, start = np.zeros(COUNT, np.uint16), np.zeros(COUNT, np.uint32)
    inner = np.arange(-(-(COUNT - 1) // fan))
    count[inner] = np.minimum(fan, COUNT - 1 - inner * fan)
    start[inner] = 1 + inner * fan
    pieces = spz.encode(Scene(splats, LodTree(count, start)), WriteOptions(compression_level=1))
    tree.write_bytes(b"".join(pieces))
    return plain, tree


PLAIN, TREE = FIXTURES / "golden" / "sh0.splat", FIXTURES / "golden" / "hand-tree-v3.spz"
COMMANDS = {
    "build-lod": (16, "build-lod HERE -o {out}.spz --threads 2"),
    "build-lod, one thread": (16, "build-lod HERE -o {out}.spz --threads 1"),
    "build-lod --method quality": (100, "build-lod HERE -o {out}.spz --method quality"),
    "convert": (16, "convert HERE {out}.spz --leaves --overwrite"),
    "inspect": (16, "inspect HERE --stats --threads 2"),
    "inspect --check": (16, "inspect HERE --check"),
    "traverse": (16, "traverse HERE --budget 100 --orbit 2 -o {out}.csv"),
    "render": (16, "render HERE --size 32x32 --threads 2 -o {out}.png"),
}


def limited(folder: Path, room: int, small: object, large: object, command: str) -> tuple[int, list[str]]:
    """Exit status and lines of standard error of the run that has no room."""
    words = command.format(out=folder / "out").split()
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(room), str(small), str(large), *words],
        cwd=ROOT,
        env={**os.environ, "MALLOC_ARENA_MAX": "1"},  # threads' arenas reserve room that a limited run could use
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert "---\n" in done.stderr, done.stderr
    return done.returncode, done.stderr.partition("---\n")[2].splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does")
@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_too_large_for_memory_is_one_error_that_names_it(
    name: str, large: tuple[Path, Path], tmp_path: Path
) -> None:
    room, command = COMMANDS[name]
    plain = command.startswith("build-lod HERE")
    small, file = (PLAIN, large[0]) if plain else (TREE, large[1])
    code, lines = limited(tmp_path, room, small, file, command)
    assert (code, len(lines)) == (1, 1), lines
    assert lines[0].startswith(f"error: {file}: ")
    assert "it does not fit into memory" in lines[0]
    assert not [path for path in tmp_path.iterdir() if path.stem != "out"]  # which the small file's run left


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does")
def test_a_picture_that_is_too_large_is_said_to_be(tmp_path: Path) -> None:
    code, lines = limited(tmp_path, 200, "32x32", "8000x8000", f"render {TREE} --size HERE -o {{out}}.png")
    assert (code, len(lines)) == (1, 1), lines
    assert "it does not fit into memory: 8,000 x 8,000 x" in lines[0]


def test_one_file_that_is_too_large_does_not_stop_the_others(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture, tmp_path: Path
) -> None:
    from sparklod_cli.inspection import tree

    examine_blocks = tree.examine_blocks
    calls = iter([MemoryError(), None])

    def full_once(*args: object, **kwargs: object) -> object:
        error = next(calls)
        if error:
            raise error
        return examine_blocks(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(tree, "examine_blocks", full_once)
    assert run(["inspect", str(TREE), str(TREE), "--check"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(f"error: {TREE}: it does not fit into memory")
    assert "no problems found" in second


@pytest.mark.parametrize("threads", [1, 3])
def test_memory_that_runs_out_in_a_thread_is_an_out_of_memory_error(threads: int) -> None:
    def work(size: int) -> int:
        return len(np.empty(size, np.uint8))

    with pytest.raises(OutOfMemoryError, match="1,000,000,000,000,000 numbers"), memory_errors_translated():
        list(ordered_map(work, [1, 10**15, 2], threads))


def test_every_way_in_which_memory_runs_out_is_known() -> None:
    for error in (
        MemoryError(),
        MemoryError("Allocation failed (probably too large)."),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("libx.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
    ):
        assert str(out_of_memory(error)).startswith("it does not fit into memory; ")
    for other in (RuntimeError("no"), OSError(errno.ENOSPC, "No space left"), ImportError("no module"), ValueError()):
        assert out_of_memory(other) is None
    with pytest.raises(MemoryError) as caught:
        np.empty((8000, 10**12, 4), np.float32)
    assert "8,000 x 1,000,000,000,000 x 4 numbers (float32) take 128,000,000.0 GB" in str(out_of_memory(caught.value))
