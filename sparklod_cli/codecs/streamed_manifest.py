"""The manifest of Streamed SOG, lod-meta.json, as it is read and written.

Parsing checks what reading needs; all other rules, of the manifest, chunk files and their splats, are checked apart,
so that a report can name every rule that a file breaks.
"""

from __future__ import annotations

import decimal
import functools
import itertools
import json
import math
import posixpath
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from ..model.morton import order_of_cells
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError, VersionError
from ..system.progress import Progress, silent
from ..system.units import count_of
from ..system.untrusted import Json, quoted_value
from . import quantize, sog, sog_images
from .format_rules import RuleViolation, count_outside, leads_away, nodes_of, parse_manifest, place_of, violation
from .formats import MANIFEST, ZIP
from .merging import Chunk, SceneFiles, not_finite
from .reader import FileNote, OpenCompanion, code_of, read_note
from .sog import MAX_META, image_names, parse_meta

#: Version that is read and written; old manifests have none.
VERSION = 1

#: Largest manifest in bytes; fits 100,000 regions at several levels.
MAX_MANIFEST = 1 << 25

#: Most detail levels; tools write up to ten.
MAX_LEVELS = 32

#: Most splats of a run, and its largest offset: the texels of the largest image of a SOG.
MAX_RUN = 1 << 28

#: Most nodes of the tree: twice as many as there are regions of 8,192 splats in 500 million. Chosen.
MAX_NODES = 1 << 17

#: Largest magnitude of a coordinate of a bound, that of float32.
LARGEST = float(quantize.LARGEST)

#: Significant digits: those of a float32.
DIGITS = 7

_DOWN = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_FLOOR)
_UP = decimal.Context(prec=DIGITS, rounding=decimal.ROUND_CEILING)

Corner = tuple[float, float, float]
Bound = tuple[Corner, Corner]


@dataclass(frozen=True)
class Run:
    """Splats of a region at one detail level: `count` of them from `offset` on in the file with the number `file`."""

    file: int
    offset: int
    count: int


