"""The backend `open3d`: what it asks for, and what Open3D draws where it can."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.render import rasterizer
from sparklod_cli.render.open3d import backend
from sparklod_cli.render.open3d.child import PIECE
from sparklod_cli.render.rasterizer import ShadedSplats
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.system.errors import BackendError
from tests.render.open3d.test_process import forget

pytestmark = pytest.mark.slow

BY_DEPTH = RasterSettings(sort="z")


def camera(width: int = 320, height: int = 200, *, at: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    """Turned about all axes, and with its axis off the middle."""
    turn, _ = np.linalg.qr(np.array([[0.9, 0.2, -0.3], [-0.1, 0.95, 0.3], [0.3, -0.2, 0.9]]))
    turn *= np.sign(np.diag(turn))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, at
    return Camera(matrix, width, height, (250.0, 260.0), (width / 2 + 7.25, height / 2 - 5.5))


def straight(width: int, height: int) -> Camera:
    return Camera(np.eye(4), width, height, (200.0, 200.0), (width / 2, height / 2))


def in_front(camera: Camera, right: object, down: object, away: object) -> NDArray[np.float32]:
    """(N, 3) in the world, of places that the camera sees."""
    local = np.stack(np.broadcast_arrays(right, -np.asarray(down), -np.asarray(away)), axis=-1).astype(float)
    return (local.reshape(-1, 3) @ camera.camera_to_world[:3, :3].T + camera.position).astype(np.float32)


def shown(
    center: NDArray[np.float32], *, scale: object = 0.05, opacity: object = 0.99, rgb: object = 0.5
) -> ShadedSplats:
    count = len(center)
    return ShadedSplats(
        center,
        np.broadcast_to(np.asarray(scale, np.float32), (count, 3)).copy(),
        np.tile(np.array([0, 0, 0, 1], np.float32), (count, 1)),
        lod_opacity(np.broadcast_to(np.asarray(opacity, np.float32), count).copy()),
        np.broadcast_to(np.asarray(rgb, np.float32), (count, 3)).copy(),
    )


def crowd(camera: Camera, count: int, most_opacity: float) -> ShadedSplats:
    rng = np.random.default_rng(count)
    away = rng.uniform(1, 6, count)
    at = in_front(camera, *(rng.uniform(-0.8, 0.8, (2, count)) * away), away)
    splats = shown(
        at, scale=np.exp(rng.normal(-3.5, 0.6, (count, 3))), opacity=rng.uniform(0.02, 1, count) * most_opacity
    )
    splats.quat_xyzw[:] = rng.normal(size=(count, 4))
    splats.quat_xyzw[:] /= np.linalg.norm(splats.quat_xyzw, axis=1, keepdims=True)
    splats.rgb[:] = rng.uniform(0, 1, (count, 3))
    return splats


def psnr(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    return float(-10 * np.log10(np.square(one - other).mean()))


# What Open3D is asked for


def requests(splats: ShadedSplats, camera: Camera, most: int = 1 << 25) -> list[tuple[tuple[int, int], dict, NDArray]]:
    return list(backend.pieces(splats, camera, BY_DEPTH, most))


def test_merged_splats_are_inflated_and_opaque() -> None:
    seen = camera()
    splats = shown(in_front(seen, 0, 0, [2, 2, 2]), scale=[1, 2, 4], opacity=[0.5, 1, 27], rgb=0.25)
    *_, (_, _, rows) = requests(splats, seen)
    scale = rows[:, 3:6] / rows[0, 3]
    np.testing.assert_allclose(scale, np.outer([1, 1, 3], [1, 2, 4]), rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows[:, 10])), [0.5, 1, 1], atol=1e-5)
    np.testing.assert_allclose(rows[:, 11:] * 0.28209479177387814 + 0.5, 0.25, atol=1e-6)
    np.testing.assert_allclose(rows[:, 6:10], [[1, 0, 0, 0]] * 3)


def test_what_spark_does_not_draw_is_not_sent() -> None:
    seen = straight(200, 200)
    at = [[0, 0, 0.005], [0, 0, -1], [0, 0, 2000], [1, 0, 1], [0, -1, 1], [0, 0, 1], [np.nan, 0, 1]]
    (_, _, rows), *more = requests(shown(in_front(seen, *np.transpose(at))), seen)
    assert len(rows) == 1 and not more
    assert not requests(shown(in_front(seen, 0, 0, 1), opacity=0.001), seen)


@pytest.mark.parametrize("most", [1 << 25, 500, 20])
def test_pieces_cover_each_splat_once(most: int) -> None:
    seen = straight(700, 300)
    splats = shown(in_front(seen, np.linspace(-1.7, 1.7, 300), 0.2, 1), scale=0.002)
    seen_by = np.zeros((2 * PIECE, 3 * PIECE), int)
    for (left, top), request, rows in requests(splats, seen, most):
        side = request["side"]
        seen_by[top : top + side, left : left + side] += 1
        unit = request["range"][0] / BY_DEPTH.near
        x, _, z = (rows[:, :3] / unit).T
        column = 200 * x / -z + 350 - left
        assert (column > -5).all() and (column < side + 5).all()
        assert request["intrinsic"][0][2] == 350 - left and request["intrinsic"][1][2] == 150 - top
        assert request["entries"] <= most or side == 16
    assert seen_by.max() == 1
    across = (200 * np.linspace(-1.7, 1.7, 300) + 350).astype(int)
    assert (seen_by[190, across] == 1).all()


# What Open3D draws


@pytest.fixture(scope="module")
def open3d() -> Iterator[None]:
    """Skips where Open3D cannot draw."""
    try:
        forget()
        seen = straight(32, 32)
        backend.draw(shown(in_front(seen, 0, 0, 1)), seen, RasterSettings())
    except BackendError as error:
        pytest.skip(f"Open3D cannot draw here: {error}")
    yield
    forget()


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("at", [(0, 0, 0), (3e4, -2e4, 1e4)])
def test_open3d_draws_landmarks_where_the_camera_sees_them(at: tuple[float, float, float]) -> None:
    seen = camera(600, 300, at=at)
    right, down, away = np.array([-0.9, 0.7, 0.1]), np.array([-0.3, -0.25, 0.4]), np.array([2.0, 1.5, 2.5])
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    splats = shown(in_front(seen, right, down, away), scale=0.02, rgb=colors)
    image = backend.draw(splats, seen, BY_DEPTH)
    local = (splats.center - seen.position) @ seen.camera_to_world[:3, :3]
    for color in range(3):
        weight = image[..., color]
        rows, columns = np.indices(weight.shape) + 0.5
        x = seen.principal[0] - seen.focal[0] * local[color, 0] / local[color, 2]
        y = seen.principal[1] + seen.focal[1] * local[color, 1] / local[color, 2]
        assert abs(float((weight * columns).sum() / weight.sum()) - x) < 0.2
        assert abs(float((weight * rows).sum() / weight.sum()) - y) < 0.2


@pytest.mark.usefixtures("open3d")
def test_open3d_draws_the_colours_it_is_given() -> None:
    seen = straight(400, 100)
    colors = np.array([[0.9, 0.5, 0.1], [0.02, 0.3, 1], [1, 1, 1], [0.2, 0.2, 0.2]], np.float32)
    column = np.array([50, 150, 250, 350])
    splats = shown(in_front(seen, (column - 200) / 200, 0.0, 1), scale=0.05, opacity=1, rgb=colors)
    image = backend.draw(splats, seen, RasterSettings())
    np.testing.assert_allclose(image[50, column, :3], colors, atol=3 / 255)
    np.testing.assert_allclose(image[50, column, 3], 1, atol=3 / 255)
    assert not image[5, :, :].any()


@pytest.mark.usefixtures("open3d")
def test_a_splat_that_is_not_oblique_is_drawn() -> None:
    """Its covariance on the screen is a multiple of the axes, for which Open3D by itself divides by 0."""
    seen = straight(120, 80)
    splats = shown(in_front(seen, [0.0, 0.2], 0.0, [1, 1]), scale=[[0.08, 0.02, 0.02], [0.02, 0.02, 0.02]], rgb=0.8)
    ours, theirs = rasterizer.draw(splats, seen, BY_DEPTH), backend.draw(splats, seen, BY_DEPTH)
    assert psnr(ours, theirs) > 45


@pytest.mark.usefixtures("open3d")
def test_a_splat_larger_than_the_picture_is_drawn() -> None:
    seen = straight(600, 400)
    splats = shown(in_front(seen, 0, 0, 1), scale=0.9, opacity=1, rgb=0.6)
    ours, theirs = rasterizer.draw(splats, seen, BY_DEPTH), backend.draw(splats, seen, BY_DEPTH)
    assert theirs[..., 3].min() > 0.1
    assert psnr(ours, theirs) > 45


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize(("count", "most_opacity", "least"), [(20_000, 1.0, 45), (3000, 4.0, 22)])
def test_open3d_agrees_with_the_reference(count: int, most_opacity: float, least: float) -> None:
    """Measured: 56 dB, and 25 dB with merged splats, which it has no way to draw as they are."""
    seen = camera(500, 280)
    splats = crowd(seen, count, most_opacity)
    ours, theirs = rasterizer.draw(splats, seen, BY_DEPTH), backend.draw(splats, seen, BY_DEPTH)
    assert psnr(ours, theirs) > least
    assert psnr(ours[:, ::-1], theirs) < 20 and psnr(ours[::-1], theirs) < 20


@pytest.mark.usefixtures("open3d")
def test_a_picture_without_splats_is_empty() -> None:
    seen = straight(33, 17)
    image = backend.draw(shown(in_front(seen, 0, 0, -1)), seen, RasterSettings())
    assert image.shape == (17, 33, 4) and image.dtype == np.float32 and not image.any()
