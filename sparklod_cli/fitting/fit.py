"""Fitting of the merged splats of a finished tree to pictures of full detail."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..cameras.camera import Camera
from ..model.lod_tree import LodTree
from ..model.splats import Splats
from ..render.settings import RasterSettings
from ..support.parallel import on_threads
from ..support.progress import Progress, silent
from .cameras import HELD_OUT, Place, placed, split_path
from .nodes import FittedNodes
from .optimiser import ROUNDS, STAGES, Optimiser, default_steps, rates_at
from .pictures import FullDetailPicture, Scores, gain, keep_gains, keep_sizes, pictures, scores_of
from .settings import FitReport, FitSettings, FitStage

#: Near plane at most and far plane at least, in radii of the scene, for scenes of tiny or huge units.
NEAR, FAR = 0.01, 100.0

#: Times that nodes are given their first values for one law after another, until they keep all.
TRIES = 4


def fit(
    nodes: Splats,
    tree: LodTree,
    settings: FitSettings,
    *,
    antialiased: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda text: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> tuple[Splats, FitReport]:
    """Fit the merged splats of a finished tree to pictures of full detail.

    Args:
        nodes: N nodes in final order.
        tree: of them; it stays as it is, and so do the leaves, bit for bit.
        antialiased: of the scene; splats are drawn the same either way, as Spark draws them.
        say: called with a line of text after each stage.
        interrupted: asked between steps; when it returns True, what the finished stages gained is returned.

    Returns:
        N nodes, and what fitting brought: at none of `settings.SHARES` less than before on the held-out cameras.
    """
    with on_threads(threads):
        fitting = _Fitting(nodes, tree, settings, threads)
        is_complete = True
        for number in range(STAGES if fitting.can_gain else 0):
            if not fitting.run_stage(number, progress, interrupted):
                is_complete = False
                break
            say(fitting.describe_stage())
        return fitting.finish(is_complete)


class _Fitting:
    """State of a fit."""

    def __init__(self, nodes: Splats, tree: LodTree, settings: FitSettings, threads: int) -> None:
        place = Place.of(nodes.center[tree.is_leaf])
        raster = RasterSettings()
        near, far = min(raster.near, NEAR * place.radius), max(raster.far, FAR * place.radius)
        self.nodes = FittedNodes(nodes, tree, RasterSettings(near=near, far=far), threads)
        seeds = np.random.SeedSequence(settings.seed).spawn(3)
        self._random = np.random.Generator(np.random.PCG64(seeds[2]))
        training, held_out = placed(place, seeds[0]), placed(place, seeds[1])
        if settings.path is not None:
            of_training, of_held_out = split_path(settings.path)
            training, held_out = self._shuffled(of_training), iter(of_held_out)
        self._training, self._rounds = pictures(training, self.nodes), itertools.cycle(ROUNDS)
        self._held_out = list(itertools.islice(pictures(held_out, self.nodes), HELD_OUT))
        self._steps = default_steps(len(self.nodes.leaves)) if settings.steps is None else settings.steps
        self._done = 0
        self._optimiser = Optimiser(self.nodes)
        self._before = self._best = scores_of(self.nodes, self._held_out)
        self._kept = self.nodes.copy()
        self._stages: list[FitStage] = []

    def _shuffled(self, cameras: tuple[Camera, ...]) -> Iterator[Camera]:
        """Yield cameras without end, each as often as the others; on a path neighbours see nearly the same."""
        while True:
            for at in self._random.permutation(len(cameras)):
                yield cameras[at]

    @property
    def can_gain(self) -> bool:
        """True if there is anything to do, and to see."""
        return self._steps > 0 and bool(self._held_out) and self.nodes.merged.size > 0

    def run_stage(self, number: int, progress: Progress, interrupted: Callable[[], bool]) -> bool:
        """Take the steps of a stage, and keep the nodes if they gained; return False if it was interrupted."""
        first, last = self._done, self._steps * (number + 1) // STAGES
        while self._done < last:
            picture = next(self._training, None)
            if picture is None:
                break
            shares = next(self._rounds).shares(self._random)[: last - self._done]
            if not self._fit_to(picture, shares, progress, interrupted):
                return False
        now = scores_of(self.nodes, self._held_out)
        start = self._stages[-1].psnr_after if self._stages else self._before
        self._stages.append(FitStage(f"fit {number + 1} of {STAGES}", self._done - first, start, now))
        if gain(self._best, now) > 0:
            self._best, self._kept = now, self.nodes.copy()
        return True

    def _fit_to(
        self, picture: FullDetailPicture, shares: Sequence[float], progress: Progress, interrupted: Callable[[], bool]
    ) -> bool:
        """Take a step for cuts of some shares of the leaves; return False if it was interrupted."""
        shown = []
        for share in shares:
            if interrupted():
                return False
            cut = self.nodes.cut(picture.camera, share)
            shown.append(self._optimiser.step(picture, cut, rates_at(self._done / self._steps)))
            self._done += 1
            progress("refining", self._done, self._steps, "step")
        self.nodes.renew(np.unique(np.concatenate(shown)))
        return True

    def describe_stage(self) -> str:
        """Return what the last stage gained, for display."""
        stage, before = self._stages[-1], self._before
        changes = (f"{share:.0%} {before[share]:.2f} -> {after:.2f} dB" for share, after in stage.psnr_after.items())
        return f"{stage.name}: {', '.join(changes)}"

    def finish(self, is_complete: bool) -> tuple[Splats, FitReport]:
        """Return the best nodes, those that lost with their first values, and the report."""
        self.nodes.restore(self.nodes.merged, self._kept)
        after = self._lawful() if self.can_gain else self._before
        kept = float(self.nodes.changed()[self.nodes.merged].mean()) if self.nodes.merged.size else 0.0
        report = FitReport(self._done, tuple(self._stages), self._before, after, kept, is_complete)
        return self.nodes.result(), report

    def _lawful(self) -> Scores:
        """Take back what breaks a law, and return the scores of the nodes."""
        for _ in range(TRIES):
            keep_sizes(self.nodes)
            after = keep_gains(self.nodes, self._held_out, self._before)
            if not keep_sizes(self.nodes):
                return after
        self.nodes.restore(self.nodes.merged)
        return self._before
