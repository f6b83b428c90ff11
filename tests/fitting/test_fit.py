"""Merged splats fitted to pictures of full detail: laws, interruptions, a failing card, and the schedule of cuts."""

from __future__ import annotations

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.fitting import fit as fit_module
from sparklod_cli.fitting.fit import AHEAD, LAST, RATES, STAGES, Schedule, default_steps, fit
from sparklod_cli.fitting.fit_settings import SHARES, FitSettings, Refined
from sparklod_cli.fitting.kernels.adam import Rates
from sparklod_cli.fitting.pictures import FittedNodes, FullDetailPicture, Index, Optimiser, Place, pictures, scores_of
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.system.errors import BackendError
from tests.conftest import FIXTURES
from tests.inspection import examine_tree
from tests.scenes import random_splats

#: Steps of quick tests.
STEPS = 160

#: dB that so few steps gain at least.
GAINED = 0.3


@functools.cache
def demo() -> tuple[Splats, LodTree]:
    """A quality tree of the demo scene: things with texture, and a ground."""
    return quality.build(read_scene(FIXTURES / "demo.ply").splats.with_max_sh(0))


@functools.cache
def fitted(seed: int = 0, threads: int = 1, steps: int = STEPS) -> tuple[Splats, Refined]:
    """The demo tree, fitted."""
    return fit(*demo(), FitSettings(steps=steps, seed=seed), threads=threads)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (160, 90))
    monkeypatch.setattr(fit_module, "HELD_OUT", 6)


def same(a: Splats, b: Splats) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in COLUMNS)


@pytest.mark.slow
def test_a_fit_changes_merged_splats_of_its_result_only() -> None:
    nodes, tree = demo()
    before = dataclasses.replace(nodes, **{name: getattr(nodes, name).copy() for name in COLUMNS})
    links = tree.child_count.copy(), tree.child_start.copy()
    result, _ = fitted()
    assert same(nodes, before)
    assert same(result.take(tree.is_leaf), before.take(tree.is_leaf))
    assert np.array_equal(tree.child_count, links[0]) and np.array_equal(tree.child_start, links[1])
    assert not result.invalid()
    assert (result.scale > 0).all()
    assert result.opacity.min() > 0 and result.opacity.max() <= 1000
    assert examine_tree(result, tree)[1] == []


@pytest.mark.slow
def test_the_result_depends_on_the_seed_but_not_on_the_number_of_threads() -> None:
    assert same(fitted()[0], fitted(threads=2)[0])
    assert fitted()[1] == fitted(threads=2)[1]
    assert not same(fitted()[0], fitted(seed=1)[0])


@pytest.mark.slow
def test_no_budget_loses_on_held_out_cameras_and_cuts_gain_on_others() -> None:
    nodes, tree = demo()
    result, report = fitted()
    assert all(report.psnr_after[share] >= report.psnr_before[share] for share in SHARES)
    assert 0 < report.kept <= 1
    before, after = (FittedNodes(splats, tree, RasterSettings(), 1) for splats in (nodes, result))
    place = Place.of(nodes.center[tree.is_leaf])
    views = [
        Camera.look_at(
            (place.middle + 2 * place.radius * np.array(way)).tolist(), place.middle.tolist(), size=(160, 90)
        )
        for way in ((1, -0.4, 0.2), (-0.6, -0.3, 0.8), (0.1, -0.9, -1))
    ]
    unseen = list(pictures(iter(views), before))
    assert len(unseen) == 3
    was, now = scores_of(before, unseen), scores_of(after, unseen)
    assert np.mean([now[share] - was[share] for share in (0.02, 0.05, 0.1)]) > GAINED


@pytest.mark.slow
def test_an_interruption_keeps_the_gains_of_the_finished_stages() -> None:
    stages: list[str] = []
    steps: list[int] = []
    result, report = fit(
        *demo(),
        FitSettings(steps=STEPS),
        progress=lambda stage, done, total, unit: steps.append(done),
        say=stages.append,
        interrupted=lambda: len(steps) > STEPS // 2,
    )
    assert not report.is_complete
    assert report.steps == len(steps) == STEPS // 2 + 1
    assert len(report.stages) == len(stages) == STAGES // 2 - 1  # of 14 steps each
    assert report.kept > 0
    assert not same(result, demo()[0])
    result, report = fit(*demo(), FitSettings(steps=STEPS), interrupted=lambda: True)
    assert same(result, demo()[0])
    assert (report.steps, report.kept, report.is_complete) == (0, 0.0, False)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (2, 0), (3, 1), (40, 0), (40, 1), (40, 3)])
