"""Steps on a card are those of the processor, and the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.fitting.fit import RATES, fit
from sparklod_cli.fitting.fit_settings import FitSettings
from sparklod_cli.fitting.pictures import FittedNodes, FittedSet, Optimiser, Place, pictures, placed
from sparklod_cli.lod import quality
from sparklod_cli.render.render_settings import RasterSettings
from tests.cards import MARKS
from tests.scenes import random_splats

pytestmark = MARKS

COUNT, SHARE, STEPS = 40, 0.3, 2

#: Largest difference of a column after STEPS, over its largest change. Chosen: the first steps of Adam are as long for
#: derivatives that are next to nothing, whose sign is that of rounding.
MOST = 0.02


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (16, 10))


def nodes_of(kind: str) -> FittedNodes:
    tree = quality.build(random_splats(COUNT, sh_degree=1))
    if kind == "cut":
        return FittedNodes(*tree, RasterSettings(), 1)
    tree[0].opacity[:] = np.minimum(tree[0].opacity, 1)
    fixed = FittedNodes(*tree, RasterSettings(), 1)
    return FittedSet(
        *tree,
        fixed.cut(next(placed(Place.of(fixed.old.center), np.random.SeedSequence(1))), SHARE),
        RasterSettings(),
        1,
    )


def after_steps(nodes: FittedNodes, optimiser: Optimiser) -> FittedNodes:
    seen = placed(Place.of(nodes.old.center[nodes.leaves]), np.random.SeedSequence(1))
    picture = next(pictures(seen, nodes))
    for _ in range(STEPS):
        optimiser.step(picture, nodes.cut(picture.camera, SHARE), RATES)
        optimiser.place()
    optimiser.synchronize()
    return nodes


@pytest.mark.parametrize("kind", ["cut", "set"])
def test_steps_are_those_of_the_processor_and_the_same_twice(kind: str) -> None:
    from sparklod_cli.fitting.cuda.card_optimiser import CardOptimiser

    reference = nodes_of(kind)
    after_steps(reference, Optimiser(reference))
    found = [nodes_of(kind) for _ in range(2 if kind == "cut" else 1)]
    for nodes in found:
        after_steps(nodes, CardOptimiser(nodes))
    for name in reference.columns._fields:
        expected, old = getattr(reference.columns, name), getattr(reference.old, name)
        now = getattr(found[0].columns, name)
        assert np.array_equal(now, getattr(found[-1].columns, name)), name
        others = np.setdiff1d(np.arange(len(reference.tree)), reference.fitted)
        assert (now[others] == old[others]).all()
        change = np.abs(expected - old).max()
        assert change > 0, name
        # All but a few, whose derivatives are rounding.
        assert np.quantile(np.abs(now - expected), 0.98) < MOST * change, name
    every = np.arange(len(reference.tree))
    assert np.allclose(found[0].sizes(every), reference.sizes(every), rtol=1e-3)
    assert found[0].columns.lod_opacity.max() <= reference.bounds.most_d


def test_a_fit_on_a_card_gains() -> None:
    said: list[str] = []
    settings = FitSettings(steps=3, device="cuda")
    nodes, tree = quality.build(random_splats(COUNT, sh_degree=0))
    _, report = fit(nodes, tree, settings, say=said.append)
    assert said[0].startswith("uses the card")
    assert report.steps > 0
    assert all(report.psnr_after[share] >= report.psnr_before[share] for share in report.psnr_before)
