"""Manifests in JSON with trees of nodes that have "children": parsing one, and where a node is, for messages."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from typing import Any

from ..support.errors import FormatError
from ..support.untrusted import parse_json

#: Deepest nesting of a manifest; a node of a tree takes two.
MAX_NESTING = 512


def parse_manifest(data: bytes, called: str, most: int) -> dict[str, Any]:
    """Return the object that a manifest is.

    Args:
        called: its name, for messages.
        most: bytes that are read.

    Raises:
        FormatError: it has more bytes, is not JSON, or no object.
    """
    if len(data) > most:
        raise FormatError(f"{called} has more than {most:,} bytes")
    try:
        root = parse_json(data, depth=MAX_NESTING)
    except ValueError as error:
        raise FormatError(f"{called} is not JSON: {error}") from None
    if not isinstance(root, dict):
        raise FormatError(f"{called} is not an object")
    return root


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
