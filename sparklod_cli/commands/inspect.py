"""`sparklod inspect`: reports on splat files and checks them."""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..system.defaults import MAX_SH_DEGREE, PLOT_BY
from ..system.errors import OutOfMemoryError, SparklodError, StdoutError
from ..system.printable import printable
from ..system.setting_fields import Quantity, Range, whole
from ..system.stdio import name_of
from ..system.units import format_size, parse_size
from .command import COMMON, argument, command, flag, option, refuse, values_of
from .console import Console, count_of
from .inspect_text import finding_line, lines, verdict
from .options.common import General, assert_errors, assert_option, overwrite_flag, plot_option, quiet_flag, table_form
from .paths import InputPath, OutputPath, keep_apart, name_outputs

if TYPE_CHECKING:
    from ..api.inspect_jobs import Inspected, InspectSettings
    from ..inspection.expectations import Expectations
    from ..inspection.html import FileSection
    from ..inspection.report import Report, ReportSettings
    from ..tables.output import TableOutput

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
    """Options of what files are checked for."""

    HEADING: ClassVar[str] = "Checks"

    check: bool = flag(
        "Look for everything that can be wrong, and print a line for each finding instead of a report.", heading=COMMON
    )
    asserts: tuple[str, ...] = assert_option(
        "Expect this of every file, such as 'nodes<5M', 'bytes<=40MB' or 'tree.depth<24'; can be given several times."
        " The exit status is 3 if it does not hold.",
        heading=COMMON,
    )
    require_lod: bool = flag("Expect a Level-of-Detail tree.", heading=COMMON)
    leaves_of: Path | None = option(
        "Expect the leaves to be exactly the splats of this file, within the rounding of the format.",
        InputPath(),
        heading=COMMON,
    )
    expect: Path | None = option("Take expectations from a .toml or .json file.", InputPath(), heading=COMMON)
    fail_on: str = option("Lowest severity of a finding that makes the exit status 3.", ("error", "warning"), "error")
    style: str = option(
        "How findings are printed; github prints annotations for GitHub Actions.",
        ("text", "github"),
        "text",
        flags=("--format",),
    )
    max_bytes: int | None = option("Expect files of at most this size, such as 3MB.", Quantity("SIZE", parse_size))
    min_splats: int | None = option("Expect at least N splats; in a tree, leaves.", whole(0))
    max_splats: int | None = option("Expect at most N splats; in a tree, leaves.", whole(0))
    sh: int | None = option("Expect this SH degree.", whole(0, MAX_SH_DEGREE))
    max_growth: float | None = option("Expect a tree with at most X nodes for each leaf.", Range(1))

    @property
    def has_expectations(self) -> bool:
        """Whether there are expectations, of options or of a file."""
        numbers = (self.max_bytes, self.min_splats, self.max_splats, self.sh, self.max_growth)
        return bool(self.asserts or self.require_lod or self.expect) or any(each is not None for each in numbers)

    @property
    def holds(self) -> bool:
        """Whether findings are printed."""
        return self.check or self.has_expectations or self.leaves_of is not None

    def expectations(self) -> Expectations | None:
        """Return the expectations of the file, overridden by those of the options; None where there are none.

        Raises:
            click.UsageError: an assertion cannot be understood.
            ExpectationError: the file cannot.
        """
        from ..inspection.expectations import KEYS, Expectations, parse_assertion, read

        if not self.has_expectations:
            return None
        with assert_errors():
            for text in self.asserts:
                parse_assertion(text)
        values = {"lod": self.require_lod or None} | {key: getattr(self, key) for key in KEYS if key != "lod"}
        expected = Expectations() if self.expect is None else read(self.expect)
        return replace(
            expected,
            **{key: value for key, value in values.items() if value is not None},
            asserts=expected.asserts + self.asserts,
        )


