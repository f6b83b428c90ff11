"""Compiling kernels in advance: which ones each job needs, and how they get into the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .codecs import ply, spz
from .io import write_whole
from .model.lod_tree import LodTree
from .model.scene import Scene
from .model.splats import Splats
from .support import jit
from .support.errors import SparklodError
from .support.progress import Progress, silent

#: Seconds between two counts of the kernels that are in the cache, for the progress bar.
PATIENCE = 0.1


@dataclass(frozen=True)
class Job:
    """A job that needs kernels.

    Attributes:
        kernels: the kernels that Python code of the job calls, as `jit.is_cached` names them.
        commands: command lines that call all of them, on the files of `_write_inputs`.
    """

    kernels: tuple[str, ...]
    commands: tuple[str, ...]


#: The jobs by name, in the order in which processes that work at the same time compile the fewest kernels twice.
JOBS = {
    "quick": Job(
        (
            *(
                "drawable.count_doubtful",
                "geometry.find_bounds",
                "group.level_keys",
                "cell_pairs.merge_in_cells",
                "cell_pairs.split_families",
            ),
            *("final_order.fill_leaves", "final_order.merge_colors"),
            *("node_rows.fill_leaf_rows", "node_rows.fill_merged_splats", "sort.cell_words", "sort.sort_pass"),
        ),
        ("build-lod scene.ply -o quick.spz",),
    ),
    "traverse": Job(
        (
            *(
                "cut_parts.take_step",
                "cut_statistics.measure_cut",
                "cut_statistics.replace_drawn",
                "cut_statistics.select",
            ),
        ),
        ("traverse tree.spz --orbit 2 -o frames.csv",),
    ),
    "inspect": Job(
        (
            *("tree_links.find_cycles", "tree_links.find_depths", "tree_links.find_parents"),
            *("tree_links.add_weighted", "tree_links.fill_weights", "tree_links.sum_by_depth"),
            *("tree_links.count_limits", "tree_links.mark_small"),
            *("spz_codes.count_bytes", "spz_codes.count_ends", "spz_codes.count_squares", "spz_codes.count_halves"),
            *("spz_codes.fill_extremes", "spz_codes.fill_sizes", "spz_codes.look_up"),
            *("digits.count_digits", "digits.sh_lengths"),
        ),
        (
            "inspect shiny.spz --check --stats --json",
            "inspect shiny.ply --check --stats --json",
            "inspect small.spz --check --json",
        ),
    ),
    "quality": Job(
        (
            *(
                "drawable.count_doubtful",
                "geometry.find_bounds",
                "final_order.fill_leaves",
                "final_order.merge_colors",
                "sort.sort_pass",
            ),
            *("node_rows.fill_leaf_rows", "node_rows.fill_merged_splats", "node_rows.morton_keys"),
            "curve_sort.sort_along_curve",
            *("pair_cost.find_partners", "pair_cost.match_pairs", "pair_merge.merge_pairs", "prune.drop_nodes"),
            *("prune.fill_usefulness_terms", "prune.lay_out_children", "prune.size_ranks"),
            *("family_links.find_limits", "tree_links.find_parents"),
        ),
        ("build-lod scene.ply --method quality -o quality.spz",),
    ),
    "rad": Job(
        (
            *("chunk_demand.fill_demand", "chunk_inside.sort_within_chunks", "chunk_sets.split_sets", "sort.sort_pass"),
            *("family_links.find_limits", "tree_links.find_parents"),
        ),
        ("build-lod tree.spz --format rad -o tree.rad",),
    ),
    "render": Job(
        (
            *("bands.count_fragments", "bands.draw_discs", "continuous.blend", "continuous.find_limits"),
            *("continuous.order_inner", "cut_parts.take_step"),
            *("project.project", "raster.draw_tiles", "tiles.sort_into_tiles"),
        ),
        (
            "render tree.spz --size 64x64 -o cut.png",
            "render tree.spz --size 64x64 --continuous -o continuous.png",
            "render scene.ply --size 64x64 --style billboards -o billboards.png",
            "render scene.ply --size 64x64 --color-by overdraw -o overdraw.png",
        ),
    ),
    "refine": Job(
        (
            *("adam.step", "backward.first_rows", "backward.weigh_tiles", "cut_parts.take_step", "difference.by_image"),
            *("difference.squared_differences", "project.project"),
            *("project_gradients.carry_back", "raster.draw_tiles", "tiles.sort_into_tiles", "shade.add_sh"),
            *("shade.sh_gradients", "tree_links.add_child_sizes", "tree_links.find_parents", "view.gather"),
            "view.mark_seen",
        ),
        ("build-lod shiny.spz --refine 2 -o refined.spz",),
    ),
    "palette": Job(
        (
            *("chunk_demand.fill_demand", "chunk_inside.sort_within_chunks", "chunk_sets.split_sets", "sort.sort_pass"),
            *("family_links.find_limits", "tree_links.find_parents", "row_hash.hash_rows", "cells.halve_cells"),
            *("cells.average_cells", "nearest.find_neighbours", "nearest.choose_codes"),
        ),
        ("build-lod shiny.spz --format rad --cluster-sh 4 -o palette.rad",),
    ),
    "streamed-sog": Job(
        (
            *("region_errors.compare_levels", "row_hash.hash_rows", "shade.add_sh", "tree_links.find_parents"),
            *(
                "texels.fill_quats",
                "texels.gather_rows",
                "texels.look_up",
                "texels.look_up_words",
                "texels.place_bytes",
            ),
            *("webp_codes.read_codes", "webp_pixels.read_pixels", "webp_transforms.undo"),
        ),
        ("build-lod shiny.spz -o web/lod-meta.json", "inspect web/lod-meta.json --check"),
    ),
}


class _Children:
    """Child processes that are stopped together; none starts afterwards."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._started: list[subprocess.Popen[str]] = []
        self._stopped = False

    def start(self, line: list[str], **how: Any) -> subprocess.Popen[str] | None:
        """Starts a process; None if all have been stopped."""
        with self._lock:
            if self._stopped:
                return None
            process: subprocess.Popen[str] = subprocess.Popen(line, **how)
            self._started.append(process)
            return process

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for process in self._started:
                process.terminate()


