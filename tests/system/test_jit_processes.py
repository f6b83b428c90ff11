"""What kernels do in processes of their own: threads, forks, errors, interruptions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.system.kernel_cache import SUFFIX
from tests.conftest import ROOT
from tests.signals import heed_signals

pytestmark = pytest.mark.slow

#: Kernels, and what scripts call them with.
KERNELS = """
import os, signal, sys, threading, time, warnings
import numpy as np
from sparklod_cli.system import jit
from sparklod_cli.system.jit import kernel
from sparklod_cli.system.jit import f8, i8, out
from sparklod_cli.system.threads import on_threads, threads_in_use

@kernel(i8, f8[:], out(f8[:]), ranges=True)
def fill_squares(start, stop, values, found):
    for i in range(start, stop):
        found[i] = values[i] * values[i]

def squares(values):
    found = np.empty(len(values), np.float64)
    fill_squares(len(values), values, found)
    return found

@kernel(f8[:], nogil=True)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found

@kernel(i8)
def refuse(number):
    if number > 2:
        raise ValueError("too many")
    return number

@kernel(f8[:], i8, nogil=True)
def slow(values, times):
    found = values + 1
    for _ in range(times):
        for i in range(len(values)):
            found[i] = found[i] / 3 + values[i]
    return found, values * 2

values = np.arange(20_000.0)
expected = values * values
"""

#: Fills the cache: the process that compiles.
FILL = """
assert (squares(values) == expected).all() and total(values) == values.sum() and refuse(1) == 1
slow(values, 1)
"""

#: What holds in a process that finds everything in the cache.
SCRIPTS = {
    "errors, threads and arrays that outlive modules": """
for number in (3, 4):
    try:
        refuse(number)
    except ValueError as error:
        assert str(error) == "too many"
    else:
        raise SystemExit("nothing was raised")
for arguments in [(), (1, 2)]:
    try:
        refuse(*arguments)
    except TypeError:
        continue
    raise SystemExit("nothing was raised")
right = []
def call():
    for _ in range(20):
        right.append((squares(values) == expected).all() and total(values) == values.sum())
threads = [threading.Thread(target=call) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(right) == 160 and all(right)
import builtins
builtins.kept = squares(values)[::2]
""",
    "a kernel is loaded once": """
from sparklod_cli.system.kernel_cache import KernelCache
load, loaded = KernelCache.load_overload, []
KernelCache.load_overload = lambda cache, *more: loaded.append(cache) or load(cache, *more)
for _ in range(3):
    assert (squares(values) == expected).all()
assert len(loaded) == 1
""",
    "a forked process": """
assert total(values) == values.sum()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = total(values) == values.sum() and (squares(values) == expected).all() and threads_in_use() == 2
    os._exit(0 if right else 1)
assert os.waitpid(child, 0)[1] == 0
""",
    "a process forked from one that used all threads": """
assert (squares(values) == expected).all()
warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 advises against forks
child = os.fork()
if not child:
    right = True
    for count in (1, 2):
        with on_threads(count):
            right &= (squares(values) == expected).all()
    thread = threading.Thread(target=lambda: seen.append((squares(values) == expected).all()))
    seen = []
    thread.start(); thread.join()
    os._exit(0 if right and seen == [True] else 1)
assert os.waitpid(child, 0)[1] == 0
assert (squares(values) == expected).all()
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


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the module of kernels and a cache that has them."""
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "scripted.py").write_text(KERNELS)
    run(folder, FILL)
    assert len(list((folder / "cache").rglob(f"*{SUFFIX}"))) == 4
    return folder


def run(folder: Path, script: str) -> None:
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(folder / "cache"),
        "NUMBA_NUM_THREADS": "2",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)]),
    }
    command = [sys.executable, "-c", f"from scripted import *\n{script}"]
    ways: dict[str, Any] = {"preexec_fn": heed_signals} if os.name == "posix" else {}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, **ways)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_in_a_process_that_finds_everything_in_the_cache(kernels: Path, script: str) -> None:
    run(kernels, script)
