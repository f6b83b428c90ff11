"""`inspect`, which reports on a splat file: contents, statistics and findings."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ..codecs.spz_layout import KNOWN_FLAGS
from ..io import examine_scene, read_arrays, read_coded, size_of_input
from ..io.rad_file import RadFile
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS
from ..support.errors import FormatError, SparklodError
from ..support.printable import printable
from ..support.progress import Progress, silent
from ..support.untrusted import QUOTED
from ..tables.columns import Row
from . import arrays, chunks, code_values, rad, streamed_sog, tree, tree_findings, value_checks, values
from .blocks import Block, Blocks
from .findings import Finding

#: Version of the report: counts up when a field changes its meaning or is removed. schema.json describes this one.
SCHEMA_VERSION = 1

#: Columns that the facts of a tree are computed from.
TREE_COLUMNS = tree_findings.USED


#: Fields for which the headers of a RAD file, or of the files of a Streamed SOG, are enough.
HEADER_FIELDS = (
    "file",
    "bytes",
    "format",
    "splats",
    "sh_degree",
    "bytes_per_splat",
    "compression_ratio",
    "rad",
    "streamed_sog",
)


#: What the headers of a file tell, of the formats that have much to tell there.
Surveyed = rad.Survey | streamed_sog.Survey


class NoFieldError(SparklodError):
    """A report has no such field."""


@dataclass(frozen=True)
class ReportSettings:
    """What to report besides the header and the tree.

    Attributes:
        values: statistics of the splats.
        all_quantities: all of their quantities, instead of the main ones.
        check: findings.
        chunks: a row for each chunk.
        headers_only: read no more than headers where a format has those; tree and values are left out.
        at_once: have the whole scene in memory, as those need who look at it besides; False reads RAD files chunk by
            chunk; None does so with large ones, see `RadFile.fits`. SPZ files are decoded as a whole for True only.
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
        up: the axis that the file says points up: "y", "-z"; None where it does not say.
        header: fields of the header, which depend on the format.
        bytes_per_splat: size over splats.
        compression_ratio: size of the decoded splats, as 4-byte floats, over that of the file.
        notes: data that the reader left out.
        rad: what the headers of a RAD file tell; None for other formats.
        streamed_sog: what the manifest of a Streamed SOG tells; None for other formats.
        tree: facts of the Level-of-Detail tree; None without one.
        values: statistics of the splats; None if not asked for.
        chunks: a row for each chunk, see `chunks.COLUMNS`; None if not asked for.
        findings: None if not asked for, unless the file could not be read.
    """

    file: str
    bytes: int | None
    format: str | None = None
    splats: int | None = None
    sh_degree: int | None = None
    antialiased: bool | None = None
    up: str | None = None
    header: dict[str, int] = dataclasses.field(default_factory=dict)
    bytes_per_splat: float | None = None
    compression_ratio: float | None = None
    notes: list[str] = dataclasses.field(default_factory=list)
    rad: rad.RadFacts | None = None
    streamed_sog: streamed_sog.StreamedSogFacts | None = None
    tree: tree.TreeFacts | None = None
    values: values.ValueFacts | None = None
    chunks: list[Row] | None = None
    findings: list[Finding] | None = None

    def fails(self, severity: str) -> bool:
        """Whether it has a finding of this severity, or an error."""
        return any(found.severity in ("error", severity) for found in self.findings or [])

    def value_at(self, name: str) -> Any:
        """The value of a field, see `value_at`."""
        return value_at(self.as_dict(), name)

    def as_dict(self) -> dict[str, Any]:
        """The report as plain values, for JSON."""
        plain = {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(self)
        if self.findings is not None:
            plain["findings"] = [{"severity": found.severity} | dataclasses.asdict(found) for found in self.findings]
        return plain


def value_at(plain: dict[str, Any], name: str) -> Any:
    """The value of a field of a report as JSON: keys and indices with dots between ("tree.levels.0.nodes").

    Raises:
        NoFieldError: there is no such field.
    """
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
    """The report on a file, and its scene as far as it was read.

    A file that cannot be read gives a finding, not an error, and None for the scene. Unless the scene is wanted, a
    large RAD file is read chunk by chunk, and an SPZ file stays codes, which gives the same report, but no scene.

    Args:
        path: of the file, or of the folder of an unpacked SOG.
        settings: what to report.
        threads: to read with.
        progress: called while the file is read.
    """
    columns = COLUMNS if settings.values or settings.check or settings.chunks else TREE_COLUMNS
    size = size_of_input(path)
    surveyed = None
    try:
        held = read_arrays(path)
        if held is not None:
            facts_of_arrays, scene_of_arrays = arrays.examine(held, settings, threads=threads)
            return Report(**arrays.as_report_fields(facts_of_arrays, path, size, settings)), scene_of_arrays
        surveyed = rad.survey(path, check=settings.check) or streamed_sog.survey(
            path, check=settings.check, threads=threads, progress=progress
        )
        if surveyed is not None and surveyed.facts is None:
            return Report(str(path), size, findings=surveyed.findings if settings.check else surveyed.fatal), None
        if surveyed is not None and settings.headers_only:
            return _of_headers(path, surveyed), None
        if isinstance(surveyed, rad.Survey) and settings.at_once is not True:
            file = RadFile.open(path)
            if file is not None and not (settings.at_once is None and file.fits):
                blocks = Blocks.of_file(file, threads=threads, progress=progress)
                return _of_blocks(path, blocks, size, settings, surveyed, threads), None
        if settings.at_once is not True:
            kept, watched = _columns_of(settings), code_values.Watched(all_quantities=settings.all_quantities)
            watch = watched.watch if settings.values else None
            coded = read_coded(path, columns=kept, watch=watch, threads=threads, progress=progress)
            if coded is not None:
                return _of_blocks(path, Blocks.of_codes(coded), size, settings, surveyed, threads, watched), None
        scene = examine_scene(path, columns=columns, threads=threads, progress=progress)
    except FormatError as error:
        found = surveyed.findings if surveyed is not None and settings.check else []
        known = any(each.code == error.code for each in found)
        return Report(str(path), size, findings=[*found, *([] if known else [Finding(error.code, str(error))])]), None
    return _of_blocks(path, Blocks.of(scene), size, settings, surveyed, threads), scene


def _columns_of(settings: ReportSettings) -> set[str]:
    """Columns of `Splats` whose codes a report on sound splats keeps."""
    return {
        *TREE_COLUMNS,
        *(value_checks.USED if settings.check else ()),
        *(chunks.USED if settings.chunks else ()),
        *(values.USED if settings.values else ()),
    }


def _of_headers(path: Path, surveyed: Surveyed) -> Report:
    """The report on a file of which only the headers were read."""
    head = surveyed.head
    assert head is not None
    return Report(
        str(path),
        head.bytes,
        head.format,
        head.splats,
        head.sh_degree,
        head.antialiased,
        head.up,
        bytes_per_splat=_bytes_per_splat(head.bytes, head.splats),
        compression_ratio=_compression_ratio(head.bytes, head.splats, head.sh_degree),
        **_facts_of(surveyed),
    )


def _facts_of(surveyed: Surveyed | None) -> dict[str, Any]:
    """The field of a report that has what the headers of a format tell."""
    if surveyed is None:
        return {}
    return {"rad" if isinstance(surveyed, rad.Survey) else "streamed_sog": surveyed.facts}


class _Passed(Protocol):
    """What blocks pass through: parts are made on several threads, and merged in order."""

    def part_of(self, block: Block, /) -> Any: ...

    def merge(self, part: Any, /) -> None: ...


def _of_blocks(
    path: Path,
    blocks: Blocks,
    size: int | None,
    settings: ReportSettings,
    surveyed: Surveyed | None,
    threads: int,
    watched: code_values.Watched | None = None,
) -> Report:
    """The report on a file that can be read, block by block."""
    size = blocks.header.get("bytes", size)
    ends = value_checks.ends_of(blocks.header)
    findings = _container_findings(blocks)
    if surveyed is not None and surveyed.facts is not None:
        size = surveyed.facts.bytes
        findings += surveyed.findings
    if isinstance(surveyed, rad.Survey) and surveyed.facts is not None:
        ends = rad.ends_of(surveyed.facts)
    columns = tree.Columns.of(blocks) if blocks.is_tree and blocks.count else None
    coded = blocks.coded
    statistics = values.Statistics(blocks.sh_degree, all_quantities=settings.all_quantities)
    checks = value_checks.ValueChecks(ends, is_tree=blocks.is_tree)
    rows = chunks.Rows(blocks)
    wanted: list[tuple[_Passed, Collection[str]]] = [
        *([] if columns is None else [(columns, TREE_COLUMNS if coded is None else ())]),
        *([(statistics, values.USED if blocks.sound else COLUMNS)] if settings.values and coded is None else []),
        *([(checks, () if coded else value_checks.USED if blocks.sound else COLUMNS)] if settings.check else []),
        *([(rows, chunks.USED)] if settings.chunks else []),
    ]
    used = {name for _, names in wanted for name in names}
    for parts in blocks.map(lambda block: [each.part_of(block) for each, _ in wanted], used, threads):
        for (each, _), part in zip(wanted, parts, strict=True):
            each.merge(part)
    told = None
    if settings.values and coded is not None and watched is not None:
        sizes = None if columns is None else columns.size
        told = code_values.examine(coded, sizes, watched, threads=threads)
    elif settings.values:
        statistics.finish(blocks, threads=threads)
        told = statistics.facts()
    facts = None
    in_order = rows.rows(columns) if settings.chunks else None
    if columns is not None:
        facts, found = tree.examine_blocks(
            blocks,
            columns,
            check=settings.check,
            scale_ends=ends.scale,
            in_chunks=isinstance(surveyed, rad.Survey),
            threads=threads,
        )
        findings += found
    if settings.check:
        findings += checks.findings()
    return Report(
        file=str(path),
        bytes=size,
        format=blocks.format,
        splats=blocks.count,
        sh_degree=blocks.sh_degree,
        antialiased=blocks.antialiased,
        up=blocks.up,
        header=dict(blocks.header),
        bytes_per_splat=_bytes_per_splat(size, blocks.count),
        compression_ratio=_compression_ratio(size, blocks.count, blocks.sh_degree),
        notes=list(blocks.notes),
        tree=facts,
        values=told,
        chunks=in_order,
        findings=findings if settings.check else None,
        **_facts_of(surveyed),
    )


def _bytes_per_splat(size: int | None, count: int) -> float | None:
    return round(size / count, 3) if size and count else None


def _compression_ratio(size: int | None, count: int, sh_degree: int) -> float | None:
    return round(4 * count * (14 + 3 * COEFFICIENTS[sh_degree]) / size, 3) if size else None


def _container_findings(blocks: Blocks) -> list[Finding]:
    header = blocks.header
    findings = [Finding("container.left-out", note) for note in blocks.notes]
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
