"""Errors of regions at their detail levels: laws, and the pictures that they are of."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.bake import parts_output
from sparklod_cli.bake.parts_output import measured
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.gaussian import covariance
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render import rasterizer
from sparklod_cli.render.rasterizer import shade
from sparklod_cli.render.render_settings import RasterSettings
from tests.scenes import random_splats


def scene_of(regions: Sequence[Sequence[Splats]]) -> DetailScene:
    """A scene of regions, each a list of its levels."""
    levels = range(len(regions[0]))
    counts = np.array([[len(run) for run in region] for region in regions], np.int64)
    bounds = np.array([bound(Splats.concat(region)) for region in regions])
    children = np.array(
        [[-1 - r, r + 1 if r + 2 < len(regions) else -2 - r] for r in range(len(regions) - 1)], np.int64
    )
    splats = Splats.concat([region[level] for level in levels for region in regions])
    return DetailScene(splats, counts, bounds, children.reshape(-1, 2))


def bound(splats: Splats) -> NDArray[np.float64]:
    half = np.sqrt(covariance(splats.scale, splats.quat_xyzw)[:, [0, 3, 5]])
    return np.array([(splats.center - half).min(axis=0), (splats.center + half).max(axis=0)])


def moved(splats: Splats, scale: float, offset: Sequence[float]) -> Splats:
    center = (splats.center * np.float64(scale) + offset).astype(np.float32)
    return dataclasses.replace(splats, center=center, scale=(splats.scale * scale).astype(np.float32))


@pytest.fixture(scope="module")
def regions() -> list[list[Splats]]:
    """Three regions at four levels: all splats, and each time fewer."""
    full = [random_splats(count, sh_degree=1, seed=seed) for seed, count in enumerate((300, 40, 900))]
    return [[splats.take(slice(0, None, step)) for step in (1, 2, 3, 20)] for splats in full]


@pytest.fixture(scope="module")
def errors(regions: list[list[Splats]]) -> NDArray[np.float64]:
    return measured(scene_of(regions), threads=1)


def error_of(*levels: Splats) -> list[float]:
    """Errors of a scene of one region."""
    return measured(scene_of([levels]), threads=1)[0].tolist()


def test_errors_begin_with_0_and_do_not_decrease(errors: NDArray[np.float64]) -> None:
    assert errors.shape == (3, 4)
    assert (errors[:, 0] == 0).all()
    assert (errors[:, 1] > 0.01).all()
    assert (np.diff(errors, axis=1) >= 0).all()
    assert np.isfinite(errors).all()


def test_an_error_is_that_of_pictures_of_the_rasterizer(
    regions: list[list[Splats]], errors: NDArray[np.float64]
) -> None:
    """The slow, obvious way: each region at each level as a scene, seen by cameras."""
    turns = parts_output._turns()
    for region, expected in zip(regions, errors, strict=True):
        low, high = bound(Splats.concat(region))
        middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        small = np.quantile(region[0].scale.max(axis=1), parts_output.FINE)
        width = int(np.ceil(np.clip(4 * radius / small, 64, parts_output.MOST_WIDTH) / 16) * 16)
        focal = width * 200 / 2.1
        settings = RasterSettings(near=100 * radius, far=400 * radius, sort="z", max_radius=1e6)
        sums = np.zeros(len(region))
        for right, down, ahead in turns:
            pose = np.eye(4)
            pose[:3] = np.stack([right, -down, -ahead, middle - 200 * radius * ahead], axis=1)
            camera = Camera(pose, width, width, (focal, focal), (width / 2, width / 2))
            pictures = [
                rasterizer.draw(shade([(run, np.eye(4))], camera), camera, settings).astype(np.float64)
                for run in region
            ]
            sums += [(pictures[0] ** 2).sum(), *(((other - pictures[0]) ** 2).sum() for other in pictures[1:])]
        np.testing.assert_allclose(expected[1:], np.maximum.accumulate(sums[1:] / sums[0]), rtol=0.01)


@pytest.mark.parametrize(("scale", "offset"), [(1e-3, (0, 0, 0)), (300.0, (0, 0, 0)), (1.0, (50, -80, 20))])
def test_size_and_place_of_a_region_do_not_matter(
    regions: list[list[Splats]], errors: NDArray[np.float64], scale: float, offset: Sequence[float]
) -> None:
    other = [[moved(run, scale, offset) for run in region] for region in regions]
    np.testing.assert_allclose(measured(scene_of(other), threads=1), errors, rtol=2e-3)


def test_threads_batches_and_other_regions_do_not_matter(
    regions: list[list[Splats]], errors: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert np.array_equal([error_of(*region) for region in regions], errors)
    monkeypatch.setattr(parts_output, "BATCH", 500)
    steps: list[tuple[int, int]] = []
    again = measured(scene_of(regions), threads=2, progress=lambda name, done, total, unit: steps.append((done, total)))
    assert np.array_equal(again, errors)
    assert steps[-1] == (3, 3)
    assert len(steps) > 1


def test_errors_of_equal_empty_and_invisible_levels() -> None:
    splats = random_splats(100, sh_degree=1, seed=4)
    none, half = splats.take(slice(0)), splats.take(slice(0, 50))
    hidden = dataclasses.replace(splats, opacity=np.zeros_like(splats.opacity))
    dots = dataclasses.replace(splats, center=np.zeros_like(splats.center), scale=np.zeros_like(splats.scale))
    _, error = error_of(splats, half)
    assert error_of(splats, splats, splats) == [0, 0, 0]
    assert error_of(splats, hidden) == error_of(hidden, splats) == [0, 1]
    assert error_of(hidden, hidden) == [0, 0]
    assert error_of(splats, none, half, none) == [0, 0, error, error]
    assert error_of(none, splats, half) == [0, 0, error]
    assert error_of(dots, dots.take(slice(0, 1))) == [0, 0]


def test_colors_seen_from_some_directions_only_count() -> None:
    splats = random_splats(100, sh_degree=3, seed=7)
    for coefficient in range(15):
        sh = splats.sh.copy()
        sh[:, coefficient] += 0.5
        assert error_of(splats, dataclasses.replace(splats, sh=sh))[1] > 1e-3
