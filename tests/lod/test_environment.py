"""The environment: which splats are far outside."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from sparklod_cli.lod.environment import beyond, middle_of
from sparklod_cli.model.splats import Splats
from sparklod_cli.support.errors import InvalidSplatsError


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
