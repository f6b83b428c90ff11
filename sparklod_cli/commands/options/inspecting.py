"""Options of `sparklod inspect`: what is checked, what is printed, and which pictures are drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from ...support.defaults import MAX_SH_DEGREE, PLOT_BY
from ...support.setting_fields import Quantity, Range, whole
from ...support.units import parse_size
from ..option_groups import COMMON, flag, option, refuse
from ..paths import InputPath, OutputPath
from .common import assert_errors, assert_option, overwrite_flag, plot_option, table_form

if TYPE_CHECKING:
    from ...inspection.expectations import Expectations
    from ...tables.output import TableOutput

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
        from ...inspection.chunks import COLUMNS
        from ...tables.output import TableOutput

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
        from ...inspection.values import QUANTITIES

        if name not in QUANTITIES:
            known = ", ".join(QUANTITIES)
            raise click.UsageError(f"--histogram: there is no quantity {name}; choose one of {known}")