@dataclass(frozen=True)
class InspectOutput:
    """Options of what is printed and drawn."""

    HEADING: ClassVar[str] = "Report"

    overwrite: bool = overwrite_flag()
    stats: bool = flag("Report statistics of all quantities, not only of the main ones.", heading=COMMON)
    field: str | None = option(
        "Print one value of the JSON report, such as tree.leaves, instead of a report.", metavar="NAME", heading=COMMON
    )
    html: Path | None = option(
        "Write the reports as one HTML page, with pictures.", OutputPath(suffixes=[".html", ".htm"]), heading=COMMON
    )
    histogram: tuple[str, ...] = option(
        "Print a histogram of a quantity that --stats lists; can be given several times.", metavar="NAME", multiple=True
    )
    chunks: bool = flag(
        "Print a table of the chunks; with --json, put it into the report. Files without chunks have those of 65,536"
        " splats in which a viewer would stream them."
    )
    chunks_out: Path | None = option(
        "Write the table of the chunks of a single file to FILE: .csv, .json or .parquet.", OutputPath()
    )
    json_schema: bool = flag("Print the JSON Schema of --json and exit.", is_eager=True, callback=_print_schema)
    plot: Path | None = plot_option("Draw the structure of a single file as a .png, with pyvista.", heading=PICTURES)
    plot_level: int | None = option(
        "Draw the nodes at this depth of the tree.  [default: the leaves]", whole(0), heading=PICTURES
    )
    plot_by: str = option("What the colours of the picture show.", PLOT_BY, PLOT_BY[0], heading=PICTURES)

    def table(self) -> TableOutput | None:
        """Return the output of the table of the chunks; None without one.

        Raises:
            click.UsageError: no table is written by that suffix.
        """
        from ..inspection.chunks import COLUMNS
        from ..tables.output import TableOutput

        if self.chunks_out is None:
            return None
        return TableOutput(
            self.chunks_out, table_form("--chunks-out", self.chunks_out), COLUMNS, overwrite=self.overwrite
        )


def check_usage(ctx: click.Context, count: int, checks: Checks, output: InspectOutput, *, as_json: bool) -> None:
    """Raise a `click.UsageError` where options exclude each other or would do nothing."""
    if output.plot is not None and count > 1:
        raise click.UsageError(f"--plot takes one file, not {count}")
    if output.chunks_out is not None and count > 1:
        raise click.UsageError(f"--chunks-out takes one file, not {count}")
    if output.chunks and output.field:
        raise click.UsageError("--chunks cannot be used with --field")
    if output.field and as_json:
        raise click.UsageError("--field cannot be used with --json")
    if output.histogram and (output.field or as_json):
        raise click.UsageError(f"--histogram cannot be used with {'--json' if as_json else '--field'}")
    if output.stats and checks.holds and not as_json:
        what = "--check" if checks.check else "expectations"
        raise click.UsageError(f"--stats cannot be used with {what} unless --json is given")
    if not checks.holds:
        refuse(ctx, ("style", "fail_on"), "needs --check or an expectation")
    if as_json or output.field:
        refuse(ctx, ("style",), f"cannot be used with {'--json' if as_json else '--field'}")
    if output.plot is None and output.html is None:
        refuse(ctx, ("plot_level", "plot_by"), "needs --plot or --html")
    for name in output.histogram:
        from ..inspection.values import QUANTITIES

        if name not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            raise click.UsageError(f"--histogram: there is no quantity {name}; choose one of {known}")


@dataclass(frozen=True)
class _InspectGeneral(General):
    quiet: bool = quiet_flag("Print only what other options ask for, and errors.")


@dataclass(frozen=True)
class InspectOptions:
    """Options of the command, group by group."""

    files: tuple[Path, ...] = argument(InputPath(stdin=True), metavar="FILE...", required=True)
    checks: Checks = dataclasses.field(default_factory=Checks)
    output: InspectOutput = dataclasses.field(default_factory=InspectOutput)
    general: _InspectGeneral = dataclasses.field(default_factory=_InspectGeneral)


@command("inspect", InspectOptions, examples=EXAMPLES)
def inspect(ctx: click.Context, /, **_: Any) -> None:
    """Report on splat files and check them.

    Reads every format that build-lod reads, and the .npz files that build-lod --encoding writes; a FILE of - is
    standard input. Without --check or an expectation, prints a report. With them, prints a line for each finding;
    the exit status is 3 if one is an error (or a warning, with --fail-on warning).

    A file that cannot be read is a finding, too, and does not stop the others.
    """
    name_outputs(ctx, ctx.params["files"][0])
    options = values_of(ctx, InspectOptions)
    files, checks, output, general = options.files, options.checks, options.output, options.general
    keep_apart(ctx)
    check_usage(ctx, len(files), checks, output, as_json=general.as_json)
    with general.console() as console:
        from ..api.inspect_jobs import InspectSettings, check_outputs, read_original

        console.announce_compiling()
        table = output.table()
        check_outputs(output.plot, output.html, table, overwrite=output.overwrite)
        expected = checks.expectations()
        original = None
        if checks.leaves_of is not None:
            original = read_original(checks.leaves_of, threads=general.threads, progress=console.progress)
        settings = InspectSettings(
            report=_report_settings(checks, output, expected, as_json=general.as_json),
            expected=expected,
            original=original,
            everything=checks.check,
            histograms=output.histogram,
            plot=output.plot,
            depth=output.plot_level,
            by=output.plot_by,
            html=output.html,
            overwrite=output.overwrite,
            chunks=table,
            threads=general.threads,
            progress=console.progress,
        )
        job = _Job(console, options, settings)
        worst = max(job.inspect(file) for file in files)
        job.write_page()
    if worst:
        ctx.exit(worst)


