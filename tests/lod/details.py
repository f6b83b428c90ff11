"""Made-up scenes at several detail levels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.model.scene import DetailScene
from tests.lod.sights import CutView
from tests.scenes import random_splats


@dataclass(frozen=True)
class Regions:
    """Bounds and counts of R regions at L levels.

    Attributes:
        bounds: (R, 2, 3) float64.
        counts: (R, L) int64.
    """

    bounds: NDArray[np.float64]
    counts: NDArray[np.int64]


def random_regions(random: np.random.Generator, regions: int, levels: int, *, gaps: float = 0.0) -> Regions:
    """Regions of random places, sizes and counts, which fall from level to level.

    Args:
        random: where numbers come from.
        regions, levels: how many.
        gaps: share of the runs that are empty.
    """
    low = random.uniform(-50, 50, (regions, 3))
    size = random.lognormal(0, 1.5, (regions, 3))
    finest = random.integers(1, 5000, regions)
    shares = np.cumprod(random.uniform(0.2, 0.9, (regions, levels)), axis=1)
    counts = np.maximum(1, (finest[:, None] * shares).astype(np.int64))
    counts[random.random(counts.shape) < gaps] = 0
    return Regions(np.stack([low, low + size], axis=1), counts)


def random_view(random: np.random.Generator, spread: float = 60.0) -> CutView:
    """A camera somewhere, which looks somewhere."""
    camera = np.eye(4)
    camera[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    if np.linalg.det(camera[:3, :3]) < 0:
        camera[:3, 0] *= -1
    camera[:3, 3] = random.uniform(-spread, spread, 3)
    fov_y = float(random.uniform(0.2, 2.0))
    aspect = float(random.uniform(0.4, 2.5))
    return CutView(camera, 2 * float(np.arctan(np.tan(fov_y / 2) * aspect)), fov_y)


def row_of_regions(regions: int = 6, levels: int = 3, splats: int = 64, *, environment: int = 0) -> DetailScene:
    """Regions side by side along z, two units long each, whose levels have half as many splats each.

    Args:
        regions, levels: how many.
        splats: of each region at level 0.
        environment: splats around them, far away.
    """
    counts = np.repeat(splats >> np.arange(levels)[None, :], regions, axis=0).astype(np.int64)
    scene = random_splats(int(counts.sum()), sh_degree=1, seed=7)
    center = np.random.default_rng(3).uniform(-1, 1, scene.center.shape).astype(np.float32)
    flat = counts.T.ravel()
    center[:, 2] += np.repeat(np.tile(2 * np.arange(regions), levels), flat).astype(np.float32)
    low = np.stack([np.full(regions, -1.0), np.full(regions, -1.0), 2.0 * np.arange(regions) - 1], axis=1)
    children = np.array([[-1 - at, at + 1 if at + 2 < regions else -2 - at] for at in range(regions - 1)], np.int64)
    around = None
    if environment:
        around = random_splats(environment, sh_degree=1, seed=8)
        direction = around.center / np.linalg.norm(around.center, axis=1, keepdims=True)
        around = replace(around, center=(100 * direction).astype(np.float32))
    return DetailScene(
        replace(scene, center=center),
        counts,
        np.stack([low, low + 2], axis=1),
        children.reshape(-1, 2),
        environment=around,
    )
