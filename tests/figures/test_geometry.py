"""What pictures are made of: ellipsoids, grids, ticks, and the place they are seen from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.figures import geometry
from sparklod_cli.figures.geometry import viewpoint
from sparklod_cli.model.gaussian import covariance
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("rounds", "points", "triangles"), [(0, 12, 20), (1, 42, 80), (2, 162, 320)])
def test_a_sphere_is_closed_and_faces_outwards(rounds: int, points: int, triangles: int) -> None:
    sphere = geometry.sphere(rounds)
    assert (len(sphere.points), len(sphere.triangles)) == (points, triangles)
    assert np.allclose(np.linalg.norm(sphere.points, axis=1), 1)
    p, q, r = sphere.points[sphere.triangles].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(q - p, r - p), p) > 0).all()  # all faces look outwards
    edges = np.sort(sphere.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # and it is closed


def test_ellipsoids_are_where_the_gaussian_says() -> None:
    splats = random_splats(30)
    of = geometry.sphere(1)
    mesh = geometry.ellipsoids(splats, 2, of, thinnest=0)
    points = (mesh.points.reshape(30, len(of.points), 3) - splats.center[:, None]).astype(np.float64)
    matrices = covariance(splats.scale, splats.quat_xyzw)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(30, 3, 3)
    gradient = np.linalg.solve(matrices[:, None], points[..., None])[..., 0]
    assert np.allclose(np.einsum("nij,nij->ni", points, gradient), 4, rtol=1e-3)
    normals = mesh.normals.reshape(points.shape)
    assert np.allclose(normals, gradient / np.linalg.norm(gradient, axis=2, keepdims=True), atol=2e-3)
    assert mesh.triangles.max() == len(mesh.points) - 1


def test_ellipsoids_are_not_thinner_than_a_pixel() -> None:
    splats = random_splats(10)
    of = geometry.sphere(0)
    mesh = geometry.ellipsoids(splats, 1, of, thinnest=10)
    away = np.linalg.norm(mesh.points.reshape(10, -1, 3) - splats.center[:, None], axis=2)
    assert np.allclose(away, 10, rtol=1e-5)


@given(st.integers(0, 10**9), st.integers(1, 1000))
def test_a_sample_is_even_and_has_the_size_asked_for(count: int, most: int) -> None:
    if count > most:
        index = geometry.evenly(count, most)
        assert len(index) == most
        assert index[0] == 0
        assert set(np.diff(index)) <= {count // most, count // most + 1}
        assert index[-1] < count


def test_an_even_sample_of_few_has_all() -> None:
    assert geometry.evenly(5, 5).tolist() == [0, 1, 2, 3, 4]


@given(st.floats(1e-30, 1e30))
def test_the_level_of_a_step_is_the_smallest_not_below_it(size: float) -> None:
    level = geometry.level_of_step(size)
    assert 1.5 ** (level - 1) * (1 - 1e-6) <= size <= 1.5**level * (1 + 1e-6)


def test_cells_are_the_corners_of_occupied_cubes_once_each() -> None:
    center = np.array([[0.1, 0.1, -0.1], [0.4, 0.3, -0.4], [0.6, 0.1, -0.1]], np.float32)
    assert geometry.cells(center, 0.5).tolist() == [[0, 0, -0.5], [0.5, 0, -0.5]]


def test_a_box_has_twelve_edges_of_its_size() -> None:
    lines = geometry.box_lines(np.array([[1.0, 2, 3]]), np.array([[2.0, 4, 6]])).reshape(12, 2, 3)
    assert sorted(np.abs(np.diff(lines, axis=1)).sum(axis=(1, 2)).tolist()) == [1] * 4 + [2] * 4 + [3] * 4


def test_wall_lines_are_at_multiples_of_the_step() -> None:
    low, high = np.array([-1.1, 0.2, 5.0]), np.array([1.1, 0.9, 6.0])
    lines = geometry.wall_lines(low, high, np.array([-1.1, 0.9, 5.0]), 0.5).reshape(-1, 2, 3)
    assert len(lines) == 2 * (5 + 1 + 3)
    assert (lines >= low).all()
    assert (lines <= high).all()
    for ends in lines:
        (along,) = np.flatnonzero(ends[0] != ends[1])
        others = {axis: ends[0, axis] for axis in {0, 1, 2} - {along}}
        assert any(np.isclose(value % 0.5, 0) for value in others.values())
        assert any(value == (-1.1, 0.9, 5.0)[axis] for axis, value in others.items())


@pytest.mark.parametrize("aspect", [0.5, 1.6, 3])
@pytest.mark.parametrize("extent", [(1.0, 1, 1), (100, 1, 1), (1, 50, 0.1), (1e-6, 1e-6, 1e-6)])
def test_a_viewpoint_sees_all_within_its_frame(aspect: float, extent: tuple[float, float, float]) -> None:
    corners = geometry.CORNERS * extent + 7
    frame = (0.1, 0.2, 0.8, 0.9)
    eye = viewpoint(corners, np.array([-0.6, 0.5, -1]), np.array([0, -1.0, 0]), aspect=aspect, frame=frame)
    seen = eye.project(corners)
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert (low >= np.array(frame[:2]) - 1e-6).all()
    assert (high <= np.array(frame[2:]) + 1e-6).all()
    assert np.isclose((high - low) / (0.7, 0.7), 1, atol=1e-6).any()  # and fills it in one way
    assert np.allclose((low + high) / 2, (0.45, 0.55), atol=1e-6)
    assert np.allclose(eye.axes @ eye.axes.T, np.eye(3))


def test_a_viewpoint_sees_y_downwards() -> None:
    eye = viewpoint(
        geometry.CORNERS, np.array([0, 0, -1.0]), np.array([0, -1.0, 0]), aspect=1, frame=(0.1, 0.1, 0.9, 0.9)
    )
    above, below = eye.project(np.array([[0.5, 0, 0.5], [0.5, 1, 0.5]]))
    assert above[1] < below[1]
