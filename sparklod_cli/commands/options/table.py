"""Outputs of `sparklod traverse`: the table, the summary, charts, and the nodes of each cut."""

from __future__ import annotations

import functools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...support.stdin import DASH
from ...tables.files import FORMS
from ..command import COMMON, option, with_options
from ..console import is_terminal
from ..paths import OutputPath
from ..usage import exclude, refuse, require
from .common import Command, assert_errors, assert_option, output_option, overwrite_option, plot_option, table_form

if TYPE_CHECKING:
    from ...simulation.outputs import FrameOutputs
    from ...tables.assertions import Assertion

HEADING = "Output"

#: Options that say what is in the table.
OF_TABLES = ("form", "per_instance", "no_timing")


@dataclass(frozen=True)
class Table:
    """The values of the options of `table_options`; None for those not given.

    Attributes:
        output: file of the table, or -.
        overwrite: replace files that exist.
        form: a key of `FORMS`.
        per_instance: rows for single instances, too.
        no_timing: leave out the column of the time that traversals took.
        summary: print what the frames come to.
        asserts: texts of the assertions.
        plot: file of the charts.
        indices_out: folder of the nodes of each cut.
        padded: fill their files up to rows of Spark's index texture.
    """

    output: Path | None
    overwrite: bool
    form: str | None
    per_instance: bool
    no_timing: bool
    summary: bool | None
    asserts: tuple[str, ...]
    plot: Path | None
    indices_out: Path | None
    padded: bool

    def check(self, ctx: click.Context, *, as_json: bool) -> None:
        """Raises a `click.UsageError` where options contradict each other, or have nothing to do."""
        if as_json and self.output is None:
            exclude(ctx, OF_TABLES, "--json without --output, which writes no table")
        elif self.summary_on_stdout(as_json=as_json):
            refuse(ctx, OF_TABLES, "is of the table, and a terminal gets the summary; redirect it, or add --output")
        if self.indices_out is None:
            require(ctx, ["padded"], "--indices-out")

    def summary_on_stdout(self, *, as_json: bool) -> bool:
        """Whether the summary is printed instead of the table, which would scroll by on a terminal."""
        return self.output is None and not as_json and is_terminal(sys.stdout)

    def outputs(self, *, as_json: bool) -> FrameOutputs:
        """Where the table and the other outputs go.

        Raises:
            click.UsageError: the suffix of --output promises something else.
        """
        from ...simulation import columns
        from ...simulation.outputs import FrameOutputs
        from ...tables.output import TableOutput

        nowhere = self.output is None and (as_json or self.summary_on_stdout(as_json=as_json))
        table = TableOutput(
            path=None if self.output == DASH else self.output,
            form=None if nowhere else table_form("--output", self.output, self.form),
            columns=columns.select(timing=not self.no_timing),
            overwrite=self.overwrite,
        )
        return FrameOutputs(table, self.indices_out, self.padded, self.plot, self.overwrite)

    def assertions(self) -> list[Assertion]:
        """The assertions.

        Raises:
            click.UsageError: an assertion cannot be understood.
        """
        from ...simulation.columns import COLUMNS, LOADING
        from ...tables import assertions

        with assert_errors():
            return [assertions.parse(text, (*COLUMNS, *LOADING)) for text in self.asserts]


def table_options(command: Command) -> Command:
    """The options of `Table`."""
    add = functools.partial(option, heading=HEADING)
    common = functools.partial(option, heading=COMMON)
    return with_options(
        command,
        output_option(
            "Write the table to FILE: .csv, .json or .parquet; - is standard output.  [default: standard"
            " output, but for a terminal, which gets the summary]"
        ),
        overwrite_option,
        common(
            "--summary/--no-summary",
            default=None,
            help="Print what the frames come to, on standard error.  [default: if that is a terminal]",
        ),
        assert_option("Condition that must hold, such as 'churn_p95<0.2'; the exit status is 3 if it does not."),
        plot_option("Draw charts of the table and the path over the scene, as a .png."),
        add(
            "--format",
            "form",
            type=click.Choice(list(FORMS)),
            help="Format of the table.  [default: by the suffix of --output, or csv]",
        ),
        add("--per-instance", is_flag=True, help="Write a row for each instance, besides that of all together."),
        add(
            "--no-timing",
            is_flag=True,
            help="Leave out traverse_ms, the time that each traversal took, so that two runs write the same bytes.",
        ),
        add(
            "--indices-out",
            metavar="DIR",
            type=OutputPath(folder=True),
            help="Write the nodes of every cut to DIR, as .npy of uint32.",
        ),
        add(
            "--padded",
            is_flag=True,
            help="With --indices-out: pad each file to rows of 16,384 nodes, as Spark's index texture has them.",
        ),
    )
