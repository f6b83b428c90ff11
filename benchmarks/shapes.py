"""Parts of the scenes that we make: strands, letters and a sky. A unit is a metre; y is up here, and down in splats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sparklod_cli import Splats

Array = NDArray[np.float64]

#: Radius of the sky.
SKY = 70.0

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

#: Distance from letter to letter, in sixths of their height.
ADVANCE = 5.4


def shuffled(rng: np.random.Generator, parts: Sequence[Splats]) -> Splats:
    """All parts in random order, as training leaves splats."""
    scene = Splats.concat(parts)
    return scene.take(rng.permutation(len(scene)))


def splats(center: Array, scale: Array, quat_xyzw: Array, rgb: Array, opacity: Array) -> Splats:
    """Splats of a world whose y is up."""
    turn = np.array([1.0, -1.0, -1.0])
    x, y, z, w = quat_xyzw.T
    turned = np.stack([w, -z, y, -x], axis=1)  # half a turn about x, then the rotation
    columns = (center * turn, scale, turned, opacity, np.clip(rgb, 0.02, 0.98), np.zeros((len(center), 0, 3)))
    return Splats(*(np.ascontiguousarray(column, np.float32) for column in columns))


def from_axis(axis: int, to: Array) -> Array:
    """(N, 4) unit quaternions x, y, z, w of the smallest rotations of a coordinate axis to (N, 3) unit vectors."""
    quat = np.column_stack([np.cross(np.eye(3)[axis], to), 1 + to[:, axis]])
    quat[quat[:, 3] < 1e-6] = np.eye(4)[(axis + 1) % 3]
    return quat / np.linalg.norm(quat, axis=1, keepdims=True)


def strand(rng: np.random.Generator, points: Array, radius: Array | float, rgb: Sequence[float]) -> Splats:
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
    return splats(center, scale, from_axis(0, direction), light * rgb, rng.uniform(0.75, 0.99, len(which)))


def sky(rng: np.random.Generator, count: int = 5_500) -> Splats:
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
    return splats(SKY * outward, scale, from_axis(2, outward), rgb, rng.uniform(0.9, 0.99, count))


def letters(
    rng: np.random.Generator, line: str, corner: Array, height: float, rgb: Sequence[float] = (0.08, 0.08, 0.1)
) -> list[Splats]:
    """Return the strokes of a line of letters in the plane z = corner[2].

    Args:
        corner: (3,) lower left corner of the line.
        height: of a letter.
    """
    unit, parts = height / 6, []
    for place, letter in enumerate(line):
        left = corner + np.array([place * ADVANCE * unit, 0, 0])
        for stroke in STROKES.get(letter, ()):
            points = left + np.array([[x * unit, y * unit, 0] for x, y in stroke])
            parts.append(strand(rng, points, max(0.45 * unit, 0.006), rgb))
    return parts
