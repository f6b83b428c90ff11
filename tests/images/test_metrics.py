"""Metrics against obvious twins, identities that follow from their definitions, and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.images.metrics import (
    C1,
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


@pytest.mark.parametrize("noise", [0.01, 0.1, 0.5])
def test_ssim_is_the_formula_of_the_paper(noise: float) -> None:
    a, b = pictures(noise=noise)
    assert ssim(a, b) == pytest.approx(ssim_as_written(a, b), abs=1e-12)


@pytest.mark.parametrize("size", [(45, 37), (11, 11), (43, 80), (100, 12)])
def test_ssim_is_that_of_scikit_image(size: tuple[int, int]) -> None:
    metrics = pytest.importorskip("skimage.metrics", reason="compares with scikit-image")
    a, b = pictures(*size)
    _, places = metrics.structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True
    )
    inside = places[5 : size[0] - 5, 5 : size[1] - 5]
    assert ssim(a, b) == pytest.approx(float(inside.mean()), abs=1e-9)


def test_ssim_of_the_same_image_is_1_and_it_is_symmetric() -> None:
    a, b = pictures()
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-15)
    assert ssim(a, b) > ssim(a, pictures(noise=0.3)[1])


def test_ssim_of_flat_images_compares_their_means_alone() -> None:
    a, b = np.full((20, 20, 3), 0.25), np.full((20, 20, 3), 0.75)
    assert ssim(a, b) == pytest.approx((2 * 0.25 * 0.75 + C1) / (0.25**2 + 0.75**2 + C1), abs=1e-12)


def test_ssim_of_an_image_smaller_than_its_window_is_defined() -> None:
    a, b = pictures(7, 4)
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)
    assert -1 < ssim(a, b) < 1


def test_ssim_of_float32_is_that_of_float64() -> None:
    a, b = (image.astype(np.float32) for image in pictures())
    assert ssim(a, b) == pytest.approx(ssim_as_written(a.astype(np.float64), b.astype(np.float64)), abs=1e-12)


def test_psnr_of_a_known_difference() -> None:
    a = np.full((8, 8, 3), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a + 1 / 255) == pytest.approx(20 * math.log10(255))
    b = a.copy()
    b[0, 0, 0] += 0.5  # one number of 192
    assert psnr(a, b) == pytest.approx(-10 * math.log10(0.25 / 192))


def test_psnr_of_equal_images_is_the_largest() -> None:
    a = np.full((8, 8, 3), 0.5)
    assert psnr(a, a) == MOST_PSNR
    assert psnr(a, a + 1e-9) == MOST_PSNR
    assert psnr(a, a + 1e-4) == pytest.approx(80)


def test_the_worst_tile_is_the_one_that_differs_most() -> None:
    a, b = pictures(150, 200)
    b[70:80, 140:150] = 1 - b[70:80, 140:150]
    parts = {
        (x, y): psnr(a[y : y + 64, x : x + 64], b[y : y + 64, x : x + 64])
        for x in range(0, 200, 64)
        for y in range(0, 150, 64)
    }
    tile = worst_tile(a, b)
    assert (tile.x, tile.y) == min(parts, key=lambda place: parts[place]) == (128, 64)
    assert tile.psnr == pytest.approx(parts[128, 64])


def test_a_tile_at_the_edge_counts_its_own_pixels_alone() -> None:
    a = np.full((65, 65, 3), 0.5)
    b = a.copy()
    b[64, 64] += 0.1
    b[0, 0] += 0.3
    assert worst_tile(a, b) == Tile(pytest.approx(20), 64, 64)


def test_the_worst_tile_of_the_same_image_is_the_first() -> None:
    a, _ = pictures()
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


def test_a_slope_is_an_edge_where_it_is_steep_in_any_direction() -> None:
    y, x = np.mgrid[:60, :60] / 1.0
    for angle in np.linspace(0, math.pi, 9):
        ramp = math.cos(angle) * x + math.sin(angle) * y
        for slope, strong in ((0.98, False), (1.02, True)):
            light = 0.5 + slope * EDGE * (ramp - ramp.mean())
            inside = edges(covered(np.clip(light, 0, 1)))[(light > 0.2) & (light < 0.8)]
            assert inside.all() if strong else not inside.any(), angle


def test_a_silhouette_is_an_edge_on_either_background() -> None:
    """White splats have none on white, but do on black."""
    alpha = np.zeros((20, 20))
    alpha[5:15, 5:15] = 1
    for gray in (0.0, 1.0):
        assert edges(covered(np.full((20, 20), gray), alpha))[4, 10]


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


def test_a_planted_pop_has_its_size() -> None:
    a, b = pictures(40, 50)
    popped = a.copy()
    popped[10:20, 10:30] += 8 / 255  # a tenth of the pixels
    assert popping(popped, b, a, b) == pytest.approx(8 * math.sqrt(0.1))