@pytest.mark.parametrize("builder", [quick, quality])
def test_small_trees_of_any_builder_and_sh_degree_can_be_fitted(builder: Any, count: int, degree: int) -> None:
    nodes, tree = builder.build(random_splats(count, sh_degree=degree, seed=count))
    result, report = fit(nodes, tree, FitSettings(steps=6))
    assert not result.invalid()
    assert same(result.take(tree.is_leaf), nodes.take(tree.is_leaf))
    assert report.is_complete
    assert (report.steps > 0) >= (count == 40)  # two splats cover very little
    assert report.steps <= (0 if count == 1 else 6)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-4, 1e6])
def test_scenes_of_extreme_units_with_floaters_can_be_fitted(unit: float) -> None:
    nodes, tree = demo()
    center = nodes.center.copy()
    floater = np.flatnonzero(tree.is_leaf)[0]
    center[floater] = 1e3
    scaled = dataclasses.replace(nodes, center=center * np.float32(unit), scale=nodes.scale * np.float32(unit))
    result, report = fit(scaled, tree, FitSettings(steps=STEPS // 2))
    assert not result.invalid()
    assert 0 < report.steps <= STEPS // 2
    assert len(report.psnr_after) == len(SHARES)


@pytest.mark.slow
def test_a_fit_without_further_gain_ends_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "FLAT", 100.0)
    _, report = fit(*demo(), FitSettings(steps=120))
    assert [stage.steps for stage in report.stages] == [10] * 8
    assert report.steps == 80
    assert report.is_complete


@pytest.mark.slow
def test_spherical_harmonics_are_fitted() -> None:
    nodes, tree = quality.build(random_splats(500, sh_degree=2))
    result, report = fit(nodes, tree, FitSettings(steps=STEPS))
    assert report.kept > 0
    assert not np.array_equal(result.sh, nodes.sh)


def path_of(*cameras: Camera) -> CameraPath:
    return CameraPath(cameras, "a path", (), tuple(range(len(cameras))))


@pytest.mark.slow
def test_a_tree_is_fitted_to_the_cameras_of_a_path() -> None:
    nodes, tree = demo()
    near = path_of(*(Camera.look_at((0, -1, 2 + at / 4), (0, 0, 0), size=(96, 54)) for at in range(9)))
    result, report = fit(nodes, tree, FitSettings(steps=STEPS, path=near))
    assert 0 < report.steps <= STEPS
    assert not same(result, fitted()[0])
    assert all(report.psnr_after[share] >= report.psnr_before[share] for share in SHARES)
    away = path_of(Camera.look_at((0, 0, 1e5), (0, 0, 2e5), size=(96, 54)))
    result, report = fit(nodes, tree, FitSettings(steps=STEPS, path=away))
    assert same(result, nodes)  # nothing was seen
    assert report.steps == 0


REASON = "the card has too little memory for 400 splats; about 200 fit"


class FailingOptimiser(Optimiser):
    """A card whose memory does not suffice for the seventh step."""

    taken = 0

    def step(self, picture: FullDetailPicture, index: Index, rates: Rates) -> None:
        self.taken += 1
        if self.taken == 7:
            raise BackendError(REASON)
        super().step(picture, index, rates)


@pytest.fixture
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (64, 36))
    monkeypatch.setattr(fit_module, "TRAINING", 4)
    monkeypatch.setattr(fit_module, "HELD_OUT", 2)


