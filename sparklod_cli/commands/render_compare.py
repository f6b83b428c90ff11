"""What `sparklod render --compare` does: measures how far cuts of several budgets are from full detail."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import click

from ..support.stdin import DASH
from .console import Console, count_of, for_screen, is_terminal
from .options.common import table_form
from .paths import keep_apart

if TYPE_CHECKING:
    from ..api.jobs import Compared
    from ..cameras.path import CameraPath
    from ..lod.settings import LodSettings
    from ..scenes.loaded import Scenes
    from ..tables.comparison import BudgetSummary
    from ..tables.output import TableOutput
    from .render import Asked


def compare(ctx: click.Context, asked: Asked) -> int:
    """Compares, writes the table and the charts, and says what they come to; the exit status."""
    budgets = asked.comparison.budgets(asked.cut.budget)
    asserts = asked.comparison.assertions(budgets)
    table = _table(asked)
    instances = asked.inputs.instances()
    from ..api.jobs import compare_files
    from .render import fitted, read_besides, told, view

    keep_apart(ctx, read_besides(asked, instances))
    with asked.general.console() as console:
        console.announce_compiling("render")
        start = time.perf_counter()

        def ready(path: CameraPath, scenes: Scenes) -> None:
            for note in path.notes:
                console.say(note)

        def passed(pieces: Iterable[bytes]) -> Iterable[bytes]:
            console.clear()  # a bar and a table do not go together on one screen
            return for_screen(pieces) if is_terminal(sys.stdout) and table.form != "parquet" else pieces

        with told(asked):
            compared = compare_files(
                view(asked, instances, console),
                budgets,
                _limited(asked),
                asked.appearance.settings(max_sh=asked.comparison.max_sh),
                table,
                fitted=fitted(ctx),
                asserts=asserts,
                plot=asked.comparison.plot,
                overwrite=asked.pictures.overwrite,
                ready=ready,
                passed=passed,
            )
        console.clear()
        console.detail(f"  {compared.pictures:,} pictures, {time.perf_counter() - start:.2f} s")
        return _report(console, asked, compared, [at for at, _ in asserts])


def _table(asked: Asked) -> TableOutput:
    """Where the table goes: nowhere where a terminal, or JSON, gets the summary alone."""
    from ..tables.comparison import COLUMNS
    from ..tables.output import TableOutput

    output = asked.pictures.output
    nowhere = _on_screen(asked) or (output is None and asked.general.as_json)
    return TableOutput(
        path=None if output == DASH else output,
        form=None if nowhere else table_form("--output", output),
        columns=COLUMNS,
        overwrite=asked.pictures.overwrite,
    )


def _on_screen(asked: Asked) -> bool:
    """Whether the summary takes the place of a table that would scroll by on a terminal, and nobody asked for."""
    return asked.pictures.output is None and not asked.general.as_json and is_terminal(sys.stdout)


def _limited(asked: Asked) -> LodSettings:
    """Settings whose cuts go down to the budget, not to the size of a pixel, unless a limit was given."""
    settings = asked.cut.settings(budget=1)
    if settings.pixel_scale_limit is None and settings.render_scale == 1:
        return dataclasses.replace(settings, pixel_scale_limit=0.0)
    return settings


def _report(console: Console, asked: Asked, compared: Compared, about: Sequence[int | None]) -> int:
    """Says what the comparison comes to; the exit status.

    Args:
        console: says it.
        asked: on the command line.
        compared: what was found.
        about: of each assertion, the place of the budget that it is about; None for all of them.
    """
    summary, outcomes = compared.summary, compared.outcomes
    if asked.general.as_json:
        held = [{"assert": each.assertion.text, "held": each.held, "value": each.value} for each in outcomes]
        figures = [each.as_dict() for each in summary]
        frames = len(compared.path.cameras)
        whole = {"frames": frames, "leaves": compared.leaves, "budgets": figures, "asserts": held}
        click.echo(json.dumps(whole, allow_nan=False))
    told = lines(summary, compared.path, compared.leaves)
    if _on_screen(asked):
        click.echo("\n".join(told))
    else:
        for line in told:
            console.say(line)
    for at, outcome in zip(about, outcomes, strict=True):
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
