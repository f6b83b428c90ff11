"""Bounding volumes of tiles, boxes and spheres, and the axes of tilesets; of regions nothing is known here.

z is up in a tileset and its bounding volumes, y in the glTF content of its tiles, which a viewer turns when it loads
it: (x, y, z) becomes (x, -z, y). Facts: 3D Tiles 1.1, "glTF transforms".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Bounds
from ..glb.placement import rotation_of_up

Vector = NDArray[np.float64]

#: Numbers of each kind of volume that is read.
KINDS = {"box": 12, "sphere": 4, "region": 6}

#: Largest magnitude of a number: that of float32, in which viewers draw.
LARGEST = 3.4e38


@dataclass(frozen=True, eq=False)
class Volume:
    """A box or a sphere.

    Attributes:
        center: (3,).
        axes: (3, 3) halves of the sides of a box as rows; (0, 3) of a sphere.
        radius: of a sphere, else 0.
    """

    center: Vector
    axes: Vector
    radius: float = 0.0

    def reach(self, directions: Vector) -> Vector:
        """Return (n,) how far it reaches from its centre along (n, 3) directions of length 1."""
        return np.abs(directions @ self.axes.T).sum(axis=1) + self.radius

    def corners(self) -> Vector:
        """Return (n, 3) corners of a box."""
        signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], np.float64)
        return self.center + signs @ self.axes

    def directions(self) -> Vector:
        """Return (3, 3) directions of the sides of a box as rows, right angles between those that have no length."""
        found = list[Vector]()
        for axis in self.axes[np.argsort(-np.linalg.norm(self.axes, axis=1), kind="stable")]:
            length = float(np.linalg.norm(axis))
            if length > 0:
                found.append(axis / length)
        for unit in np.eye(3):
            rest = unit - sum((unit @ each * each for each in found), np.zeros(3))
            if len(found) < 3 and np.linalg.norm(rest) > 0.5:
                found.append(rest / np.linalg.norm(rest))
        return np.array(found)

    def bounds(self) -> Vector:
        """Return (2, 3) corners of the box along the axes around it."""
        half = self.reach(np.eye(3))
        return np.stack([self.center - half, self.center + half])

    def moved(self, matrix: Vector) -> Volume:
        """Return it after a (4, 4) transform; a sphere grows by the largest scale."""
        scale = float(np.linalg.norm(matrix[:3, :3], axis=0).max())
        return Volume(matrix[:3, :3] @ self.center + matrix[:3, 3], self.axes @ matrix[:3, :3].T, scale * self.radius)

    def holds(self, other: Volume, loose: float) -> bool:
        """Return whether another volume is inside, but for a distance."""
        if not len(self.axes):
            if len(other.axes):
                far = float(np.linalg.norm(other.corners() - self.center, axis=1).max())
            else:
                far = float(np.linalg.norm(other.center - self.center)) + other.radius
            return far <= self.radius + loose
        sides = self.directions()
        return bool(
            (np.abs(sides @ (other.center - self.center)) + other.reach(sides) <= self.reach(sides) + loose).all()
        )

    @property
    def size(self) -> float:
        """Largest number in it, by which rounding is measured."""
        return float(np.abs(self.center).max() + self.reach(np.eye(3)).max())


def volume_of(value: Any) -> Volume | str | None:
    """Return the volume of a "boundingVolume"; None for a region, whose numbers are angles; a text on what is none."""
    kind = next((kind for kind in KINDS if isinstance(value, dict) and kind in value), None)
    if kind is None:
        return "none of box, sphere and region"
    numbers = value[kind]
    if not isinstance(numbers, list) or len(numbers) != KINDS[kind]:
        return f"a {kind} that has not {KINDS[kind]} numbers"
    if not all(type(each) in (int, float) and math.isfinite(each) and abs(each) <= LARGEST for each in numbers):
        return f"a {kind} with something else than finite numbers"
    found = np.array(numbers, np.float64)
    if kind == "box":
        return Volume(found[:3], found[3:].reshape(3, 3))
    if kind == "region":
        return None
    if found[3] < 0:
        return "a sphere with a radius below 0"
    return Volume(found[:3], np.empty((0, 3)), float(found[3]))


#: The turn from the axes of glTF to those of tilesets, of column vectors.
Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def to_tileset(up: str | None) -> NDArray[np.float64]:
    """Return the (3, 3) rotation from the axes of splats in a GLB of ours, of which `up` is up, to the tileset's.

    Its entries are 0, 1 and -1, so that boxes stay boxes.
    """
    return Y_TO_Z @ rotation_of_up(up)


def turned(bounds: Bounds, rotation: NDArray[np.float64]) -> Bounds:
    """Return (..., 2, 3) corners of the boxes around turned ones.

    Args:
        bounds: (..., 2, 3) lowest and highest corners.
        rotation: (3, 3), of column vectors.
    """
    middle, half = bounds.mean(axis=-2), (bounds[..., 1, :] - bounds[..., 0, :]) / 2
    center, reach = middle @ rotation.T, half @ np.abs(rotation).T
    return np.stack([center - reach, center + reach], axis=-2)
