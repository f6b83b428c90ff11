"""Options of `sparklod inspect`: what is checked, what is printed, and which pictures are drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...support.defaults import MAX_SH_DEGREE, PLOT_BY
from ...support.units import parse_size
from ..command import COMMON, option, with_options
from ..paths import InputPath, OutputPath
from ..usage import refuse
from .common import Command, assert_errors, assert_option, plot_option, table_form
from .types import Quantity, Real

if TYPE_CHECKING:
    from ...inspection.expectations import Expectations
    from ...tables.output import TableOutput

CHECKS, REPORT, PICTURES = "Checks", "Report", "Pictures"


def _print_schema(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        click.echo(files("sparklod_cli.inspection").joinpath("schema.json").read_text("utf-8"), nl=False)
        ctx.exit()


OPTIONS: tuple[Callable[[Command], Command], ...] = (
    option(
        "--check",
        heading=COMMON,
        is_flag=True,
        help="Look for everything that can be wrong, and print a line for each finding instead of a report.",
    ),
    assert_option(
        "Expect this of every file, such as 'nodes<5M', 'bytes<=40MB' or 'tree.depth<24'; can be given several"
        " times. The exit status is 3 if it does not hold."
    ),
    option("--require-lod", heading=COMMON, is_flag=True, help="Expect a Level-of-Detail tree."),
    option(
        "--leaves-of",
        heading=COMMON,
        metavar="FILE",
        type=InputPath(),
        help="Expect the leaves to be exactly the splats of this file, within the rounding of the format.",
    ),
    option(
        "--expect",
        heading=COMMON,
        metavar="FILE",
        type=InputPath(),
        help="Take expectations from a .toml or .json file.",
    ),
    option(
        "--stats", heading=COMMON, is_flag=True, help="Report statistics of all quantities, not only of the main ones."
    ),
    option(
        "--field",
        heading=COMMON,
        metavar="NAME",
        help="Print one value of the JSON report, such as tree.leaves, instead of a report.",
    ),
    option(
        "--html",
        heading=COMMON,
        metavar="FILE",
        type=OutputPath(suffixes=[".html", ".htm"]),
        help="Write the reports as one HTML page, with pictures.",
    ),
    option(
        "--fail-on",
        heading=CHECKS,
        type=click.Choice(["error", "warning"]),
        default="error",
        help="Lowest severity of a finding that makes the exit status 3.",
    ),
    option(
        "--format",
        "style",
        heading=CHECKS,
        type=click.Choice(["text", "github"]),
        default="text",
        help="How findings are printed; github prints annotations for GitHub Actions.",
    ),
    option(
        "--max-bytes",
        heading=CHECKS,
        type=Quantity("SIZE", parse_size),
        help="Expect files of at most this size, such as 3MB.",
    ),
    option(
        "--min-splats",
        heading=CHECKS,
        metavar="N",
        type=click.IntRange(0),
        help="Expect at least N splats; in a tree, leaves.",
    ),
    option(
        "--max-splats",
        heading=CHECKS,
        metavar="N",
        type=click.IntRange(0),
        help="Expect at most N splats; in a tree, leaves.",
    ),
    option("--sh", heading=CHECKS, metavar="N", type=click.IntRange(0, MAX_SH_DEGREE), help="Expect this SH degree."),
    option(
        "--max-growth",
        heading=CHECKS,
        metavar="X",
        type=Real(1),
        help="Expect a tree with at most X nodes for each leaf.",
    ),
    option(
        "--histogram",
        heading=REPORT,
        metavar="NAME",
        multiple=True,
        help="Print a histogram of a quantity that --stats lists; can be given several times.",
    ),
    option(
        "--chunks",
        heading=REPORT,
        is_flag=True,
        help="Print a table of the chunks; with --json, put it into the report. Files without chunks have those of"
        " 65,536 splats in which a viewer would stream them.",
    ),
    option(
        "--chunks-out",
        heading=REPORT,
        metavar="FILE",
        type=OutputPath(),
        help="Write the table of the chunks of a single file to FILE: .csv, .json or .parquet.",
    ),
    option(
        "--json-schema",
        heading=REPORT,
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=_print_schema,
        help="Print the JSON Schema of --json and exit.",
    ),
    plot_option("Draw the structure of a single file as a .png, with pyvista.", PICTURES),
    option(
        "--plot-level",
        heading=PICTURES,
        metavar="N",
        type=click.IntRange(0),
        help="Draw the nodes at this depth of the tree.  [default: the leaves]",
    ),
    option(
        "--plot-by",
        heading=PICTURES,
        type=click.Choice(PLOT_BY),
        default=PLOT_BY[0],
        help="What the colours of the picture show.",
    ),
)


def inspect_options(command: Command) -> Command:
    """Adds the options of this module, of which `Checks`, `Output` and `Pictures` have the values."""
    return with_options(command, *OPTIONS)


@dataclass(frozen=True)
class Checks:
    """What files are held to.

    Attributes:
        check: everything that can be wrong.
        fail_on: the lowest severity of a finding that is a failure.
        asserts, max_bytes, min_splats, max_splats, sh, require_lod, max_growth: expectations of options.
        expect: a file of others.
        leaves_of: a file whose splats the leaves should be.
    """

    check: bool
    fail_on: str
    asserts: tuple[str, ...]
    max_bytes: int | None
    min_splats: int | None
    max_splats: int | None
    sh: int | None
    require_lod: bool
    max_growth: float | None
    expect: Path | None
    leaves_of: Path | None

    @property
    def has_expectations(self) -> bool:
        """Whether there are any, of options or of a file."""
        numbers = (self.max_bytes, self.min_splats, self.max_splats, self.sh, self.max_growth)
        return bool(self.asserts or self.require_lod or self.expect) or any(each is not None for each in numbers)

    @property
    def holds(self) -> bool:
        """Whether findings are asked for."""
        return self.check or self.has_expectations or self.leaves_of is not None

    def expectations(self) -> Expectations | None:
        """Those of the file, and of the options, which take the place of the file's; None where there are none.

        Raises:
            click.UsageError: an assertion cannot be understood.
            ExpectationError: the file cannot.
        """
        from ...inspection.expectations import KEYS, Expectations, parse_assertion, read

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
class Output:
    """What is printed and written.

    Attributes:
        style: of findings.
        stats: all quantities.
        field: of the report, alone.
        histogram: quantities that are drawn as text.
        chunks: print a table of the chunks.
        chunks_out: file of that table.
        html, plot: files of a page and of a picture.
        plot_level, plot_by: what the picture shows.
        overwrite: replace files that exist.
    """

    style: str
    stats: bool
    field: str | None
    histogram: tuple[str, ...]
    chunks: bool
    chunks_out: Path | None
    html: Path | None
    plot: Path | None
    plot_level: int | None
    plot_by: str
    overwrite: bool

    def table(self) -> TableOutput | None:
        """Where the table of the chunks is written; None for nowhere.

        Raises:
            click.UsageError: no table is written by that suffix.
        """
        from ...inspection.chunks import COLUMNS
        from ...tables.output import TableOutput

        if self.chunks_out is None:
            return None
        return TableOutput(
            self.chunks_out, table_form("--chunks-out", self.chunks_out), COLUMNS, overwrite=self.overwrite
        )


def check_usage(ctx: click.Context, count: int, checks: Checks, output: Output, *, as_json: bool) -> None:
    """Raises a `click.UsageError` where options exclude each other or would do nothing.

    Args:
        ctx: of the command.
        count: how many files there are.
        checks, output: what was given.
        as_json: --json was given.
    """
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
        from ...inspection.values import QUANTITIES

        if name not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            raise click.UsageError(f"--histogram: there is no quantity {name}; choose one of {known}")