def test_a_card_that_fails_is_replaced_by_the_processor_unless_it_was_requested(
    few_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def optimiser_on(device: str, nodes: FittedNodes, say: Callable[[str], None]) -> Optimiser:
        return Optimiser(nodes) if device == "cpu" else FailingOptimiser(nodes)

    monkeypatch.setattr(fit_module, "_optimiser_on", optimiser_on)
    nodes, tree = quality.build(random_splats(400))
    said: dict[str, list[str]] = {"auto": [], "cpu": []}
    (result, report), (reference, expected) = (
        fit(nodes, tree, FitSettings(steps=40, device=device), say=lines.append) for device, lines in said.items()
    )
    assert report == expected
    assert same(result, reference)
    line = f"starts again on the processor: {REASON}"
    assert line in said["auto"]
    assert said["auto"][said["auto"].index(line) + 1 :] == said["cpu"]
    with pytest.raises(BackendError, match=REASON):
        fit(nodes, tree, FitSettings(steps=40, device="cuda"))


class CountingOptimiser(Optimiser):
    """An optimiser that counts its steps, and those that the nodes of cuts have seen."""

    taken = placed = 0

    def step(self, *arguments: Any) -> None:
        super().step(*arguments)
        self.taken += 1

    def place(self) -> None:
        super().place()
        self.placed = self.taken


class RecordedNodes(FittedNodes):
    """Nodes that record after how many steps the cuts of steps are found."""

    def cut(self, camera: Camera, share: float) -> Index:
        if threading.current_thread() is not threading.main_thread():  # which scores the nodes
            self.found_after.append(self.optimiser.placed)
        return super().cut(camera, share)

    found_after: list[int]
    optimiser: CountingOptimiser


@pytest.mark.parametrize("threads", [1, 3])
def test_cuts_are_found_before_the_steps_of_the_previous_group(
    threads: int, few_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They depend on the steps taken, not on when threads find them."""
    stages, steps = 2, 2 * AHEAD + AHEAD // 2  # the last group is half of one
    made: list[RecordedNodes] = []

    def optimiser_on(device: str, nodes: RecordedNodes, say: object) -> Optimiser:
        nodes.found_after, nodes.optimiser = [], CountingOptimiser(nodes)
        made.append(nodes)
        return nodes.optimiser

    monkeypatch.setattr(fit_module, "STAGES", stages)
    monkeypatch.setattr(fit_module, "FittedNodes", RecordedNodes)
    monkeypatch.setattr(fit_module, "_optimiser_on", optimiser_on)
    monkeypatch.setattr(fit_module, "FLAT", -1.0)  # no stage is left out
    fit(*quality.build(random_splats(300)), FitSettings(steps=stages * steps), threads=threads)
    expected = [0] * 2 * AHEAD + [AHEAD] * (steps - 2 * AHEAD)
    assert made[0].found_after == [stage * steps + step for stage in range(stages) for step in expected]
    assert made[0].optimiser.placed == stages * steps


def rates_of(schedule: Schedule) -> list[Rates]:
    rates = []
    while schedule.remaining:
        rates.append(schedule.rates())
        schedule.advance()
    return rates


def test_rates_fall_from_the_first_to_the_last() -> None:
    rates = np.array(rates_of(Schedule(50)))
    assert len(rates) == 50
    assert np.allclose(rates[0], RATES)
    assert (np.diff(rates, axis=0) < 0).all()
    assert (rates[-1] < 1.1 * LAST * np.array(RATES)).all()


def test_a_shortened_schedule_omits_half_of_its_steps_and_ends_with_the_same_rates() -> None:
    schedule = Schedule(120)
    assert schedule.stage_steps == 120 // STAGES
    for _ in range(40):
        schedule.advance()
    before = schedule.rates()
    schedule.shorten()
    assert (schedule.done, schedule.remaining) == (40, 40)
    assert schedule.rates() == before
    assert np.allclose(rates_of(schedule)[-1], LAST * np.array(RATES), rtol=0.1)
    schedule = Schedule(120)
    for _ in range(111):
        schedule.advance()
    schedule.shorten()
    assert schedule.remaining == 0


def test_larger_trees_have_fewer_steps_within_bounds() -> None:
    steps = [default_steps(leaves) for leaves in (1, 100_000, 500_000, 1_000_000, 50_000_000)]
    assert steps == [12_000, 12_000, 6000, 3000, 1000]
