"""Placement of the splats of a glTF: transforms of nodes, and the turn that makes y the axis that points up."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import rotation_matrices
from ...model.transforms import LARGEST, Transform, scale_of
from ...system.errors import FormatError, UnsupportedError
from ...system.untrusted import Json, Origin
from .glb_container import GltfFile

Matrix = NDArray[np.float64]

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

#: How far axes of a node may be from right angles, and from one length, as a share: float32 leaves 1e-7. Chosen.
SKEW = 1e-5


class GltfNodes:
    """Nodes of a glTF, and the scene that a viewer shows.

    Raises:
        FormatError: the nodes are linked in a circle.
    """

    def __init__(self, file: GltfFile) -> None:
        self.records = list(file.items("nodes"))
        self._parent: dict[int, int] = {}
        for number, node in enumerate(self.records):
            children = node.get("children", [])
            for child in children if isinstance(children, list) else ():
                if isinstance(child, int) and 0 <= child < len(self.records):
                    self._parent[child] = number
        self._shown = _roots_of_scene(file)
        self._is_shown: dict[int, bool] = {}
        self._matrices: dict[int, Matrix] = {}

    def having(self, meshes: Collection[int]) -> tuple[list[int], int]:
        """Return the nodes with these meshes that a viewer shows, in order, and the number of hidden nodes.

        All are shown where the file has no scene, or one without any of them.
        """
        wanted = set(meshes)
        having = [
            number
            for number, node in enumerate(self.records)
            if type(node.get("mesh")) is int and node["mesh"] in wanted
        ]
        for number in having:
            for each in self._down_to(number, self._is_shown):
                parent = self._parent.get(each)
                self._is_shown[each] = each in self._shown if parent is None else self._is_shown[parent]
        shown = [number for number in having if self._is_shown[number]]
        return (shown, len(having) - len(shown)) if shown else (having, 0)

    def matrix(self, number: int) -> Matrix:
        """Return the (4, 4) matrix from a node to the scene, for column vectors.

        Raises:
            FormatError: a number of it is beyond `LARGEST`, or a node above has no transform that can be read.
        """
        for each in self._down_to(number, self._matrices):
            own, parent = _matrix(self.records[each]), self._parent.get(each)
            self._matrices[each] = own if parent is None else product(self._matrices[parent], own)
        return self._matrices[number]

    def _down_to(self, number: int, known: Container[int]) -> Iterator[int]:
        """Yield a node and its ancestors that are not in `known`, from the top down."""
        line, at = dict[int, None](), number
        while at not in known:
            if at in line:
                raise FormatError("its nodes are linked in a circle")
            line[at] = None
            if at not in self._parent:
                break
            at = self._parent[at]
        yield from reversed(line)


def _roots_of_scene(file: GltfFile) -> frozenset[int]:
    """Return the roots of the scene that a viewer shows, the first unless the file says otherwise."""
    scenes = list(file.items("scenes"))
    number = file.root.get("scene", 0)
    if type(number) is not int or not 0 <= number < len(scenes):
        return frozenset()
    roots = scenes[number].get("nodes", [])
    return frozenset(each for each in roots if type(each) is int) if isinstance(roots, list) else frozenset()


def product(outer: Matrix, inner: Matrix) -> Matrix:
    """Return the product of two (4, 4) matrices for column vectors.

    Raises:
        FormatError: a number of it is not finite, or beyond `LARGEST`.
    """
    with np.errstate(all="ignore"):
        matrix = outer @ inner
        if not (np.abs(matrix) <= LARGEST).all():
            raise FormatError(f"transforms multiply to numbers beyond {LARGEST:g}")
    return matrix


def _matrix(node: dict[str, Any]) -> Matrix:
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


def _numbers(node: dict[str, Any], name: str, count: int, default: tuple[float, ...]) -> Matrix:
    if name not in node:
        return np.array(default, np.float64)
    return np.array(Json(node, Origin("a node", FormatError)).get(name).numbers(count, most=LARGEST))


def transform_of(matrix: Matrix) -> Transform:
    """Return a (4, 4) matrix as a rotation, a uniform scale and a translation.

    Raises:
        FormatError: it is singular, or out of the range of a `Transform`.
        UnsupportedError: it stretches, shears or mirrors.
    """
    axes = matrix[:3, :3]
    with np.errstate(all="ignore"):
        determinant = float(np.linalg.det(axes))
    if not (matrix[3] == (0, 0, 0, 1)).all() or not math.isfinite(determinant):
        raise FormatError("the transform of its splats is not affine, or not of finite numbers")
    if determinant == 0:
        raise FormatError("the transform of its splats is singular: it makes their volume 0")
    scale = scale_of(matrix, SKEW)
    if scale is None:
        raise UnsupportedError(
            "a transform stretches, shears or mirrors its splats; only rotations and uniform scales are read"
        )
    if abs(scale - 1) <= SKEW:
        scale = 1.0
    left, _, right = np.linalg.svd(axes)
    rotation = np.rint(left @ right) if np.abs(left @ right - np.rint(left @ right)).max() < SKEW else left @ right
    try:
        return Transform(rotation, scale, matrix[:3, 3])
    except ValueError as error:
        raise FormatError(f"the transform of its splats: {error}") from None


def rotation_of_up(up: str | None) -> Matrix:
    """Return the (3, 3) turn of an axis to +y, exactly; the identity where it is unknown."""
    return np.rint(rotation_matrices(np.array([TURNS[up or "y"]]))[..., 0]) + 0.0  # no -0


def is_turn_of(transform: Transform, up: str) -> bool:
    """Return True if a transform is the turn of an axis to +y, and nothing else."""
    at_rest = transform.scale == 1 and not transform.translation.any()
    return at_rest and bool(np.abs(transform.rotation - rotation_of_up(up)).max() <= SKEW)
