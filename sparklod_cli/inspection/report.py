"""Reports on splat files (contents, statistics, findings), and expectations, which are assertions about reports."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..codecs import layouts
from ..codecs.formats import RAD
from ..codecs.rad.rad_reader import RadReader, fits
from ..codecs.reader import code_of
from ..codecs.spark_codings import SplatEncoding
from ..codecs.spz import KNOWN_FLAGS
from ..io.files import opened, read_arrays, read_text, size_of_input
from ..io.reading import read_scene
from ..lod.kernels.tree_links import find_depths, find_parents
from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.sh import width_of
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.errors import FormatError, SparklodError
from ..system.progress import Progress, silent
from ..system.untrusted import QUOTED, near, printable, quoted
from ..tables.assertions import Assertion, BadAssertionError, is_number, number_text, parse_assertion
from ..tables.columns import Cell, Column, Row
from . import headers, tree, values
from .findings import Block, Finding, ReportBlocks, findings_of, merged
from .headers import HeaderScan

CHUNK_COLUMNS = (
    Column("chunk", int, "", "", "number of the chunk, from 0"),
    Column("base", int, "", "", "index of its first splat"),
    Column("splats", int, "", "splats", "splats; nodes in a tree"),
    Column("leaves", int, "", "splats", "leaves among them; empty without a tree"),
    Column("bytes", int, "", "bytes", "size in the file; empty in formats without chunks"),
    *(
        Column(f"{end}_{axis}", float, ".6g", "world units", f"{what} {axis} of the centres")
        for end, what in (("min", "lowest"), ("max", "highest"))
        for axis in "xyz"
    ),
    Column("extent", float, ".6g", "world units", "diagonal of the box of the centres"),
    Column("size_min", float, ".6g", "world units", "smallest feature size"),
    Column("size_max", float, ".6g", "world units", "largest feature size"),
    Column("depth_min", int, "", "", "smallest depth of a node; empty without a tree"),
    Column("depth_max", int, "", "", "largest depth of a node; empty without a tree"),
    Column("parent_chunks", int, "", "", "other chunks that hold parents of its nodes; empty without a tree"),
)

#: Columns of the printed table, with their headings and widths, 80 characters in all.
SHOWN_COLUMNS = {
    "chunk": ("chunk", 6),
    "splats": ("splats", 8),
    "leaves": ("leaves", 8),
    "bytes": ("bytes", 11),
    "extent": ("extent", 9),
    "size_min": ("size", 10),
    "size_max": ("to", 10),
    "depth_min": ("depth", 6),
    "depth_max": ("to", 4),
    "parent_chunks": ("parents", 8),
}


def chunk_row(block: Block) -> dict[str, Any]:
    """Return the row of a block with center, scale and opacity, for `chunk_table` to complete."""
    center, size = block.splats.center, spark_size(block.splats)
    low, high = center.min(axis=0), center.max(axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        extent = np.linalg.norm(high.astype(np.float64) - low)
    numbers = dict(zip(("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"), (*low, *high), strict=True))
    numbers |= {"extent": extent, "size_min": size.min(), "size_max": size.max()}
    row: dict[str, Any] = dict.fromkeys(column.name for column in CHUNK_COLUMNS)
    row |= {"base": block.start, "splats": len(center)}
    row["leaves"] = None if block.tree is None else int(np.count_nonzero(block.tree.is_leaf))
    return row | {name: float(value) for name, value in numbers.items() if np.isfinite(value)}


def chunk_table(
    rows: Sequence[dict[str, Any]], chunk_bytes: Sequence[int] | None, nodes: tuple[LodTree, FloatArray] | None
) -> list[Row]:
    """Complete the rows of all chunks, see `chunk_row`.

    Args:
        chunk_bytes: sizes in the file; None for formats without chunks.
        nodes: the tree and its (N,) feature sizes.
    """
    if nodes is not None:
        tree, size = nodes
        depth, _ = find_depths(tree.child_count, tree.child_start, size)
        parent, _ = find_parents(tree.child_count, tree.child_start)
    for chunk, row in enumerate(rows):
        row["chunk"], row["bytes"] = chunk, None if chunk_bytes is None else chunk_bytes[chunk]
        if nodes is not None:
            part = slice(row["base"], row["base"] + row["splats"])
            chunks = np.unique(parent[part][parent[part] >= 0] // rows[0]["splats"])
            row["parent_chunks"] = int(np.count_nonzero(chunks != chunk))
            row["depth_min"], row["depth_max"] = (int(max(end, 0)) for end in (depth[part].min(), depth[part].max()))
    return [{column.name: column.rounded(row[column.name]) for column in CHUNK_COLUMNS} for row in rows]


def chunk_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the printed table, without empty columns."""
    shown = {name: column for name, column in SHOWN_COLUMNS.items() if any(row[name] is not None for row in rows)}
    yield "".join(f"{heading:>{width}}" for heading, width in shown.values())
    for row in rows:
        yield "".join(f"{_text(row[name]):>{width}}" for name, (_, width) in shown.items())


