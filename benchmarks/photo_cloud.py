"""Point clouds as photogrammetry gives them, as splats: round, of one size and opacity.

`python benchmarks/photo_cloud.py photo-cloud.ply` writes a bumpy stone whose surface has patches with sharp edges,
shading and grain; with `--loose`, a cloud in space whose splats hardly touch. No splat is thinner, fainter or smaller
than another, so that only places and colours tell which are worth keeping. y is down. The same seed gives the same
splats.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import write_ply

from sparklod_cli import Splats

Array = NDArray[np.float64]

#: Splats and their opacity.
COUNT, OPACITY = 100_000, 0.6

#: Standard deviations: on the stone, as a share of the distance between neighbours; in the cloud, of 1 / cbrt(COUNT).
WIDTH, LOOSE = 0.6, 0.6

#: Patches of colour, and waves of the relief and of the grain.
PATCHES, WAVES = 400, 24


def photo_cloud(seed: int = 0, count: int = COUNT) -> Splats:
    """Return the scene: `count` splats without spherical harmonics."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    relief = 0.12 * _waves(rng, normal, 2, 6) + 0.03 * _waves(rng, normal, 8, 24)
    center = normal * (1 + relief)[:, None] * [1.0, 0.7, 0.85]
    sites = rng.normal(size=(PATCHES, 3))
    sites /= np.linalg.norm(sites, axis=1, keepdims=True)
    wavy = normal + 0.06 * np.stack([_waves(rng, normal, 6, 20) for _ in range(3)], axis=1)
    patch = np.argmax(wavy @ sites.T, axis=1)
    palette = np.clip(rng.normal([0.5, 0.42, 0.34], 0.2, (PATCHES, 3)), 0.02, 0.98)
    light = 0.65 + 0.35 * normal @ np.array([0.4, -0.8, 0.45]) + 1.5 * relief
    grain = 0.05 * _waves(rng, normal, 30, 120) + rng.normal(0, 0.04, count)
    rgb = np.clip(palette[patch] * light[:, None] + grain[:, None], 0, 1)
    return _equal(center, WIDTH * np.sqrt(4 * np.pi / count), rgb)


def loose_cloud(seed: int = 0, count: int = COUNT) -> Splats:
    """Return the cloud: `count` splats without spherical harmonics, densest in the middle."""
    rng = np.random.default_rng(seed)
    center = rng.normal(0, 0.5, (count, 3))
    smooth = np.stack([_waves(rng, center, 2, 6) + _waves(rng, center, 8, 24) / 2 for _ in range(3)], axis=1)
    rgb = np.clip(0.5 + 0.2 * smooth + 0.15 * _waves(rng, center, 3, 10)[:, None], 0, 1)
    return _equal(center, LOOSE * count ** (-1 / 3), rgb)


def _equal(center: Array, scale: float, rgb: Array) -> Splats:
    """Return round splats of one standard deviation, world units."""
    count = len(center)
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    columns = (center, np.full((count, 3), scale), quat, np.full(count, OPACITY), rgb, np.zeros((count, 0, 3)))
    return Splats(*(np.ascontiguousarray(column, np.float32) for column in columns))


def _waves(rng: np.random.Generator, points: Array, low: float, high: float) -> Array:
    """Return smooth noise at points, about -1 to 1, of wave numbers from low to high."""
    ways = rng.normal(size=(WAVES, 3))
    ways *= (rng.uniform(low, high, WAVES) / np.linalg.norm(ways, axis=1))[:, None]
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    noise: Array = np.cos(points @ ways.T + phases).sum(axis=1) * np.sqrt(2 / WAVES) / 2
    return noise


def main() -> None:
    """Writes the scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--loose", action="store_true", help="write the cloud in space")
    arguments = parser.parse_args()
    write_ply(arguments.output, (loose_cloud if arguments.loose else photo_cloud)(arguments.seed))


if __name__ == "__main__":
    main()