def _report_settings(
    checks: Checks, output: InspectOutput, expected: Expectations | None, *, as_json: bool
) -> ReportSettings:
    """Return settings of a report that has all that is printed and checked."""
    from ..inspection.report import HEADER_FIELDS, ReportSettings

    field = output.field or ""
    about = [condition.name for condition in expected.conditions()] if expected else []
    everything = (
        output.stats
        or bool(output.histogram)
        or checks.expect is not None
        or any(name.startswith("values") for name in (field, *about))
    )
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
    """Inspection of all files with the same settings, and the sections of the page so far."""

    console: Console
    options: InspectOptions
    settings: InspectSettings
    sections: list[FileSection] = dataclasses.field(default_factory=list)

    def inspect(self, file: Path) -> int:
        """Print the report of a file and return its exit status; one too large for memory does not stop the others."""
        from ..api.inspect_jobs import inspect_file

        start, name = time.perf_counter(), name_of(file)
        try:
            inspected = inspect_file(file, self.settings)
        except OutOfMemoryError as error:
            self.console.error(f"{name}: {error}")
            return 1
        self.console.clear()
        status = self._report(name, inspected)
        if inspected.section is not None:
            self.sections.append(inspected.section)
        self.console.detail(f"  {name}: {inspected.report.format or 'not read'}, {time.perf_counter() - start:.2f} s")
        return status

    def _report(self, name: str, inspected: Inspected) -> int:
        """Print the results for a file and return the exit status."""
        report, checks = inspected.report, self.options.checks
        status = 3 if checks.holds and report.fails(checks.fail_on) else 0
        if report.format is None and not checks.holds:
            status = 1
            for finding in report.findings or []:
                self.console.error(f"{name}: {finding.message}")
        try:
            self._print(name, report)
        except StdoutError:
            raise  # of no file
        except SparklodError as error:
            self.console.error(f"{name}: {error}")
            status = 1
        if report.format is not None and self.settings.report.chunks:
            status = max(status, self._print_chunks(name, report))
        for quantity, text in inspected.histograms.items():
            click.echo(f"\n  {quantity}\n{text}")
        if inspected.picture is not None:
            description, size = inspected.picture
            self.console.say(f"{self.settings.plot}  {description.partition(';')[0]}, {format_size(size)}")
        elif inspected.problem is not None and self.settings.plot is not None:
            self.console.error(f"{name}: {inspected.problem}")
            status = max(status, 1)
        elif inspected.problem is not None:
            self.console.say(f"{name}: no plot of the tree on the page: {inspected.problem}")
        return status

    def _print_chunks(self, name: str, report: Report) -> int:
        """Print the table of the chunks, or its path, and return the exit status."""
        from ..inspection.chunks import lines as lines_of_chunks

        if report.chunks is None:
            self.console.error(f"{name}: its chunks cannot be told, for it does not hold all of its splats")
            return 1
        if self.options.output.chunks and not self.options.general.as_json:
            click.echo("\n".join(lines_of_chunks(report.chunks)))
        if self.settings.chunks is not None:
            self.console.say(f"{self.settings.chunks.path}  table of {count_of(len(report.chunks), 'chunk')}")
        return 0

    def _print(self, name: str, report: Report) -> None:
        """Print the report of one file to standard output."""
        plain, checks, output = report.as_dict(), self.options.checks, self.options.output
        if self.options.general.as_json:
            click.echo(json.dumps(plain, allow_nan=False))
        elif output.field:
            if report.format is not None:
                value = report.value_at(output.field)
                click.echo(printable(value) if isinstance(value, str) else json.dumps(value))
        elif checks.holds:
            for finding in report.findings or []:
                click.echo(finding_line(name, finding, checks.style))
            if not report.findings:
                self._say_verdict(name, report)
        elif report.format is not None and output.html is not None and not output.stats:
            self._say_verdict(name, report)
        elif report.format is not None and not self.console.quiet:
            click.echo("\n".join(lines(name, plain)))

    def _say_verdict(self, name: str, report: Report) -> None:
        """Print the result of the check, and hints on a file without findings."""
        self.console.say(f"{name}: {verdict(report)}")
        for hint in () if report.findings else report.hints:
            self.console.say(f"{name}: {hint}")

    def write_page(self) -> None:
        """Write the page, if there is an option for it."""
        if self.settings.html is None:
            return
        from ..api.inspect_jobs import write_page

        size = write_page(self.settings.html, self.sections, overwrite=self.settings.overwrite)
        self.console.say(f"{self.settings.html}  page of {count_of(len(self.sections), 'file')}, {format_size(size)}")
