"""Writes the manifest of Streamed SOG, with numbers of 7 significant digits, as its other writers do."""

from __future__ import annotations

import decimal
import json
from collections.abc import Mapping
from typing import Any

from .manifest import LARGEST, Manifest, ManifestNode

#: Significant digits: those of a float32.
DIGITS = 7

_DOWN = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_FLOOR)
_UP = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_CEILING)


def serialise(manifest: Manifest) -> bytes:
    """The bytes of a lod-meta.json.

    Bounds are rounded outward, so that they still enclose what they enclosed. `lodLevels` comes early, since a file is
    recognised by it, and the tree last.
    """
    head = dict(manifest.head)
    first: dict[str, Any] = {key: head.pop(key) for key in ("version", "asset", "count", "counts") if key in head}
    first |= {"lodLevels": manifest.levels} | head
    if manifest.environment is not None:
        first["environment"] = manifest.environment
    first["filenames"] = list(manifest.filenames)
    return b'%b,"tree":%b}' % (_json(first)[:-1].encode(), _tree(manifest.nodes).encode())


def _tree(nodes: tuple[ManifestNode, ...]) -> str:
    """The tree, node by node from its end, since it may be deeper than functions can call themselves."""
    texts = [""] * len(nodes)
    for number in reversed(range(len(nodes))):
        node = nodes[number]
        parts = []
        if node.bound is not None:
            low, high = node.bound
            corners = (_list(_text(_DOWN, each) for each in low), _list(_text(_UP, each) for each in high))
            parts.append('"bound":{{"min":{},"max":{}}}'.format(*corners))
        if node.children:
            parts.append(f'"children":{_list(texts[child] for child in node.children)}')
            for child in node.children:
                texts[child] = ""
        if node.runs is not None:
            parts.append(f'"lods":{_json({str(level): vars(run) for level, run in node.runs.items()})}')
        if node.errors is not None:
            parts.append(f'"errors":{_list(f"{error:.{DIGITS}g}" for error in node.errors)}')
        texts[number] = "{" + ",".join(parts) + "}"
    return texts[0]


def _text(rounding: decimal.Context, number: float) -> str:
    """A number of a bound, rounded to one side, but not out of float32; with few enough digits it stays as it is."""
    rounded = float(rounding.create_decimal(repr(number)))
    return f"{rounded:.{DIGITS}g}" if abs(rounded) <= LARGEST else repr(number)


def _list(texts: Any) -> str:
    return f"[{','.join(texts)}]"


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"))
