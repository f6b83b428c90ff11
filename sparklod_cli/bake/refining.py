"""Fitting of the merged splats of a tree to pictures of full detail: `--refine`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fitting.settings import FitReport, FitSettings
from ..model.scene import Scene
from ..model.splats import Splats
from ..system import interrupts
from ..system.progress import Progress
from .settings import BakeSettings


@dataclass(frozen=True, kw_only=True)
class Refined(FitReport):
    """Result of fitting merged splats, as reported by `--json`.

    Attributes:
        seed: of the random cameras and budgets.
        seconds: duration.
    """

    seed: int
    seconds: float


def fit_settings(settings: BakeSettings) -> FitSettings | None:
    """Return the settings of fitting, with the cameras of the file they name; None without `--refine`.

    Raises:
        CameraPathError: the file cannot be read, or has no cameras; names it.
    """
    if settings.refine is None or settings.camera_path is None:
        return settings.refine
    from ..cameras.sources import read_path  # most bakes read no cameras

    return dataclasses.replace(settings.refine, path=read_path(settings.camera_path))


def refined(
    scene: Scene,
    settings: FitSettings,
    *,
    fixed: NDArray[np.int64] | None = None,
    threads: int,
    progress: Progress,
    say: Callable[[str], None],
) -> tuple[Scene, Refined]:
    """Fit the merged splats of a tree; return the tree and the result.

    A first Ctrl-C ends the fitting early, with the improvements of finished stages.

    Args:
        fixed: see `fitting.fit.fit`.
        say: receives one-line messages for the user.

    Raises:
        KeyboardInterrupt: the fitting was interrupted before it improved anything.
    """
    from ..fitting.fit import fit

    assert scene.tree is not None
    start = time.perf_counter()
    with interrupts.deferred() as interrupted:
        nodes, report = fit(
            scene.splats,
            scene.tree,
            settings,
            fixed=fixed,
            antialiased=scene.antialiased,
            threads=threads,
            progress=progress,
            say=say,
            interrupted=interrupted,
        )
    if not report.is_complete:
        if not report.kept:
            say("Stopped before --refine improved anything; no file written.")
            raise KeyboardInterrupt
        say("Interrupted: writing the improvements of the finished stages; another Ctrl-C ends without an output.")
    seconds = round(time.perf_counter() - start, 4)
    return dataclasses.replace(scene, splats=_within(nodes, scene)), Refined(
        **vars(report), seed=settings.seed, seconds=seconds
    )


def _within(nodes: Splats, scene: Scene) -> Splats:
    """Return nodes whose centres stay in their former box, so that a format needs no other number of bits for them.

    With another number, leaves would move.
    """
    before = scene.splats.center
    return dataclasses.replace(nodes, center=nodes.center.clip(before.min(axis=0), before.max(axis=0)))
