"""Pictures of full detail: cameras, steps towards them, the bounds of steps, and gains that are kept."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.fitting.fit import RATES
from sparklod_cli.fitting.fit_settings import SHARES
from sparklod_cli.fitting.kernels.adam import MOST_D, Rates
from sparklod_cli.fitting.pictures import (
    DISTANCES,
    LONGEST,
    TRAINING,
    FittedNodes,
    FullDetailPicture,
    Optimiser,
    Place,
    keep_gains,
    keep_sizes,
    pictures,
    placed,
    scores_of,
    smaller,
    split_path,
)
from sparklod_cli.lod import quality
from sparklod_cli.render.rasterizer import draw
from sparklod_cli.render.render_settings import RasterSettings
from tests.inspection import examine_tree
from tests.scenes import random_splats

#: Share of a tree's leaves that its cuts have.
SHARE = 0.05


def cameras_of(place: Place, count: int, seed: int = 3) -> list[Camera]:
    return list(itertools.islice(placed(place, np.random.SeedSequence(seed)), count))


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e6])
def test_cameras_are_placed_around_and_inside_a_scene_with_floaters(unit: float) -> None:
    center = np.random.default_rng(1).normal(size=(500, 3)) * unit
    scene = Place.of(np.append(center, [[1e5 * unit, 0, 0]], axis=0).astype(np.float32))
    away = np.array([camera.position - scene.middle for camera in cameras_of(scene, 200)]) / scene.radius
    distance = np.linalg.norm(away, axis=1)
    assert distance.max() <= DISTANCES[1] * 1.0001
    assert np.count_nonzero(distance < 0.5) > 10  # inside
    assert np.count_nonzero(distance > 2) > 30
    for axis, sign in itertools.product(range(3), (-1, 1)):
        assert np.count_nonzero(sign * away[:, axis] > 0.6 * distance) > 5
    first, same, other = ([each.camera_to_world for each in cameras_of(scene, 9, seed)] for seed in (7, 7, 8))
    assert np.array_equal(first, same)
    assert not np.isclose(first, other).all()


def test_coincident_splats_have_cameras_around_them() -> None:
    cameras = cameras_of(Place.of(np.ones((4, 3), np.float32)), 20)
    assert all(np.isfinite(camera.camera_to_world).all() for camera in cameras)


@pytest.mark.parametrize("count", [1, 2, 9, 100, 1000])
def test_a_path_is_split_into_training_and_held_out_cameras(count: int) -> None:
    cameras = tuple(Camera.look_at((0, 0, 3 + at), (0, 0, 0), size=(1920, 1080)) for at in range(count))
    training, held_out = split_path(CameraPath(cameras, "a path", (), tuple(range(count))))
    assert 1 <= len(held_out) <= 16
    if count == 1:  # the only camera is both
        assert len(training) == len(held_out) == 1
        return
    assert len(training) + len(held_out) == count or TRAINING / 2 < len(training) <= TRAINING
    assert not {camera.position[2] for camera in training} & {camera.position[2] for camera in held_out}


def test_a_smaller_picture_has_the_same_field_of_view() -> None:
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), size=(1920, 1080))
    small = smaller(camera)
    assert (small.width, small.height) == (LONGEST, LONGEST * 9 // 16)
    assert (small.fov_x, small.fov_y) == pytest.approx((camera.fov_x, camera.fov_y))
    assert smaller(small) is small


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> FittedNodes:
    monkeypatch.setattr("sparklod_cli.fitting.pictures.SIZE", (160, 90))
    return FittedNodes(*quality.build(random_splats(2000, sh_degree=1)), RasterSettings(), 1)


def pictures_of(nodes: FittedNodes, count: int = 1) -> list[FullDetailPicture]:
    cameras = placed(Place.of(nodes.old.center[nodes.leaves]), np.random.SeedSequence(1))
    return list(itertools.islice(pictures(cameras, nodes), count))


def error(nodes: FittedNodes, picture: FullDetailPicture) -> float:
    _, shaded = nodes.visible(nodes.cut(picture.camera, SHARE), picture.camera)
    return sum(picture.errors(draw(shaded, picture.camera, nodes.raster)))


@pytest.mark.parametrize("number", range(len(RATES)))
def test_steps_in_each_property_alone_bring_a_picture_closer(nodes: FittedNodes, number: int) -> None:
    (picture,), optimiser = pictures_of(nodes), Optimiser(nodes)
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
    (picture,) = pictures_of(nodes)
    cut = nodes.cut(picture.camera, 0.3)
    shown, _ = nodes.visible(cut, picture.camera)
    Optimiser(nodes).step(picture, cut, RATES)
    moved = np.flatnonzero(nodes.changed())
    assert moved.size > 50
    assert np.isin(moved, np.intersect1d(shown, nodes.fitted)).all()
    assert nodes.tree.is_leaf[shown].any()


def test_long_steps_stay_within_bounds(nodes: FittedNodes) -> None:
    (picture,), optimiser = pictures_of(nodes), Optimiser(nodes)
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


def findings_of(nodes: FittedNodes) -> list[str]:
    return [finding.code for finding in examine_tree(nodes.result(), nodes.tree)[1]]


def test_nodes_smaller_than_their_children_get_their_first_values(nodes: FittedNodes) -> None:
    nodes.columns.scale[nodes.fitted] *= 1.05
    assert not keep_sizes(nodes)
    assert nodes.changed()[nodes.fitted].all()
    shrunk = nodes.fitted[::7]
    nodes.columns.scale[shrunk] /= 4
    nodes.columns.rgb[nodes.fitted] += 0.01
    assert findings_of(nodes) == ["tree.size"]
    assert keep_sizes(nodes)
    assert findings_of(nodes) == []
    restored = ~nodes.changed()
    assert restored[shrunk].any()
    assert not restored[np.setdiff1d(nodes.fitted, shrunk)].any()
    deep = nodes.fitted[nodes.tree.depths()[nodes.fitted] >= 4]
    nodes.columns.scale[deep] *= 8
    assert "tree.size" in findings_of(nodes)
    assert keep_sizes(nodes)
    assert findings_of(nodes) == []


def test_nodes_of_a_budget_that_lost_get_their_first_values_and_those_that_gained_stay(nodes: FittedNodes) -> None:
    held_out = pictures_of(nodes, 3)
    before = scores_of(nodes, held_out)
    nodes.columns.rgb[nodes.fitted] += 1e-4
    keep_gains(nodes, held_out, {share: psnr - 1 for share, psnr in before.items()})
    assert nodes.changed()[nodes.fitted].all()
    nodes.restore(nodes.fitted, nodes.old)
    coarse = np.unique(np.concatenate([nodes.cut(picture.camera, SHARES[0]) for picture in held_out]))
    coarse = np.intersect1d(coarse, nodes.fitted)
    nodes.columns.rgb[coarse] += 0.3
    after = keep_gains(nodes, held_out, before)
    assert all(after[share] >= before[share] for share in SHARES)
    assert not nodes.changed()[coarse].all()
