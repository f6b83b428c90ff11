"""Validation of splats and trees where they are read or passed to the API, and of the rules of formats."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import covariance
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.selection import EXAMINED
from ..model.splats import COLUMNS, UNIT_TOLERANCE, Splats, describe_invalid
from ..system.errors import FormatError, InvalidSplatsError, TreeError
from ..system.threads import blocks_of, ordered_map
from .kernels.drawable import count_doubtful


@dataclass(frozen=True)
class RuleViolation:
    """Rule of a format that a file breaks.

    Attributes:
        code: for `inspect`, such as "rad.sizes".
        text: what is wrong, with the values.
        fatal: a viewer, or this reader, cannot read the file, or would read something else than was written.
    """

    code: str
    text: str
    fatal: bool = True


def check_rules(violations: Iterable[RuleViolation]) -> None:
    """Raise a `FormatError` with the code and the text of the first fatal violation."""
    for violation in violations:
        if violation.fatal:
            raise error_of(violation.code, violation.text)


def error_of(code: str, text: str) -> FormatError:
    """Return the error for a broken rule, which has its code."""
    error = FormatError(text)
    error.code = code
    return error


def with_valid_tree(scene: Scene) -> Scene:
    """Return a scene whose tree, if it has one, is valid; its leaves have a `child_start` of 0.

    Raises:
        FormatError: its tree is broken.
    """
    if scene.tree is None:
        return scene
    try:
        scene.tree.validate()
    except TreeError as error:
        raise FormatError(f"its Level-of-Detail tree is broken: {error}") from error
    start = scene.tree.first_child()
    if np.array_equal(start, scene.tree.child_start):
        return scene  # whose tree knows that it is valid
    return dataclasses.replace(scene, tree=LodTree(scene.tree.child_count, start))


def is_valid_and_visible(splats: Splats, threads: int) -> tuple[bool, bool]:
    """Return whether all splats are certainly valid, and visible; otherwise `Splats.invalid` and `Selection` decide.

    Rounding differs from theirs, so a rotation has to be nearer to a unit one.
    """
    tolerance = np.float32(UNIT_TOLERANCE / 2)

    def counts(part: slice) -> tuple[int, int]:
        columns = (getattr(splats, name)[part].reshape(-1) for name in COLUMNS)
        doubtful, invisible = count_doubtful(*columns, tolerance)
        return int(doubtful), int(invisible)

    tallies = list(ordered_map(counts, blocks_of(len(splats), EXAMINED), threads))
    return not any(doubtful for doubtful, _ in tallies), not any(invisible for _, invisible in tallies)


def check_valid(splats: Splats, threads: int) -> None:
    """Check splats where they enter: from a file or from the API; `InvalidSplatsError` if one is invalid."""
    if not is_valid_and_visible(splats, threads)[0] and (invalid := splats.invalid()):
        raise InvalidSplatsError(f"{describe_invalid(invalid)}; such splats are not written, leave them out")


#: By how much a splat may lie outside of its bound: a share of its own extent, by which codes of 8 bits change it; of
#: its largest scale, since they turn it by up to 1.1 degrees; of the bound; and, for codes of logarithms of 16 bits, of
#: the distance from the origin plus 1, or half a step of these codes where that is more.
LOOSE_EXTENT, LOOSE_TURN, LOOSE_BOUND, LOOSE_CENTER = 0.25, 0.02, 1e-3, 2e-4


def count_outside(
    splats: Splats,
    bound: NDArray[np.float64],
    steps: NDArray[np.float64] | float = 0.0,
    directions: NDArray[np.float64] | None = None,
) -> int:
    """Count the splats that lie outside of a bound with the ellipsoids of one standard deviation.

    Args:
        bound: (2, 3) lowest and highest coordinates along the directions.
        steps: (3,) those of the codes of centres, as shares of the distance from the origin plus 1.
        directions: (3, 3) unit vectors as rows, those of the sides of a box; None for the axes.
    """
    loose, step = LOOSE_BOUND * np.abs(bound[1] - bound[0]), np.maximum(LOOSE_CENTER, np.expm1(steps) / 2)
    count = 0
    for block in blocks_of(len(splats)):
        center = splats.center[block].astype(np.float64)
        shape = covariance(splats.scale[block], splats.quat_xyzw[block])
        if directions is None:
            variance = shape[:, [0, 3, 5]]
        else:
            center = center @ directions.T
            full = shape[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
            variance = np.maximum(np.einsum("da,nab,db->nd", directions, full, directions), 0)
        turned = LOOSE_TURN * np.maximum.reduce(splats.scale[block].T)[:, None]
        reach = (1 - LOOSE_EXTENT) * np.sqrt(variance) - turned - loose - step * (1 + np.abs(center))
        count += int(np.count_nonzero(np.any((center - reach < bound[0]) | (center + reach > bound[1]), axis=1)))
    return count