@dataclass(frozen=True)
class ManifestNode:
    """Node of the tree of regions.

    Attributes:
        bound: lowest and highest corner in world units; None if it is missing, or not finite.
        children: numbers of the child nodes, ascending; empty for a region.
        runs: runs of a region by detail level; None if the node has no `lods`.
        errors: unchecked value of the key `errors` of a region; None if the key is missing.
        parent: number of the parent, -1 for the root.
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
        filenames: path of the meta.json of each chunk, relative to the manifest's folder.
        nodes: nodes of the tree, depth first; regions are numbered in this order.
        environment: path of the meta.json of the environment.
        head: other keys at the top level, unchecked: "version", "asset", "count", "counts", "lodErrors".
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
        """Return the place of a node in the file, such as "tree.children[0]"."""
        return place_of("tree", number, lambda each: self.nodes[each].parent, lambda each: self.nodes[each].children)

    def regions(self) -> Iterator[tuple[int, ManifestNode]]:
        """Return the nodes without children with their numbers."""
        return ((number, node) for number, node in enumerate(self.nodes) if not node.children)

    def names(self) -> list[str]:
        return [*self.filenames, *([] if self.environment is None else [self.environment])]

    def read_names(self) -> list[str]:
        """Return the files that readers of the scene open, without chunk files that no run uses."""
        read = {run.file for _, node in self.regions() for run in (node.runs or {}).values() if run.count}
        return [name for number, name in enumerate(self.names()) if number in read or number >= len(self.filenames)]


def parse(data: bytes) -> Manifest:
    """Parse a lod-meta.json; errors name the value and its place."""
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
    """Return the runs of a region by detail level; `keys` are the levels by their keys in the file."""
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
    """Encode a lod-meta.json, with bounds rounded outward; `lodLevels` identifies the format and so comes early."""
    head = dict(manifest.head)
    first: dict[str, Any] = {key: head.pop(key) for key in ("version", "asset", "count", "counts") if key in head}
    first |= {"lodLevels": manifest.levels} | head
    if manifest.environment is not None:
        first["environment"] = manifest.environment
    first["filenames"] = list(manifest.filenames)
    return b'%b,"tree":%b}' % (_json(first)[:-1].encode(), _tree(manifest.nodes).encode())


def _tree(nodes: tuple[ManifestNode, ...]) -> str:
    """Encode the tree from its last node on, since it may be too deep for recursion."""
    texts = [""] * len(nodes)
    for number in reversed(range(len(nodes))):
        node = nodes[number]
        parts = []
        if node.bound is not None:
            low, high = (
                _json_list(_rounded(rounding, each) for each in corner)
                for rounding, corner in zip((_DOWN, _UP), node.bound, strict=True)
            )
            parts.append(f'"bound":{{"min":{low},"max":{high}}}')
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
    """Round a number of a bound to `DIGITS` digits; beyond float32 it stays as it is."""
    rounded = float(rounding.create_decimal(repr(number)))
    return f"{rounded:.{DIGITS}g}" if abs(rounded) <= LARGEST else repr(number)


def _json_list(texts: Any) -> str:
    return f"[{','.join(texts)}]"


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"))


#: Meaning of each code; the text of a violation has the values. Values that the parser refuses have the codes
#: "container.corrupt" and "container.version", as in other formats.
ERRORS = {
    "streamed-sog.nodes": "a node of the tree has neither two children nor runs, or it has both",
    "streamed-sog.bounds": "a bound is missing, not finite, or begins beyond its end",
    "streamed-sog.union": "the bound of an inner node is not the union of its children's",
    "streamed-sog.extents": "splats of a region lie outside of its bound",
    "streamed-sog.errors": "errors are not one a level, finite, from 0 on, 0 at level 0 and never decreasing",
    "streamed-sog.counts": "count or counts is not the sum of the runs",
    "streamed-sog.filenames": "the name of a chunk file leads elsewhere, or is there twice",
    "streamed-sog.chunk-files": "a chunk file is missing, damaged or no SOG",
    "streamed-sog.mixed": "a chunk file has runs of more than one detail level",
    "streamed-sog.runs": "the runs in a chunk file overlap, leave a gap, or are not all of its splats",
    "streamed-sog.environment": "the environment is missing, damaged or no SOG",
}
WARNINGS = {
    "streamed-sog.old": "version, count or counts is missing, as in files from before version 1",
    "streamed-sog.unused": "no region refers to a chunk file",
    "streamed-sog.full-detail": "a region has no splats at level 0, so that it never has full detail",
    "streamed-sog.coarsest": "a region has no splats at the coarsest level, and disappears where a viewer asks for it",
    "streamed-sog.decreasing": "a detail level has no fewer splats than the level before",
    "streamed-sog.lod-errors": "lodErrors does not say whether the regions have errors, or only some of them have",
    "streamed-sog.kind": "SH degree or antialias of a chunk file is not that of the first one",
    "streamed-sog.order": "the splats of a run are not in Morton order",
}

#: Rules that a readable file may break.
READABLE = {*WARNINGS, *(f"streamed-sog.{name}" for name in ("union", "extents", "counts", "mixed"))}
broken = functools.partial(violation, READABLE, "streamed-sog")

#: Allowed difference of two equal bounds, as a share of their largest number: seven digits are written.
ROUNDING = 1e-5


def regions_of(manifest: Manifest) -> Iterator[tuple[int, Mapping[int, Run], ManifestNode]]:
    """Yield the number, runs and node of each region; leaves of a broken tree that have no runs are left out."""
    return ((number, node.runs, node) for number, node in manifest.regions() if node.runs is not None)


def is_box(bound: Bound) -> bool:
    """Return whether the lowest corner of a bound is not above the highest on any axis."""
    return all(low <= high for low, high in zip(*bound, strict=True))


def violations(manifest: Manifest) -> Iterator[RuleViolation]:
    """Yield the rules that a manifest breaks."""
    yield from _node_violations(manifest)
    yield from _name_violations(manifest)
    yield from run_violations(manifest)
    yield from _count_violations(manifest)
    yield from _level_violations(manifest)
    yield from _union_violations(manifest)
    yield from _error_violations(manifest)


def file_violations(manifest: Manifest, files: Mapping[str, Chunk | str]) -> Iterator[RuleViolation]:
    """Yield the rules that chunk files break, by the header of each, or why it cannot be read."""
    ends = [0] * len(manifest.filenames)
    for _, runs, _ in regions_of(manifest):
        for run in runs.values():
            ends[run.file] = max(ends[run.file], run.offset + run.count)
    first: Chunk | None = None
    for name, end in zip(manifest.filenames, ends, strict=True):
        found = files.get(name)
        if isinstance(found, str):
            yield broken("chunk-files", found)
        elif found is not None:
            yield from _about(found)
            if end and found.count != end:
                text = f"{quoted_value(name)} has {count_of(found.count, 'splat')}, but its runs end at {end:,}"
                yield broken("runs", text)
            first = first or found
            if (found.sh_degree, found.antialiased) != (first.sh_degree, first.antialiased):
                text = f"{quoted_value(name)} has {_kind_of(found)}; the first chunk file has {_kind_of(first)}"
                yield broken("kind", text)
    environment = None if manifest.environment is None else files.get(manifest.environment)
    if isinstance(environment, str):
        yield broken("environment", environment)
    elif environment is not None:
        yield from _about(environment)


def _about(file: Chunk) -> Iterator[RuleViolation]:
    """Yield the notes on a chunk file that are findings, as violations."""
    for note in file.notes:
        if (code := code_of(note)) is not None:
            yield RuleViolation(code, f"{quoted_value(file.name)}: {note}", fatal=False)


def _kind_of(file: Chunk) -> str:
    return f"SH degree {file.sh_degree} and {'' if file.antialiased else 'no '}antialias"


def _node_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    for number, node in enumerate(manifest.nodes):
        if len(node.children) not in (0, 2) or bool(node.children) == (node.runs is not None):
            having = f"{count_of(len(node.children), 'child', 'children')} and {'no ' * (node.runs is None)}lods"
            yield broken("nodes", f"{manifest.place(number)} has {having}; a node has two children or lods")
        if node.bound is None:
            yield broken("bounds", f"{manifest.place(number)} has no bound of six numbers that are finite in float32")
        elif not is_box(node.bound):
            text = f"the bound of {manifest.place(number)} is {_text(node.bound)}, the wrong way round"
            yield broken("bounds", text, fatal=False)


def _name_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    for name, times in Counter(manifest.filenames).items():
        if leads_away(name):
            text = f"filenames has {quoted_value(name)}, which is not a file below the folder of the manifest"
            yield broken("filenames", text)
        if times > 1:
            yield broken("filenames", f"filenames has {quoted_value(name)} {times:,} times")
    if manifest.environment is not None and leads_away(manifest.environment):
        text = f"environment is {quoted_value(manifest.environment)}, which is not below the folder of the manifest"
        yield broken("environment", text)


def run_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    """Yield the chunk files whose runs are of several levels, or do not lie end to end."""
    by_file: list[list[tuple[int, int, int, int]]] = [[] for _ in manifest.filenames]
    for number, held, _ in regions_of(manifest):
        for level, run in held.items():
            if run.count:
                by_file[run.file].append((run.offset, run.count, level, number))
    for name, runs in zip(manifest.filenames, by_file, strict=True):
        if not runs:
            yield broken("unused", f"no region refers to {quoted_value(name)}")
        levels = sorted({level for _, _, level, _ in runs})
        if len(levels) > 1:
            yield broken("mixed", f"{quoted_value(name)} has runs of the levels {', '.join(map(str, levels))}")
        at = 0
        for offset, count, level, number in sorted(runs):
            if offset != at:
                where = f"{manifest.place(number)}.lods.{level} begins at splat {offset:,} of {quoted_value(name)}"
                yield broken("runs", f"{where}, but the run before it ends at {at:,}")
            at = max(at, offset + count)


def _count_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    missing = [name for name in ("version", "count", "counts") if manifest.head.get(name) is None]
    if missing:
        yield broken("old", f"it has no {', '.join(missing)}, as before version 1")
    held = [0] * manifest.levels
    for _, runs, _ in regions_of(manifest):
        for level, run in runs.items():
            held[level] += run.count
    for key, actual, text in (
        ("counts", held, f"{quoted_value(held)} splats"),
        ("count", sum(held), count_of(sum(held), "splat")),
    ):
        given = manifest.head.get(key)
        if given is not None and given != actual:
            yield broken("counts", f"{key} is {quoted_value(given)}, but the runs have {text}")
    for level, (finer, coarser) in enumerate(itertools.pairwise(held), 1):
        if coarser >= finer:
            yield broken(
                "decreasing", f"level {level} has {count_of(coarser, 'splat')}, level {level - 1} has {finer:,}"
            )


def _level_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    for number, runs, _ in regions_of(manifest):
        held = {level for level, run in runs.items() if run.count}
        for rule, level in (("full-detail", 0), ("coarsest", manifest.levels - 1)):
            if level not in held:
                yield broken(rule, f"{manifest.place(number)} has no splats at level {level}")


def _union_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    for number, node in enumerate(manifest.nodes):
        below = [bound for child in node.children if (bound := manifest.nodes[child].bound) is not None]
        if node.bound is None or not below or len(below) != len(node.children) or not all(map(is_box, below)):
            continue
        low = [min(bound[0][axis] for bound in below) for axis in range(3)]
        high = [max(bound[1][axis] for bound in below) for axis in range(3)]
        size = max(map(abs, (*low, *high)))
        given = (*node.bound[0], *node.bound[1])
        if any(abs(a - b) > ROUNDING * size for a, b in zip(given, (*low, *high), strict=True)):
            text = f"the bound of {manifest.place(number)} is {_text(node.bound)}"
            yield broken("union", f"{text}, but that of its children is {_text((low, high))}")


def _text(bound: Sequence[Sequence[float]]) -> str:
    return " to ".join(" ".join(f"{x:.7g}" for x in corner) for corner in bound)


def _error_violations(manifest: Manifest) -> Iterator[RuleViolation]:
    regions = list(regions_of(manifest))
    for number, runs, node in regions:
        if node.errors is not None and (wrong := _wrong_errors(node.errors, runs, manifest.levels)) is not None:
            text, fatal = wrong
            place = f"{manifest.place(number)}.errors is {quoted_value(node.errors)}"
            yield broken("errors", f"{place}, {text}", fatal=fatal)
    having = sum(node.errors is not None for _, _, node in regions)
    says = manifest.head.get("lodErrors")
    if 0 < having < len(regions):
        yield broken("lod-errors", f"{having:,} of {count_of(len(regions), 'region')} have errors")
    elif bool(having) != bool(says):
        text = f"lodErrors is {quoted_value(says)}, but {'all' if having else 'no'} regions have errors"
        yield broken("lod-errors", text)


def _wrong_errors(errors: Any, runs: Mapping[int, Run], levels: int) -> tuple[str, bool] | None:
    """Return what is wrong with the errors of a region, and whether it is fatal; ignores levels without splats."""
    if not isinstance(errors, list) or len(errors) != levels:
        return f"not one for each of {count_of(levels, 'level')}", True
    if not all(type(each) in (int, float) and math.isfinite(each) and each >= 0 for each in errors):
        return "not finite numbers from 0 on", True
    if errors[0]:
        return "not 0 at level 0", False
    held = [errors[level] for level, run in sorted(runs.items()) if run.count]
    return ("which decrease", False) if held != sorted(held) else None


#: Cells along each axis by which the order of a run is checked; writers sort by as many, or by more.
CELLS = 1 << 10

#: Share of a run's splats that may be out of order, since codes move centres into the next cell: files of
#: splat-transform have up to 0.009, random orders 0.5; and the largest number that is not reported.
OUT_OF_ORDER, FEW = 0.05, 16


def chunk_files(open_companion: OpenCompanion | None) -> SceneFiles:
    """Return the SOG scenes that a manifest names."""
    return SceneFiles(
        open_companion, MANIFEST, "streamed-sog.chunk-files", lambda name, source: sog.open_content(source)
    )


def files_of_chunk(open_companion: OpenCompanion, name: str) -> list[str]:
    """Return the files of a chunk: its meta.json and images, or the one bundled file; `FormatError` if unreadable."""
    with open_companion(name) as file:
        data = file.read(MAX_META + 1)
    if data.startswith(ZIP):
        return [name]
    return [name, *(posixpath.join(posixpath.dirname(name), image) for image in image_names(parse_meta(data)))]


def scan_files(
    file: BinaryIO, open_companion: OpenCompanion
) -> tuple[Manifest, dict[str, Chunk | str], list[RuleViolation]]:
    """Read a manifest and the headers of its files; `FormatError` if the manifest cannot be parsed.

    Returns:
        the manifest; the header of each file by name, or why it cannot be read; and the rules that they break.
    """
    manifest = parse(file.read(MAX_MANIFEST + 1))
    found, beside = list(violations(manifest)), chunk_files(open_companion)
    files: dict[str, Chunk | str] = {}
    for name in manifest.names():
        if leads_away(name):
            continue  # a violation says so
        try:
            files[name] = beside.open(name)
        except FormatError as error:
            files[name] = str(error)
    return manifest, files, [*found, *file_violations(manifest, files)]


def scan_splats(
    open_companion: OpenCompanion,
    manifest: Manifest,
    chunks: Mapping[str, Chunk],
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> Iterator[RuleViolation]:
    """Yield the rules that the splats of chunk files break, see `SceneFiles.violations`."""
    runs: dict[str, list[tuple[int, int, Run]]] = {name: [] for name in manifest.filenames}
    for number, held, _ in regions_of(manifest):
        for level, run in held.items():
            runs[manifest.filenames[run.file]].append((number, level, run))

    def broken_by(chunk: Chunk, splats: Splats) -> Iterator[RuleViolation]:
        here = runs[chunk.name]
        # The report on the scene, which is level 0, checks the splats of that level itself.
        if any(level for _, level, _ in here) and (unusable := not_finite(chunk, splats)) is not None:
            yield unusable
            return
        steps = np.ptp(sog_images.sign_log(splats.center), axis=0) / sog_images.LAST_WORD if len(splats) else 0.0
        for number, level, run in here:
            part = splats.take(slice(run.offset, run.offset + run.count))
            subject = f"{manifest.place(number)} at level {level}"
            bound = manifest.nodes[number].bound
            outside = count_outside(part, np.array(bound), steps) if bound is not None and is_box(bound) else 0
            if outside:
                yield broken("extents", f"{count_of(outside, 'splat')} of {subject} lie outside of its bound")
            descents = _descents(part.center)
            if descents > max(FEW, OUT_OF_ORDER * run.count):
                text = f"{descents:,} of {count_of(run.count, 'splat')} of {subject} come after one that they precede"
                yield broken("order", text)

    named = [chunks[name] for name in manifest.filenames if name in chunks]
    return chunk_files(open_companion).violations(named, broken_by, threads, progress)


def _descents(center: FloatArray) -> int:
    """Return the number of splats whose predecessor comes after them on the Morton curve."""
    wide = center.astype(np.float64)
    low, extent = wide.min(axis=0, initial=np.inf), np.ptp(wide, axis=0) if len(wide) else 0
    scaled = (wide - low) / np.where(extent > 0, extent, 1) * CELLS
    order = order_of_cells(np.minimum(scaled, CELLS - 1).astype(np.uint32))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return int(np.count_nonzero(np.diff(rank) < 0))
