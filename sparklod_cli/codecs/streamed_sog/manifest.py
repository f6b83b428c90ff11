"""The manifest of Streamed SOG, lod-meta.json, as it is read and written.

Parsing checks what reading needs; all other rules of the format are in `manifest_rules`, so that a file which breaks
them can be reported on.
"""

from __future__ import annotations

import decimal
import functools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...system.errors import VersionError
from ...system.untrusted import Json, quoted_value
from .. import quantize
from ..formats import MANIFEST
from ..reader import FileNote, read_note
from ..rules import nodes_of, parse_manifest, place_of

#: The version that is read and written. A manifest from before versions has none.
VERSION = 1

#: Largest manifest, bytes: that of 100,000 regions at some levels.
MAX_MANIFEST = 1 << 25

#: Most detail levels; tools write up to ten.
MAX_LEVELS = 32

#: Most splats of a run, and its largest offset: no image of a SOG has more texels.
MAX_RUN = 1 << 28

#: Most nodes of the tree: twice as many as there are regions of 8,192 splats in 500 million. Chosen.
MAX_NODES = 1 << 17

#: The largest magnitude of a coordinate of a bound: that of float32.
LARGEST = float(quantize.LARGEST)

#: Significant digits: those of a float32.
DIGITS = 7

_DOWN = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_FLOOR)
_UP = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_CEILING)

Corner = tuple[float, float, float]
Bound = tuple[Corner, Corner]


@dataclass(frozen=True)
class Run:
    """Run of `count` splats of a region at a detail level, from `offset` on in a file, by its number."""

    file: int
    offset: int
    count: int


@dataclass(frozen=True)
class ManifestNode:
    """Node of the tree of regions.

    Attributes:
        bound: lowest and highest corner in world units; None if it is missing, or not finite.
        children: numbers of nodes, ascending; none of a region.
        runs: of a region, by detail level; None where the node has no `lods`.
        errors: of a region, not checked; None without errors.
        parent: number of the node above, -1 of the root.
    """

    bound: Bound | None
    children: tuple[int, ...] = ()
    runs: Mapping[int, Run] | None = None
    errors: Any = None
    parent: int = -1


