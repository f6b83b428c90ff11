"""Regions: a kd partition, and the boxes of splats."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sparklod_cli.lod.detail_settings import DetailSettings
from sparklod_cli.lod.regions import EXTENT, Places, divide, extents, united
from sparklod_cli.model.gaussian import covariance, rotation_matrices
from tests.scenes import random_splats


def places(count: int, seed: int = 0, splats: int = 10) -> Places:
    center = np.random.default_rng(seed).uniform(size=(count, 3)).astype(np.float32) * np.float32([4, 2, 1])
    box = np.stack([center, center], axis=1).astype(np.float64)
    return Places(center, box, np.full(count, splats, np.int64))


def test_regions_have_no_more_splats_than_a_chunk() -> None:
    some = places(1000)
    regions = divide(some, DetailSettings(chunk_splats=777, extent=100.0))
    sums = np.bincount(regions.number, some.splats)
    assert sums.max() <= 777 and sums.min() >= 777 / 2 - 10 and len(regions.children) == len(sums) - 1


def test_regions_are_no_wider_than_the_extent_unless_they_have_few_splats() -> None:
    some = places(1000)
    for least in (1, 2000):
        regions = divide(some, DetailSettings(extent=0.5, min_splats=least))
        for region in range(len(regions.children) + 1):
            inside = regions.number == region
            side = np.ptp(some.center[inside], axis=0).max()
            assert side <= 0.5 or some.splats[inside].sum() <= least
        assert (len(regions.children) >= 8 * 4 * 2 - 1) == (least == 1)


def test_what_lies_below_a_place_counts_for_the_extent() -> None:
    some = places(2)
    wide = dataclasses.replace(some, box=some.box + np.array([[-50.0], [50.0]]))
    assert len(divide(some, DetailSettings(min_splats=1)).children) == 0
    assert len(divide(wide, DetailSettings(min_splats=1)).children) == 1


def test_heavy_places_divide_where_the_splats_are() -> None:
    some = places(100)
    splats = some.splats.copy()
    splats[np.argmin(some.center[:, 0])] = 5_000
    regions = divide(dataclasses.replace(some, splats=splats), DetailSettings(chunk_splats=5_500))
    assert np.bincount(regions.number).tolist() == [1, 99]


def test_a_place_is_never_divided() -> None:
    regions = divide(places(4, splats=100), DetailSettings(chunk_splats=10))
    assert sorted(regions.number) == [0, 1, 2, 3]


def test_places_at_one_point_are_divided_all_the_same() -> None:
    some = places(64)
    same = dataclasses.replace(some, center=np.zeros_like(some.center), box=np.zeros_like(some.box))
    assert np.bincount(divide(same, DetailSettings(chunk_splats=100)).number).max() == 10 - 2


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
