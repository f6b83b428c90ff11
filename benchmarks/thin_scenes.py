"""Scenes of one kind of thin thing each: foliage, cables, a floor of one layer, and text on a wall.

`python benchmarks/thin_scenes.py cables cables.ply` writes one. A unit is a metre; y is down in the file, as in scenes
that training makes. The same seed gives the same splats.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
from scenes import write_ply
from shapes import ADVANCE, Array, from_axis, letters, shuffled, sky, splats, strand

from sparklod_cli import Splats

#: Words on the wall.
WORDS = ("SPARKLOD", "LEAST DETAIL", "ROOT NODE LEAF STAR", "TREES AND FIELDS", "SPLATS LOAD IN PARTS", "A FINE LETTER")


def foliage_cards(seed: int = 0) -> Splats:
    """Return three crowns of flat leaves that point all ways, on trunks, before a sky: about 80,000 splats."""
    rng = np.random.default_rng(seed)
    parts = [sky(rng)]
    for x, z, tall in ((-2.2, 0.4, 3.4), (0.3, -1.0, 4.2), (2.4, 0.9, 2.9)):
        foot = np.array([x, 0.0, z])
        parts.append(strand(rng, foot + np.linspace(0, 1, 12)[:, None] * [0, tall, 0], 0.09, (0.3, 0.24, 0.2)))
        count = 24_000
        twigs = foot + [0, tall, 0] + rng.normal(size=(900, 3)) * [0.75, 0.6, 0.75]
        center = twigs[rng.integers(len(twigs), size=count)] + 0.07 * rng.normal(size=(count, 3))
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        wide = rng.lognormal(np.log(0.022), 0.3, count)
        scale = np.stack([wide, 0.55 * wide, 0.04 * wide], axis=1)
        light = 0.55 + 0.45 * np.abs(normal[:, 1:2]) + 0.12 * rng.normal(size=(count, 1))
        rgb = light * (np.array([0.3, 0.5, 0.16]) + rng.normal(0, 0.05, (count, 3)))
        parts.append(splats(center, scale, from_axis(2, normal), rgb, rng.uniform(0.8, 0.99, count)))
    return shuffled(rng, parts)


def cables(seed: int = 0) -> Splats:
    """Return two grids of cables between masts, against the sky: about 50,000 splats."""
    rng = np.random.default_rng(seed)
    parts = [sky(rng)]
    for across, along in ((0, 2), (2, 0)):
        for high in (2.0, 3.2):
            for place in np.linspace(-5, 5, 20):
                points = np.zeros((61, 3))
                points[:, along] = np.linspace(-6, 6, 61)
                points[:, across] = place + 0.05 * rng.normal()
                points[:, 1] = high - 0.5 * (1 - (points[:, along] / 6) ** 2) * rng.uniform(0.7, 1.2)
                parts.append(strand(rng, points, rng.uniform(0.005, 0.01), (0.1, 0.1, 0.12)))
    for x, z in itertools.product((-6, 0, 6), repeat=2):
        mast = np.array([[x, y, z] for y in np.linspace(0, 3.6, 9)])
        parts.append(strand(rng, mast, 0.06, (0.45, 0.42, 0.4)))
    return shuffled(rng, parts)


def single_floor(seed: int = 0) -> Splats:
    """Return a tiled floor and nothing below it, of one layer of flat splats, under a sky: 95,000 splats."""
    rng = np.random.default_rng(seed)
    x, z = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-9, 9, 300)] * 2))
    tile = (np.floor(x / 0.9) + np.floor(z / 0.9)) % 2
    joint = (np.abs((x / 0.9) % 1 - 0.5) > 0.46) | (np.abs((z / 0.9) % 1 - 0.5) > 0.46)
    rgb = np.where(tile[:, None] > 0, [0.72, 0.68, 0.6], [0.42, 0.36, 0.32]) * (1 - 0.6 * joint[:, None])
    floor = _layer(rng, np.stack([x, np.zeros_like(x), z], axis=1), 1, 18 / 299, rgb)
    return shuffled(rng, [sky(rng), floor])


def text_wall(seed: int = 0) -> Splats:
    """Return lines of letters on a wall of one layer, before a sky: about 47,000 splats."""
    rng = np.random.default_rng(seed)
    width, height = 6.0, 3.2
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, width, 0.022), np.arange(0, height, 0.022)))
    rgb = np.array([0.86, 0.82, 0.74]) * (0.93 + 0.07 * np.sin(9 * x) * np.sin(7 * y))[:, None]
    parts = [sky(rng), _layer(rng, np.stack([x, y, np.zeros_like(x)], axis=1), 2, 0.022, rgb)]
    top = height - 0.1
    for line, size in zip(WORDS, (0.62, 0.42, 0.3, 0.24, 0.17, 0.12), strict=True):
        for repeat in range(max(int((width - 0.2) / (len(line) * ADVANCE * size / 6)), 1)):
            left = 0.1 + repeat * (len(line) + 1) * ADVANCE * size / 6
            if left + len(line) * ADVANCE * size / 6 < width:
                parts += letters(rng, line, np.array([left, top - size, 0.02]), size)
        top -= 1.5 * size
    return shuffled(rng, parts)


def _layer(rng: np.random.Generator, center: Array, axis: int, step: float, rgb: Array) -> Splats:
    """Return one layer of flat splats at (N, 3) places of a grid that just overlap; `axis` is its normal's."""
    count = len(center)
    scale = step * np.stack([*rng.uniform(0.55, 0.75, (2, count)), np.full(count, 0.1)], axis=1)
    jitter = step * rng.normal(0, 0.1, (count, 3))
    jitter[:, axis] *= 0.3
    quat = from_axis(2, np.tile(np.eye(3)[axis], (count, 1)))
    shade = 1 + 0.03 * rng.normal(size=(count, 1))
    return splats(center + jitter, scale, quat, rgb * shade, rng.uniform(0.9, 0.99, count))


#: The scenes by name.
THIN = {"foliage-cards": foliage_cards, "cables": cables, "single-floor": single_floor, "text-wall": text_wall}


def main() -> None:
    """Writes a scene as a PLY."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=THIN)
    parser.add_argument("output", type=Path, help="the .ply to write")
    parser.add_argument("--seed", type=int, default=0, help="of other places and colours (default 0)")
    arguments = parser.parse_args()
    scene = THIN[arguments.scene](arguments.seed)
    write_ply(arguments.output, scene)
    print(f"{arguments.output}: {len(scene):,} splats")


if __name__ == "__main__":
    main()
