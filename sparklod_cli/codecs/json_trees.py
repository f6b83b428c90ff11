"""Trees in JSON, of nodes with "children": where a node is, for messages."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence


def place_of(
    root: str, number: int, parent_of: Callable[[int], int], children_of: Callable[[int], Sequence[int]]
) -> str:
    """Return where a node is in a file, such as "tree.children[0]".

    Args:
        root: name of the root.
        parent_of: number of the parent of a node, -1 of the root.
        children_of: numbers of the children, ascending.
    """
    way = list[str]()
    while (parent := parent_of(number)) >= 0:
        way.append(f".children[{bisect.bisect_left(children_of(parent), number)}]")
        number = parent
    return root + "".join(reversed(way))
