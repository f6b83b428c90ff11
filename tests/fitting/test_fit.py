"""Merged splats that are fitted to pictures of full detail."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.codecs import ply
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.fitting import fit as fit_module
from sparklod_cli.fitting.fit import fit
from sparklod_cli.fitting.pictures import FittedNodes, Place, pictures, scores_of
from sparklod_cli.fitting.settings import SHARES, FitSettings, Refined
from sparklod_cli.inspection.tree import examine
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.render.render_settings import RasterSettings
from tests.conftest import FIXTURES
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: Steps of quick tests.
STEPS = 160


@functools.cache
def demo() -> tuple[Splats, LodTree]:
    """A quality tree of the demo scene: things with texture, and a ground."""
    with (FIXTURES / "demo.ply").open("rb") as file:
        splats = decode_file(ply, file).splats
    return quality.build(splats.with_max_sh(0))


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


def test_leaves_stay_bit_for_bit_and_the_tree_too() -> None:
    nodes, tree = demo()
    before = dataclasses.replace(nodes), tree.child_count.copy(), tree.child_start.copy()
    result, _ = fitted()
    assert same(result.take(tree.is_leaf), before[0].take(tree.is_leaf))
    assert np.array_equal(tree.child_count, before[1]) and np.array_equal(tree.child_start, before[2])


def test_what_comes_in_is_not_changed() -> None:
    nodes, tree = demo()
    copies = {name: getattr(nodes, name).copy() for name in COLUMNS}
    fit(nodes, tree, FitSettings(steps=5))
    assert all(np.array_equal(getattr(nodes, name), copies[name]) for name in COLUMNS)


def test_the_result_is_the_same_for_any_number_of_threads_and_another_for_another_seed() -> None:
    assert same(fitted()[0], fitted(threads=2)[0])
    assert fitted()[1] == fitted(threads=2)[1]
    assert not same(fitted()[0], fitted(seed=1)[0])


def test_fitted_splats_are_valid() -> None:
    result, _ = fitted()
    assert not result.invalid()
    assert (result.scale > 0).all()
    assert result.opacity.min() > 0 and result.opacity.max() <= 1000


def test_no_budget_loses_on_the_held_out_cameras_and_cuts_gain_on_cameras_that_nothing_was_chosen_by() -> None:
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


#: dB that so few steps gain at least.
GAINED = 0.3


def test_an_interruption_keeps_what_the_finished_stages_gained() -> None:
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
    assert len(report.stages) == len(stages) == fit_module.STAGES // 2 - 1  # of 14 steps each
    assert report.kept > 0
    assert not same(result, demo()[0])


def test_an_interruption_before_the_first_step_changes_nothing() -> None:
    result, report = fit(*demo(), FitSettings(steps=STEPS), interrupted=lambda: True)
    assert same(result, demo()[0])
    assert (report.steps, report.kept, report.is_complete) == (0, 0.0, False)


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (2, 0), (3, 1), (40, 0), (40, 1), (40, 3)])
@pytest.mark.parametrize("builder", [quick, quality])
def test_small_trees_of_both_builders_and_of_any_sh_degree_can_be_fitted(builder: Any, count: int, degree: int) -> None:
    nodes, tree = builder.build(random_splats(count, sh_degree=degree, seed=count))
    result, report = fit(nodes, tree, FitSettings(steps=6))
    assert not result.invalid()
    assert same(result.take(tree.is_leaf), nodes.take(tree.is_leaf))
    assert report.is_complete
    assert (report.steps > 0) >= (count == 40)  # two splats cover very little
    assert report.steps <= (0 if count == 1 else 6)


@pytest.mark.parametrize("unit", [1e-4, 1e6])
def test_scenes_of_extreme_units_and_with_floaters_gain_too(unit: float) -> None:
    nodes, tree = demo()
    center = nodes.center.copy()
    floater = np.flatnonzero(tree.is_leaf)[0]
    center[floater] = 1e3
    scaled = dataclasses.replace(nodes, center=center * np.float32(unit), scale=nodes.scale * np.float32(unit))
    result, report = fit(scaled, tree, FitSettings(steps=STEPS // 2))
    assert not result.invalid()
    assert 0 < report.steps <= STEPS // 2
    assert len(report.psnr_after) == len(SHARES)


def test_a_curve_that_is_flat_ends_the_fit_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "FLAT", 100.0)
    _, report = fit(*demo(), FitSettings(steps=120))
    assert [stage.steps for stage in report.stages] == [10] * 8
    assert report.steps == 80
    assert report.is_complete


def test_spherical_harmonics_are_fitted_too() -> None:
    nodes, tree = quality.build(random_splats(500, sh_degree=2))
    result, report = fit(nodes, tree, FitSettings(steps=STEPS))
    assert report.kept > 0
    assert not np.array_equal(result.sh, nodes.sh)


def test_the_cameras_of_a_path_are_what_a_tree_is_fitted_to() -> None:
    nodes, tree = demo()
    views = [Camera.look_at((0, -1, 2 + at / 4), (0, 0, 0), size=(96, 54)) for at in range(9)]
    path = CameraPath(tuple(views), "a path", (), tuple(range(9)))
    result, report = fit(nodes, tree, FitSettings(steps=STEPS, path=path))
    assert 0 < report.steps <= STEPS
    assert not same(result, fitted()[0])
    assert all(report.psnr_after[share] >= report.psnr_before[share] for share in SHARES)


def test_cameras_that_see_nothing_leave_all_as_it_is() -> None:
    away = Camera.look_at((0, 0, 1e5), (0, 0, 2e5), size=(96, 54))
    result, report = fit(*demo(), FitSettings(steps=STEPS, path=CameraPath((away,), "a path", (), (0,))))
    assert same(result, demo()[0])
    assert report.steps == 0


def test_a_report_on_a_fitted_tree_finds_no_fault() -> None:
    result, _ = fitted()
    assert examine(result, demo()[1])[1] == []