@dataclass(frozen=True)
class Manifest:
    """Contents of a lod-meta.json.

    Attributes:
        levels: number of detail levels.
        filenames: paths of the meta.json of each chunk, from the folder of the manifest on.
        nodes: of the tree, depth first; regions are counted in this order.
        environment: path of the meta.json of the environment.
        head: all other keys at the top level, not checked: "version", "asset", "count", "counts", "lodErrors".
    """

    levels: int
    filenames: tuple[str, ...]
    nodes: tuple[ManifestNode, ...]
    environment: str | None = None
    head: Mapping[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def noted(self) -> FileNote:
        return read_note(self.head.get("asset"))

    def place(self, number: int) -> str:
        """Return the place of a node in the file: "tree.children[0]"."""
        return place_of("tree", number, lambda each: self.nodes[each].parent, lambda each: self.nodes[each].children)

    def regions(self) -> Iterator[tuple[int, ManifestNode]]:
        """Return the nodes without children, and their numbers."""
        return ((number, node) for number, node in enumerate(self.nodes) if not node.children)

    def names(self) -> list[str]:
        return [*self.filenames, *([] if self.environment is None else [self.environment])]

    def read_names(self) -> list[str]:
        """Return the files that readers of the scene open: `names` without chunk files that no run uses."""
        read = {run.file for _, node in self.regions() for run in (node.runs or {}).values() if run.count}
        return [name for number, name in enumerate(self.names()) if number in read or number >= len(self.filenames)]


def parse(data: bytes) -> Manifest:
    """Parse the bytes of a lod-meta.json; errors name the value and its place."""
    root = parse_manifest(data, MANIFEST, MAX_MANIFEST)
    version = root.value.get("version")
    if version is not None and (type(version) is not int or version != VERSION):
        raise VersionError(f"Streamed SOG version {quoted_value(version)} is unknown, only {VERSION} is read")
    levels = root.whole("lodLevels", least=1, most=MAX_LEVELS)
    filenames = tuple(name.text() for name in root.items("filenames"))
    # Viewers test for truth, and some writers leave "" where there is no environment.
    environment = root.text("environment") if root.value.get("environment") else None
    nodes = _nodes(root.get("tree"), levels, len(filenames))
    beside = ("lodLevels", "filenames", "environment", "tree")
    head = {key: value.value for key, value in root.entries() if key not in beside}
    return Manifest(levels, filenames, nodes, environment, head)


def _nodes(tree: Json, levels: int, files: int) -> tuple[ManifestNode, ...]:
    keys, nodes = {str(level): level for level in range(levels)}, list[ManifestNode]()
    for node, parent, children in nodes_of(tree, MAX_NODES):
        lods = node.get("lods")
        runs = _runs(lods, keys, files) if lods.value or lods.value == {} else None
        bound, errors = _bound(node.value.get("bound")), node.value.get("errors")
        nodes.append(ManifestNode(bound, tuple(children), runs, errors, parent))
    return tuple(nodes)


def _runs(lods: Json, keys: Mapping[str, int], files: int) -> dict[int, Run]:
    """Return the runs of a region by detail level; `keys` has the levels by their names."""
    runs = dict[int, Run]()
    for key, run in lods.entries():
        if key not in keys:
            raise run.error(f"there is no such level, only 0 to {len(keys) - 1}")
        offset, count = run.whole("offset", most=MAX_RUN), run.whole("count", most=MAX_RUN)
        runs[keys[key]] = Run(run.whole("file", most=files - 1), offset, count)
    return runs


def _bound(value: Any) -> Bound | None:
    """Return two corners of three numbers that are finite in float32, as viewers hold them; None for anything else."""
    if not isinstance(value, dict):
        return None
    low, high = (value.get(name) for name in ("min", "max"))
    corners = [each for each in (low, high) if isinstance(each, list) and len(each) == 3]
    numbers = [number for corner in corners for number in corner]
    if len(numbers) != 6 or not all(type(each) in (int, float) and abs(each) <= LARGEST for each in numbers):
        return None
    a, b, c, d, e, f = map(float, numbers)
    return (a, b, c), (d, e, f)


def serialise(manifest: Manifest) -> bytes:
    """Return the bytes of a lod-meta.json.

    Bounds are rounded outward. `lodLevels` comes early, since a file is recognised by it, and the tree last.
    """
    head = dict(manifest.head)
    first: dict[str, Any] = {key: head.pop(key) for key in ("version", "asset", "count", "counts") if key in head}
    first |= {"lodLevels": manifest.levels} | head
    if manifest.environment is not None:
        first["environment"] = manifest.environment
    first["filenames"] = list(manifest.filenames)
    return b'%b,"tree":%b}' % (_json(first)[:-1].encode(), _tree(manifest.nodes).encode())


def _tree(nodes: tuple[ManifestNode, ...]) -> str:
    """Write the tree, node by node from its end, since it may be too deep for recursion."""
    texts = [""] * len(nodes)
    for number in reversed(range(len(nodes))):
        node = nodes[number]
        parts = []
        if node.bound is not None:
            low, high = node.bound
            corners = (
                _json_list(_rounded(_DOWN, each) for each in low),
                _json_list(_rounded(_UP, each) for each in high),
            )
            parts.append('"bound":{{"min":{},"max":{}}}'.format(*corners))
        if node.children:
            parts.append(f'"children":{_json_list(texts[child] for child in node.children)}')
            for child in node.children:
                texts[child] = ""
        if node.runs is not None:
            parts.append(f'"lods":{_json({str(level): vars(run) for level, run in node.runs.items()})}')
        if node.errors is not None:
            parts.append(f'"errors":{_json_list(f"{error:.{DIGITS}g}" for error in node.errors)}')
        texts[number] = "{" + ",".join(parts) + "}"
    return texts[0]


def _rounded(rounding: decimal.Context, number: float) -> str:
    """Round a number of a bound to one side, but not out of float32; with few enough digits it stays as it is."""
    rounded = float(rounding.create_decimal(repr(number)))
    return f"{rounded:.{DIGITS}g}" if abs(rounded) <= LARGEST else repr(number)


def _json_list(texts: Any) -> str:
    return f"[{','.join(texts)}]"


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"))
