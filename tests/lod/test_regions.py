"""Regions: a kd partition, and the boxes of splats."""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
import pytest

from sparklod_cli.lod.parts import EXTENT, beyond, divide, extents, middle_of, united
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.gaussian import covariance, rotation_matrices
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import InvalidSplatsError
from tests.scenes import random_splats


class Places(NamedTuple):
    center: np.ndarray
    box: np.ndarray
    splats: np.ndarray


def places(count: int, seed: int = 0, splats: int = 10) -> Places:
    center = np.random.default_rng(seed).uniform(size=(count, 3)).astype(np.float32) * np.float32([4, 2, 1])
    box = np.stack([center, center], axis=1).astype(np.float64)
    return Places(center, box, np.full(count, splats, np.int64))


def test_regions_have_no_more_splats_than_a_chunk() -> None:
    some = places(1000)
    number, children = divide(*some, DetailSettings(chunk_splats=777, extent=100.0))
    sums = np.bincount(number, some.splats)
    assert sums.max() <= 777 and sums.min() >= 777 / 2 - 10 and len(children) == len(sums) - 1


def test_regions_are_no_wider_than_the_extent_unless_they_have_few_splats() -> None:
    some = places(1000)
    for least in (1, 2000):
        number, children = divide(*some, DetailSettings(extent=0.5, min_splats=least))
        for region in range(len(children) + 1):
            inside = number == region
            side = np.ptp(some.center[inside], axis=0).max()
            assert side <= 0.5 or some.splats[inside].sum() <= least
        assert (len(children) >= 8 * 4 * 2 - 1) == (least == 1)


def test_what_lies_below_a_place_counts_for_the_extent() -> None:
    some = places(2)
    wide = some._replace(box=some.box + np.array([[-50.0], [50.0]]))
    assert len(divide(*some, DetailSettings(min_splats=1))[1]) == 0
    assert len(divide(*wide, DetailSettings(min_splats=1))[1]) == 1


def test_heavy_places_divide_where_the_splats_are() -> None:
    some = places(100)
    splats = some.splats.copy()
    splats[np.argmin(some.center[:, 0])] = 5_000
    number, _ = divide(*some._replace(splats=splats), DetailSettings(chunk_splats=5_500))
    assert np.bincount(number).tolist() == [1, 99]


def test_a_place_is_never_divided() -> None:
    number, _ = divide(*places(4, splats=100), DetailSettings(chunk_splats=10))
    assert sorted(number) == [0, 1, 2, 3]


def test_places_at_one_point_are_divided_all_the_same() -> None:
    some = places(64)
    same = some._replace(center=np.zeros_like(some.center), box=np.zeros_like(some.box))
    assert np.bincount(divide(*same, DetailSettings(chunk_splats=100))[0]).max() == 10 - 2


def test_boxes_enclose_the_ellipsoid_and_the_rotated_box_of_one_deviation() -> None:
    splats = random_splats(500, seed=3)
    half = (extents(splats)[:, 1] - extents(splats)[:, 0]) / 2
    np.testing.assert_allclose(extents(splats).mean(axis=1), splats.center, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        half, EXTENT * np.sqrt(covariance(splats.scale, splats.quat_xyzw)[:, [0, 3, 5]]), rtol=1e-5
    )
    turned = np.abs(rotation_matrices(splats.quat_xyzw)).transpose(2, 0, 1) @ splats.scale[:, :, None]
    assert (half >= turned[:, :, 0] * (1 - 1e-6)).all()


@pytest.mark.parametrize("count", [1, 5])
def test_a_union_touches_what_it_encloses(count: int) -> None:
    boxes = extents(random_splats(50, seed=1))
    number = np.arange(50) % count
    for at, box in enumerate(united(boxes, number, count)):
        assert box[0].tolist() == boxes[number == at, 0].min(axis=0).tolist()
        assert box[1].tolist() == boxes[number == at, 1].max(axis=0).tolist()


def at(*centers: tuple[float, float, float]) -> Splats:
    splats = Splats.zeros(len(centers), 0)
    splats.center[:] = centers
    return splats


@pytest.fixture
def scene() -> Splats:
    """A ball of radius 1 around (10, 20, 30), and a sky to one side of it."""
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(900, 3))
    inside *= rng.uniform(0, 1, (900, 1)) / np.linalg.norm(inside, axis=1, keepdims=True)
    sky = rng.normal(size=(100, 3)) + np.array([1000, 0, 0])
    return at(*((np.concatenate([inside, sky]) + np.array([10, 20, 30])).tolist()))


def test_a_sky_is_beyond_and_does_not_move_the_middle(scene: Splats) -> None:
    np.testing.assert_allclose(middle_of(scene), [10, 20, 30], atol=0.15)
    assert beyond(scene, 5).tolist() == [False] * 900 + [True] * 100


def test_those_at_the_radius_are_not_beyond() -> None:
    assert beyond(at((-2, 0, 0), (0, 0, 0), (2, 0, 0)), 2).tolist() == [False] * 3
    assert beyond(at((-2, 0, 0), (0, 0, 0), (2, 0, 0)), 1.99).tolist() == [True, False, True]


def test_a_larger_radius_leaves_fewer(scene: Splats) -> None:
    wider = [beyond(scene, radius) for radius in (0.5, 0.8, 5, 999, 2000)]
    assert all((a | ~b).all() for a, b in itertools.pairwise(wider))
    assert [int(mask.sum()) for mask in wider[2:]] == sorted((int(mask.sum()) for mask in wider[2:]), reverse=True)
    assert not wider[-1].any()


def test_order_place_and_size_do_not_matter(scene: Splats) -> None:
    order = np.random.default_rng(1).permutation(len(scene))
    expected = beyond(scene, 0.7)
    assert np.array_equal(beyond(scene.take(order), 0.7), expected[order])
    center = (4 * scene.center.astype(np.float64) + [64, -32, 0]).astype(np.float32)
    other = beyond(dataclasses.replace(scene, center=center), 2.8)
    assert np.count_nonzero(other != expected) <= 1  # one on the border may round to the other side


def test_large_coordinates_do_not_overflow() -> None:
    assert beyond(at((0, 0, 0), (0, 0, 0), (3e38, -3e38, 3e38)), 1e30).tolist() == [False, False, True]


def test_no_splat_near_the_middle_is_an_error() -> None:
    with pytest.raises(InvalidSplatsError, match=r"no splat is within 2 of the middle of the scene \(0, 0, 0\); give"):
        beyond(at((-5, 0, 0), (5, 0, 0)), 2)
