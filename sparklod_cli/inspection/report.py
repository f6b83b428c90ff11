"""Reports on splat files (contents, statistics, findings), and expectations, which are assertions about reports."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Collection, Sequence
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
from ..model.scene import Scene
from ..model.sh import width_of
from ..model.splats import COLUMNS, Splats
from ..system.errors import FormatError, SparklodError
from ..system.progress import Progress, silent
from ..system.untrusted import QUOTED, near, printable, quoted
from ..tables.assertions import Assertion, BadAssertionError, is_number, number_text, parse_assertion
from ..tables.columns import Row
from . import headers, tree, values
from .blocks import Block, ReportBlocks, chunk_row, chunk_table, merged
from .findings import Finding
from .headers import Head, HeaderScan

#: Version of the report: counts up when a field changes its meaning or is removed. schema.json describes this one.
SCHEMA_VERSION = 1

#: Columns of `Splats` that a report without statistics, findings and chunks is computed from, those that all others
#: need of a file whose codes cannot be invalid, and what --stats needs besides.
OF_TREE, OF_VALUES, OF_STATISTICS = {"scale", "opacity"}, {"center", "scale", "opacity"}, {"rgb", "sh"}

#: Fields for which the headers of a RAD file, or of the files of a Streamed SOG or 3D Tiles, are enough.
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
        all_quantities: all of their quantities, instead of the main ones.
        headers_only: read no more than headers where a format has those; tree and values are left out.
        at_once: have the whole scene in memory, with all columns, for callers that draw it; False reads RAD files chunk
            by chunk; None does so with large ones, see `rad_reader.fits`.
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

    Attributes:
        file: path, as it was given.
        bytes: size on disk; of a file that names others, that of all files together.
        format: name for display; None if the file could not be read.
        splats: number of splats, or nodes of a tree.
        sh_degree, antialiased: of the splats.
        up: the axis that points up: "y", "-z"; None where it is unknown.
        up_by: the format whose specification says so; empty if the file itself does, or if unknown.
        header: fields of the header, which depend on the format.
        bytes_per_splat: size over splats.
        compression_ratio: size of the decoded splats, as 4-byte floats, over that of the file.
        notes: data that the reader left out.
        hints: settings of viewers that suit the file; none unless it was checked.
        rad: facts from the headers of a RAD file; None for other formats.
        streamed_sog: facts from the manifest of a Streamed SOG; None for other formats.
        tiles: facts from the tilesets and headers of 3D Tiles; None for other formats.
        tree: facts of the Level-of-Detail tree; None without one.
        values: statistics of the splats; None if not requested.
        chunks: a row for each chunk, see `blocks.CHUNK_COLUMNS`; None if not requested.
        findings: None if not requested, unless the file could not be read.
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
        """Whether it has a finding of this severity, or an error."""
        return any(found.severity in ("error", severity) for found in self.findings or [])

    def value_at(self, name: str) -> Any:
        """Return the value of a field, see `value_at`."""
        return value_at(self.as_dict(), name)

    def as_dict(self) -> dict[str, Any]:
        plain = {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(self)
        if self.findings is not None:
            plain["findings"] = [{"severity": found.severity} | dataclasses.asdict(found) for found in self.findings]
        return plain


def value_at(plain: dict[str, Any], name: str) -> Any:
    """Return the value of a field of a report as JSON: keys and indices with dots between ("tree.levels.0.nodes")."""
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
    """Return the report on a file, or on the folder of an unpacked SOG, and its scene if it was read.

    A file that cannot be read gives a finding, not an error, and None for the scene. Unless the scene is wanted as a
    whole (`ReportSettings.at_once`), it is None of RAD files that are read chunk by chunk and of SPZ files.
    """
    columns = set(COLUMNS) if settings.values or settings.check or settings.chunks else OF_TREE
    size, unread, surveyed = size_of_input(path), set[str](), None
    try:
        held = read_arrays(path)
        if held is not None:
            fields, scene_of_arrays = _of_arrays(held, settings, threads=threads)
            each = round(size / fields["splats"], 3) if size and fields["splats"] else None
            return Report(str(path), size, bytes_per_splat=each, **fields), scene_of_arrays
        surveyed = _surveyed(path, settings.check, threads, progress)
        if surveyed is not None and surveyed.facts is None:
            return Report(str(path), size, findings=surveyed.findings if settings.check else surveyed.fatal), None
        if surveyed is not None and settings.headers_only:
            return _report(path, surveyed.head, surveyed), None
        if surveyed is not None and surveyed.field == "rad" and settings.at_once is not True:
            with opened(path) as (source, _):
                rad = RadReader.open(source.file, source.open_companion)
            if settings.at_once is False or not fits(rad.header):
                blocks = ReportBlocks.of_file(path, rad, threads=threads, progress=progress)
                return _of_blocks(path, blocks, columns, size, settings, surveyed, threads), None
        if surveyed is None and settings.at_once is not True and not settings.check:
            # Only SPZ files are read by columns. None of their codes is invalid but positions of version 1.
            needed = OF_VALUES | (OF_STATISTICS if settings.values and settings.all_quantities else set())
            unread, columns = columns - needed, columns & needed
        scene = read_scene(path, columns=columns, threads=threads, progress=progress, validate=False)
    except FormatError as error:
        found = surveyed.findings if surveyed is not None and settings.check else []
        known = any(each.code == error.code for each in found)
        return Report(str(path), size, findings=[*found, *([] if known else [Finding(error.code, str(error))])]), None
    partial = surveyed is None and settings.at_once is not True and "fractional_bits" in scene.header
    blocks = ReportBlocks.of(scene, unread if partial else ())
    return _of_blocks(path, blocks, columns, size, settings, surveyed, threads), None if partial else scene


def _surveyed(path: Path, check: bool, threads: int, progress: Progress) -> HeaderScan | None:
    """Return facts and findings from the headers of a file; None for formats of one part."""
    with opened(path) as (source, form):
        if form.name != RAD and form.parts is None:
            return None
        assert source.open_companion is not None
        if form.parts is None:
            return headers.survey_rad(source.file, source.open_companion, check=check)
        survey = {"levels": headers.survey_streamed_sog, "tiles": headers.survey_tiles}[form.parts]
        return survey(source.file, source.open_companion, check=check, threads=threads, progress=progress)


def _of_blocks(
    path: Path,
    blocks: ReportBlocks,
    columns: Collection[str],
    size: int | None,
    settings: ReportSettings,
    surveyed: HeaderScan | None,
    threads: int,
) -> Report:
    about = blocks.about
    degree = about.splats.sh_degree
    ends, size = values.ends_of(about.header), about.header.get("bytes", size)
    findings = _container_findings(about)
    if surveyed is not None:
        of_files = {each.code for each in surveyed.findings}  # which say in which file
        findings = [each for each in findings if each.code not in of_files] + surveyed.findings
        size = surveyed.facts.bytes
    if surveyed is not None and surveyed.field == "rad":
        ends = headers.ends_of_rad(surveyed.facts)
    nodes = tree.TreeColumns.of(blocks) if blocks.is_tree and blocks.count else None

    def examined(block: Block) -> tuple[Any, Any, Any]:
        return (
            None if nodes is None else nodes.add(block),
            values.ValueTally.of(block, ends, layouts=settings.check) if settings.values or settings.check else None,
            chunk_row(block) if settings.chunks else None,
        )

    opaque, tallies, rows = zip(*blocks.map(examined, columns, threads), strict=True) if blocks.count else ((), (), ())
    statistics = facts = table = None
    hints: list[str] = []
    if settings.values:
        total = values.ValueTally.total(tallies)
        statistics = values.statistics_of(blocks, total, all_quantities=settings.all_quantities, threads=threads)
    if settings.chunks:
        table = chunk_table(rows, about.chunk_bytes, None if nodes is None else (nodes.tree, nodes.size))
    if nodes is not None:
        facts, found = tree.examine_blocks(
            blocks,
            nodes,
            merged(opaque),
            check=settings.check,
            scale_ends=ends.scale,
            in_chunks=surveyed is not None and surveyed.field == "rad",
            threads=threads,
        )
        findings += found
    if settings.check:
        total = values.ValueTally.total(tallies)
        findings += values.findings_about(total, ends, is_tree=blocks.is_tree)
        hints = values.hints_about(total.layouts, degree)
    head = Head(about.format, size or 0, blocks.count, degree, about.antialiased, about.up, about.up_by)
    report = _report(path, head, surveyed)
    return dataclasses.replace(
        report,
        bytes=size,
        header=dict(about.header),
        notes=list(about.notes),
        hints=hints,
        tree=facts,
        values=statistics,
        chunks=table,
        findings=findings if settings.check else None,
    )


def _report(path: Path, head: Head | None, surveyed: HeaderScan | None) -> Report:
    assert head is not None
    size, count = head.bytes, head.splats
    decoded = 4 * count * width_of(head.sh_degree)
    return Report(
        str(path),
        **dataclasses.asdict(head),
        bytes_per_splat=round(size / count, 3) if size and count else None,
        compression_ratio=round(decoded / size, 3) if size else None,
        **({} if surveyed is None else {surveyed.field: surveyed.facts}),
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
    arrays: layouts.Arrays, settings: ReportSettings, *, threads: int = 1
) -> tuple[dict[str, Any], Scene | None]:
    """Return the fields of a report on the arrays of one of `codecs.formats.ENCODINGS`, and the splats if complete."""
    fields: dict[str, Any] = {"sh_degree": 0, "antialiased": False, "findings": []}
    scene: Scene | None = None
    if "packed" in arrays or "ext0" in arrays:
        if "packed" in arrays:
            # build-lod writes trees, for which Spark stores LoD opacities; the file does not record that.
            splats = layouts.unpack_packed(arrays, SplatEncoding(lod_opacity=True), threads=threads)
            scene = Scene(splats, format="NPZ of PackedSplats")
        else:
            splats = layouts.unpack_ext(arrays, threads=threads)
            scene = Scene(splats, format="NPZ of ExtSplats")
        form, count, note, fields["sh_degree"] = scene.format, len(splats), NO_CHILDREN, splats.sh_degree
        if settings.values:
            fields["values"] = values.examine(splats, all_quantities=settings.all_quantities)
        if settings.check:  # merged splats have opacities above 1
            opaque = dataclasses.replace(splats, opacity=np.minimum(splats.opacity, np.float32(1)))
            fields["findings"] = values.check(Scene(opaque))
    elif "lod_tree" in arrays:
        nodes = layouts.unpack_nodes(arrays)
        form, count = "NPZ of LodTree", len(nodes.tree)
        note = "it has centres, sizes and children of nodes, but no opacities, colours and shapes"
        if count:
            # Opaque balls of the sizes of the nodes, whose scales and opacities are not stored.
            balls = Splats.zeros(count, 0)
            balls.scale[:] = nodes.size[:, None] / 2
            balls.opacity[:] = 1
            facts, fields["findings"] = tree.examine(balls, nodes.tree, check=settings.check)
            fields["tree"] = dataclasses.replace(facts, more_than_opaque=None)
        else:
            fields["findings"] = [Finding("values.empty", "there are no splats")]
    elif "texture" in arrays:
        capacity = layouts.texture_capacity(arrays)
        used = np.flatnonzero(np.ascontiguousarray(arrays["texture"]).reshape(capacity, 8).any(axis=1))
        form, count = "NPZ of a data texture", int(used[-1]) + 1 if len(used) else 0
        note = "it has centres, covariances and colours of nodes, but no opacities above 1, SH and children"
    else:
        raise FormatError(f"its arrays ({', '.join(arrays)}) match no layout that convert writes")
    fields |= {"format": form, "splats": count, "notes": [note]}
    return fields | ({} if settings.check else {"findings": None}), scene


class ExpectationError(SparklodError):
    """A file of expectations cannot be understood."""


#: Short names for values of a report, besides its fields.
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

#: Formats that have the names which are not about a tree.
NAMED_FORMATS = dict.fromkeys(("chunk_bytes", "first_bytes"), "RAD, Streamed SOG or 3D Tiles")
NAMED_FORMATS["tiles"] = "3D Tiles"
NAMED_FORMATS |= dict.fromkeys(("chunked", "palette"), "RAD") | dict.fromkeys(("levels", "regions"), "Streamed SOG")

#: Codes of findings by name; all other names have expect.value.
EXPECTATION_CODES = {
    "bytes": "expect.bytes",
    "leaves": "expect.splats",
    "sh": "expect.sh",
    "lod": "expect.lod",
    "growth": "expect.growth",
}

#: Beginnings of the lines that replace the keys of files of expectations in TOML and JSON, which are no longer read.
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
    """Return an assertion about a report; `BadAssertionError` if it names nothing that a report has."""
    assertion = parse_assertion(text, example="nodes<=5M")
    known = [*SHORT_NAMES, *(each.name for each in fields(Report))]
    if assertion.name.partition(".")[0] not in known:
        name = printable(assertion.name, QUOTED)
        raise BadAssertionError(f"{text!r}: there is no {name!r} in a report{near(assertion.name, known)}")
    return assertion


def read_expectations(path: Path) -> list[Assertion]:
    """Return the assertions in a text file, one a line; blank lines and lines that begin with # are left out.

    Raises:
        ExpectationError: a line is not an assertion about a report; for a file in TOML or JSON, with its new lines.
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
                raise ExpectationError(f"{path}, line {number}: {quoted(error)}") from None
            lines = [REPLACED_KEYS[key] + value.replace("_", "") for key, value in OLD_KEY.findall(text)]
            raise ExpectationError(
                f"{path} has expectations as TOML or JSON, which are no longer read; write assertions, one a line: "
                + printable(", ".join([*lines, "NAME==VALUE, NAME>=MIN and NAME<=MAX for values"]), 2 * QUOTED)
            ) from None
    return found


def check_expectations(report: Report, expected: Sequence[Assertion]) -> list[Finding]:
    """Return findings for the assertions that do not hold; none for a file that could not be read."""
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