def _text(value: Cell) -> str:
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value


#: Version of the report: counts up when a field changes its meaning or is removed. schema.json describes this one.
SCHEMA_VERSION = 1

#: Columns of `Splats` needed by all reports on a tree, by reports with statistics, findings or chunks on a file whose
#: codes cannot be invalid, and, additionally, by --stats.
OF_TREE, OF_VALUES, OF_STATISTICS = {"scale", "opacity"}, {"center", "scale", "opacity"}, {"rgb", "sh"}

#: Fields that headers alone provide, for RAD, Streamed SOG and 3D Tiles.
HEADER_FIELDS = (
    *("file", "bytes", "format", "splats", "sh_degree", "bytes_per_splat", "compression_ratio", "rad", "streamed_sog"),
    "tiles",
)


class NoFieldError(SparklodError):
    """A report has no such field."""


@dataclass(frozen=True)
class ReportSettings:
    """Contents of a report besides the header and the tree.

    Attributes:
        all_quantities: with `values`, all of their quantities, instead of the main ones.
        headers_only: of formats with several parts, read headers only; tree and values are left out.
        at_once: read the whole scene, with all columns, so that it can be drawn; False reads RAD files chunk by chunk;
            None does so with large ones, see `rad_reader.fits`.
    """

    chunks: bool = False
    headers_only: bool = False
    values: bool = False
    all_quantities: bool = False
    check: bool = False
    at_once: bool | None = None


