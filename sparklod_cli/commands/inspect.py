"""`sparklod inspect`: reports on splat files and checks them."""

from __future__ import annotations

import dataclasses
import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..images.picture_files import PLOT_BY
from ..system.errors import CHECK_FAILED, OutOfMemoryError, SparklodError, memory_errors_translated
from ..system.output import write_file
from ..system.setting_fields import setting, whole
from ..system.stdio import name_of
from ..system.threads import on_threads
from ..system.units import format_size
from ..system.untrusted import MOST, printable, shortened
from .command import COMMON, Command, common, flag, values_of
from .console import Console, count_of, rows
from .option_groups import ASSERT, EACH_AS_JSON, JSON, OVERWRITE, PNG, QUIET, General, table_output
from .outputs import NamedPath, keep_apart, name_outputs
from .rules import check

if TYPE_CHECKING:
    from ..inspection.findings import Finding
    from ..inspection.html import FileSection
    from ..inspection.report import Report, ReportSettings
    from ..model.scene import Scene
    from ..tables.assertions import Assertion
    from ..tables.columns import TableOutput


EXAMPLES = """\
  sparklod inspect scene-lod.spz
  sparklod inspect web/*.spz --check                      # exit status 3
  sparklod inspect scene-lod.spz --assert 'nodes<5M' --assert 'bytes<40MB'
  sparklod inspect scene-lod.spz --check --leaves-of scene.ply
  sparklod inspect scene-lod.spz --html report.html
  sparklod inspect scene-lod.spz --field tree.leaves
  sparklod inspect web/*.spz --check --format github      # in GitHub Actions
  curl -s https://example.org/scene.spz | sparklod inspect -
"""


PICTURES = "Pictures"


