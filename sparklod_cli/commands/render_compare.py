"""Command `sparklod render --compare`: errors of cuts of several budgets against full detail."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import click

from ..system.stdio import DASH
from .console import Console, count_of, for_screen, is_terminal, print_json
from .options.common import question_budgets, report_outcomes, table_form
from .options.cut import check_scenes, viewed_files
from .paths import Folder, keep_apart

if TYPE_CHECKING:
    from ..api.jobs import Compared
    from ..cameras.path import CameraPath
    from ..lod.settings import LodSettings
    from ..scenes.loaded import Scenes
    from ..tables.comparison import BudgetSummary
    from ..tables.output import TableOutput
    from .render import RenderOptions


def compare(ctx: click.Context, options: RenderOptions) -> int:
    """Compare, writes the table and the charts, and print the summary; returns the exit status."""
    budgets = options.comparison.budgets(options.cut.budget)
    asserts = options.comparison.assertions(budgets)
    table = _table(options)
    instances = options.inputs.instances()
    from ..api.jobs import compare_files
    from .render import files_read, fit_planes

    keep_apart(ctx, files_read(options, instances))
    with options.general.console() as console:
        question_budgets(console, *budgets)
        console.announce_compiling("pictures")
        start = time.perf_counter()

        def ready(path: CameraPath, scenes: Scenes) -> None:
            for note in (*path.notes, *options.cameras.axis_notes(scenes)):
                console.say(note)
            check_scenes(ctx, scenes)

        def passed(pieces: Iterable[bytes]) -> Iterable[bytes]:
            console.clear()  # a bar and a table do not go together on one screen
            return for_screen(pieces) if is_terminal(sys.stdout) and table.form != "parquet" else pieces

        with options.cameras.usage_errors():
            compared = compare_files(
                viewed_files(options, instances, console),
                budgets,
                _limited(options),
                dataclasses.replace(options.appearance.settings(console.say), max_sh=options.comparison.max_sh),
                table,
                fit_planes=fit_planes(ctx),
                asserts=asserts,
                plot=options.comparison.plot,
                overwrite=options.pictures.overwrite,
                ready=ready,
                passed=passed,
            )
        console.clear()
        console.detail(f"  {compared.pictures:,} pictures, {time.perf_counter() - start:.2f} s")
        return _report(console, options, compared, [at for at, _ in asserts])


def _table(options: RenderOptions) -> TableOutput:
    """Return the output of the table: none if only the summary is printed, to a terminal or as JSON."""
    from ..tables.comparison import COLUMNS
    from ..tables.output import TableOutput

    output = options.pictures.output
    assert not isinstance(output, Folder)  # see `name_outputs`
    nowhere = _on_screen(options) or (output is None and options.general.as_json)
    return TableOutput(
        path=None if output == DASH else output,
        form=None if nowhere else table_form("--output", output),
        columns=COLUMNS,
        overwrite=options.pictures.overwrite,
    )


def _on_screen(options: RenderOptions) -> bool:
    """Return whether the summary is printed instead of the table, which would scroll by on a terminal."""
    return options.pictures.output is None and not options.general.as_json and is_terminal(sys.stdout)


def _limited(options: RenderOptions) -> LodSettings:
    """Return settings of cuts that only the budget limits, not the size of a pixel, unless a limit was given."""
    settings = options.cut.settings()
    if settings.pixel_scale_limit is None and settings.render_scale == 1:
        return dataclasses.replace(settings, pixel_scale_limit=0.0)
    return settings


def _report(console: Console, options: RenderOptions, compared: Compared, about: Sequence[int | None]) -> int:
    """Print the results of a comparison; return the exit status.

    Args:
        about: for each assertion the index of its budget; None for all budgets.
    """
    summary, outcomes = compared.summary, compared.outcomes
    if options.general.as_json:
        asserts = [each.as_dict() for each in outcomes]
        figures = [each.as_dict() for each in summary]
        frames = len(compared.path.cameras)
        whole = {"frames": frames, "leaves": compared.leaves, "budgets": figures, "asserts": asserts}
        print_json(whole)
    texts = lines(summary, compared.path, compared.leaves)
    if _on_screen(options):
        click.echo("\n".join(texts))
    else:
        for line in texts:
            console.say(line)
    places = [
        f", at a budget of {each.worst['budget']:,}" if at is None and each.worst is not None else ""
        for at, each in zip(about, outcomes, strict=True)
    ]
    return report_outcomes(console, outcomes, places)


def lines(summary: Sequence[BudgetSummary], path: CameraPath, leaves: int) -> Iterator[str]:
    """Yield the summary as a person reads it; with popping where frames follow each other."""
    sizes = list(dict.fromkeys((camera.width, camera.height) for camera in path.cameras))
    size = f"{sizes[0][0]} x {sizes[0][1]}" + (" and others" if len(sizes) > 1 else "")
    yield f"  {count_of(len(path.cameras), 'frame')} of {size}, against {count_of(leaves, 'splat')}, on black and white"
    pops = any(each.popping is not None for each in summary)
    head = f" {'popping':>7} {'most':>5}" if pops else ""
    yield f"  {'budget':>8} {'splats':>10} {'PSNR':>6} {'least':>6} {'SSIM':>6} {'edges':>6}{head}  worst tile"
    for each in summary:
        popped = f" {_or_dash(each.popping):>7} {_or_dash(each.popping_max):>5}" if pops else ""
        yield (
            f"  {each.text:>8} {round(each.selected):>10,} {each.psnr:>6.2f} {each.psnr_min:>6.2f} {each.ssim:>6.4f}"
            f" {_or_dash(each.edge_psnr):>6}{popped}  {each.worst_tile_psnr:.2f}"
            f" at {each.worst_tile_x}, {each.worst_tile_y} of frame {each.worst_frame:,}"
        )


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
