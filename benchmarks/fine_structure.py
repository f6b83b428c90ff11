"""A scene of thin things: a bare tree, wires, a fence and an eye chart, on a ground and before a sky.

`python benchmarks/fine_structure.py fine-structure.ply` writes it. It is what coarse cuts are worst at: splats a few
millimetres to centimetres thick, far longer than wide, in front of something smooth. A unit is a metre; y is down, as
in scenes that training makes. The same seed gives the same splats.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import write_ply
from shapes import ADVANCE, from_axis, letters, shuffled, sky, splats, strand

from sparklod_cli import Splats

Array = NDArray[np.float64]

#: Radius of the ground, and height of the poles that carry the wires.
GROUND, POLE = 11.0, 4.2

#: Lines of the eye chart and the heights of their letters.
CHART = (("SPLAT", 0.36), ("SPARKLOD", 0.22), ("LEAST DETAIL", 0.14), ("ROOT NODE LEAF STAR", 0.09))


def fine_structure(seed: int = 0) -> Splats:
    """The scene: about 100,000 splats without spherical harmonics."""
    rng = np.random.default_rng(seed)
    parts = [_ground(rng), sky(rng), _tree(rng), _bush(rng), *_wires(rng), *_fence(rng), *_chart(rng)]
    return shuffled(rng, parts)


def _ground(rng: np.random.Generator, count: int = 30_000) -> Splats:
    """Grass and gravel: flat splats, smaller in the middle, with a few blades that stand up."""
    away = GROUND * rng.uniform(size=count) ** 0.62
    turn = rng.uniform(0, 2 * np.pi, count)
    center = np.stack([away * np.cos(turn), 0.02 * rng.normal(size=count), away * np.sin(turn)], axis=1)
    center[:, 1] += 0.12 * np.sin(0.7 * center[:, 0]) * np.cos(0.5 * center[:, 2])
    patch = 0.5 + 0.5 * np.sin(1.3 * center[:, 0] + np.sin(0.9 * center[:, 2])) * np.sin(1.1 * center[:, 2])
    mixed = patch[:, None] * [0.36, 0.45, 0.2] + (1 - patch[:, None]) * [0.5, 0.45, 0.36]
    rgb = mixed + 0.07 * rng.normal(size=(count, 1)) + 0.015 * rng.normal(size=(count, 3))
    normal = np.array([0.0, 1.0, 0.0]) + 0.15 * rng.normal(size=(count, 3))
    wide = (0.045 + 0.01 * away) * rng.lognormal(0, 0.35, count)
    scale = np.stack([wide, wide * rng.uniform(0.4, 1, count), 0.15 * wide], axis=1)
    quat = from_axis(2, normal / np.linalg.norm(normal, axis=1, keepdims=True))
    return splats(center, scale, quat, rgb, rng.uniform(0.8, 0.99, count))


def _branches(
    rng: np.random.Generator, start: Array, ahead: Array, length: float, radius: float, least: float
) -> list[tuple[Array, Array]]:
    """Points and radii of a branch and of all that grow out of it, down to the least radius."""
    points, thick = [start], [radius]
    for at in range(1, 7):
        ahead = ahead + rng.normal(0, 0.11, 3) + [0, 0.03, 0]
        ahead /= np.linalg.norm(ahead)
        points.append(points[-1] + ahead * length / 6)
        thick.append(radius * (1 - 0.35 * at / 6))
    found = [(np.array(points), np.array(thick))]
    if radius * 0.6 < least:
        return found
    for at in (2, 4, 5, 6, 6):
        side = rng.normal(size=3)
        side -= (side @ ahead) * ahead
        turned = ahead + rng.uniform(0.5, 1.0) * side / np.linalg.norm(side) + [0, 0.15, 0]
        turned /= np.linalg.norm(turned)
        shorter = length * rng.uniform(0.55, 0.78)
        found += _branches(rng, points[at], turned, shorter, thick[at] * rng.uniform(0.5, 0.72), least)
    return found


def _tree(rng: np.random.Generator) -> Splats:
    """A bare tree, 5 m high, from a trunk of 16 cm to twigs of 5 mm."""
    branches = _branches(rng, np.array([-2.4, 0.0, 0.6]), np.array([0.05, 1.0, 0.0]), 1.9, 0.16, 0.0042)
    return Splats.concat([strand(rng, points, thick, (0.32, 0.25, 0.2)) for points, thick in branches])


def _bush(rng: np.random.Generator, count: int = 170) -> Splats:
    """Stalks of reed, which lean all ways."""
    stalks = []
    for turn, away in zip(rng.uniform(0, 2 * np.pi, count), 0.6 * np.sqrt(rng.uniform(size=count)), strict=True):
        foot = np.array([2.9 + away * np.cos(turn), 0.0, 2.0 + away * np.sin(turn)])
        lean = 0.35 * rng.normal(size=2)
        rise = np.linspace(0, 1, 7)[:, None] * rng.uniform(0.5, 1.1)
        points = foot + np.concatenate([rise * rise * lean[0], rise, rise * rise * lean[1]], axis=1)
        stalks.append(strand(rng, points, np.linspace(0.006, 0.0025, 7), (0.66, 0.6, 0.34)))
    return Splats.concat(stalks)


def _wires(rng: np.random.Generator) -> list[Splats]:
    """Three poles with cross-bars, and five wires that hang between them."""
    feet = [np.array([x, 0.0, -3.2]) for x in (-6.5, 0.0, 6.5)]
    parts = []
    for foot in feet:
        parts.append(strand(rng, foot + np.linspace(0, 1, 9)[:, None] * [0, POLE, 0], 0.07, (0.4, 0.34, 0.28)))
        bar = foot + [0, POLE - 0.25, 0] + np.linspace(-0.8, 0.8, 7)[:, None] * [0, 0, 1]
        parts.append(strand(rng, bar, 0.035, (0.42, 0.36, 0.3)))
    for one, other in itertools.pairwise(feet):
        for across in (-0.75, -0.35, 0.0, 0.35, 0.75):
            share = np.linspace(0, 1, 41)[:, None]
            points = one + share * (other - one) + [0, POLE - 0.2, across]
            points[:, 1] -= 4 * 0.45 * (share * (1 - share))[:, 0]
            parts.append(strand(rng, points, 0.009, (0.1, 0.1, 0.12)))
    return parts


def _fence(rng: np.random.Generator) -> list[Splats]:
    """A fence of woven wire, 7 m wide, between posts."""
    width, height, mesh, rgb = 7.0, 1.5, 0.14, (0.62, 0.65, 0.66)
    parts = []
    for start in np.arange(-height, width, mesh):
        for lean in (1, -1):
            low, high = max(start, 0.0), min(start + height, width)
            if high - low < mesh / 2:
                continue
            rise = np.linspace(low - start, high - start, max(int((high - low) / 0.1), 2))
            x = start + rise if lean == 1 else width - start - rise
            weave = 0.006 * np.sin(2 * np.pi * rise / mesh) * lean
            points = np.stack([x - 1.0, 0.05 + rise, 1.9 + weave], axis=1)
            parts.append(strand(rng, points, 0.0055, rgb))
    posts = [np.array([[x - 1.0, y, 1.9] for y in (0.0, 0.8, 1.7)]) for x in np.linspace(0, width, 4)]
    return parts + [strand(rng, post, 0.03, (0.5, 0.5, 0.52)) for post in posts]


def _chart(rng: np.random.Generator) -> list[Splats]:
    """A board on two legs, with lines of letters that become smaller."""
    width, height, foot, step = 2.6, 1.7, np.array([0.4, 0.75, 0.2]), 0.028
    across, up = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    count = across.size
    center = (
        foot + np.stack([across.ravel(), up.ravel(), np.zeros(count)], axis=1) + 0.003 * rng.normal(size=(count, 3))
    )
    scale = step * np.stack([*rng.uniform(0.55, 0.75, (2, count)), np.full(count, 0.12)], axis=1)
    flat = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    rgb = np.array([0.93, 0.92, 0.88]) + 0.015 * rng.normal(size=(count, 1))
    parts = [splats(center, scale, flat, rgb, rng.uniform(0.9, 0.99, count))]
    top = height - 0.12
    for line, size in CHART:
        left = (width - len(line) * ADVANCE * size / 6) / 2
        parts += letters(rng, line, foot + np.array([left, top - size, 0.02]), size)
        top -= 1.45 * size
    legs = [np.array([[x, y, -0.03] for y in (-0.75, 0, 0.6, 1.5)]) + foot for x in (0.25, width - 0.25)]
    return parts + [strand(rng, leg, 0.03, (0.45, 0.4, 0.34)) for leg in legs]


def main() -> None:
    """Writes the scene as a PLY."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="the .ply to write")
    parser.add_argument("--seed", type=int, default=0, help="of another tree, and of other colours (default 0)")
    arguments = parser.parse_args()
    scene = fine_structure(arguments.seed)
    write_ply(arguments.output, scene)
    print(f"{arguments.output}: {len(scene):,} splats")


if __name__ == "__main__":
    main()
