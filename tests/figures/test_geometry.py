"""Geometry of pictures, and pictures of camera paths."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.figures import charts, pyvista_scene
from sparklod_cli.figures.charts import FRAME, PathScene, _above, frustum_lines, picture_of_path
from sparklod_cli.figures.pyvista_scene import viewpoint
from sparklod_cli.model.gaussian import covariance
from sparklod_cli.system.errors import SparklodError
from tests.figures.flights import SIZE, circle, count_of, looking, path_scene, pixels, plotted
from tests.scenes import random_splats
from tests.tables.rows import flight

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("rounds", "points", "triangles"), [(0, 12, 20), (1, 42, 80), (2, 162, 320)])
def test_a_sphere_is_closed_and_faces_outwards(rounds: int, points: int, triangles: int) -> None:
    sphere = pyvista_scene.sphere(rounds)
    assert (len(sphere.points), len(sphere.triangles)) == (points, triangles)
    assert np.allclose(np.linalg.norm(sphere.points, axis=1), 1)
    p, q, r = sphere.points[sphere.triangles].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(q - p, r - p), p) > 0).all()  # all faces look outwards
    edges = np.sort(sphere.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # and it is closed


def test_ellipsoids_are_where_the_gaussian_says() -> None:
    splats = random_splats(30)
    of = pyvista_scene.sphere(1)
    mesh = pyvista_scene.ellipsoids(splats, 2, of, thinnest=0)
    points = (mesh.points.reshape(30, len(of.points), 3) - splats.center[:, None]).astype(np.float64)
    matrices = covariance(splats.scale, splats.quat_xyzw)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(30, 3, 3)
    gradient = np.linalg.solve(matrices[:, None], points[..., None])[..., 0]
    assert np.allclose(np.einsum("nij,nij->ni", points, gradient), 4, rtol=1e-3)
    normals = mesh.normals.reshape(points.shape)
    assert np.allclose(normals, gradient / np.linalg.norm(gradient, axis=2, keepdims=True), atol=2e-3)
    assert mesh.triangles.max() == len(mesh.points) - 1


def test_ellipsoids_are_not_thinner_than_a_pixel() -> None:
    splats = random_splats(10)
    of = pyvista_scene.sphere(0)
    mesh = pyvista_scene.ellipsoids(splats, 1, of, thinnest=10)
    away = np.linalg.norm(mesh.points.reshape(10, -1, 3) - splats.center[:, None], axis=2)
    assert np.allclose(away, 10, rtol=1e-5)


@given(st.integers(0, 10**9), st.integers(1, 1000))
def test_a_sample_is_even_and_has_the_size_asked_for(count: int, most: int) -> None:
    if count > most:
        index = pyvista_scene.evenly(count, most)
        assert len(index) == most
        assert index[0] == 0
        assert set(np.diff(index)) <= {count // most, count // most + 1}
        assert index[-1] < count


def test_an_even_sample_of_few_has_all() -> None:
    assert pyvista_scene.evenly(5, 5).tolist() == [0, 1, 2, 3, 4]


@given(st.floats(1e-30, 1e30))
def test_the_level_of_a_step_is_the_smallest_not_below_it(size: float) -> None:
    level = pyvista_scene.level_of_step(size)
    assert 1.5 ** (level - 1) * (1 - 1e-6) <= size <= 1.5**level * (1 + 1e-6)


def test_cells_are_the_corners_of_occupied_cubes_once_each() -> None:
    center = np.array([[0.1, 0.1, -0.1], [0.4, 0.3, -0.4], [0.6, 0.1, -0.1]], np.float32)
    assert pyvista_scene.cells(center, 0.5).tolist() == [[0, 0, -0.5], [0.5, 0, -0.5]]


def test_a_box_has_twelve_edges_of_its_size() -> None:
    lines = pyvista_scene.box_lines(np.array([[1.0, 2, 3]]), np.array([[2.0, 4, 6]])).reshape(12, 2, 3)
    assert sorted(np.abs(np.diff(lines, axis=1)).sum(axis=(1, 2)).tolist()) == [1] * 4 + [2] * 4 + [3] * 4


def test_wall_lines_are_at_multiples_of_the_step() -> None:
    low, high = np.array([-1.1, 0.2, 5.0]), np.array([1.1, 0.9, 6.0])
    lines = pyvista_scene.wall_lines(low, high, np.array([-1.1, 0.9, 5.0]), 0.5).reshape(-1, 2, 3)
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
    corners = pyvista_scene.CORNERS * extent + 7
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
        pyvista_scene.CORNERS, np.array([0, 0, -1.0]), np.array([0, -1.0, 0]), aspect=1, frame=(0.1, 0.1, 0.9, 0.9)
    )
    above, below = eye.project(np.array([[0.5, 0, 0.5], [0.5, 1, 0.5]]))
    assert above[1] < below[1]


@pytest.mark.usefixtures("drawing")
class TestPictureOfPath:
    def test_the_figure_shows_the_scene_and_the_path(self) -> None:
        of = path_scene()
        with_frame = pixels(picture_of_path(of, size=SIZE))
        without = pixels(picture_of_path(dataclasses.replace(of, frame=None), size=SIZE))
        assert with_frame.shape == without.shape == (250, 400, 3)
        body = (slice(50, None), slice(0, 320))
        assert count_of(without[body], "#ffffff", 60) > 100
        assert count_of(with_frame[body], "#ff5c8a", 40) > 10
        assert count_of(without[body], "#ff5c8a", 40) == 0

    def test_two_figures_have_the_same_bytes(self) -> None:
        of = path_scene()
        assert len({picture_of_path(of, size=SIZE) for _ in range(2)}) == 1

    def test_one_camera_and_one_splat_are_drawn(self) -> None:
        splats = random_splats(1)
        assert picture_of_path(PathScene(circle(1), splats, np.array([4]), 0), size=SIZE)

    def test_hidden_lines_are_seen_faintly(self) -> None:
        """The path goes through a ball."""
        splats = random_splats(200).take(np.zeros(1, np.int64))
        splats.center[:], splats.scale[:] = 0, 3
        path = [looking((x, 0.01, 0.3)) for x in np.linspace(-1, 1, 9)]
        image = picture_of_path(PathScene(path, splats, np.array([0])), size=SIZE)
        plain = picture_of_path(PathScene([looking((0, 0, 0.001))], splats, np.array([0])), size=SIZE)
        middle = (slice(100, 190), slice(120, 240))
        assert (np.abs(pixels(image)[middle] - pixels(plain)[middle]).max(axis=2) > 40).sum() > 50

    def test_splats_that_are_not_finite_are_left_out(self) -> None:
        of = path_scene()
        of.splats.center[0], of.splats.scale[1] = np.nan, np.inf
        assert picture_of_path(of, size=SIZE)
        of.splats.scale[:] = 0
        with pytest.raises(SparklodError, match="nothing to draw"):
            picture_of_path(of, size=SIZE)

    @pytest.mark.usefixtures("charting")
    def test_the_figure_is_below_the_charts(self) -> None:
        whole = plotted(flight(5), path_scene=path_scene())
        alone = pixels(plotted(flight(5))[0])
        both = pixels(whole[0])
        assert whole[1] is None
        assert both.shape == (len(alone) + 1000, charts.WIDTH, 3)
        assert (both[: len(alone)] == alone).all()


def test_frusta_are_what_the_camera_sees() -> None:
    camera = looking((3, -2, 5))
    points = frustum_lines(camera, 2.0).reshape(-1, 2, 3)
    local = (points - camera.position) @ camera.camera_to_world[:3, :3]
    corners = local[:4, 1]
    assert np.allclose(points[:4, 0], camera.position)
    assert np.allclose(corners[:, 2], -2)
    at = corners[:, :2] / -corners[:, 2:] * camera.focal * (1, -1) + camera.principal
    assert np.allclose(at, [(0, 0), (1600, 0), (1600, 900), (0, 900)], atol=1e-6)
    assert local[-1, 0, 1] > local[:4, 1, 1].max()  # the mark is on the upper side


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0, 0, 1)])
def test_the_viewpoint_has_the_up_of_the_cameras(up: tuple[float, float, float]) -> None:
    positions = [(4, 0.5, 0.7), (0.3, 4, 3), (2, 0.4, 4)]
    low, high = np.array([-3.0, -2, -1]), np.array([3.0, 2, 1])
    eye = _above([looking(position, up) for position in positions], low, high, (1600, 1000))
    assert eye.axes[1] @ up > 0.5
    assert (eye.position - (low + high) / 2) @ up > 0
    corners = np.array([[x, y, z] for x in (-3, 3) for y in (-2, 2) for z in (-1, 1)])
    seen = eye.project(corners)
    assert (seen >= np.array(FRAME[:2]) - 1e-6).all()
    assert (seen <= np.array(FRAME[2:]) + 1e-6).all()