def _print_schema(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        click.echo(files("sparklod_cli.inspection").joinpath("schema.json").read_text("utf-8"), nl=False)
        ctx.exit()


@dataclass(frozen=True)
class Checks:
    """Options of the checks of files."""

    HEADING: ClassVar[str] = "Checks"

    check: bool = flag(
        "Search for all kinds of faults, and print a line for each finding instead of a report.", heading=COMMON
    )
    asserts: tuple[str, ...] = common(
        "Assert this of every file, such as 'lod==true', 'nodes<5M', 'bytes<=40MB' or 'tree.depth<24'; repeatable. The"
        " exit status is 3 if it does not hold.",
        **ASSERT,
    )
    leaves_of: Path | None = common(
        "Assert that the leaves are the splats of this file, within the rounding of the format.", NamedPath()
    )
    expect: Path | None = common("Make the assertions of a text file, one a line.", NamedPath())
    fail_on: str = setting("Lowest severity of a finding that makes the exit status 3.", ("error", "warning"), "error")
    style: str = setting(
        "How findings are printed; github prints annotations for GitHub Actions.",
        ("text", "github"),
        "text",
        flags=("--format",),
    )

    @property
    def holds(self) -> bool:
        """Whether files are checked, so that findings are printed in place of reports."""
        return self.check or bool(self.asserts) or self.expect is not None or self.leaves_of is not None

    def expectations(self) -> list[Assertion] | None:
        """Return the assertions of the file and of the options; None without either.

        Raises:
            SparklodError: a line of the file is not an assertion.
        """
        from ..inspection.report import parse_expectation, read_expectations
        from ..tables.assertions import BadAssertionError

        if not self.asserts and self.expect is None:
            return None
        try:
            given = [parse_expectation(text) for text in self.asserts]
        except BadAssertionError as error:
            raise click.UsageError(f"--assert {error}") from None
        return [*(read_expectations(self.expect) if self.expect is not None else ()), *given]


@dataclass(frozen=True)
class InspectOutput:
    """Options of reports and pictures."""

    HEADING: ClassVar[str] = "Report"

    overwrite: bool = flag(**OVERWRITE)
    stats: bool = flag("Report statistics of all quantities, not only of the main ones.", heading=COMMON)
    field: str | None = common(
        "Print one value of the JSON report, such as tree.leaves, instead of a report.", metavar="NAME"
    )
    html: Path | None = common(
        "Write the reports as one HTML page, with pictures.", NamedPath(output=True, suffixes=[".html", ".htm"])
    )
    histogram: tuple[str, ...] = setting(
        "Print a histogram of a quantity that --stats lists; repeatable.", metavar="NAME", multiple=True
    )
    chunks: bool = flag(
        "Print a table of the chunks, or add it to the report of --json; a file without chunks is divided into ones of"
        " 65,536 splats."
    )
    chunks_out: Path | None = setting(
        "Write the table of the chunks of a single file to FILE: .csv, .json or .parquet.", NamedPath(output=True)
    )
    json_schema: bool = flag("Print the JSON Schema of --json and exit.", is_eager=True, callback=_print_schema)
    plot: Path | None = setting("Draw the structure of a single file as a .png, with pyvista.", PNG, heading=PICTURES)
    plot_level: int | None = setting(
        "Draw the nodes at this depth of the tree.  [default: the leaves]", whole(0), heading=PICTURES
    )
    plot_by: str = setting("What the colours of the picture show.", PLOT_BY, PLOT_BY[0], heading=PICTURES)


@dataclass(frozen=True)
class _InspectGeneral(General):
    quiet: bool = flag("Print only what other options ask for, and errors.", **QUIET)


@dataclass(frozen=True)
class InspectOptions:
    """Options of the command, group by group."""

    files: tuple[Path, ...] = setting(
        "", NamedPath(stdin=True), (), argument=True, nargs=-1, metavar="FILE...", required=True
    )
    checks: Checks = dataclasses.field(default_factory=Checks)
    output: InspectOutput = dataclasses.field(default_factory=InspectOutput)
    as_json: bool = flag(EACH_AS_JSON, **JSON)
    general: _InspectGeneral = dataclasses.field(default_factory=_InspectGeneral)


#: Options of earlier versions, and the assertions that replace them.
REPLACED = {
    "--require-lod": "--assert lod==true",
    "--max-bytes": "--assert 'bytes<=N'",
    "--min-splats": "--assert 'leaves>=N'",
    "--max-splats": "--assert 'leaves<=N'",
    "--sh": "--assert sh==N",
    "--max-growth": "--assert 'growth<=N'",
}


@click.command("inspect", cls=Command, options=InspectOptions, examples=EXAMPLES, replaced=REPLACED)
@click.pass_context
def inspect(ctx: click.Context, /, **_: Any) -> None:
    """Report on splat files and check them.

    Reads every format that build-lod reads, and the .npz files that convert --layout writes; a FILE of - is
    standard input. Without --check or an expectation, prints a report. With them, prints a line for each finding;
    the exit status is 3 if one is an error (or a warning, with --fail-on warning).

    A file that cannot be read is a finding, too, and does not stop the others.
    """
    name_outputs(ctx, ctx.params["files"][0])
    options = values_of(ctx, InspectOptions)
    files, checks, output, general = options.files, options.checks, options.output, options.general
    check(ctx, count=len(files))
    keep_apart(ctx)
    if output.histogram:
        from ..inspection.values import QUANTITIES

        for name in (each for each in output.histogram if each not in QUANTITIES):
            raise click.UsageError(f"--histogram: there is no quantity {name}; choose one of {', '.join(QUANTITIES)}")
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.reports import check_outputs, read_original
        from ..inspection.report import CHUNK_COLUMNS

        console.announce_compiling()
        table = None
        if output.chunks_out is not None:
            table = table_output(output.chunks_out, CHUNK_COLUMNS, overwrite=output.overwrite, flag="--chunks-out")
            table.check()
        check_outputs(output.plot, output.html, overwrite=output.overwrite)
        expected = checks.expectations()
        original = None
        if checks.leaves_of is not None:
            original = read_original(checks.leaves_of, threads=general.threads, progress=console.progress)
        settings = _report_settings(checks, output, expected, as_json=options.as_json)
        job = _Job(console, options, settings, expected, original, table)
        worst = max(job.inspect(file) for file in files)
        job.write_page()
    if worst:
        ctx.exit(worst)


def _report_settings(
    checks: Checks, output: InspectOutput, expected: list[Assertion] | None, *, as_json: bool
) -> ReportSettings:
    """Return the parts of a report that are printed, drawn or checked."""
    from ..inspection.report import HEADER_FIELDS, ReportSettings

    field = output.field or ""
    about = (field, *(assertion.name for assertion in expected or ()))
    everything = output.stats or bool(output.histogram) or checks.expect is not None
    everything = everything or any(name.startswith("values") for name in about)
    drawn = output.html is not None or output.plot is not None
    printed = not (as_json or field or checks.holds)
    return ReportSettings(
        headers_only=field.partition(".")[0] in HEADER_FIELDS
        and not (drawn or everything or checks.holds or output.chunks_out),
        values=everything or drawn or printed,
        all_quantities=everything or output.html is not None,
        check=checks.holds or output.html is not None or field.startswith("findings"),
        chunks=output.chunks or output.chunks_out is not None or field.startswith("chunks"),
        at_once=True if drawn or output.histogram or checks.leaves_of is not None else None,
    )


@dataclass
class _Job:
    """Inspection of files with the same settings, which collects the sections of the page of --html."""

    console: Console
    options: InspectOptions
    settings: ReportSettings
    expected: list[Assertion] | None
    original: Scene | None
    table: TableOutput | None
    sections: list[FileSection] = dataclasses.field(default_factory=list)

    def inspect(self, file: Path) -> int:
        """Report on a file, check it and draw it; return the exit status."""
        from ..api.reports import inspect_file, picture_of, thumbnail_of

        start, name, options, output = time.perf_counter(), name_of(file), self.options, self.options.output
        threads, picture, problem, size = options.general.threads, None, None, 0
        try:
            with memory_errors_translated(), on_threads(threads):
                report, scene = inspect_file(
                    file,
                    self.settings,
                    self.expected,
                    self.original,
                    everything=options.checks.check,
                    threads=threads,
                    progress=self.console.progress,
                )
                if self.table is not None and report.chunks is not None:
                    self.table.write(report.chunks)
                if (output.plot is not None or output.html is not None) and report.format is not None:
                    picture, problem = picture_of(scene, output.plot_by, output.plot_level)
                if picture is not None and output.plot is not None:
                    size = write_file(output.plot, [picture.png], overwrite=output.overwrite)
                histograms = {}
                if scene is not None and output.histogram:
                    from ..inspection.values import histogram_of, names_of
                    from ..tables.histograms import as_text

                    held = [each for each in output.histogram if each in names_of(scene.splats)]
                    histograms = {each: as_text(histogram_of(scene.splats, each)) for each in held}
                if output.html is not None:
                    from ..inspection.html import section_of

                    thumbnail = None if scene is None else thumbnail_of(report, scene, threads)
                    self.sections.append(section_of(report, scene, picture, thumbnail))
        except OutOfMemoryError as error:
            self.console.error(f"{name}: {error}")
            return 1
        self.console.clear()
        status = self._report(name, report)
        for quantity, text in histograms.items():
            click.echo(f"\n  {quantity}\n{text}")
        if picture is not None and output.plot is not None:
            self.console.say(f"{output.plot}  {picture.description.partition(';')[0]}, {format_size(size)}")
        elif problem is not None and output.plot is not None:
            self.console.error(f"{name}: {problem}")
            status = max(status, 1)
        elif problem is not None:
            self.console.say(f"{name}: no plot of the tree on the page: {problem}")
        self.console.detail(f"  {name}: {report.format or 'not read'}, {time.perf_counter() - start:.2f} s")
        return status

    def _report(self, name: str, report: Report) -> int:
        """Print the report, findings or a value, as the options choose; return the exit status."""
        console, options, checks, output = self.console, self.options, self.options.checks, self.options.output
        is_read, findings = report.format is not None, report.findings or []
        status = CHECK_FAILED if checks.holds and report.fails(checks.fail_on) else 0
        if not is_read and not checks.holds:
            status = 1
            for finding in findings:
                console.error(f"{name}: {finding.message}")
        if options.as_json:
            click.echo(json.dumps(report.as_dict(), allow_nan=False))
        elif output.field and is_read:
            try:
                value = report.value_at(output.field)
            except SparklodError as error:
                console.error(f"{name}: {error}")
                status = 1
            else:
                click.echo(printable(value) if isinstance(value, str) else json.dumps(value))
        elif output.field:
            pass
        elif checks.holds and findings:
            for finding in findings:
                click.echo(finding_line(name, finding, checks.style))
        elif checks.holds or (is_read and output.html is not None and not output.stats):
            noun = "node" if report.tree is not None else "splat"
            counts = Counter(each.severity for each in findings)
            verdict = ", ".join(count_of(count, severity) for severity, count in counts.items())
            console.say(f"{name}: {verdict or f'OK: {count_of(report.splats or 0, noun)}, no problems found'}")
            for hint in () if findings else report.hints:
                console.say(f"{name}: {hint}")
        elif is_read and not options.general.quiet:
            click.echo("\n".join(lines(name, report.as_dict())))
        return max(status, self._report_chunks(name, report)) if is_read and self.settings.chunks else status

    def _report_chunks(self, name: str, report: Report) -> int:
        from ..inspection.report import chunk_lines

        if report.chunks is None:
            self.console.error(f"{name}: its chunks are unknown, since it does not hold all of its splats")
            return 1
        if self.options.output.chunks and not self.options.as_json:
            click.echo("\n".join(chunk_lines(report.chunks)))
        if self.table is not None:
            self.console.say(f"{self.table.path}  table of {count_of(len(report.chunks), 'chunk')}")
        return 0

    def write_page(self) -> None:
        output = self.options.output
        if output.html is None:
            return
        from ..inspection.html import page

        size = write_file(output.html, [page(self.sections).encode()], overwrite=output.overwrite)
        self.console.say(f"{output.html}  page of {count_of(len(self.sections), 'file')}, {format_size(size)}")


#: Numbers of children that get a row of their own.
MOST_ROWS = 8

#: Characters of a comment that are shown; Spark's has 800.
MOST_COMMENT = 160

#: Depths that get a row of their own; a good tree has some twenty.
MOST_DEPTHS = 64


def lines(name: str, report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a report, given as JSON, for people."""
    from ..model.scene import up_note

    tree, values = report["tree"], report["values"]
    noun = "node" if tree else "splat"
    size = "" if report["bytes"] is None else f", {format_size(report['bytes'])}"
    yield f"{printable(name)}  {report['format']}{size}"
    about = [count_of(report["splats"], noun), f"SH {report['sh_degree']}"]
    about += ["antialiased"] * bool(report["antialiased"])
    about += [f"{report['up']} is up"] * bool(report["up"])
    if "fractional_bits" in report["header"]:
        about.append(f"{report['header']['fractional_bits']} fractional bits")
    yield from rows("holds", ", ".join(about))
    if report["bytes_per_splat"]:
        ratio = report["compression_ratio"]
        less = "" if ratio is None else f", {ratio:.1f} times less than as floats"
        yield from rows("takes", f"{report['bytes_per_splat']:.1f} bytes a {noun}{less}")
    for note in report["notes"]:
        yield from rows("note", note)
    if report["up"] and report["up_by"]:
        yield from rows("note", up_note(report["up"], report["up_by"]))
    for hint in report["hints"]:
        yield from rows("hint", hint)
    if report["rad"]:
        yield from _rad(report["rad"])
    if report["streamed_sog"]:
        yield from _streamed_sog(report["streamed_sog"])
    if report["tiles"]:
        yield from _tiles(report["tiles"])
    if tree:
        yield from _tree(tree)
    if values:
        yield from _values(values)


def _sizes(sizes: dict[str, int]) -> str:
    return f"{format_size(sizes['min'])} to {format_size(sizes['max'])}, median {format_size(sizes['median'])}"


def _rad(rad: dict[str, Any]) -> Iterator[str]:
    where = "files of their own" if rad["chunked"] else "one file"
    header, first = format_size(rad["header_bytes"]), format_size(rad["first_bytes"])
    yield from rows("stored", f"{where}, header {header}, with the first chunk {first}")
    if rad["chunk_bytes"]:
        yield from rows("chunks", f"{_sizes(rad['chunk_bytes'])}, of {rad['chunk_size']:,} splats")
    if rad["palette"]:
        yield from rows("palette", count_of(rad["palette"], "entry", "entries") + " of SH")
    if rad["ranges"]:
        texts = {True: "on", False: "off"}
        ranges = (
            f"{name} {texts[value] if isinstance(value, bool) else f'{value:g}'}"
            for name, value in rad["ranges"].items()
        )
        yield from rows("ranges", ", ".join(ranges))
    if rad["properties"]:
        yield from rows("properties", f"{'encoding':<12} {'bytes':>13} {'share':>7}  range")
    for name, found in rad["properties"].items():
        ends = [f"{found[end]:g}" for end in ("min", "max") if found[end] is not None]
        share = f"{100 * found['share']:.1f} %"
        text = f"{found['encoding']:<12} {found['bytes']:>13,} {share:>7}  {' to '.join(ends)}"
        yield f"    {name:<12} {text}".rstrip()
    if rad["comment"]:
        yield from rows("comment", printable(rad["comment"], MOST_COMMENT))


def _streamed_sog(streamed: dict[str, Any]) -> Iterator[str]:
    first, manifest = format_size(streamed["first_bytes"]), format_size(streamed["manifest_bytes"])
    around = " and the environment" if streamed["environment"] else ""
    yield from rows("stored", f"manifest {manifest}, with the coarsest level{around} {first}")
    if streamed["file_bytes"]:
        count = count_of(streamed["files"], "chunk file")
        yield from rows("files", f"{count} of {_sizes(streamed['file_bytes'])}")
    splats, edge = streamed["region_splats"], streamed["region_edge"]
    regions = count_of(streamed["regions"], "region")
    yield from rows("regions", f"{regions} in a tree of depth {streamed['depth']}")
    yield from rows(
        "", f"{splats['min']:,.0f} to {splats['max']:,.0f} splats of level 0 each, median {splats['p50']:,.0f}"
    )
    yield from rows("", f"{edge['min']:.4g} to {edge['max']:.4g} world units long, median {edge['p50']:.4g}")
    head = f"{'splats':>11} {'share':>7} {'regions':>7} {'files':>5} {'size':>8}"
    if any(level["errors"] for level in streamed["levels"]):
        head += f"{'err. p25':>9}{'p50':>8}{'p75':>8}"
    yield from rows("levels", head)
    for number, level in enumerate(streamed["levels"]):
        share = "" if level["share"] is None else f"{100 * level['share']:.1f} %"
        errors = (f"{level['errors'][name]:>8.2g}" for name in ("p25", "p50", "p75") if level["errors"])
        size = format_size(level["bytes"])
        counts = f"{level['splats']:>11,} {share:>7} {level['regions']:>7,} {level['files']:>5,} {size:>8}"
        yield f"    {number:<8} {counts} {''.join(errors)}".rstrip()
    if streamed["environment"]:
        around = streamed["environment"]
        yield from rows("environment", f"{count_of(around['splats'], 'splat')}, {format_size(around['bytes'])}")
    if streamed["generator"]:
        yield from rows("written by", streamed["generator"])


def _tiles(tiles: dict[str, Any]) -> Iterator[str]:
    first, tileset = format_size(tiles["first_bytes"]), format_size(tiles["tileset_bytes"])
    nested = f" and {tiles['tilesets'] - 1:,} nested" if tiles["tilesets"] > 1 else ""
    yield from rows("stored", f"tileset.json{nested} {tileset}, with the root tile {first}")
    if tiles["file_bytes"]:
        yield from rows("files", f"{count_of(tiles['tiles'], 'tile')} of {_sizes(tiles['file_bytes'])}")
    splats = tiles["tile_splats"]
    yield from rows("", f"{splats['min']:,.0f} to {splats['max']:,.0f} splats each, median {splats['p50']:,.0f}")
    if tiles["geometric_error"] is not None:
        yield from rows("error", f"{tiles['geometric_error']:.4g} where nothing is drawn")
    yield from rows(
        "depths", f"{'splats':>11} {'tiles':>6} {'leaves':>6} {'size':>9} {'err. min':>8} {'p50':>8} {'max':>8}"
    )
    for number, level in enumerate(tiles["levels"]):
        errors = [f"{level['errors'][name]:>8.3g}" for name in ("min", "p50", "max")] if level["errors"] else []
        counts = f"{level['splats']:>11,} {level['tiles']:>6,} {level['leaves']:>6,} {format_size(level['bytes']):>9}"
        yield f"    {number:<8} {' '.join([counts, *errors])}"
    if tiles["georeference"]:
        place = tiles["georeference"]
        where = f"latitude {place['latitude']:.7g}, longitude {place['longitude']:.7g}, height {place['height']:.6g} m"
        yield from rows("stands at", f"{where}, heading {place['heading']:.5g}")
    if tiles["generator"]:
        yield from rows("written by", tiles["generator"])


def _tree(tree: dict[str, Any]) -> Iterator[str]:
    inner = count_of(tree["inner"], "inner node")
    leaves = count_of(tree["leaves"], "leaf", "leaves")
    yield from rows("tree", f"{leaves}, {inner}, growth {tree['growth']:.3f}, depth {tree['depth']}")
    if tree["more_than_opaque"] is not None:
        yield from rows("", f"{100 * tree['more_than_opaque']:.1f} % of the nodes have a LoD opacity above 1")
    chunks = count_of(tree["chunks"], "chunk")
    yield from rows(
        "", f"{chunks} of 65,536 nodes, {tree['chunks_of_coarse_cut']} of them for the coarsest cut of that many nodes"
    )
    if tree["split_siblings"]:
        yield from rows("", f"the children of {count_of(tree['split_siblings'], 'node')} lie in more than one chunk")
    counts = sorted(tree["children"].items(), key=lambda item: -item[1])
    shown = ", ".join(f"{children}: {count:,}" for children, count in counts[:MOST_ROWS])
    yield from rows(
        "children", shown + (f", and {len(counts) - MOST_ROWS} other numbers" if len(counts) > MOST_ROWS else "")
    )
    yield from rows("by depth", f"{'depth':>5} {'nodes':>12} {'leaves':>12} {'size':>10}")
    for depth, level in enumerate(tree["levels"][:MOST_DEPTHS]):
        size = "" if level["size"] is None else f"{level['size']:.4g}"
        yield from rows("", f"{depth:>5} {level['nodes']:>12,} {level['leaves']:>12,} {size:>10}")
    if tree["depth"] >= MOST_DEPTHS:
        yield from rows("", f"and {tree['depth'] + 1 - MOST_DEPTHS:,} more")


def _values(values: dict[str, Any]) -> Iterator[str]:
    for name, what in (("box", "box"), ("box_98", "98 %")):
        box = values[name]
        if box:
            low, high = (" ".join(f"{number:.4g}" for number in box[end]) for end in ("min", "max"))
            yield from rows(what, f"{low}  to  {high}")
    names = ("min", "p1", "p50", "p99", "max", "mean")
    yield from rows("values", " ".join(f"{name:>10}" for name in names))
    for quantity, summary in values["quantities"].items():
        cells = ("" if summary[name] is None else f"{summary[name]:.4g}" for name in names)
        yield from rows(quantity, " ".join(f"{cell:>10}" for cell in cells))
    counts = {
        "not finite": values["non_finite"],
        "of a negative scale": values["negative_scale"],
        "of opacity 0": values["zero_opacity"],
        "of scale 0": values["zero_scale"],
    }
    bad = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
    if bad:
        yield from rows("degenerate", bad)


def finding_line(file: str, found: Finding, style: str) -> str:
    """Return a finding in a line, as text or as an annotation of GitHub Actions."""
    if style == "text":
        return f"{printable(file)}: {found.severity}: {found.code}: {printable(found.message, MOST)}"
    kind = {"note": "notice"}.get(found.severity, found.severity)
    return f"::{kind} file={_escaped(file, ':,')},title={found.code}::{_escaped(shortened(found.message, MOST))}"


def _escaped(text: str, more: str = "") -> str:
    """Escape a text for workflow commands of GitHub Actions: line ends are encoded, other control characters shown."""
    text = "".join(mark if mark in "\r\n" else printable(mark) for mark in text)
    for mark in "%\r\n" + more:
        text = text.replace(mark, f"%{ord(mark):02X}")
    return text
