"""The picture shows the path of the cameras."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.figures import charts
from sparklod_cli.figures.camera_path import FRAME, _above, frustum_lines, picture_of_path
from sparklod_cli.support.errors import SparklodError
from tests.figures.flights import SIZE, circle, count_of, looking, path_scene, pixels, plotted
from tests.scenes import random_splats
from tests.tables.rows import flight

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("drawing")
class TestPictureOfPath:
    def test_the_figure_shows_the_scene_and_the_path(self) -> None:
        of = path_scene()
        with_frame = pixels(picture_of_path(of.cameras, of.splats, of.depth, frame=3, size=SIZE))
        without = pixels(picture_of_path(of.cameras, of.splats, of.depth, size=SIZE))
        assert with_frame.shape == without.shape == (250, 400, 3)
        body = (slice(50, None), slice(0, 320))
        assert count_of(without[body], "#ffffff", 60) > 100
        assert count_of(with_frame[body], "#ff5c8a", 40) > 10
        assert count_of(without[body], "#ff5c8a", 40) == 0

    def test_two_figures_have_the_same_bytes(self) -> None:
        of = path_scene()
        assert len({picture_of_path(of.cameras, of.splats, of.depth, size=SIZE) for _ in range(2)}) == 1

    def test_one_camera_and_one_splat_are_drawn(self) -> None:
        splats = random_splats(1)
        assert picture_of_path(circle(1), splats, np.array([4]), frame=0, size=SIZE)

    def test_hidden_lines_are_seen_faintly(self) -> None:
        """The path goes through a ball."""
        splats = random_splats(200).take(np.zeros(1, np.int64))
        splats.center[:], splats.scale[:] = 0, 3
        path = [looking((x, 0.01, 0.3)) for x in np.linspace(-1, 1, 9)]
        image = picture_of_path(path, splats, np.array([0]), size=SIZE)
        plain = picture_of_path([looking((0, 0, 0.001))], splats, np.array([0]), size=SIZE)
        middle = (slice(100, 190), slice(120, 240))
        assert (np.abs(pixels(image)[middle] - pixels(plain)[middle]).max(axis=2) > 40).sum() > 50

    def test_splats_that_are_not_finite_are_left_out(self) -> None:
        of = path_scene()
        of.splats.center[0], of.splats.scale[1] = np.nan, np.inf
        assert picture_of_path(of.cameras, of.splats, of.depth, size=SIZE)
        of.splats.scale[:] = 0
        with pytest.raises(SparklodError, match="nothing to draw"):
            picture_of_path(of.cameras, of.splats, of.depth, size=SIZE)

    @pytest.mark.usefixtures("charting")
    def test_the_figure_is_below_the_charts(self) -> None:
        whole = plotted(flight(5), path_scene=path_scene())
        alone = pixels(plotted(flight(5)).png)
        both = pixels(whole.png)
        assert whole.note is None
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
