"""Metrics against obvious twins, and identities that follow from their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.images.metrics import (
    EDGE,
    MOST_PSNR,
    Tile,
    edge_psnr,
    edges,
    on_background,
    popping,
    psnr,
    ssim,
    worst_tile,
)

pytestmark = pytest.mark.slow


def pictures(height: int = 45, width: int = 37, noise: float = 0.1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Something smooth, and the same with noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    image = 0.5 + 0.4 * np.sin(0.2 * x[..., None] + 0.1 * y[..., None] * np.arange(1, 4))
    return image, np.clip(image + noise * rng.normal(size=image.shape), 0, 1)


def ssim_as_written(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, window by window."""
    away = np.arange(11) - 5
    window = np.exp(-(away[:, None] ** 2 + away**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for channel in range(a.shape[2]):
        for row in range(a.shape[0] - 10):
            for column in range(a.shape[1] - 10):
                x = a[row : row + 11, column : column + 11, channel]
                y = b[row : row + 11, column : column + 11, channel]
                mean_x, mean_y = (window * x).sum(), (window * y).sum()
                variance_x, variance_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
                covariance = (window * (x - mean_x) * (y - mean_y)).sum()
                values.append(
                    (2 * mean_x * mean_y + 0.01**2)
                    * (2 * covariance + 0.03**2)
                    / ((mean_x**2 + mean_y**2 + 0.01**2) * (variance_x + variance_y + 0.03**2))
                )
    return float(np.mean(values))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5])
def test_ssim_is_the_formula_of_the_paper(noise: float, kind: type) -> None:
    a, b = (image.astype(kind) for image in pictures(noise=noise))
    assert ssim(a, b) == pytest.approx(ssim_as_written(a.astype(np.float64), b.astype(np.float64)), abs=1e-12)


@pytest.mark.parametrize("size", [(45, 37), (7, 4)], ids=["image", "image smaller than the window"])
def test_ssim_of_the_same_image_is_1_and_it_is_symmetric(size: tuple[int, int]) -> None:
    a, b = pictures(*size)
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-15)
    assert ssim(a, pictures(*size, noise=0.3)[1]) < ssim(a, b) < 1


def test_psnr_of_known_differences() -> None:
    a = np.full((8, 8, 3), 0.5)
    for difference, expected in ((0.1, 20), (1 / 255, 20 * math.log10(255)), (1e-4, 80), (1e-9, MOST_PSNR)):
        assert psnr(a, a + difference) == pytest.approx(expected)
    assert psnr(a, a) == MOST_PSNR
    b = a.copy()
    b[0, 0, 0] += 0.5  # one number of 192
    assert psnr(a, b) == pytest.approx(-10 * math.log10(0.25 / 192))


def test_the_worst_tile_is_the_one_that_differs_most_and_the_first_of_equal_ones() -> None:
    a, b = pictures(150, 200)
    b[70:80, 140:150] = 1 - b[70:80, 140:150]
    tile = worst_tile(a, b)
    assert (tile.x, tile.y) == (128, 64)
    assert tile.psnr == pytest.approx(psnr(a[64:128, 128:192], b[64:128, 128:192]))
    assert worst_tile(a, a) == Tile(MOST_PSNR, 0, 0)


def covered(gray: np.ndarray, alpha: float | np.ndarray = 1.0) -> np.ndarray:
    """(H, W, 4) a picture of grays (H, W), premultiplied."""
    alpha = np.broadcast_to(alpha, gray.shape)
    return np.dstack([*[gray * alpha] * 3, alpha]).astype(np.float32)


def edges_as_written(image: np.ndarray) -> np.ndarray:
    """Scharr's operator at each pixel, on both backgrounds, and the neighbours of what is strong."""
    kernel = np.array([[-3, 0, 3], [-10, 0, 10], [-3, 0, 3]]) / 32
    height, width = image.shape[:2]
    found = np.zeros((height, width), bool)
    for gray in (0.0, 1.0):
        light = np.pad(on_background(image, gray).astype(np.float64) @ [0.2126, 0.7152, 0.0722], 1, mode="edge")
        for y in range(height):
            for x in range(width):
                near = light[y : y + 3, x : x + 3]
                found[y, x] |= math.hypot((near * kernel).sum(), (near * kernel.T).sum()) >= EDGE
    wide = np.zeros_like(found)
    for y, x in np.argwhere(found):
        wide[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = True
    return wide


def test_edges_are_where_the_formula_has_them() -> None:
    rng = np.random.default_rng(1)
    image = covered(*rng.uniform(0, 1, (2, 30, 41)).round(1) * (rng.uniform(size=(2, 30, 41)) < 0.1))
    found = edges(image)
    assert (found == edges_as_written(image)).all()
    assert 0.2 < found.mean() < 0.9


@pytest.mark.parametrize("height", [0.19, 0.21])
def test_steps_of_a_fifth_of_the_range_are_edges(height: float) -> None:
    image = np.full((20, 30), 0.4)
    image[:, 15:] += height
    for turned in (image, image.T):
        where = edges(covered(turned))
        along = where if turned is image else where.T
        assert along.any(axis=0).nonzero()[0].tolist() == ([] if height < 0.2 else [13, 14, 15, 16])


def test_psnr_of_edges_counts_their_pixels_alone() -> None:
    a, b = pictures()
    where = np.zeros(a.shape[:2], bool)
    assert edge_psnr(a, b, where) is None
    where[10:20, 5:9] = True
    assert edge_psnr(a, b, where) == pytest.approx(psnr(a[10:20, 5:9], b[10:20, 5:9]))
    assert edge_psnr(a, a, where) == MOST_PSNR
    assert edge_psnr(a, b, ~np.zeros_like(where)) == pytest.approx(psnr(a, b))


def test_popping_is_the_change_of_the_error() -> None:
    a, b = pictures(seed=1)
    c, d = pictures(seed=2)
    assert popping(a, b, a, b) == 0
    assert popping(a, a, c, c) == 0, "full detail"
    assert popping(a, b, c, d) == pytest.approx(255 * math.sqrt((((a - b) - (c - d)) ** 2).mean()))
    assert popping(a, b, c, d) == pytest.approx(popping(c, d, a, b))
    assert popping(a + 0.1, b + 0.1, c, d) == pytest.approx(popping(a, b, c, d)), "light that goes on in both"
