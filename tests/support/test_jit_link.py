"""Machine code that runs without numba."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.lod.kernels.geometry import find_bounds
from sparklod_cli.lod.kernels.sort import morton_code
from sparklod_cli.support import jit, jit_cache, jit_link, jit_numba
from sparklod_cli.support.jit_cache import CODE
from tests.conftest import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not jit_link.is_tested(), reason="machine code is not linked on this system"),
]

#: Kernels, and what scripts call them with.
KERNELS = """
import os, signal, sys, threading, time, warnings
import numpy as np
from sparklod_cli.support import jit
from sparklod_cli.support.jit import kernel, prange

@kernel(parallel=True, nogil=True)
def squares(values):
    found = np.empty(len(values), np.float64)
    for i in prange(len(values)):
        found[i] = values[i] * values[i]
    return found

@kernel(nogil=True)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found

@kernel()
def refuse(number):
    if number > 2:
        raise ValueError("too many")
    return number

@kernel(nogil=True)
def slow(values, times):
    found = values + 1
    for _ in range(times):
        for i in range(len(values)):
            found[i] = found[i] / 3 + values[i]
    return found, values * 2

values = np.arange(20_000.0)
expected = values * values
"""

#: Fills the cache: the process that compiles, and links what it has compiled.
FILL = """
assert (squares(values) == expected).all() and total(values) == values.sum() and refuse(1) == 1
slow(values, 1)
"""

#: What holds in a process that finds everything in the cache, one after another.
SCRIPTS = {
    "numba is not loaded": f"{FILL}assert 'numba' not in sys.modules",
    "errors come through": """
for number in (3, 4):
    try:
        refuse(number)
    except ValueError as error:
        assert str(error) == "too many"
    else:
        raise SystemExit("nothing was raised")
assert 'numba' not in sys.modules
""",
    "a wrong number of arguments": """
for arguments in [(), (1, 2)]:
    try:
        refuse(*arguments)
    except TypeError:
        continue
    raise SystemExit("nothing was raised")
""",
    "arguments by name": "assert refuse(number=2) == 2",
    "threads are set for each thread": """
jit.use_threads(1)
seen = []
thread = threading.Thread(target=lambda: seen.append(jit.threads_in_use()))
thread.start(); thread.join()
assert jit.threads_in_use() == 1 and seen == [2], seen
jit.use_threads(256)
assert jit.threads_in_use() == 2
assert (squares(values) == expected).all()
""",
    "numba is loaded later": """
assert (squares(values) == expected).all()
jit.use_threads(1)
assert squares(values.astype(np.float32)).dtype == np.float64  # compiled by numba
import numba
assert jit.threads_in_use() == numba.get_num_threads() == 1
assert jit.threading_layer() == numba.threading_layer()
jit.use_threads(2)
assert numba.get_num_threads() == 2
assert (squares(values) == expected).all() and total(values) == values.sum()
try:
    refuse(3)
except ValueError as error:
    assert str(error) == "too many"
@numba.njit(parallel=True)
def halves(values):
    found = np.empty(len(values))
    for i in numba.prange(len(values)):
        found[i] = values[i] / 2
    return found
assert (halves(values) == values / 2).all()
""",
    "numba is loaded before": """
import numba
numba.set_num_threads(1)
assert jit.threads_in_use() == 1
assert (squares(values) == expected).all() and total(values) == values.sum()
jit.use_threads(2)
assert numba.get_num_threads() == 2
""",
    "arrays outlive the process's modules": "kept = squares(values)[::2]; import builtins; builtins.kept = kept",
    "a forked process": """
assert total(values) == values.sum()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = total(values) == values.sum() and (squares(values) == expected).all() and 'numba' not in sys.modules
    os._exit(0 if right else 1)
assert os.waitpid(child, 0)[1] == 0
""",
}


#: What holds however kernels are called, see `WAYS`.
EVERYWHERE = {
    "many threads at once": """
right = []
def call():
    for _ in range(20):
        right.append((squares(values) == expected).all() and total(values) == values.sum())
threads = [threading.Thread(target=call) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(right) == 160 and all(right)
""",
    "a process forked from one that used all threads": """
assert (squares(values) == expected).all()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = jit.threads_in_use() == 1
    for count in (1, 2):
        jit.use_threads(count)
        right &= (squares(values) == expected).all()
    thread = threading.Thread(target=lambda: seen.append((squares(values) == expected).all()))
    seen = []
    thread.start(); thread.join()
    os._exit(0 if right and seen == [True] else 1)
assert os.waitpid(child, 0)[1] == 0
assert (squares(values) == expected).all() and jit.threads_in_use() == 2
""",
    "an interruption while a result is returned": """
def interrupt():
    time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGINT)
