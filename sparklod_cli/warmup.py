"""Compiling kernels in advance: all (`jit.kernel`), or the kernels of a command, in a second process."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any, NamedTuple

from .codecs.formats import RAD_SUFFIX
from .system import jit
from .system.errors import SparklodError
from .system.machine_code import stem_of
from .system.progress import Progress, silent
from .system.python_process import program_command
from .system.threads import processors

if TYPE_CHECKING:
    from .bake.settings import BakeSettings

#: Seconds between updates of the progress bar.
PATIENCE = 0.1

#: Modules with kernels that Python calls, by room.
KERNELS = {
    "codecs": "drawable sh_clustering texels",
    "fitting": "adam view",
    "lod": "cell_pairs chunk_sets cut cut_statistics geometry node_rows pair_merge pixel_scale prune sort tree_links",
    "render": "backward project raster region_errors shade",
}

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
        return stem_of(self.kernel.py_func)

    @property
    def is_kept(self) -> bool:
        """Whether no run compiles it."""
        return self.kernel.is_kept(self.number)


def units() -> list[Unit]:
    """Return all kernels and signatures that can be compiled in advance, by module."""
    found = []
    for name in [f"{__package__}.{room}.kernels.{name}" for room, names in KERNELS.items() for name in names.split()]:
        members = vars(importlib.import_module(name)).values()
        kernels = [each for each in members if isinstance(each, jit.Kernel) and each.__module__ == name]
        found += [Unit(kernel, number) for kernel in kernels for number in range(len(kernel.declared))]
    return found


def missing() -> list[Unit]:
    """Return the `units` that are not in the cache."""
    return [unit for unit in units() if not unit.is_kept]


def duration(count: int, processes: int = 1) -> str:
    """Return how long compiling some kernels takes, for display: "about 20 to 60 s"."""
    return f"about {' to '.join(f'{max(1, round(count * seconds / processes))}' for seconds in SECONDS)} s"


def warm_up(*, processes: int, progress: Progress = silent) -> int:
    """Compile all kernels that are missing, and return their number.

    Args:
        processes: number of processes to compile in, since numba compiles one kernel at a time in each.
    """
    wanted = missing()
    if not wanted:
        return 0
    if jit.CACHE_FOLDER is None:
        raise SparklodError("no cache can be written; set NUMBA_CACHE_DIR to a folder that can be written")
    # A module's kernels share code, which one process compiles once.
    modules = [list(group) for _, group in itertools.groupby(wanted, lambda unit: unit.kernel.__module__)]
    left = iter(modules)
    children = [CompilingProcess(left) for _ in range(min(processes, len(modules)))]
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
        modules: units left to compile, by module; children share the iterator.
    """

    def __init__(self, modules: Iterator[list[Unit]]) -> None:
        self._modules, self._stopped = modules, threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self.compiled = 0

    def run(self) -> None:
        piped: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        assert jit.CACHE_FOLDER is not None
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(jit.CACHE_FOLDER.parent.resolve())}
        with subprocess.Popen(program_command(_PROGRAM), env=environment, text=True, **piped) as process:
            self._process = process
            for unit in itertools.chain.from_iterable(self._modules):
                if self._stopped.is_set():
                    return
                self._compile(process, unit)

    def _compile(self, process: subprocess.Popen[str], unit: Unit) -> None:
        assert process.stdin and process.stdout and process.stderr
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
        kernel.compile(number)
        print(flush=True)


#: The kernels of a command's jobs that take longest to compile, in the order in which they are called.
JOBS = {
    "quick": """
        node_rows.fill_leaf_rows cell_pairs.merge_in_cells cell_pairs.fill_families
        node_rows.fill_leaves node_rows.merge_colors node_rows.fill_merged_splats
    """,
    "quality": """
        node_rows.fill_leaf_rows pair_merge.merge_pairs pair_merge.find_partners
        prune.link prune.fill_size_ranks prune.lay_out_children
        node_rows.fill_leaves node_rows.merge_colors node_rows.fill_merged_splats
    """,
    "chunks": """
        tree_links.fill_parents
        chunk_sets.fill_demand chunk_sets.sort_within_chunks chunk_sets.split_sets
    """,
    "levels": "tree_links.fill_parents region_errors.compare_levels",
    "cuts": "cut.find_cut cut_statistics.select cut_statistics.replace_drawn cut_statistics.measure_cut",
    "pictures": "cut.find_cut project.project raster.count_in_tiles raster.list_in_tiles raster.draw_tiles",
    "fit": "cut.find_cut project.project raster.draw_tiles adam.step backward.weigh_tiles backward.carry_back",
}


def jobs_of(work: str | BakeSettings) -> list[str]:
    """Return the jobs of a bake, or the job of that name."""
    if isinstance(work, str):
        return [work]
    jobs = [work.method]
    if work.refine is not None:
        jobs.append("fit")
    if work.detail is not None:
        jobs.append("levels")
    elif work.suffix == RAD_SUFFIX and work.tiles is None:
        jobs.append("chunks")
    return jobs


class CompileAhead:
    """Compiles missing kernels of jobs from the last to the first; no kernel is compiled by both processes.

    Args:
        compiling: name of the kernel that this process is compiling.
    """

    def __init__(self, missing: Sequence[Unit], jobs: Sequence[str], compiling: str) -> None:
        wanted = dict.fromkeys(name for job in jobs for name in JOBS[job].split())
        by_name = {unit.name: unit for unit in missing if unit.name != compiling}
        self._left = [by_name[name] for name in wanted if name in by_name] if processors() > 1 else []
        self._current: Unit | None = None
        self._changed = threading.Condition()
        self._process: CompilingProcess | None = None
        if self._left and jit.CACHE_FOLDER is not None:
            self._process = CompilingProcess(self._taken())
            self._thread = threading.Thread(target=self._run, args=(self._process,), daemon=True)
            jit.before_first_call = self.claim
            self._thread.start()

    @property
    def compiled(self) -> int:
        return 0 if self._process is None else self._process.compiled

    def claim(self, kernel: jit.Kernel) -> None:
        """Leave a kernel to the caller; where it is being compiled, wait until it is in the cache."""
        with self._changed:
            self._left = [unit for unit in self._left if unit.kernel is not kernel]
            self._changed.wait_for(lambda: self._current is None or self._current.kernel is not kernel)

    def close(self) -> None:
        if self._process is not None:
            jit.before_first_call = None
            self._process.stop()
            self._thread.join()

    def _taken(self) -> Iterator[list[Unit]]:
        while True:
            with self._changed:
                self._current = self._left.pop() if self._left else None
                self._changed.notify_all()
            if self._current is None:
                return
            yield [self._current]

    def _run(self, process: CompilingProcess) -> None:
        try:
            process.run()
        except (OSError, SparklodError):  # it was stopped, or the command will compile the kernel and report the error
            pass
        finally:
            with self._changed:
                self._left, self._current = [], None
                self._changed.notify_all()
