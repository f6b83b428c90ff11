"""Manifests in JSON with trees of nodes that have "children": their nodes, where these are, and names of files."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence

from ..system.errors import FormatError
from ..system.untrusted import Json, Origin

#: Deepest nesting of a manifest; a node of a tree takes two.
MAX_NESTING = 512


def parse_manifest(data: bytes, called: str, most: int) -> Json:
    """Parse a manifest of at most `most` bytes, called so in messages; raises `FormatError` if it is no object."""
    root = Json.parse(data, Origin(called, FormatError), most=most, depth=MAX_NESTING)
    if not isinstance(root.value, dict):
        raise root.unexpected("an object")
    return root


def place_of(
    root: str, number: int, parent_of: Callable[[int], int], children_of: Callable[[int], Sequence[int]]
) -> str:
    """Return the place of a node in a file, such as "tree.children[0]", where "tree" is `root`.

    Args:
        parent_of: number of the parent of a node, -1 of the root.
        children_of: numbers of the children, ascending.
    """
    way = list[str]()
    while (parent := parent_of(number)) >= 0:
        way.append(f".children[{bisect.bisect_left(children_of(parent), number)}]")
        number = parent
    return root + "".join(reversed(way))


def nodes_of(tree: Json, most: int) -> list[tuple[Json, int, list[int]]]:
    """Return the nodes of a tree, however deep, root first and depth first.

    A node is its object, the number of its parent, -1 of the root, and the numbers of its children.
    """
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
    """Return True if a name means something else than a file in the manifest's folder or in one below."""
    return any(part in ("", ".", "..") for part in name.split("/")) or any(mark in name for mark in "\\:\0?#")
