"""Comparison of pictures: of cuts with full detail (`--compare`), and of one file with another (`--diff`)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...support import defaults
from ..command import option, with_options
from ..paths import InputPath
from ..usage import exclude, require
from .appearance import Appearance
from .common import Command, assert_errors, assert_option, plot_option
from .types import Real

if TYPE_CHECKING:
    from ...lod.budget import Budget
    from ...tables.assertions import Assertion

HEADING = "Comparison"

#: The budgets to compare, unless others are given.
DEFAULT_BUDGETS = "2%,5%,10%,25%,50%"

#: Options that only --compare knows.
COMPARED = ("asserts", "plot", "max_sh")

#: Options that --compare has no use for.
NOT_COMPARED = (
    *("full", "preset", "lod_splat_scale", "background", "alpha", "supersample", "style", "color_by", "no_bar"),
    *("through", "diff", "gain", "sheet", "jobs", "thumbnail", "jpeg_quality"),
)

#: Separates the budget of an assertion from the rest of it.
ABOUT = ":"


@dataclass(frozen=True)
class Comparison:
    """The values of the options of `comparison_options`; None for those not given.

    Attributes:
        compare: measure cuts, in place of drawing pictures.
        asserts: texts of the assertions.
        plot: file of the charts.
        max_sh: degrees of spherical harmonics above this are left out.
        diff: the other file.
        gain: factor by which differences are multiplied.
    """

    compare: bool
    asserts: tuple[str, ...]
    plot: Path | None
    max_sh: int
    diff: Path | None
    gain: float | None

    def check(self, ctx: click.Context, appearance: Appearance) -> None:
        """Raises a `click.UsageError` where options contradict each other, or have nothing to do."""
        if self.compare:
            exclude(ctx, NOT_COMPARED, "--compare")
            return
        require(ctx, COMPARED, "--compare")
        if self.diff is None:
            require(ctx, ["gain"], "--diff")
            if appearance.color_by is None:
                require(ctx, ["no_bar"], "--color-by or --diff")
            return
        exclude(ctx, ["color_by"], "--diff, which compares the splats' own colours")
        if appearance.keeps_alpha:
            raise click.UsageError("--diff compares pictures without alpha; name a --background such as black")

    def budgets(self, budgets: Sequence[Budget] | None) -> Sequence[Budget]:
        """The budgets to compare: those given, or `DEFAULT_BUDGETS`."""
        from ...lod.budget import parse_budgets

        return parse_budgets(DEFAULT_BUDGETS) if budgets is None else budgets

    def assertions(self, budgets: Sequence[Budget]) -> list[tuple[int | None, Assertion]]:
        """The assertions, each with the index of its budget; None for all budgets.

        Raises:
            click.UsageError: an assertion cannot be understood.
        """
        from ...tables import assertions
        from ...tables.comparison import COLUMNS

        found = []
        for text in self.asserts:
            name, about, rest = text.rpartition(ABOUT)
            at, texts = None, [budget.text for budget in budgets]
            if about:
                if name.strip() not in texts:
                    raise click.UsageError(
                        f"--assert {text!r}: {name.strip()} is not one of the budgets, {', '.join(texts)}"
                    )
                at = texts.index(name.strip())
            with assert_errors():
                found.append((at, dataclasses.replace(assertions.parse(rest, COLUMNS), text=text.strip())))
        return found


def comparison_options(command: Command) -> Command:
    """The options of `Comparison`."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--compare",
            is_flag=True,
            help="Measure how far the cuts of each --budget are from full detail, as a table instead of pictures.",
        ),
        assert_option(
            "With --compare: a condition that must hold, such as 'psnr_min>30', or '5%:psnr>30' for one of the"
            " budgets; the exit status is 3 if it does not.",
            HEADING,
        ),
        plot_option("With --compare: draw charts of the table as a .png.", HEADING),
        add(
            "--max-sh",
            metavar="N",
            type=click.IntRange(0, defaults.MAX_SH_DEGREE),
            default=defaults.MAX_SH_DEGREE,
            help="With --compare: highest degree of spherical harmonics to draw.",
        ),
        add(
            "--diff",
            metavar="FILE",
            type=InputPath(),
            help="Draw the difference from the picture of another file, and print its PSNR.",
        ),
        add(
            "--gain",
            metavar="X",
            type=Real(0, min_open=True),
            help="Factor by which --diff multiplies differences.  [default: chosen for the pictures]",
        ),
    )
