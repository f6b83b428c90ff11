"""Metrics against obvious twins, identities that follow from their definitions, and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.images.metrics import C1, MOST_PSNR, Tile, psnr, ssim, worst_tile


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
