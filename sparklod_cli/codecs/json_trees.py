"""Manifests in JSON with trees of nodes that have "children": their nodes, where these are, and names of files."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from ..system.errors import FormatError
from ..system.untrusted import parse_json, quoted_value

#: Deepest nesting of a manifest; a node of a tree takes two.
MAX_NESTING = 512


def parse_manifest(data: bytes, called: str, most: int) -> dict[str, Any]:
    """Return the object that a manifest is, without keys whose value is null.

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
    return _without_nulls(root)


def _without_nulls(record: dict[str, Any]) -> dict[str, Any]:
    """Return an object without keys whose value is null, which viewers take for missing."""
    return {key: value for key, value in record.items() if value is not None}


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


def nodes_of(
    tree: Any, root: str, called: str, kind: str, most: int, too_many: str
) -> Iterator[tuple[dict[str, Any], int, list[int], Callable[[], str]]]:
    """Yield the nodes of a tree, however deep, root first and depth first.

    A node is its object, without keys whose value is null, the number of its parent, -1 of the root, the numbers of its
    children, to which each is added when it is reached, and a function that returns its place.

    Args:
        tree: the value that should be the root.
        root: name of the root.
        called: name of the manifest, for messages.
        kind: what a node must be, for messages.
        most: nodes that are read.
        too_many: message for a tree of more.

    Raises:
        FormatError: there are too many, one is no object, or its children are no list.
    """
    parents, children = list[int](), list[list[int]]()
    waiting = [(tree, -1)]  # a value, and the number of its parent
    while waiting:
        value, parent = waiting.pop()
        number = len(parents)
        if number == most:
            raise FormatError(too_many)
        parents.append(parent)
        children.append([])
        if parent >= 0:
            children[parent].append(number)

        def place(number: int = number) -> str:
            return place_of(root, number, parents.__getitem__, children.__getitem__)

        if not isinstance(value, dict):
            raise wrong(called, place(), value, kind)
        value = _without_nulls(value)
        below = value.get("children", [])
        if below == "" or below is False:  # which viewers take for missing, too
            below = []
        if not isinstance(below, list):
            raise wrong(called, f"{place()}.children", below, "a list")
        yield value, parent, children[number], place
        waiting.extend((each, number) for each in reversed(below))


def wrong(called: str, place: str, value: Any, expected: str) -> FormatError:
    """Return the error for a value of a manifest that is missing, None, or of the wrong kind."""
    if value is None:
        return FormatError(f"{called} has no {place}, which must be {expected}")
    return FormatError(f"{place} of {called} is {quoted_value(value)}, not {expected}")


def leads_away(name: str) -> bool:
    """Return True if a name means something else than a file in the manifest's folder or in one below."""
    return any(part in ("", ".", "..") for part in name.split("/")) or any(mark in name for mark in "\\:\0?#")
