"""Compiling kernels in advance: all that declare the types that Python calls them with, see `jit.kernel`."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from .system import jit
from .system.errors import SparklodError
from .system.kernel_cache import PACKAGE, KernelCache, stem_of
from .system.progress import Progress, silent
from .system.python_process import program_command

#: Seconds between two looks at how far the child processes are, for the progress bar.
PATIENCE = 0.1

#: Program of a child process.
_PROGRAM = f"from {__name__} import _compile_requested; _compile_requested()"

#: Seconds that compiling a kernel takes on a fast machine and on a slow one; docs/performance.md has measurements.
SECONDS = (1, 3)


class Unit(NamedTuple):
    """A kernel and the number of one of the signatures that it declares."""

    kernel: jit.Kernel
    number: int

    @property
    def name(self) -> str:
        """Return "module.function", for display."""
        return stem_of(self.kernel.py_func)

    @property
    def is_cached(self) -> bool:
        """Whether the cache has its machine code."""
        cache = KernelCache(self.kernel.py_func, jit.CACHE_FOLDER, jit.READ_FOLDERS, jit.report_trouble)
        return cache.is_cached(self.kernel.signatures[self.number])


def units() -> list[Unit]:
    """Return all that can be compiled in advance, by module."""
    found = []
    for path in sorted(PACKAGE.glob("*/kernels/*.py")):
        name = ".".join([PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts])
        members = vars(importlib.import_module(name)).values()
        kernels = [each for each in members if isinstance(each, jit.Kernel) and each.__module__ == name]
        found += [Unit(kernel, number) for kernel in kernels for number in range(len(kernel.declared))]
    return found


def missing() -> list[Unit]:
    """Return those of `units` that are not in the cache."""
    return [unit for unit in units() if not unit.is_cached]


def duration(count: int, processes: int = 1) -> str:
    """Return how long compiling some kernels takes, for display: "about 20 to 60 s"."""
    return f"about {' to '.join(f'{max(1, round(count * seconds / processes))}' for seconds in SECONDS)} s"


def warm_up(*, processes: int, progress: Progress = silent) -> int:
    """Compile all kernels that are missing, and return their number.

    Args:
        processes: number of processes to compile in, since numba compiles one kernel at a time in each.

    Raises:
        SparklodError: no cache can be written, or a kernel cannot be compiled.
    """
    wanted = missing()
    if not wanted:
        return 0
    if jit.CACHE_FOLDER is None:
        raise SparklodError("no cache can be written; set NUMBA_CACHE_DIR to a folder that can be written")
    # A module's kernels share code, which one process compiles once.
    modules = [list(group) for _, group in itertools.groupby(wanted, lambda unit: unit.kernel.__module__)]
    left, cache = iter(modules), jit.CACHE_FOLDER.parent.resolve()
    children = [CompilingProcess(left, cache) for _ in range(min(processes, len(modules)))]
    with ThreadPoolExecutor(len(children)) as pool:
        running = {pool.submit(child.run) for child in children}
        try:
            while running:
                done, running = wait(running, PATIENCE)
                for each in done:
                    each.result()
                progress("compiling", sum(child.compiled for child in children), len(wanted), "kernel")
        except BaseException:
            for child in children:
                child.stop()
            raise
    absent = len(missing())
    if absent:
        raise SparklodError(f"{absent} of {len(wanted)} kernels are still not in the cache in {jit.CACHE_FOLDER}")
    return len(wanted)


class CompilingProcess:
    """Child process that compiles the kernels of one module after the other.

    Args:
        modules: what is left to compile, by module; children share it.

    Attributes:
        compiled: number of kernels that it has compiled.
    """

    def __init__(self, modules: Iterator[list[Unit]], cache: Path) -> None:
        self._modules, self._cache, self._stopped = modules, cache, threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self.compiled = 0

    def run(self) -> None:
        """Compile until nothing is left.

        Raises:
            SparklodError: a kernel cannot be compiled.
        """
        piped: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(self._cache)}
        with subprocess.Popen(program_command(_PROGRAM), env=environment, text=True, **piped) as process:
            self._process = process
            for unit in itertools.chain.from_iterable(self._modules):
                if self._stopped.is_set():
                    return
                self._compile(process, unit)

    def _compile(self, process: subprocess.Popen[str], unit: Unit) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        request = json.dumps([unit.kernel.__module__, unit.kernel.py_func.__name__, unit.number])
        try:
            process.stdin.write(f"{request}\n")
            process.stdin.flush()
            answered = process.stdout.readline()
        except OSError:
            answered = ""
        if not answered:
            process.terminate()
            said = process.stderr.read().strip().rpartition("\n")[2] or f"exit status {process.wait()}"
            raise SparklodError(f"{unit.name} cannot be compiled: {said}")
        self.compiled += 1

    def stop(self) -> None:
        """End the process; another thread may be in `run`."""
        self._stopped.set()
        if self._process is not None:
            self._process.terminate()


def _compile_requested() -> None:
    """Compile the kernels that are named on standard input, and print a line for each."""
    for line in sys.stdin:
        module, name, number = json.loads(line)
        kernel = getattr(importlib.import_module(module), name)
        kernel.dispatcher.compile(kernel.signatures[number])
        print(flush=True)
