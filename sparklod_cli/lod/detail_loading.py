"""What a viewer of Streamed SOG shows and asks for while chunk files load, as PlayCanvas 2.23 does.

A region is drawn at the level that is chosen for it as soon as the file of that level is there, and until then as it
was. `GSplatOctreeInstance.applyLodChanges` does so, and the priorities are those of its `requestFile`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .detail_choice import Chains, Levels
from .detail_distance import Distances

#: Priorities of files, whole numbers: for regions of which nothing is drawn, for those at another level, and for what
#: comes next. The environment is asked for before all others.
ENVIRONMENT, NOTHING_DRAWN, ANOTHER_LEVEL, NEXT = 4, 2, 1, 0


@dataclass(frozen=True, eq=False)
class DetailFiles:
    """Where the splats of a scene at several detail levels are.

    Attributes:
        of_run: (R, L) int64 number of the chunk file of each run; -1 where there is no run.
        sizes: (F,) int64 bytes of the chunk files, then of that of the environment where there is one.
        environment: number of the chunk file of the environment; None without.
        manifest: bytes of the manifest, which is read before any other file.
    """

    of_run: NDArray[np.int64]
    sizes: NDArray[np.int64]
    environment: int | None = None
    manifest: int = 0


@dataclass(frozen=True, eq=False)
class Loading:
    """What is drawn of regions, and what is asked for, while files load.

    Attributes:
        drawn: (R,) the level of each; -1 where nothing is.
        priority: (F,) of the files that are in use or asked for, above 0; 0 for others.
    """

    drawn: Levels
    priority: NDArray[np.float64]


def loading(
    chains: Chains,
    files: DetailFiles,
    chosen: Levels,
    squared_distance: Distances,
    resident: NDArray[np.bool_],
    before: Levels | None,
    underfill: int,
) -> Loading:
    """What is drawn of the regions of an instance, and what is asked for.

    Args:
        chains: of its regions.
        files: of its scene.
        chosen: (R,) the level that is chosen for each region; -1 for one without splats.
        squared_distance: (R,) by which it was chosen.
        resident: (F,) which files are there.
        before: (R,) what was drawn before, -1 where nothing was; None for nothing at all.
        underfill: levels by which a region may be coarser as long as a file is missing; see `DetailRule`.
    """
    levels = files.of_run.shape[1]
    before = np.full(len(chosen), -1) if before is None else before
    desired = _desired(chains, files, chosen, resident, underfill)
    drawn = np.where(_there(files, desired, resident), desired, before)
    rank = 1 / (1 + np.maximum(squared_distance, 1e-12))
    priority = np.zeros(len(files.sizes))

    def ask(level: Levels, tier: NDArray[np.int64] | int) -> None:
        file = _file(files, level)
        some = file >= 0
        value = tier + (level + rank) / levels
        np.maximum.at(priority, file[some], np.broadcast_to(value, file.shape)[some])

    waits = drawn != desired
    ask(desired, np.where(waits & (_file(files, drawn) >= 0), ANOTHER_LEVEL, NOTHING_DRAWN))
    ask(drawn, NOTHING_DRAWN)
    ask(np.where(desired == chosen, chosen, _finer(chains, desired)), NEXT)
    if files.environment is not None:
        priority[files.environment] = ENVIRONMENT
    return Loading(drawn, priority)


def _desired(chains: Chains, files: DetailFiles, chosen: Levels, resident: NDArray[np.bool_], underfill: int) -> Levels:
    """(R,) the chosen level, or while its file is missing one that is at most `underfill` levels coarser.

    That is the finest whose file is there, and where none is, the coarsest that has a file.
    """
    found, coarsest, level = chosen.copy(), chosen.copy(), chosen.copy()
    open_ = (chosen >= 0) & ~_there(files, chosen, resident)
    waiting = open_.copy()
    for _ in range(min(underfill, chains.level.shape[1])):
        level = _coarser(chains, level)
        waiting &= level >= 0
        if not waiting.any():
            break
        coarsest = np.where(waiting & (_file(files, level) >= 0), level, coarsest)
        now = open_ & waiting & _there(files, level, resident)
        found = np.where(now, level, found)
        open_ &= ~now
    return np.where(open_, coarsest, found)


def _there(files: DetailFiles, level: Levels, resident: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(R,) whether regions can be drawn at some levels: the file is there, or there is nothing to load."""
    file = _file(files, level)
    there: NDArray[np.bool_] = (file < 0) | resident[file]
    return there


def _file(files: DetailFiles, level: Levels) -> NDArray[np.int64]:
    """(R,) the files of regions at some levels; -1 for none."""
    rows = np.arange(len(level))
    file: NDArray[np.int64] = np.where(level >= 0, files.of_run[rows, level], -1)
    return file


def _coarser(chains: Chains, level: Levels) -> Levels:
    """(R,) the next coarser levels of chains; -1 where there is none."""
    above = (chains.level > level[:, None]) & (level >= 0)[:, None]
    first = np.argmax(above, axis=1)
    return np.where(above.any(axis=1), chains.level[np.arange(len(level)), first], -1)


def _finer(chains: Chains, level: Levels) -> Levels:
    """(R,) the next finer levels of chains; -1 where there is none."""
    below = (chains.level < level[:, None]) & (chains.level >= 0)
    last = below.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1)
    return np.where(below.any(axis=1), chains.level[np.arange(len(level)), last], -1)
