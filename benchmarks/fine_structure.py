"""A scene of thin things: a bare tree, wires, a fence and an eye chart, on a ground and before a sky.

`python benchmarks/fine_structure.py fine-structure.ply` writes it. It is what coarse cuts are worst at: splats a few
millimetres to centimetres thick, far longer than wide, in front of something smooth. A unit is a metre; y is down, as
in scenes that training makes. The same seed gives the same splats.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import write_ply

from sparklod_cli import Splats

Array = NDArray[np.float64]

#: Radii of the ground and of the sky, and the height of the poles that carry the wires.
GROUND, SKY, POLE = 11.0, 70.0, 4.2

#: The strokes of a letter, each as points on a grid 4 wide and 6 high, from its lower left corner.
STROKES: dict[str, tuple[tuple[tuple[float, float], ...], ...]] = {
    "A": (((0, 0), (2, 6), (4, 0)), ((0.8, 2.2), (3.2, 2.2))),
    "D": (((0, 0), (0, 6), (2.5, 6), (4, 4.5), (4, 1.5), (2.5, 0), (0, 0)),),
    "E": (((4, 0), (0, 0), (0, 6), (4, 6)), ((0, 3), (3, 3))),
    "F": (((0, 0), (0, 6), (4, 6)), ((0, 3), (3, 3))),
    "I": (((2, 0), (2, 6)), ((1, 0), (3, 0)), ((1, 6), (3, 6))),
    "K": (((0, 0), (0, 6)), ((4, 6), (0, 2.6)), ((1.4, 3.8), (4, 0))),
    "L": (((0, 6), (0, 0), (4, 0)),),
    "N": (((0, 0), (0, 6), (4, 0), (4, 6)),),
    "O": (((1.3, 0), (0, 1.5), (0, 4.5), (1.3, 6), (2.7, 6), (4, 4.5), (4, 1.5), (2.7, 0), (1.3, 0)),),
    "P": (((0, 0), (0, 6), (3, 6), (4, 5), (4, 4), (3, 3), (0, 3)),),
    "R": (((0, 0), (0, 6), (3, 6), (4, 5), (4, 4), (3, 3), (0, 3)), ((1.8, 3), (4, 0))),
    "S": (((0, 0.8), (1, 0), (3, 0), (4, 1.2), (3.4, 2.8), (0.6, 3.3), (0, 4.8), (1, 6), (3, 6), (4, 5.2)),),
    "T": (((0, 6), (4, 6)), ((2, 6), (2, 0))),
}

#: Lines of the eye chart and the heights of their letters.
CHART = (("SPLAT", 0.36), ("SPARKLOD", 0.22), ("LEAST DETAIL", 0.14), ("ROOT NODE LEAF STAR", 0.09))


def fine_structure(seed: int = 0) -> Splats:
    """The scene: about 100,000 splats without spherical harmonics."""
    rng = np.random.default_rng(seed)
    parts = [_ground(rng), _sky(rng), _tree(rng), _bush(rng), *_wires(rng), *_fence(rng), *_chart(rng)]
    splats = Splats.concat(parts)
    return splats.take(rng.permutation(len(splats)))


def _splats(center: Array, scale: Array, quat_xyzw: Array, rgb: Array, opacity: Array) -> Splats:
    """Splats of a world whose y is up."""
    turn = np.array([1.0, -1.0, -1.0])
    x, y, z, w = quat_xyzw.T
    turned = np.stack([w, -z, y, -x], axis=1)  # half a turn about x, then the rotation
    columns = (center * turn, scale, turned, opacity, np.clip(rgb, 0.02, 0.98), np.zeros((len(center), 0, 3)))
    return Splats(*(np.ascontiguousarray(column, np.float32) for column in columns))


def _from_axis(axis: int, to: Array) -> Array:
    """(N, 4) unit quaternions x, y, z, w of the smallest rotations of a coordinate axis to (N, 3) unit vectors."""
    quat = np.column_stack([np.cross(np.eye(3)[axis], to), 1 + to[:, axis]])
    quat[quat[:, 3] < 1e-6] = np.eye(4)[(axis + 1) % 3]
    return quat / np.linalg.norm(quat, axis=1, keepdims=True)


def _strand(rng: np.random.Generator, points: Array, radius: Array | float, rgb: Sequence[float]) -> Splats:
    """Splats along a line through points, each as long as the line is thick three times or more.

    Args:
        rng: for what no two splats have alike.
        points: (N, 3).
        radius: of the line, (N,) or one for all, world units.
        rgb: 0..1.
    """
    steps = np.diff(points, axis=0)
    length = np.linalg.norm(steps, axis=1)
    thick = np.broadcast_to(radius, len(points))
    count = np.maximum(np.ceil(length / (3 * thick[:-1])).astype(int), 1)
    which = np.repeat(np.arange(len(steps)), count)
    share = (np.concatenate([np.arange(each) for each in count]) + rng.uniform(0.3, 0.7, len(which))) / count[which]
    center = points[which] + share[:, None] * steps[which]
    width = 0.5 * (thick[which] * (1 - share) + thick[which + 1] * share) * rng.uniform(0.8, 1.2, len(which))
    along = 0.6 * (length / count)[which] * rng.uniform(0.8, 1.3, len(which))
    direction = steps[which] / np.maximum(length[which], 1e-9)[:, None]
    light = 0.75 + 0.35 * rng.uniform(size=(len(which), 1)) + 0.1 * direction[:, 1:2]
    scale = np.stack([along, width, width * rng.uniform(0.7, 1, len(which))], axis=1)
    return _splats(center, scale, _from_axis(0, direction), light * rgb, rng.uniform(0.75, 0.99, len(which)))


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
    quat = _from_axis(2, normal / np.linalg.norm(normal, axis=1, keepdims=True))
    return _splats(center, scale, quat, rgb, rng.uniform(0.8, 0.99, count))


def _sky(rng: np.random.Generator, count: int = 5_500) -> Splats:
    """A dome, darker above, with streaks of cloud."""
    up = rng.uniform(-0.4, 1, count)
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - up * up)
    outward = np.stack([flat * np.cos(turn), up, flat * np.sin(turn)], axis=1)
    cloud = np.clip(np.sin(4 * outward[:, 0] + 9 * up) * np.sin(5 * outward[:, 2]), 0, 1)[:, None]
    rise = np.clip(up, 0, 1)[:, None]
    rgb = (1 - cloud) * ((1 - rise) * [0.8, 0.86, 0.93] + rise * [0.3, 0.5, 0.82]) + cloud * [0.95, 0.95, 0.96]
    wide = SKY * rng.uniform(0.04, 0.055, count)
    scale = np.stack([wide, wide, 0.1 * wide], axis=1)
    return _splats(SKY * outward, scale, _from_axis(2, outward), rgb, rng.uniform(0.9, 0.99, count))


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
    return Splats.concat([_strand(rng, points, thick, (0.32, 0.25, 0.2)) for points, thick in branches])


def _bush(rng: np.random.Generator, count: int = 170) -> Splats:
    """Stalks of reed, which lean all ways."""
    stalks = []
    for turn, away in zip(rng.uniform(0, 2 * np.pi, count), 0.6 * np.sqrt(rng.uniform(size=count)), strict=True):
        foot = np.array([2.9 + away * np.cos(turn), 0.0, 2.0 + away * np.sin(turn)])
        lean = 0.35 * rng.normal(size=2)
        rise = np.linspace(0, 1, 7)[:, None] * rng.uniform(0.5, 1.1)
        points = foot + np.concatenate([rise * rise * lean[0], rise, rise * rise * lean[1]], axis=1)
        stalks.append(_strand(rng, points, np.linspace(0.006, 0.0025, 7), (0.66, 0.6, 0.34)))
    return Splats.concat(stalks)


def _wires(rng: np.random.Generator) -> list[Splats]:
    """Three poles with cross-bars, and five wires that hang between them."""
    feet = [np.array([x, 0.0, -3.2]) for x in (-6.5, 0.0, 6.5)]
    parts = []
    for foot in feet:
        parts.append(_strand(rng, foot + np.linspace(0, 1, 9)[:, None] * [0, POLE, 0], 0.07, (0.4, 0.34, 0.28)))
        bar = foot + [0, POLE - 0.25, 0] + np.linspace(-0.8, 0.8, 7)[:, None] * [0, 0, 1]
        parts.append(_strand(rng, bar, 0.035, (0.42, 0.36, 0.3)))
    for one, other in itertools.pairwise(feet):
        for across in (-0.75, -0.35, 0.0, 0.35, 0.75):
            share = np.linspace(0, 1, 41)[:, None]
            points = one + share * (other - one) + [0, POLE - 0.2, across]
            points[:, 1] -= 4 * 0.45 * (share * (1 - share))[:, 0]
            parts.append(_strand(rng, points, 0.009, (0.1, 0.1, 0.12)))
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
            parts.append(_strand(rng, points, 0.0055, rgb))
    posts = [np.array([[x - 1.0, y, 1.9] for y in (0.0, 0.8, 1.7)]) for x in np.linspace(0, width, 4)]
    return parts + [_strand(rng, post, 0.03, (0.5, 0.5, 0.52)) for post in posts]


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
    parts = [_splats(center, scale, flat, rgb, rng.uniform(0.9, 0.99, count))]
    top = height - 0.12
    for line, size in CHART:
        unit = size / 6
        left = (width - len(line) * 5.4 * unit) / 2
        for letter in line:
            for stroke in STROKES.get(letter, ()):
                points = np.array([[left + x * unit, top - size + y * unit, 0.02] for x, y in stroke]) + foot
                parts.append(_strand(rng, points, max(0.45 * unit, 0.006), (0.08, 0.08, 0.1)))
            left += 5.4 * unit
        top -= 1.45 * size
    legs = [np.array([[x, y, -0.03] for y in (-0.75, 0, 0.6, 1.5)]) + foot for x in (0.25, width - 0.25)]
    return parts + [_strand(rng, leg, 0.03, (0.45, 0.4, 0.34)) for leg in legs]


def main() -> None:
    """Writes the scene as a PLY."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="the .ply to write")
    parser.add_argument("--seed", type=int, default=0, help="of another tree, and of other colours (default 0)")
    arguments = parser.parse_args()
    splats = fine_structure(arguments.seed)
    write_ply(arguments.output, splats)
    print(f"{arguments.output}: {len(splats):,} splats")


if __name__ == "__main__":
    main()
