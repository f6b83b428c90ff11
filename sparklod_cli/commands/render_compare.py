"""What `sparklod render --compare` does: how far cuts of several budgets are from full detail."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..support import defaults
from .console import Console, count_of, for_screen, is_terminal
from .options.common import Command, table_form
from .options.types import Quantity
from .paths import OutputPath

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..compare import Comparison
    from ..lod.budget import Budget
    from ..lod.settings import LodSettings
    from ..render.settings import RenderSettings
    from ..scenes.loaded import Scenes
    from ..tables.assertions import Assertion
    from ..tables.columns import Row
    from ..tables.comparison import BudgetSummary

#: What is compared unless told otherwise.
DEFAULT_BUDGETS = "2%,5%,10%,25%,50%"

#: Between the budget that an assertion is about and the rest of it.
ABOUT = ":"


def _budgets(text: str) -> Any:
    from ..lod.budget import parse_budgets

    return parse_budgets(text)


#: Type of a --budget of several: texts such as 2%,5%,500k become `Budget`s.
BUDGETS = Quantity("N|P%,...", _budgets)


def compare_options(command: Command) -> Command:
    """`--compare` and what only it knows; `--budget` is of `BUDGETS`."""
    for option in reversed(
        (
            click.option(
                "--compare",
                is_flag=True,
                help="Tell how far the cuts of each --budget are from full detail, as a table.",
            ),
            click.option(
                "--assert",
                "asserts",
                metavar="TEXT",
                multiple=True,
                help="With --compare: what must hold, such as 'psnr_min>30', or '5%:psnr>30' for one of the budgets;"
                " the exit status is 3 if it does not.",
            ),
            click.option(
                "--plot",
                metavar="FILE",
                type=OutputPath(suffixes=[".png"]),
                help="With --compare: draw the table as a .png.",
            ),
            click.option(
                "--max-sh",
                metavar="N",
                type=click.IntRange(0, defaults.MAX_SH_DEGREE),
                default=defaults.MAX_SH_DEGREE,
                help="Leave out spherical harmonics of higher degrees.",
            ),
        )
    ):
        command = option(command)
    return command


@dataclass(frozen=True)
class Wanted:
    """What is to be made of a comparison.

    Attributes:
        budgets: at least one.
        output: of the table; None for standard output.
        form: of the table.
        plot: of the charts; None for none.
        asserts: what must hold, and of which of the budgets; None for all.
        as_json: print a summary instead of the table.
        overwrite: replace outputs.
    """

    budgets: Sequence[Budget]
    output: Path | None
    form: str
    plot: Path | None
    asserts: Sequence[tuple[int | None, Assertion]]
    as_json: bool
    overwrite: bool

    def check(self) -> None:
        """Raises a `SparklodError` where an output cannot be made, before work goes into it."""
        from ..io import check_writable

        for target in (self.output, self.plot):
            if target is not None and str(target) != "-":
                check_writable(target, overwrite=self.overwrite)
        if self.form == "parquet":
            from ..tables.files import load_pyarrow

            load_pyarrow()
        if self.plot is not None:
            from ..figures.charts import load_matplotlib

            load_matplotlib()


def wanted_from(
    settings: Mapping[str, Any], budgets: Sequence[Budget] | None, *, output: Path | None, as_json: bool
) -> Wanted:
    """What the options of `compare_options`, and `overwrite`, ask for.

    Raises:
        click.UsageError: an assertion cannot be understood, or a name is not of what is written.
    """
    budgets = _budgets(DEFAULT_BUDGETS) if budgets is None else budgets
    asserts = [_assertion(text, budgets) for text in settings["asserts"]]
    form = table_form("--output", output)
    return Wanted(budgets, output, form, settings["plot"], asserts, as_json, settings["overwrite"])


def _assertion(text: str, budgets: Sequence[Budget]) -> tuple[int | None, Assertion]:
    from ..tables import assertions
    from ..tables.comparison import COLUMNS

    name, found, rest = text.rpartition(ABOUT)
    at, texts = None, [budget.text for budget in budgets]
    if found:
        if name.strip() not in texts:
            raise click.UsageError(f"--assert {text!r}: {name.strip()} is not one of the budgets, {', '.join(texts)}")
        at = texts.index(name.strip())
    try:
        return at, dataclasses.replace(assertions.parse(rest, COLUMNS), text=text.strip())
    except assertions.BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None


def run(
    console: Console,
    world: Scenes,
    viewer: LodSettings,
    path: CameraPath,
    how: RenderSettings,
    wanted: Wanted,
    *,
    threads: int,
) -> int:
    """Compares, writes the table and the charts, and says what they come to; the exit status.

    Cuts go down to the budget, not to the size of a pixel, unless the viewer has a limit of its own.
    """
    from ..compare import Comparison
    from ..io import write_stdout, write_whole
    from ..tables.comparison import COLUMNS, rows_by_budget
    from ..tables.files import encode

    wanted.check()
    if viewer.pixel_scale_limit is None and viewer.render_scale == 1:
        viewer = dataclasses.replace(viewer, pixel_scale_limit=0.0)
    start = time.perf_counter()
    comparison = Comparison(world, viewer, wanted.budgets, how)
    rows: list[Row] = []

    def kept() -> Iterator[Row]:
        for row in comparison.run(path, threads=threads, progress=console.progress):
            rows.append(row)
            yield row

    if wanted.output is not None and str(wanted.output) != "-":
        write_whole(wanted.output, encode(kept(), COLUMNS, wanted.form), overwrite=wanted.overwrite)
    elif wanted.as_json:
        for _ in kept():
            pass
    else:  # at once, for a bar and a table do not go together on one screen
        table = list(encode(kept(), COLUMNS, wanted.form))
        console.clear()
        write_stdout(for_screen(table) if is_terminal(sys.stdout) else iter(table))
    console.clear()
    console.detail(f"  {len(rows):,} pictures, {time.perf_counter() - start:.2f} s")
    if wanted.plot is not None:
        from ..figures.comparison_chart import plot

        texts = (budget.text for budget in wanted.budgets)
        series = list(zip(texts, rows_by_budget(rows, len(wanted.budgets)), strict=True))
        write_whole(wanted.plot, [plot(series, world.title)], overwrite=wanted.overwrite)
    return _report(console, wanted, comparison, path, rows)


def _report(console: Console, wanted: Wanted, comparison: Comparison, path: CameraPath, rows: Sequence[Row]) -> int:
    from ..tables.assertions import check
    from ..tables.comparison import rows_by_budget, summarize

    groups = rows_by_budget(rows, len(wanted.budgets))
    outcomes = [
        outcome
        for at, assertion in wanted.asserts
        for outcome in check([assertion], rows if at is None else groups[at])
    ]
    summary = summarize(rows, [budget.text for budget in wanted.budgets])
    if wanted.as_json:
        asserts = [{"assert": each.assertion.text, "held": each.held, "value": each.value} for each in outcomes]
        budgets = [each.as_dict() for each in summary]
        whole = {"frames": len(path.cameras), "leaves": comparison.leaves, "budgets": budgets, "asserts": asserts}
        click.echo(json.dumps(whole, allow_nan=False))
    for line in lines(summary, path, comparison.leaves):
        console.say(line)
    for (at, _), outcome in zip(wanted.asserts, outcomes, strict=True):
        of = f", at a budget of {outcome.worst['budget']:,}" if at is None and outcome.worst is not None else ""
        if outcome.held:
            console.detail(f"  holds: {outcome.message()}{of}")
        else:
            console.error(f"{outcome.message()}{of}")
    return 0 if all(outcome.held for outcome in outcomes) else 3


def lines(summary: Sequence[BudgetSummary], path: CameraPath, leaves: int) -> Iterator[str]:
    """The summary as a person reads it."""
    sizes = list(dict.fromkeys((camera.width, camera.height) for camera in path.cameras))
    size = f"{sizes[0][0]} x {sizes[0][1]}" + (" and others" if len(sizes) > 1 else "")
    yield f"  {count_of(len(path.cameras), 'frame')} of {size}, against {count_of(leaves, 'splat')}, on black and white"
    yield f"  {'budget':>8} {'splats':>11} {'PSNR':>7} {'least':>7} {'SSIM':>7} {'least':>7}   worst tile"
    for each in summary:
        yield (
            f"  {each.text:>8} {round(each.selected):>11,} {each.psnr:>7.2f} {each.psnr_min:>7.2f}"
            f" {each.ssim:>7.4f} {each.ssim_min:>7.4f}   {each.worst_tile_psnr:.2f}"
            f" at {each.worst_tile_x}, {each.worst_tile_y} of frame {each.worst_frame:,}"
        )
