"""A second process that compiles kernels which a command will need, while the command compiles the first ones."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from .codecs.file_names import RAD_SUFFIX
from .system import jit
from .system.errors import SparklodError
from .system.threads import processors
from .warmup import CompilingProcess, Unit

if TYPE_CHECKING:
    from .bake.settings import BakeSettings

#: The kernels of a command's jobs that take longest to compile, in the order in which they are called.
JOBS = {
    "quick": (
        "node_rows.fill_leaf_rows",
        "cell_pairs.merge_in_cells",
        "cell_pairs.split_families",
        "node_rows.fill_leaves",
        "node_rows.merge_colors",
        "node_rows.fill_merged_splats",
    ),
    "quality": (
        "node_rows.fill_leaf_rows",
        "pair_merge.merge_pairs",
        "pair_cost.find_partners",
        "prune.link",
        "prune.size_ranks",
        "prune.lay_out_children",
        "node_rows.fill_leaves",
        "node_rows.merge_colors",
        "node_rows.fill_merged_splats",
    ),
    "chunks": (
        "tree_links.find_parents",
        "chunk_sets.fill_demand",
        "chunk_sets.sort_within_chunks",
        "chunk_sets.split_sets",
    ),
    "levels": ("tree_links.find_parents", "region_errors.compare_levels"),
    "cuts": ("cut.find_cut", "cut_statistics.select", "cut_statistics.replace_drawn", "cut_statistics.measure_cut"),
    "pictures": (
        "cut.find_cut",
        "project.project",
        "raster.count_in_tiles",
        "raster.list_in_tiles",
        "raster.draw_tiles",
    ),
    "fit": (
        "cut.find_cut",
        "project.project",
        "raster.draw_tiles",
        "adam.step",
        "backward.weigh_tiles",
        "backward.carry_back",
    ),
}


def jobs_of(settings: BakeSettings) -> list[str]:
    """Return the jobs of a bake."""
    jobs = [settings.method]
    if settings.refine is not None:
        jobs.append("fit")
    if settings.suffix == RAD_SUFFIX and settings.tiles is None and settings.detail is None:
        jobs.append("chunks")
    if settings.detail is not None:
        jobs.append("levels")
    return jobs


class CompileAhead:
    """Compiles missing kernels of jobs from the last to the first; no kernel is compiled by both processes.

    Args:
        missing: kernels that are not in the cache.
        jobs: of `JOBS`, in order.
        compiling: name of the kernel that this process is compiling.
    """

    def __init__(self, missing: Sequence[Unit], jobs: Sequence[str], compiling: str) -> None:
        wanted = dict.fromkeys(name for job in jobs for name in JOBS[job])
        by_name = {unit.name: unit for unit in missing if unit.name != compiling}
        self._left = [by_name[name] for name in wanted if name in by_name] if processors() > 1 else []
        self._current: Unit | None = None
        self._changed = threading.Condition()
        self._process: CompilingProcess | None = None
        if self._left and jit.CACHE_FOLDER is not None:
            self._process = CompilingProcess(self._taken(), jit.CACHE_FOLDER.parent.resolve())
            self._thread = threading.Thread(target=self._run, args=(self._process,), daemon=True)
            jit.claim_by(self.claim)
            self._thread.start()

    @property
    def compiled(self) -> int:
        """Number of kernels that the process has compiled."""
        return 0 if self._process is None else self._process.compiled

    def claim(self, kernel: jit.Kernel) -> None:
        """Leave a kernel to the caller; where it is being compiled, wait until it is in the cache."""
        with self._changed:
            self._left = [unit for unit in self._left if unit.kernel is not kernel]
            self._changed.wait_for(lambda: self._current is None or self._current.kernel is not kernel)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            jit.claim_by(None)
            self._process.stop()
            self._thread.join()

    def _taken(self) -> Iterator[list[Unit]]:
        """Yield the next kernel, which the one before is finished then."""
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
        except (OSError, SparklodError):  # it was stopped, or the command will compile the kernel and say what is wrong
            pass
        finally:
            with self._changed:
                self._left, self._current = [], None
                self._changed.notify_all()
