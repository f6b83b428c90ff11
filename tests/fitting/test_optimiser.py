"""Steps of merged splats, their bounds, and what is drawn when."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.fitting.fit import LAST, RATES, STAGES, Schedule, default_steps
from sparklod_cli.fitting.kernels.adam import MOST_D, Rates
from sparklod_cli.fitting.pictures import FittedNodes, FullDetailPicture, Optimiser, Place, pictures, placed
from sparklod_cli.lod import quality
from sparklod_cli.render.rasterizer import draw
from sparklod_cli.render.render_settings import RasterSettings
from tests.scenes import random_splats

COUNT = 2000
SHARE = 0.05


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> FittedNodes:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (160, 90))
    return FittedNodes(*quality.build(random_splats(COUNT, sh_degree=1)), RasterSettings(), 1)


def picture_of(nodes: FittedNodes) -> FullDetailPicture:
    seen = placed(Place.of(nodes.old.center[nodes.leaves]), np.random.SeedSequence(1))
    return next(pictures(seen, nodes))


def error(nodes: FittedNodes, picture: FullDetailPicture) -> float:
    _, shaded = nodes.visible(nodes.cut(picture.camera, SHARE), picture.camera)
    return sum(picture.errors(draw(shaded, picture.camera, nodes.raster)))


@pytest.mark.parametrize("number", range(len(RATES)))
def test_steps_in_each_property_alone_bring_a_picture_closer(nodes: FittedNodes, number: int) -> None:
    picture, optimiser = picture_of(nodes), Optimiser(nodes)
    before = error(nodes, picture)
    rates = Rates(*(0.005 * (at == number) for at in range(len(RATES))))
    for _ in range(10):
        optimiser.step(picture, nodes.cut(picture.camera, SHARE), rates)
        optimiser.place()
    assert error(nodes, picture) < 0.998 * before
    names = nodes.columns._fields
    # Quaternions are normalised anew, and D may bring a feature size to its bound.
    moved = {
        name
        for name, now, old in zip(names, nodes.columns, nodes.old, strict=True)
        if not np.allclose(now, old, rtol=1e-6, atol=1e-6)
    }
    assert names[number] in moved
    assert moved <= {names[number], "scale"}


def test_only_merged_splats_that_a_picture_shows_move(nodes: FittedNodes) -> None:
    picture = picture_of(nodes)
    cut = nodes.cut(picture.camera, 0.3)
    shown, _ = nodes.visible(cut, picture.camera)
    Optimiser(nodes).step(picture, cut, RATES)
    moved = np.flatnonzero(nodes.changed())
    assert moved.size > 50
    assert np.isin(moved, np.intersect1d(shown, nodes.fitted)).all()
    assert nodes.tree.is_leaf[shown].any()


def test_long_steps_stay_within_bounds(nodes: FittedNodes) -> None:
    picture, optimiser = picture_of(nodes), Optimiser(nodes)
    for share in (0.02, 0.1, 0.3) * 4:
        optimiser.step(picture, nodes.cut(picture.camera, share), Rates(*(3.0,) * len(RATES)))
    now, old, merged = nodes.columns, nodes.old, nodes.fitted
    assert not nodes.result().invalid()
    ratio = nodes.sizes(merged) / nodes.sizes(merged, old)
    assert ratio.max() > 1.05
    assert (np.abs(np.log(ratio)) <= np.log(nodes.bounds.most_growth) + 1e-5).all()
    assert now.lod_opacity.max() <= MOST_D
    away = np.linalg.norm(now.center - old.center, axis=1)
    assert (away <= 2.001 * old.scale.max(axis=1)).all()


def rates_of(schedule: Schedule) -> list[Rates]:
    found = []
    while schedule.remaining:
        found.append(schedule.rates())
        schedule.advance()
    return found


def test_rates_fall_from_the_first_to_the_last() -> None:
    rates = np.array(rates_of(Schedule(50)))
    assert len(rates) == 50
    assert np.allclose(rates[0], RATES)
    assert (np.diff(rates, axis=0) < 0).all()
    assert (rates[-1] < 1.1 * LAST * np.array(RATES)).all()


def test_a_flat_curve_leaves_out_half_of_the_steps_and_the_rates_fall_to_the_same_end() -> None:
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