slow(values, 1)
for _ in range(3):
    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        slow(values, 3000)
        time.sleep(60)
    except KeyboardInterrupt:
        thread.join()
    else:
        raise SystemExit("nothing was raised")
""",
}

#: Threading layers, and whether numba calls the kernels instead of `jit_link`.
WAYS = [(layer, by_numba) for layer in ("the first", "workqueue") for by_numba in (False, True)]


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the module of kernels and a cache that has them."""
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "scripted.py").write_text(KERNELS)
    run(folder, FILL)
    assert len(list((folder / "cache").rglob(f"*{CODE}"))) == 4
    return folder


def run(folder: Path, script: str, **settings: str) -> None:
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(folder / "cache"),
        "NUMBA_NUM_THREADS": "2",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)]),
        **settings,
    }
    command = [sys.executable, "-c", f"from scripted import *\n{script}"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_in_a_process_that_finds_everything_in_the_cache(kernels: Path, script: str) -> None:
    run(kernels, script)


@pytest.mark.parametrize("script", EVERYWHERE.values(), ids=EVERYWHERE)
@pytest.mark.parametrize(("layer", "by_numba"), WAYS)
def test_however_kernels_are_called(kernels: Path, layer: str, by_numba: bool, script: str) -> None:
    if by_numba:
        settings = {} if layer == "the first" else {"NUMBA_THREADING_LAYER": layer}
        run(
            kernels,
            f"from sparklod_cli.support import jit_link; jit_link.is_tested = lambda: False\n{script}",
            **settings,
        )
    else:
        choose = "" if layer == "the first" else f"jit_threads.LAYERS = {{{layer!r}: jit_threads.LAYERS[{layer!r}]}}"
        run(
            kernels,
            f"from sparklod_cli.support import jit_threads; {choose}\n{script}\nassert 'numba' not in sys.modules",
        )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    yield tmp_path


def thrice(x: float) -> float:
    return x * 3


def test_a_type_that_machine_code_is_not_kept_for_is_left_to_numba(folder: Path) -> None:
    kernel = jit.kernel()(thrice)
    assert kernel(2j) == 6j
    assert not list(folder.glob(f"*{CODE}"))
    assert kernel(2.0) == 6
    assert len(list(folder.glob(f"*{CODE}"))) == 1


def test_machine_code_that_takes_what_is_not_there_is_left_to_numba(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    jit.kernel()(thrice)(2.0)
    (path,) = folder.glob(f"*{CODE}")
    content = jit_cache.read(path)
    assert content is not None
    assert b"PyArg_UnpackTuple" in content
    jit_cache.write(path, [content.replace(b"PyArg_UnpackTuple", b"PyArg_UnpackTupla")], print)
    with pytest.raises(RuntimeError, match="Failed to materialize symbols"):
        jit_link.link(jit_link.MachineCode.from_bytes(jit_cache.read(path) or b""), thrice)
    assert jit.kernel()(thrice)(2.0) == 6
    jit_link.link(jit_link.MachineCode.from_bytes(jit_cache.read(path) or b""), thrice)  # it was compiled again
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("content", [b"", b"\xff" * 64, b"\x02\x00\x00\x00{}", b"\x02\x00\x00\x00[]" + b"\x7fELF"])
def test_a_whole_file_with_something_else_in_it_does_no_harm(folder: Path, content: bytes) -> None:
    jit.kernel()(thrice)(2.0)
    (path,) = folder.glob(f"*{CODE}")
    jit_cache.write(path, [content], print)
    assert jit.kernel()(thrice)(2.0) == 6
    jit_link.link(jit_link.MachineCode.from_bytes(jit_cache.read(path) or b""), thrice)


def test_results_are_those_of_numbas_own_call() -> None:
    centers = np.random.default_rng(1).normal(size=(5000, 3)).astype(np.float32)
    widths = np.abs(centers)
    calls: list[tuple[Any, tuple[Any, ...]]] = [
        (find_bounds, (centers, widths, 4)),
        (morton_code, (1.0, 2.0, 3.0, 0.5, np.zeros(3, np.int64), np.uint64(0))),
    ]
    for kernel, arguments in calls:
        ours, numbas = kernel(*arguments), jit_numba.compiler_of(kernel).dispatcher(*arguments)
        assert type(ours) is type(numbas)
        for one, other in zip(
            *((each if isinstance(each, tuple) else (each,)) for each in (ours, numbas)), strict=True
        ):
            assert type(one) is type(other)
            assert np.array_equal(one, other)
            assert np.asarray(one).dtype == np.asarray(other).dtype