@dataclass(frozen=True)
class Report:
    """The report on a file. `--json` prints `as_dict`, which `schema.json` describes.

    Fields that were not requested, or that its format does not have, are None; so are all but `file`, `bytes` and
    `findings` of a file that could not be read.
    """

    file: str
    bytes: int | None
    format: str | None = None
    splats: int | None = None
    sh_degree: int | None = None
    antialiased: bool | None = None
    up: str | None = None
    up_by: str = ""
    header: dict[str, int] = dataclasses.field(default_factory=dict)
    bytes_per_splat: float | None = None
    compression_ratio: float | None = None
    notes: list[str] = dataclasses.field(default_factory=list)
    hints: list[str] = dataclasses.field(default_factory=list)
    rad: headers.RadFacts | None = None
    streamed_sog: headers.StreamedSogFacts | None = None
    tiles: headers.TileFacts | None = None
    tree: tree.TreeFacts | None = None
    values: values.ValueFacts | None = None
    chunks: list[Row] | None = None
    findings: list[Finding] | None = None

    def fails(self, severity: str) -> bool:
        """Return whether there is an error or a finding of this severity."""
        return any(found.severity in ("error", severity) for found in self.findings or [])

    def value_at(self, name: str) -> Any:
        """Return the value of a field by its name, see the function `value_at`."""
        return value_at(self.as_dict(), name)

    def as_dict(self) -> dict[str, Any]:
        plain = {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(self)
        if self.findings is not None:
            plain["findings"] = [{"severity": found.severity} | dataclasses.asdict(found) for found in self.findings]
        return plain


def value_at(plain: dict[str, Any], name: str) -> Any:
    """Return the value of a field of a JSON report by its name, such as "tree.levels.0.nodes"."""
    value: Any = plain
    try:
        for key in name.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
    except (KeyError, IndexError, TypeError, ValueError):
        raise NoFieldError(f"the report has no {printable(name, QUOTED)}") from None
    return value


def inspect(
    path: Path, settings: ReportSettings, *, threads: int = 1, progress: Progress = silent
) -> tuple[Report, Scene | None]:
    """Report on a file, or on the folder of an unpacked SOG; also return its scene.

    A file that cannot be read gives a finding, not an error. The scene is None then, and without
    `ReportSettings.at_once` also for RAD files that are read chunk by chunk and for SPZ files.
    """
    columns = set(COLUMNS) if settings.values or settings.check or settings.chunks else OF_TREE
    size, unread, surveyed = size_of_input(path), set[str](), None
    try:
        held = read_arrays(path)
        if held is not None:
            return _of_arrays(path, held, settings, size, threads)
        surveyed = _surveyed(path, settings.check, threads, progress)
        fields = None if surveyed is None else surveyed.fields
        if surveyed is not None and fields is None:
            broken = [each for each in surveyed.violations if settings.check or each.fatal]
            return Report(str(path), size, findings=findings_of(broken)), None
        if fields is not None and settings.headers_only:
            return _report(path, fields), None
        if fields is not None and "rad" in fields and settings.at_once is not True:
            with opened(path) as (source, _):
                rad = RadReader.open(source.file, source.open_companion)
            if settings.at_once is False or not fits(rad.header):
                blocks = ReportBlocks.of_file(path, rad, threads=threads, progress=progress)
                return report_on(path, blocks, settings, columns, size, surveyed, threads), None
        if surveyed is None and settings.at_once is not True and not settings.check:
            # Only SPZ files are read by columns. None of their codes is invalid but positions of version 1.
            needed = OF_VALUES | (OF_STATISTICS if settings.values and settings.all_quantities else set())
            unread, columns = columns - needed, columns & needed
        scene = read_scene(path, columns=columns, threads=threads, progress=progress, validate=False)
    except FormatError as error:
        found = findings_of(surveyed.violations) if surveyed is not None and settings.check else []
        known = any(each.code == error.code for each in found)
        return Report(str(path), size, findings=[*found, *([] if known else [Finding(error.code, str(error))])]), None
    partial = surveyed is None and settings.at_once is not True and "fractional_bits" in scene.header
    blocks = ReportBlocks.of(scene, unread if partial else ())
    return report_on(path, blocks, settings, columns, size, surveyed, threads), None if partial else scene


def _surveyed(path: Path, check: bool, threads: int, progress: Progress) -> HeaderScan | None:
    """Scan the headers of a file; None for formats of one part."""
    with opened(path) as (source, form):
        if form.name != RAD and form.parts is None:
            return None
        assert source.open_companion is not None
        if form.parts is None:
            return headers.survey_rad(source.file, source.open_companion, check=check)
        survey = {"levels": headers.survey_streamed_sog, "tiles": headers.survey_tiles}[form.parts]
        return survey(source.file, source.open_companion, check=check, threads=threads, progress=progress)


def report_on(
    path: Path,
    blocks: ReportBlocks,
    settings: ReportSettings,
    columns: Collection[str] = COLUMNS,
    size: int | None = None,
    surveyed: HeaderScan | None = None,
    threads: int = 1,
) -> Report:
    """Report on the splats of a file of `size` bytes, reading these columns of all blocks."""
    about = blocks.about
    ends, findings = values.ends_of(about.header), _container_findings(about)
    fields: dict[str, Any] = {"bytes": about.header.get("bytes", size)}
    if surveyed is not None:
        assert surveyed.fields is not None
        broken, fields = findings_of(surveyed.violations), dict(surveyed.fields)
        findings = [each for each in findings if each.code not in {other.code for other in broken}] + broken
    in_chunks = "rad" in fields
    if in_chunks:
        ends = headers.ends_of_rad(fields["rad"])
    nodes = tree.TreeColumns.of(blocks) if blocks.is_tree and blocks.count else None

    def examined(block: Block) -> tuple[Any, Any, Any]:
        return (
            None if nodes is None else nodes.add(block),
            values.ValueTally.of(block, ends, layouts=settings.check) if settings.values or settings.check else None,
            chunk_row(block) if settings.chunks else None,
        )

    opaque, tallies, rows = zip(*blocks.map(examined, columns, threads), strict=True) if blocks.count else ((), (), ())
    found: dict[str, Any] = {}
    if settings.chunks:
        found["chunks"] = chunk_table(rows, about.chunk_bytes, None if nodes is None else (nodes.tree, nodes.size))
    if nodes is not None:
        found["tree"], of_tree = tree.examine(
            blocks,
            nodes,
            merged(opaque),
            check=settings.check,
            scale_ends=ends.scale,
            in_chunks=in_chunks,
            threads=threads,
        )
        findings += of_tree
    if settings.values or settings.check:
        total = values.ValueTally.total(tallies)
    if settings.values:
        quantities = settings.all_quantities
        found["values"] = values.statistics_of(blocks, total, all_quantities=quantities, threads=threads)
    if settings.check:
        merged_splats = blocks.is_tree or NO_CHILDREN in about.notes
        found["findings"] = findings + values.findings_about(total.by_name, ends, merged_splats=merged_splats)
        found["hints"] = values.hints_about(total.layouts, about.splats.sh_degree)
    fields |= {"format": about.format, "splats": blocks.count, "sh_degree": about.splats.sh_degree}
    fields |= {"antialiased": about.antialiased, "up": about.up, "up_by": about.up_by}
    fields |= {"header": dict(about.header), "notes": list(about.notes)}
    return _report(path, fields | found)


def _report(path: Path, fields: Mapping[str, Any]) -> Report:
    """Return a report with these fields and with the size of the file relative to its splats."""
    size, count = fields["bytes"], fields["splats"]
    decoded = 4 * count * width_of(fields["sh_degree"])
    return Report(
        str(path),
        **fields,
        bytes_per_splat=round(size / count, 3) if size and count else None,
        compression_ratio=round(decoded / size, 3) if size else None,
    )


def _container_findings(scene: Scene) -> list[Finding]:
    header = scene.header
    findings = [Finding(code, note) for note in scene.notes if (code := code_of(note)) is not None]
    unknown = header.get("flags", 0) & ~KNOWN_FLAGS
    if unknown:
        findings.append(Finding("container.flags", f"the header sets flags {unknown:#04x}, which have no meaning"))
    if header.get("reserved", 0):
        findings.append(Finding("container.flags", "reserved bytes of the header are not 0"))
    if header.get("trailing_members"):
        findings.append(Finding("container.members", "a second gzip member follows, which Spark does not read"))
    elif header.get("trailing_bytes"):
        findings.append(Finding("container.trailing", f"{header['trailing_bytes']:,} bytes follow the data"))
    return findings


#: The note on arrays with the nodes of a tree but without their children.
NO_CHILDREN = "its splats are the nodes of a tree, but it has no child indices, so leaves cannot be told apart"


def _of_arrays(
    path: Path, arrays: layouts.Arrays, settings: ReportSettings, size: int | None, threads: int
) -> tuple[Report, Scene | None]:
    """Report on the arrays of one of `codecs.formats.ENCODINGS`; also return the splats if they are complete."""
    settings = dataclasses.replace(settings, chunks=False)
    if "packed" in arrays:
        # build-lod writes trees, for which Spark stores LoD opacities; the file does not record that.
        splats = layouts.unpack_packed(arrays, SplatEncoding(lod_opacity=True), threads=threads)
        scene = Scene(splats, format="NPZ of PackedSplats", notes=(NO_CHILDREN,))
    elif "ext0" in arrays:
        scene = Scene(layouts.unpack_ext(arrays, threads=threads), format="NPZ of ExtSplats", notes=(NO_CHILDREN,))
    elif "lod_tree" in arrays:
        nodes = layouts.unpack_nodes(arrays)
        # Opaque balls of the sizes of the nodes, whose scales and opacities are not stored.
        balls = Splats.zeros(len(nodes.tree), 0)
        balls.scale[:], balls.opacity[:], balls.quat_xyzw[:, 3] = nodes.size[:, None] / 2, 1, 1
        note = "it has centres, sizes and children of nodes, but no opacities, colours and shapes"
        scene = Scene(balls, nodes.tree, format="NPZ of LodTree", notes=(note,))
        settings = dataclasses.replace(settings, values=False)
    elif "texture" in arrays:
        capacity = layouts.texture_capacity(arrays)
        used = np.flatnonzero(np.ascontiguousarray(arrays["texture"]).reshape(capacity, 8).any(axis=1))
        note = "it has centres, covariances and colours of nodes, but no opacities above 1, SH and children"
        fields = {"bytes": size, "splats": int(used[-1]) + 1 if len(used) else 0, "sh_degree": 0, "antialiased": False}
        report = _report(path, fields | {"format": "NPZ of a data texture", "notes": [note]})
        return dataclasses.replace(report, compression_ratio=None, findings=[] if settings.check else None), None
    else:
        raise FormatError(f"its arrays ({', '.join(arrays)}) match no layout that convert writes")
    report = report_on(path, ReportBlocks.of(scene), settings, size=size, threads=threads)
    kept = "values." if report.tree is None else "tree."
    findings = None if report.findings is None else [each for each in report.findings if each.code.startswith(kept)]
    facts = None if report.tree is None else dataclasses.replace(report.tree, more_than_opaque=None)
    report = dataclasses.replace(report, compression_ratio=None, hints=[], tree=facts, findings=findings)
    return report, scene if scene.tree is None else None


#: Short names for values of a report, in addition to its fields.
SHORT_NAMES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "nodes": lambda report: report["splats"],
    "leaves": lambda report: report["tree"]["leaves"] if report["tree"] else report["splats"],
    "growth": lambda report: report["tree"]["growth"],
    "depth": lambda report: report["tree"]["depth"],
    "sh": lambda report: report["sh_degree"],
    "lod": lambda report: report["tree"] is not None,
    "chunk_bytes": lambda report: _streamed(report)["chunk_bytes" if report["rad"] else "file_bytes"]["max"],
    "first_bytes": lambda report: _streamed(report)["first_bytes"],
    "chunked": lambda report: report["rad"]["chunked"],
    "palette": lambda report: report["rad"]["palette"],
    "levels": lambda report: len(report["streamed_sog"]["levels"]),
    "regions": lambda report: report["streamed_sog"]["regions"],
    "tiles": lambda report: report["tiles"]["tiles"],
}