def missing(jobs: Iterable[str]) -> set[str]:
    """The kernels of some of `JOBS` that are not in the cache."""
    return {name for job in jobs for name in JOBS[job].kernels if not jit.is_cached(name)}


def warm_up(*, processes: int, progress: Progress = silent) -> int:
    """Compiles all kernels that are missing, and returns their number.

    Args:
        processes: number of processes to compile in; each works on one job at a time.
        progress: is told how many kernels are in the cache.

    Raises:
        SparklodError: no cache can be written, or a job failed.
    """
    if jit.CACHE_FOLDER is None:
        raise SparklodError("no cache can be written; set NUMBA_CACHE_DIR to a folder that can be written")
    wanted = missing(JOBS)
    if not wanted:
        return 0
    children = _Children()
    with tempfile.TemporaryDirectory(prefix="sparklod-") as name, ThreadPoolExecutor(processes) as pool:
        _write_inputs(Path(name))
        running = [pool.submit(_do, job, Path(name), children) for job in JOBS if missing([job])]
        try:
            while not all(map(Future.done, running)):
                progress("compiling", len(wanted) - len(missing(JOBS)), len(wanted), "kernel")
                time.sleep(PATIENCE)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            children.stop()
            raise
        for job in running:
            job.result()
    left = missing(JOBS)
    if left:
        raise SparklodError(f"{len(left)} of {len(wanted)} kernels are still not in the cache in {jit.CACHE_FOLDER}")
    return len(wanted)


def _do(job: str, folder: Path, children: _Children) -> None:
    """Runs the commands of a job in child processes, since numba compiles one kernel at a time in each.

    Raises:
        SparklodError: one failed.
    """
    package = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(package.parent), os.environ.get("PYTHONPATH", "")])}
    if jit.CACHE_FOLDER is not None:
        environment["NUMBA_CACHE_DIR"] = str(jit.CACHE_FOLDER.parent.resolve())
    quiet: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    for command in JOBS[job].commands:
        line = [sys.executable, "-m", package.name, *command.split(), "--quiet"]
        process = children.start(line, cwd=folder, env=environment, text=True, **quiet)
        if process is None:
            return
        said = process.communicate()[1].strip()
        if process.returncode:
            last = said.rpartition("\n")[2] or f"exit status {process.returncode}"
            raise SparklodError(f"sparklod {command.partition(' ')[0]} failed while it compiled: {last}")


def _write_inputs(folder: Path) -> None:
    """Writes a scene of a few splats, and trees of them with and without SH, without a builder, which needs kernels."""
    rng = np.random.default_rng(0)
    count = 64
    leaves = Splats(
        center=rng.normal(size=(count, 3)).astype(np.float32),
        scale=np.full((count, 3), 0.1, np.float32),
        quat_xyzw=np.tile(np.array([0, 0, 0, 1], np.float32), (count, 1)),
        opacity=np.full(count, 0.9, np.float32),
        rgb=rng.uniform(size=(count, 3)).astype(np.float32),
        sh=np.zeros((count, 0, 3), np.float32),
    )
    root = Splats.concat([leaves.take(slice(0, 1)), leaves])
    root.scale[0] = 1
    children = np.zeros(count + 1, np.uint16)
    starts = np.zeros(count + 1, np.uint32)
    children[0], starts[0] = count, 1
    tree = Scene(root, LodTree(children, starts))
    write_whole(folder / "scene.ply", ply.encode(Scene(leaves)), overwrite=True)
    write_whole(folder / "tree.spz", spz.encode(tree), overwrite=True)
    sh = rng.uniform(-0.5, 0.5, (count + 1, 3, 3)).astype(np.float32)
    shiny = replace(root, sh=sh)
    write_whole(folder / "shiny.spz", spz.encode(replace(tree, splats=shiny)), overwrite=True)
    small = replace(root, scale=np.concatenate([root.scale[:1] / 100, root.scale[1:]]))
    write_whole(folder / "small.spz", spz.encode(replace(tree, splats=small)), overwrite=True)
    write_whole(folder / "shiny.ply", ply.encode(Scene(shiny)), overwrite=True)
