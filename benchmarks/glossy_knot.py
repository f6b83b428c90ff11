"""A scene of one glossy, finely patterned object, the size of a hand in metres, with spherical harmonics.

`python benchmarks/glossy_knot.py glossy-knot.ply` writes it: a knot of flat splats, 0.04 mm thick, which is where
SPZ's scales end, and with highlights as far as SH of degree 3 can hold them. y is down. The same seed gives the same
splats.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scenes import write_ply

from sparklod_cli import Splats
from sparklod_cli.model.transforms import sh_basis

Array = NDArray[np.float64]

#: Splats, and the radii of the torus that the knot winds around, of its windings and of its tube, world units.
COUNT, TORUS, WIND, TUBE = 70_000, 0.08, 0.032, 0.018

#: Unit vector to the light, and how much of degree 1, 2 and 3 a highlight has.
LIGHT = np.array([0.48, -0.8, -0.36])
GLOSS = (0.28, 0.24, 0.16)


def glossy_knot(seed: int = 0) -> Splats:
    """The scene: 70,000 splats of SH degree 3."""
    rng = np.random.default_rng(seed)
    along, around = 2 * np.pi * rng.uniform(size=(2, COUNT))
    middle, tangent = _curve(along)
    side = np.cross(tangent, [0.3, 1.0, 0.2])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(tangent, side)
    normal = np.cos(around)[:, None] * side + np.sin(around)[:, None] * other
    center = middle + TUBE * normal
    quat = np.column_stack([-normal[:, 1], normal[:, 0], np.zeros(COUNT), 1 + normal[:, 2]])  # turns z to the normal
    quat[quat[:, 3] < 1e-6] = [1, 0, 0, 0]
    wide = 8.8e-4 * rng.lognormal(0, 0.3, COUNT)
    scale = np.stack([wide, wide * rng.uniform(0.5, 1, COUNT), 0.04 * wide], axis=1)
    rgb = _pattern(rng, along, around) * (0.55 + 0.45 * np.clip(normal @ LIGHT, 0, 1))[:, None]
    columns = (center, scale, quat / np.linalg.norm(quat, axis=1, keepdims=True), rng.uniform(0.7, 0.99, COUNT))
    rest = (np.clip(rgb, 0.02, 0.98), _highlights(normal))
    return Splats(*(np.ascontiguousarray(column, np.float32) for column in (*columns, *rest)))


def _curve(t: Array) -> tuple[Array, Array]:
    """(N, 3) points of a knot that winds thrice while it goes around twice, and its unit tangents."""

    def at(t: Array) -> Array:
        away = TORUS + WIND * np.cos(3 * t)
        return np.stack([away * np.cos(2 * t), WIND * np.sin(3 * t), away * np.sin(2 * t)], axis=1)

    ahead = at(t + 1e-4) - at(t - 1e-4)
    return at(t), ahead / np.linalg.norm(ahead, axis=1, keepdims=True)


def _pattern(rng: np.random.Generator, along: Array, around: Array) -> Array:
    """(N, 3) colours: checks, crossed by thin lines."""
    checks = (np.floor(60 * along / np.pi) + np.floor(6 * around / np.pi)) % 2
    rgb = np.where(checks[:, None] > 0, [0.75, 0.3, 0.18], [0.2, 0.36, 0.6])
    line = np.abs((40 * along / np.pi + 3 * around / np.pi) % 1 - 0.5) > 0.44
    rgb = np.where(line[:, None], [0.95, 0.9, 0.7], rgb)
    return rgb + 0.03 * rng.normal(size=(len(along), 1))


def _highlights(normal: Array) -> Array:
    """(N, 15, 3) SH of a highlight around the direction in which a mirror would show the light."""
    seen_along = LIGHT - 2 * (normal @ LIGHT)[:, None] * normal  # from the camera to the splat
    lit = np.clip(3 * (normal @ LIGHT), 0, 1)
    degree = np.repeat([1, 2, 3], [3, 5, 7])
    each = np.array(GLOSS)[degree - 1] * np.sqrt(4 * np.pi / (2 * degree + 1))
    basis = sh_basis(seen_along / np.linalg.norm(seen_along, axis=1, keepdims=True), 3)
    return np.repeat((basis * each * lit[:, None])[:, :, None], 3, axis=2)


def main() -> None:
    """Writes the scene as a PLY."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="the .ply to write")
    parser.add_argument("--seed", type=int, default=0, help="of other splats (default 0)")
    arguments = parser.parse_args()
    write_ply(arguments.output, glossy_knot(arguments.seed))


if __name__ == "__main__":
    main()