#: Formats to which short names apply that are not about a tree.
NAMED_FORMATS = dict.fromkeys(("chunk_bytes", "first_bytes"), "RAD, Streamed SOG or 3D Tiles")
NAMED_FORMATS["tiles"] = "3D Tiles"
NAMED_FORMATS |= dict.fromkeys(("chunked", "palette"), "RAD") | dict.fromkeys(("levels", "regions"), "Streamed SOG")

#: Codes of findings about some names; those about all other names are expect.value.
EXPECTATION_CODES = {
    "bytes": "expect.bytes",
    "leaves": "expect.splats",
    "sh": "expect.sh",
    "lod": "expect.lod",
    "growth": "expect.growth",
}

#: Keys of expectations in TOML and JSON, which are no longer read, and the assertions that replace them.
REPLACED_KEYS = {
    "max_bytes": "bytes<=",
    "min_splats": "leaves>=",
    "max_splats": "leaves<=",
    "sh": "sh==",
    "lod": "lod==",
    "max_growth": "growth<=",
}
OLD_KEY = re.compile(rf"""(?<![.\w])({"|".join(REPLACED_KEYS)})["']?\s*[=:]\s*([\w.]+)""")


def parse_expectation(text: str) -> Assertion:
    """Parse an assertion about a report; raise `BadAssertionError` if no report has a value of its name."""
    assertion = parse_assertion(text, example="nodes<=5M")
    known = [*SHORT_NAMES, *(each.name for each in fields(Report))]
    if assertion.name.partition(".")[0] not in known:
        name = printable(assertion.name, QUOTED)
        raise BadAssertionError(f"{text!r}: there is no {name!r} in a report{near(assertion.name, known)}")
    return assertion


