"""Violations of rules of formats, bounds of splats, and JSON manifests of trees whose nodes have "children"."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import covariance
from ..model.splats import Splats
from ..system.errors import FormatError
from ..system.threads import blocks_of
from ..system.untrusted import Json, Origin


@dataclass(frozen=True)
class RuleViolation:
    """Rule of a format that a file breaks.

    Attributes:
        code: code of the finding of `inspect`, such as "rad.sizes".
        text: description of the fault with its values.
        fatal: a viewer, or this reader, cannot read the file, or would misread it.
    """

    code: str
    text: str
    fatal: bool = True


def violation(readable: Collection[str], format: str, code: str, text: str, fatal: bool | None = None) -> RuleViolation:
    """Return a violation of a rule of a format, fatal unless its code is `readable` or `fatal` says otherwise."""
    code = f"{format}.{code}"
    return RuleViolation(code, text, code not in readable if fatal is None else fatal)


def check_rules(violations: Iterable[RuleViolation]) -> None:
    """Raise a `FormatError` with the code and the text of the first fatal violation."""
    for violation in violations:
        if violation.fatal:
            raise error_of(violation.code, violation.text)


def error_of(code: str, text: str) -> FormatError:
    """Return a `FormatError` with the code of the broken rule."""
    error = FormatError(text)
    error.code = code
    return error


#: Allowed distance of a splat outside of its bound: a share of its own extent, the error of codes of 8 bits; of its
#: largest scale, since such codes turn it by up to 1.1 degrees; of the bound; and of the distance from the origin plus
#: 1, the error of 16-bit codes of logarithms, unless half a step of these codes is more.
LOOSE_EXTENT, LOOSE_TURN, LOOSE_BOUND, LOOSE_CENTER = 0.25, 0.02, 1e-3, 2e-4


def count_outside(
    splats: Splats,
    bound: NDArray[np.float64],
    steps: NDArray[np.float64] | float = 0.0,
    directions: NDArray[np.float64] | None = None,
) -> int:
    """Count the splats whose ellipsoids of one standard deviation extend beyond a bounding box.

    Args:
        bound: (2, 3) lowest and highest coordinates along the directions.
        steps: (3,) quantization steps of centres, as logarithms: half of exp(step) - 1, times 1 plus the distance from
            the origin, is tolerated.
        directions: (3, 3) unit vectors along the sides of the bound as rows; None for the axes.
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


#: Deepest nesting of a manifest; a node of a tree adds two levels.
MAX_NESTING = 512


def parse_manifest(data: bytes, called: str, most: int) -> Json:
    """Parse a manifest of at most `most` bytes; a `FormatError` calls it `called`."""
    root = Json.parse(data, Origin(called, FormatError), most=most, depth=MAX_NESTING)
    if not isinstance(root.value, dict):
        raise root.unexpected("an object")
    return root


def place_of(
    root: str, number: int, parent_of: Callable[[int], int], children_of: Callable[[int], Sequence[int]]
) -> str:
    """Return the place of a node in a file, such as "tree.children[0]" for the root "tree".

    Args:
        parent_of: returns the number of the parent of a node, -1 for the root.
        children_of: returns the ascending numbers of the children of a node.
    """
    way = list[str]()
    while (parent := parent_of(number)) >= 0:
        way.append(f".children[{bisect.bisect_left(children_of(parent), number)}]")
        number = parent
    return root + "".join(reversed(way))


def nodes_of(tree: Json, most: int) -> list[tuple[Json, int, list[int]]]:
    """Return the nodes of a tree depth first: object, number of the parent, -1 for the root, and of the children."""
    nodes = list[tuple[Json, int, list[int]]]()
    waiting = [(tree, -1)]
    while waiting:
        node, parent = waiting.pop()
        number = len(nodes)
        if number == most:
            raise tree.error(f"it has more than {most:,} nodes")
        if not isinstance(node.value, dict):
            raise node.unexpected("an object")
        nodes.append((node, parent, []))
        if parent >= 0:
            nodes[parent][2].append(number)
        below = node.value.get("children")
        missing = below is None or below == "" or below is False  # as for viewers, which test for truth
        items = [] if missing else list(node.items("children"))
        waiting.extend((each, number) for each in reversed(items))
    return nodes


def leads_away(name: str) -> bool:
    """Return whether a name leads out of the manifest's folder, or is no plain relative path."""
    return any(part in ("", ".", "..") for part in name.split("/")) or any(mark in name for mark in "\\:\0?#")
