"""Fitting of the merged splats of a finished tree to pictures of full detail: the optimiser and its schedule."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from ..model.lod_tree import LodTree
from ..model.splats import Splats
from ..render.render_settings import RasterSettings, uses_card
from ..system.errors import BackendError
from ..system.progress import Progress, silent
from ..system.threads import on_threads
from ..system.units import percent_of
from .fit_settings import FitSettings, FitStage, Refined
from .kernels.adam import Rates
from .pictures import (
    HELD_OUT,
    TRAINING,
    FittedNodes,
    FittedSet,
    FullDetailPicture,
    Index,
    Optimiser,
    Place,
    Scores,
    gain,
    keep_gains,
    keep_sizes,
    pictures,
    placed,
    scores_of,
    split_path,
)

#: Stages, after each of which held-out cameras decide.
STAGES = 12

#: Rates of the first steps, and their ratio to those of the last steps. Measured (benchmarks/notes/refining.md).
RATES, LAST = Rates(0.006, 0.012, 0.003, 0.006, 0.006, 0.0012), 0.02

#: Default number of steps: the most, the least, and its product with the number of leaves. Chosen.
MOST_BY_DEFAULT, LEAST_BY_DEFAULT, WORK = 12_000, 1000, 3_000_000_000


class Schedule:
    """Number of remaining steps, and their rates: half a cosine wave, from `RATES` down to `LAST` times `RATES`."""

    def __init__(self, steps: int) -> None:
        self.done, self.remaining = 0, steps
        self._stage = -(-steps // STAGES)
        self._progress = 0.0

    @property
    def stage_steps(self) -> int:
        """Number of steps of the next stage."""
        return min(self._stage, self.remaining)

    def rates(self) -> Rates:
        """Return the rates of the next step."""
        factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * self._progress))
        return Rates(*(rate * factor for rate in RATES))

    def advance(self) -> None:
        """Count a step as done."""
        self._progress += (1 - self._progress) / self.remaining
        self.done += 1
        self.remaining -= 1

    def shorten(self) -> None:
        """Drop half of the remaining steps, or all if at most a stage remains."""
        self.remaining = self.remaining // 2 if self.remaining > self._stage else 0


def default_steps(leaves: int) -> int:
    """Return the default number of steps for a tree with this number of leaves."""
    return max(LEAST_BY_DEFAULT, min(MOST_BY_DEFAULT, WORK // leaves))


#: Near plane at most and far plane at least, in radii of the scene, for scenes of tiny or huge units.
NEAR, FAR = 0.01, 100.0

#: Range of the sizes of drawn cuts, as shares of the leaves, and the golden ratio, whose multiples spread evenly.
LEAST_SHARE, MOST_SHARE, GOLDEN = 0.01, 0.7, 0.6180339887498949

#: Steps whose cuts are found during the same number of steps before. Measured (benchmarks/notes/cuts-ahead.md).
AHEAD = 8

#: Least mean gain of a stage of the second half, dB a step; after a smaller gain, half of the remaining steps are
#: dropped. The large steps of the first half may lose at first and pay later. Chosen.
FLAT = 3e-5

#: Attempts at restoring nodes for one law after another, until all laws hold.
TRIES = 4


def fit(
    nodes: Splats,
    tree: LodTree,
    settings: FitSettings,
    *,
    fixed: Index | None = None,
    antialiased: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda text: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> tuple[Splats, Refined]:
    """Fit the merged splats of a finished tree to pictures of full detail.

    Args:
        nodes: N nodes in final order.
        tree: of the nodes. It does not change, nor do the leaves, bit for bit, unless `fixed` has some.
        fixed: indices of one cut, ascending, drawn for all cameras: only its nodes are fitted, leaves too. Their
            opacities are at most 1, and stay so. None for the cuts that Spark draws.
        antialiased: of the scene; has no effect, as Spark draws splats the same either way.
        say: receives a line of text after each stage.
        interrupted: called between steps; True ends the fit with the gains of the finished stages.

    Raises:
        BackendError: `settings.device` is "cuda", and there is no card, or it failed, or its memory does not suffice.

    Returns:
        N nodes, and the report. At each of `fit_settings.SHARES`, the mean PSNR of the held-out cameras is at least
        that before.
    """

    def run(device: str) -> tuple[Splats, Refined]:
        fitting = _Fitting(nodes, tree, dataclasses.replace(settings, device=device), fixed, threads, say)
        is_complete = True
        while is_complete and fitting.schedule.remaining:
            is_complete = fitting.run_stage(progress, interrupted)
        return fitting.finish(is_complete)

    with on_threads(threads):
        try:
            return run(settings.device)
        except BackendError as error:
            if settings.device != "auto":
                raise
            say(f"starts again on the processor: {error}")
        # From the beginning, so that the result is that of the processor.
        return run("cpu")


def raster_for(place: Place) -> RasterSettings:
    """Return the raster settings for pictures of a scene."""
    raster = RasterSettings()
    return RasterSettings(near=min(raster.near, NEAR * place.radius), far=max(raster.far, FAR * place.radius))


class _Fitting:
    """State of a fit."""

    def __init__(
        self,
        nodes: Splats,
        tree: LodTree,
        settings: FitSettings,
        fixed: Index | None,
        threads: int,
        say: Callable[[str], None],
    ) -> None:
        self._threads, self._seed, self._say = threads, settings.seed, say
        place = Place.of(nodes.center[tree.is_leaf])
        raster = raster_for(place)
        self.nodes = (
            FittedNodes(nodes, tree, raster, threads)
            if fixed is None
            else FittedSet(nodes, tree, fixed, raster, threads)
        )
        seeds = np.random.SeedSequence(settings.seed).spawn(3)
        training, held_out = placed(place, seeds[0]), placed(place, seeds[1])
        if settings.path is not None:
            training, held_out = map(iter, split_path(settings.path))
        steps = default_steps(len(self.nodes.leaves)) if settings.steps is None else settings.steps
        self._held_out = list(itertools.islice(pictures(held_out, self.nodes), HELD_OUT))
        can_gain = bool(self._held_out) and self.nodes.fitted.size > 0
        self._training = list(itertools.islice(pictures(training, self.nodes), min(TRAINING, steps) * can_gain))
        self.schedule = Schedule(steps if self._training else 0)
        self._examples = self._drawn(np.random.Generator(np.random.PCG64(seeds[2])))
        self._optimiser = _optimiser_on(settings.device, self.nodes, say)
        self._before = self._best = scores_of(self.nodes, self._held_out)
        self._kept = self.nodes.copy()
        self._stages: list[FitStage] = []

    def _drawn(self, random: np.random.Generator) -> Iterator[tuple[FullDetailPicture, float]]:
        """Yield all pictures equally often, in random order, with shares of the leaves spread over their range."""
        spread = random.random()
        while True:
            for at in random.permutation(len(self._training)):
                spread = (spread + GOLDEN) % 1
                yield self._training[at], LEAST_SHARE * (MOST_SHARE / LEAST_SHARE) ** spread

    def run_stage(self, progress: Progress, interrupted: Callable[[], bool]) -> bool:
        """Take the steps of a stage, and keep the nodes if they gained; return False if interrupted."""
        schedule = self.schedule
        steps = schedule.stage_steps
        for picture, cut in self._with_cuts(itertools.islice(self._examples, steps)):
            if interrupted():
                return False
            self._optimiser.step(picture, cut, schedule.rates())
            schedule.advance()
            progress("refining", schedule.done, schedule.done + schedule.remaining, "step")
        self._optimiser.synchronize()
        now = scores_of(self.nodes, self._held_out)
        start = self._stages[-1].psnr_after if self._stages else self._before
        self._stages.append(FitStage(f"{schedule.done:,} steps", steps, start, now))
        if schedule.done >= schedule.remaining and gain(self._best, now) < FLAT * steps:
            schedule.shorten()
        if gain(self._best, now) > 0:
            self._best, self._kept = now, self.nodes.copy()
        changes = (f"{percent_of(share)} {self._before[share]:.2f} -> {now[share]:.2f} dB" for share in now)
        self._say(f"{self._stages[-1].name}: {', '.join(changes)}")
        return True

    def _with_cuts(
        self, examples: Iterator[tuple[FullDetailPicture, float]]
    ) -> Iterator[tuple[FullDetailPicture, Index]]:
        """Yield pictures and their cuts, found in advance by threads; place the nodes after the last step.

        The cuts of AHEAD steps are found during the AHEAD steps before, from the nodes as they were before those; the
        cuts of the first steps of a stage from the nodes at its start. So they depend on neither timing nor the number
        of threads.
        """
        with ThreadPoolExecutor(self._threads) as pool:

            def begin() -> list[tuple[FullDetailPicture, Future[Index]]]:
                some = itertools.islice(examples, AHEAD)
                return [(picture, pool.submit(self.nodes.cut, picture.camera, share)) for picture, share in some]

            following = begin()
            while group := following:
                cuts = [cut.result() for _, cut in group]
                self._optimiser.place()
                following = begin()
                yield from zip((picture for picture, _ in group), cuts, strict=True)
            self._optimiser.place()

    def finish(self, is_complete: bool) -> tuple[Splats, Refined]:
        """Return the best nodes, restored where they break a law, and the report."""
        self.nodes.restore(self.nodes.fitted, self._kept)
        after = self._lawful() if self._stages else self._before
        kept = float(self.nodes.changed()[self.nodes.fitted].mean()) if self.nodes.fitted.size else 0.0
        stages = tuple(self._stages)
        report = Refined(self.schedule.done, stages, self._before, after, kept, is_complete, self._seed)
        return self.nodes.result(), report

    def _lawful(self) -> Scores:
        """Undo the changes that break a law; return the scores of the nodes."""
        for _ in range(TRIES):
            keep_sizes(self.nodes)
            after = keep_gains(self.nodes, self._held_out, self._before)
            if not keep_sizes(self.nodes):
                return after
        self.nodes.restore(self.nodes.fitted)
        return self._before


def _optimiser_on(device: str, nodes: FittedNodes, say: Callable[[str], None]) -> Optimiser:
    if not uses_card(device, say):
        return Optimiser(nodes)
    from .cuda.card_optimiser import CardOptimiser

    return CardOptimiser(nodes)
