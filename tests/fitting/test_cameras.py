"""Where training and held-out cameras stand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.fitting.pictures import DISTANCES, LONGEST, TRAINING, Place, placed, smaller, split_path

UNITS = (1e-4, 1.0, 1e6)


def place(unit: float = 1.0) -> Place:
    center = np.random.default_rng(1).normal(size=(500, 3)) * unit
    return Place.of(np.append(center, [[1e5 * unit, 0, 0]], axis=0).astype(np.float32))


@pytest.mark.parametrize("unit", UNITS)
def test_cameras_stand_within_the_largest_distance_whatever_the_unit_and_floaters(unit: float) -> None:
    scene = place(unit)
    cameras = list(itertools.islice(placed(scene, np.random.SeedSequence(3)), 200))
    away = np.array([np.linalg.norm(camera.position - scene.middle) for camera in cameras]) / scene.radius
    assert away.max() <= DISTANCES[1] * 1.0001
    assert np.count_nonzero(away < 0.5) > 10  # inside
    assert np.count_nonzero(away > 2) > 30


def test_cameras_see_the_scene_from_all_sides() -> None:
    scene = place()
    cameras = list(itertools.islice(placed(scene, np.random.SeedSequence(3)), 200))
    directions = np.array([camera.position - scene.middle for camera in cameras])
    for axis, sign in itertools.product(range(3), (-1, 1)):
        assert np.count_nonzero(sign * directions[:, axis] > 0.6 * np.linalg.norm(directions, axis=1)) > 5


def test_a_seed_gives_the_same_cameras_and_another_one_others() -> None:
    first, same, other = (
        [camera.camera_to_world for camera in itertools.islice(placed(place(), np.random.SeedSequence(seed)), 9)]
        for seed in (7, 7, 8)
    )
    assert np.array_equal(first, same)
    assert not np.isclose(first, other).all()


def test_coincident_splats_have_cameras_around_them() -> None:
    cameras = list(itertools.islice(placed(Place.of(np.ones((4, 3), np.float32)), np.random.SeedSequence(0)), 20))
    assert all(np.isfinite(camera.camera_to_world).all() for camera in cameras)


def path_of(count: int) -> CameraPath:
    cameras = tuple(Camera.look_at((0, 0, 3 + at), (0, 0, 0), size=(1920, 1080)) for at in range(count))
    return CameraPath(cameras, "a path", (), tuple(range(count)))


@pytest.mark.parametrize("count", [2, 9, 100, 1000])
def test_a_path_is_split_into_training_and_held_out_cameras(count: int) -> None:
    training, held_out = split_path(path_of(count))
    assert len(training) + len(held_out) == count or TRAINING / 2 < len(training) <= TRAINING
    assert 1 <= len(held_out) <= 16
    both = {camera.position[2] for camera in training} & {camera.position[2] for camera in held_out}
    assert not both


def test_the_only_camera_of_a_path_is_both() -> None:
    training, held_out = split_path(path_of(1))
    assert len(training) == len(held_out) == 1


def test_a_smaller_picture_shows_the_same() -> None:
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), size=(1920, 1080))
    small = smaller(camera)
    assert (small.width, small.height) == (LONGEST, LONGEST * 9 // 16)
    assert small.fov_x == pytest.approx(camera.fov_x)
    assert small.fov_y == pytest.approx(camera.fov_y)
    assert smaller(small) is small
