"""Placement of the splats of a GLB: the transform of their node, and the turn that makes y the axis that points up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import rotation_matrices
from ...model.transforms import LARGEST, Transform
from ...support.errors import FormatError
from ...support.untrusted import quoted_value
from .glb_container import GlbFile

#: Rotations x y z w that turn an axis to +y: about x, so that right stays right, but of x itself.
HALF = math.sqrt(0.5)
TURNS = {
    "y": (0.0, 0.0, 0.0, 1.0),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "z": (-HALF, 0.0, 0.0, HALF),
    "-z": (HALF, 0.0, 0.0, HALF),
    "x": (0.0, 0.0, HALF, HALF),
    "-x": (0.0, 0.0, -HALF, HALF),
}

#: Most nodes from the root to the splats; scenes of editors have some tens. Chosen.
DEEPEST = 256

#: How far axes of a node may be from right angles, and from one length, as a share: float32 leaves 1e-7. Chosen.
SKEW = 1e-5


def placement_of(file: GlbFile, mesh: int) -> Transform:
    """Return the transform from the splats of a mesh to the scene; the identity where no node has it.

    Raises:
        FormatError: several nodes have it, they are linked in a circle, or one stretches its content.
    """
    nodes = list(file.items("nodes"))
    having = [number for number, node in enumerate(nodes) if node.get("mesh") == mesh]
    if len(having) > 1:
        raise FormatError(f"{len(having)} nodes have its splats; only one is read")
    parent: dict[int, int] = {}
    for number, node in enumerate(nodes):
        children = node.get("children", [])
        for child in children if isinstance(children, list) else ():
            if isinstance(child, int):
                parent[child] = number
    matrix, at = np.eye(4), having[0] if having else None
    for _ in range(DEEPEST):
        if at is None:
            break
        matrix = _matrix(nodes[at]) @ matrix
        at = parent.get(at)
    if at is not None:
        raise FormatError(f"its nodes are linked in a circle, or more than {DEEPEST} deep")
    return transform_of(matrix)


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return the (4, 4) matrix of a node for column vectors."""
    if "matrix" in node:
        return _numbers(node, "matrix", 16, ()).reshape(4, 4).T
    matrix = np.eye(4)
    turn = _numbers(node, "rotation", 4, (0, 0, 0, 1))
    length = np.linalg.norm(turn)
    if not 0.5 < length < 2:
        raise FormatError("the rotation of a node is no unit quaternion")
    matrix[:3, :3] = rotation_matrices((turn / length)[None])[..., 0] * _numbers(node, "scale", 3, (1, 1, 1))
    matrix[:3, 3] = _numbers(node, "translation", 3, (0, 0, 0))
    return matrix


def _numbers(node: dict[str, Any], name: str, count: int, default: tuple[float, ...]) -> NDArray[np.float64]:
    values = node.get(name, default)
    numbers = isinstance(values, (list, tuple)) and all(type(value) in (int, float) for value in values)
    if not numbers or len(values) != count or not all(abs(value) <= LARGEST for value in values):
        raise FormatError(f"{name} of a node is {quoted_value(values)}, not {count} numbers up to {LARGEST:g}")
    return np.array(values, np.float64)


def transform_of(matrix: NDArray[np.float64]) -> Transform:
    """Return a (4, 4) matrix as a rotation, a uniform scale and a translation; `FormatError` where it is more."""
    axes = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(axes)))
    is_affine = bool((matrix[3] == (0, 0, 0, 1)).all())
    if not (is_affine and scale > 0 and np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() <= SKEW):
        raise FormatError("a node stretches, shears or mirrors its splats; only rotations and uniform scales are read")
    if abs(scale - 1) <= SKEW:
        scale = 1.0
    left, _, right = np.linalg.svd(axes)
    rotation = np.rint(left @ right) if np.abs(left @ right - np.rint(left @ right)).max() < SKEW else left @ right
    try:
        return Transform(rotation, scale, matrix[:3, 3])
    except ValueError as error:
        raise FormatError(f"the transform of its splats: {error}") from None


def rotation_of_up(up: str | None) -> NDArray[np.float64]:
    """Return the (3, 3) turn of an axis to +y, exactly; the identity where it is unknown."""
    return np.rint(rotation_matrices(np.array([TURNS[up or "y"]]))[..., 0]) + 0.0  # no -0


def is_turn_of(transform: Transform, up: str) -> bool:
    """Return True if a transform is the turn of an axis to +y, and nothing else."""
    at_rest = transform.scale == 1 and not transform.translation.any()
    return at_rest and bool(np.abs(transform.rotation - rotation_of_up(up)).max() <= SKEW)
