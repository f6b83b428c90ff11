"""Fitting of the merged splats of a finished tree to pictures of full detail: the optimiser and its schedule."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor

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

#: Rates of the first steps, and those of the last ones over these. Measured (benchmarks/notes/refining.md).
RATES, LAST = Rates(0.006, 0.012, 0.003, 0.006, 0.006, 0.0012), 0.02

#: Steps unless given: the most, the least, and their number times that of the leaves. Chosen.
MOST_BY_DEFAULT, LEAST_BY_DEFAULT, WORK = 12_000, 1000, 3_000_000_000


class Schedule:
    """Steps that remain, and their rates: half a wave of a cosine, from `RATES` to `LAST` of them."""

    def __init__(self, steps: int) -> None:
        self.done, self.remaining = 0, steps
        self._stage = -(-steps // STAGES)
        self._progress = 0.0

    @property
    def stage_steps(self) -> int:
        return min(self._stage, self.remaining)

    def rates(self) -> Rates:
        factor = LAST + (1 - LAST) * 0.5 * (1 + math.cos(math.pi * self._progress))
        return Rates(*(rate * factor for rate in RATES))

    def advance(self) -> None:
        self._progress += (1 - self._progress) / self.remaining
        self.done += 1
        self.remaining -= 1

    def shorten(self) -> None:
        """Leave out half of the steps that remain, and all if less than a stage remains."""
        self.remaining = self.remaining // 2 if self.remaining > self._stage else 0


def default_steps(leaves: int) -> int:
    """Return the default number of steps for a tree with this number of leaves."""
    return max(LEAST_BY_DEFAULT, min(MOST_BY_DEFAULT, WORK // leaves))


#: Near plane at most and far plane at least, in radii of the scene, for scenes of tiny or huge units.
NEAR, FAR = 0.01, 100.0

#: Shares of the leaves that cuts are drawn of, and the golden ratio, whose multiples spread evenly.
LEAST_SHARE, MOST_SHARE, GOLDEN = 0.01, 0.7, 0.6180339887498949

#: Steps whose cuts are found while as many steps before them are taken. Measured (benchmarks/notes/cuts-ahead.md).
AHEAD = 8

#: Least mean gain of a stage of the second half, dB a step; after a smaller one, half of the steps that remain are left
#: out. Large steps may lose at first and pay later. Chosen.
FLAT = 3e-5

#: Times that nodes are given their first values for one law after another, until they keep all.
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
        tree: of them; it stays as it is, and so do the leaves, bit for bit, unless `fixed` has them.
        fixed: indices of one cut, ascending, whose nodes alone are fitted, leaves too, for all cameras; no node has an
            opacity above 1, and none gets one. None for the cuts that Spark draws.
        antialiased: of the scene; splats are drawn the same either way, as Spark draws them.
        say: called with a line of text after each stage.
        interrupted: called between steps; when it returns True, the gain of the finished stages is returned.

    Raises:
        BackendError: `settings.device` is "cuda", and there is no card, or it failed, or its memory does not suffice.

    Returns:
        N nodes, and the report; at none of `settings.SHARES` are held-out cameras farther from full detail than before.
    """

    def run(device: str) -> tuple[Splats, Refined]:
        fitting = _Fitting(nodes, tree, dataclasses.replace(settings, device=device), fixed, threads, say)
        while fitting.schedule.remaining:
            if not fitting.run_stage(progress, interrupted):
                return fitting.finish(is_complete=False)
            say(fitting.describe_stage())
        return fitting.finish(is_complete=True)

    with on_threads(threads):
        try:
            return run(settings.device)
        except BackendError as error:
            if settings.device != "auto":
                raise
            say(f"starts again on the processor: {error}")
        # Not from where the card stopped: the result is that of the processor.
        return run("cpu")


def raster_for(place: Place) -> RasterSettings:
    """Return the settings that the pictures of a scene are drawn with."""
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
        self._threads, self._seed = threads, settings.seed
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
        """Yield pictures, each as often as the others, and shares of the leaves, evenly spread over their range."""
        spread = random.random()
        while True:
            for at in random.permutation(len(self._training)):
                spread = (spread + GOLDEN) % 1
                yield self._training[at], LEAST_SHARE * (MOST_SHARE / LEAST_SHARE) ** spread

    def run_stage(self, progress: Progress, interrupted: Callable[[], bool]) -> bool:
        """Take the steps of a stage, and keep the nodes if they gained; return False if it was interrupted."""
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
        return True

    def _with_cuts(
        self, examples: Iterator[tuple[FullDetailPicture, float]]
    ) -> Iterator[tuple[FullDetailPicture, Index]]:
        """Yield pictures and cuts, which threads find ahead; the nodes are placed when the last step is taken.

        Cuts of AHEAD steps are found while the AHEAD steps before them are taken, from the nodes as they were before
        these; those of the first steps of a stage from the nodes at its start. So they depend on neither the time that
        they take nor the number of threads.
        """
        with ThreadPoolExecutor(self._threads) as pool:
            following = self._begin_cuts(pool, examples)
            while group := following:
                cuts = [cut.result() for _, cut in group]
                self._optimiser.place()
                following = self._begin_cuts(pool, examples)
                yield from zip((picture for picture, _ in group), cuts, strict=True)
            self._optimiser.place()

    def _begin_cuts(
        self, pool: Executor, examples: Iterator[tuple[FullDetailPicture, float]]
    ) -> list[tuple[FullDetailPicture, Future[Index]]]:
        """Return the next AHEAD pictures, with cuts that a pool finds."""
        some = itertools.islice(examples, AHEAD)
        return [(picture, pool.submit(self.nodes.cut, picture.camera, share)) for picture, share in some]

    def describe_stage(self) -> str:
        stage, before = self._stages[-1], self._before
        after = stage.psnr_after
        changes = (f"{percent_of(share)} {before[share]:.2f} -> {after[share]:.2f} dB" for share in after)
        return f"{stage.name}: {', '.join(changes)}"

    def finish(self, is_complete: bool) -> tuple[Splats, Refined]:
        """Return the best nodes, where those that break a law have their first values, and the report."""
        self.nodes.restore(self.nodes.fitted, self._kept)
        after = self._lawful() if self._stages else self._before
        kept = float(self.nodes.changed()[self.nodes.fitted].mean()) if self.nodes.fitted.size else 0.0
        stages = tuple(self._stages)
        report = Refined(self.schedule.done, stages, self._before, after, kept, is_complete, self._seed)
        return self.nodes.result(), report

    def _lawful(self) -> Scores:
        """Undo changes that break a law, and return the scores of the nodes."""
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