def read_expectations(path: Path) -> list[Assertion]:
    """Read assertions from a text file, one a line; blank lines and lines that begin with # are skipped.

    Raises:
        SparklodError: a line is not an assertion about a report; for TOML or JSON, it suggests the assertions.
    """
    text = read_text(path)
    found = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        try:
            found.append(parse_expectation(line))
        except BadAssertionError as error:
            if path.suffix.lower() not in (".toml", ".json"):
                raise SparklodError(f"{path}, line {number}: {quoted(error)}") from None
            lines = [REPLACED_KEYS[key] + value.replace("_", "") for key, value in OLD_KEY.findall(text)]
            raise SparklodError(
                f"{path} has expectations as TOML or JSON, which are no longer read; write assertions, one a line: "
                + printable(", ".join([*lines, "NAME==VALUE, NAME>=MIN and NAME<=MAX for values"]), 2 * QUOTED)
            ) from None
    return found


def check_expectations(report: Report, expected: Sequence[Assertion]) -> list[Finding]:
    """Return a finding for each assertion that does not hold; none for a file that could not be read."""
    if report.format is None:
        return []
    plain = report.as_dict()
    found = []
    for assertion in expected:
        code, text = EXPECTATION_CODES.get(assertion.name, "expect.value"), printable(assertion.text, QUOTED)
        try:
            value = _value(plain, assertion.name)
        except NoFieldError as error:
            found.append(Finding(code, f"{text}: {error}"))
            continue
        if not assertion.holds(value):
            shown = number_text(value) if is_number(value) else printable(json.dumps(value), QUOTED)
            found.append(Finding(code, f"{text}: {printable(assertion.name, QUOTED)} is {shown}"))
    return found


def _value(plain: dict[str, Any], name: str) -> Any:
    if name not in SHORT_NAMES:
        return value_at(plain, name)
    try:
        return SHORT_NAMES[name](plain)
    except TypeError:
        form = NAMED_FORMATS.get(name)
        raise NoFieldError("the file has no tree" if form is None else f"the file is not {form}") from None


def _streamed(report: dict[str, Any]) -> Any:
    return report["rad"] or report["streamed_sog"] or report["tiles"]
