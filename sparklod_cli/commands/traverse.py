"""`sparklod traverse`: simulates budgeted cuts along a camera path."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..lod.budget import doubt
from ..system.progress import silent
from ..system.setting_fields import setting
from ..system.units import format_size, percent_of
from ..system.untrusted import printable
from ..tables.columns import FORMS
from ..viewers.viewer_settings import StreamingSettings
from .command import COMMON, Command, common, flag, values_of
from .console import WIDTH, Console, count_of, for_screen, is_terminal, print_json, rows
from .option_groups import ASSERT, JSON, OUTPUT, OVERWRITE, PNG, General, parse_asserts, report_outcomes, table_output
from .outputs import NamedPath, keep_apart, name_outputs
from .rules import check
from .viewing_options import Cameras, CutOptions, Inputs, check_view, files_read, scenes_of

if TYPE_CHECKING:
    from ..simulation.results import Summary
    from ..tables.columns import Row

#: Below this share of splats in front of the cameras, path and scene probably do not share their axes.
LEAST_IN_FRONT = 0.05

EXAMPLES = """\
  sparklod traverse scene-lod.spz --budget 500k    # an orbit
  sparklod traverse scene-lod.spz --camera-path path.json -o frames.csv
  sparklod traverse scene-lod.spz --assert 'churn_p95<0.2'    # exit status 3
  sparklod traverse scene-lod.spz --dolly --bandwidth 20Mbit --plot path.png
  sparklod traverse scene-lod.spz --preset quest --json
  sparklod traverse scene-lod.rad --bandwidth 20Mbit --latency 60ms
  sparklod traverse --scene city.json \\
    --keyframes '0,-2,9:0,0,0 9,-2,0:0,0,0' --per-instance
  sparklod traverse scene-lod.spz \\
    --look-at 0,-1,4:0,0,0 --indices-out cuts --padded
"""


@dataclass(frozen=True)
class TraverseOptions:
    """Options of traverse."""

    HEADING: ClassVar[str] = "Output"

    output: Path | None = setting(
        "Output of the table: .csv, .json or .parquet; - is standard output.  [default: standard output; a terminal"
        " gets the summary]",
        NamedPath(output=True),
        **OUTPUT,
    )
    overwrite: bool = flag(**OVERWRITE)
    summary: bool | None = common(
        "Print a summary of the frames on standard error.  [default: if that is a terminal]",
        flags=("--summary/--no-summary",),
    )
    asserts: tuple[str, ...] = common(
        "Condition that must hold, such as 'churn_p95<0.2'; the exit status is 3 if it does not.", **ASSERT
    )
    plot: Path | None = common("Draw charts of the table and the path over the scene, as a .png.", PNG)
    form: str | None = setting(
        "Format of the table.  [default: by the suffix of --output, or csv]", tuple(FORMS), flags=("--format",)
    )
    per_instance: bool = flag("Write a row for each instance, besides that of all together.")
    no_timing: bool = flag("Leave out traverse_ms, the time of each traversal, so that two runs write the same bytes.")
    indices_out: Path | None = setting(
        "Write the nodes of every cut to DIR, as .npy of uint32.", NamedPath(output=True, folder=True)
    )
    padded: bool = flag("With --indices-out: pad each file to rows of 16,384 nodes, as Spark's index texture has them.")

    inputs: Inputs = field(default_factory=Inputs)
    cameras: Cameras = field(default_factory=Cameras)
    cut: CutOptions = field(default_factory=CutOptions)
    streaming: StreamingSettings = field(default_factory=StreamingSettings)
    as_json: bool = flag(
        "Print the summary as one JSON object on standard output; write a table only to --output.", **JSON
    )
    general: General = field(default_factory=General)


HEADINGS = (COMMON, "Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming", "Output")


@click.command("traverse", cls=Command, options=TraverseOptions, examples=EXAMPLES, headings=HEADINGS)
@click.pass_context
def traverse(ctx: click.Context, /, **_: Any) -> None:
    """Simulate what a viewer draws of Level-of-Detail files or Streamed SOG along a camera path.

    Finds the cut of every frame as Spark's traversal would find it: the nodes of the trees that a viewer draws within
    its budget. Reports how fine the cuts are, how much changes from frame to frame, and what has to be fetched, as a
    table with a row for each frame. Files are those that build-lod writes; several share one budget.

    Of Streamed SOG, the cut is made of the detail levels that PlayCanvas would choose for the regions of the scene.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    name_outputs(ctx, ctx.params["scene"] or next(iter(ctx.params["files"]), None))
    options = values_of(ctx, TraverseOptions)
    general = options.general
    budget = options.cut.one_budget()
    instances = options.inputs.instances()
    besides = files_read(options.cameras, instances)
    keep_apart(ctx, besides)
    from ..simulation import results

    columns = [each for each in results.COLUMNS if each.name not in results.TIMING or not options.no_timing]
    table = table_output(
        options.output, columns, overwrite=options.overwrite, as_json=options.as_json, form=options.form
    )
    check(ctx, table=table.form or "none")
    outputs = results.FrameOutputs(table, options.indices_out, options.padded, options.plot, options.overwrite)
    asserts = parse_asserts(options.asserts, (*results.COLUMNS, *results.LOADING))
    start = time.perf_counter()
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.view_jobs import traverse_files
        from ..model.splats import COLUMNS
        from ..viewers.loaded_scene import TRAVERSED

        if question := doubt(budget.count):
            console.say(question)
        console.announce_compiling("cuts")
        screen = table.path is None and table.form is not None and is_terminal(sys.stdout)
        outputs.check()
        held = TRAVERSED if outputs.plot is None else COLUMNS
        scenes = scenes_of(options.cut, general, instances, console, columns=held, trees_only=True, paged=True)
        path = options.cameras.path(scenes)
        check_view(ctx, console, options.cameras, path, scenes(), options.streaming.network)
        keep_apart(ctx, {**besides, "indices_out": outputs.index_files(path.numbers, len(instances))})
        whole, outcomes, in_front, note = traverse_files(
            scenes(),
            path,
            budget,
            options.cut.settings(),
            options.streaming,
            outputs,
            by_instance=options.per_instance,
            asserts=asserts,
            passed=for_screen if screen and table.form != "parquet" else None,
            threads=general.threads,
            progress=silent if screen else console.progress,  # a bar and a table do not go together on one screen
        )
        console.clear()
        console.detail(f"  {len(path.cameras):,} frames of {path.format}, {time.perf_counter() - start:.2f} s")
        if table.path is not None:
            console.say(f"{table.path}  table of {count_of(len(path.cameras), 'frame')}")
        if note:
            console.say(f"{outputs.plot}: {note}")
        if in_front < LEAST_IN_FRONT:
            share = percent_of(in_front, 2)
            console.say(
                f"warning: only {share} of the splats lie in front of the cameras; path and scene may"
                " not share their axes (--camera-axes, --world-transform, --up)"
            )
        on_stdout = table.form is None and not options.as_json
        if options.as_json:
            print_json(whole.as_dict() | {"asserts": [each.as_dict() for each in outcomes]})
        if on_stdout and options.summary is not False:
            click.echo("\n".join(lines(whole)))
        elif options.summary or (options.summary is None and is_terminal(sys.stderr)):
            for line in lines(whole):
                console.say(line)
        if outcomes:
            ctx.exit(report_outcomes(console, outcomes))


#: Names of the quantities, and the style of their numbers, see `_said`.
QUANTITIES = {
    "selected": ("splats drawn", "count"),
    "budget_used": ("budget used", "share"),
    "pixel_scale_min": ("pixel scale", "plain"),
    "projected_px_p95": ("large splats, px", "fixed"),
    "overdraw_estimate": ("overdraw", "fixed"),
    "in_frustum_share": ("inside the frustum", "share"),
    "chunks_new": ("chunks fetched", "count"),
    "bytes_new": ("bytes fetched", "bytes"),
    "missing": ("missing", "count"),
    "complete_in_s": ("complete in", "seconds"),
    "churn": ("churn", "share"),
    "traverse_ms": ("traversal", "ms"),
}

#: Texts of the criteria by which frames stand out, and the style of their values.
MOMENTS = {
    "churn": ("{} of the splats pop", "share"),
    "bytes": ("{} are fetched", "bytes"),
    "coarsest": ("coarsest: {} times the pixel limit", "plain"),
    "missing": ("splats drawn too coarse: {}", "count"),
    "incomplete": ("{} until it is complete", "seconds"),
    "overdraw": ("{} splats cover a pixel", "fixed"),
}

#: Styles of numbers, but for bytes, which are written by `format_size`.
STYLES = {
    "count": "{:,.0f}",
    "share": "{:.1f} %",
    "seconds": "{:.2f} s",
    "ms": "{:.2f} ms",
    "fixed": "{:.1f}",
    "plain": "{:.4g}",
}

STOPS = {
    "budget": "at the budget",
    "pixel": "at the pixel limit",
    "exhausted": "in full detail",
    "missing": "at missing chunks",
    "distance": "at the levels that distances ask for",
}


def lines(summary: Summary) -> Iterator[str]:
    """Yield the lines of a summary."""
    yield from rows("path", f"{count_of(summary.frames, 'frame')}, {summary.seconds:.3f} s")
    if summary.stop_reasons:
        stops = (
            f"{_said(share, 'share')} {STOPS.get(reason, reason)}" for reason, share in summary.stop_reasons.items()
        )
        yield from rows("stops", ", ".join(stops))
    if summary.chunks:
        first = f"{format_size(summary.bytes_first)} in {count_of(summary.chunks_first, 'chunk')} for the first frame"
        yield from rows("fetches", f"{format_size(summary.bytes)} in {count_of(summary.chunks, 'chunk')}, {first}")
    if summary.loading:
        yield from rows("opens", _loading(summary.loading))
    if summary.quantities:
        yield from rows("a frame", f"{'':<18} {'min':>11} {'median':>11} {'p95':>11} {'max':>11}")
        for quantity in summary.quantities:
            name, style = QUANTITIES[quantity.name]
            numbers = (quantity.min, quantity.p50, quantity.p95, quantity.max)
            yield from rows("", f"{name:<18} " + " ".join(f"{_said(number, style):>11}" for number in numbers))
    if summary.moments:
        yield from rows("look at", f"{'frame':>7} {'time':>11}")
        for moment in summary.moments:
            text, style = MOMENTS[moment.criterion]
            time_s = "" if moment.time_s is None else f"{moment.time_s:.3f} s"
            name = f"  {printable(moment.name, WIDTH)}" if moment.name else ""
            what = text.format(_said(moment.value, style))
            yield from rows("", f"{moment.frame:>7,} {time_s:>11}  {what}{name}")


def _loading(figures: Row) -> str:
    """Return the waiting times of a visitor who opens the page at the first camera."""
    parts = []
    for label, name in (("first picture", "first_picture"), ("90 %", "resident_90"), ("all", "resident_all")):
        seconds, size = figures[f"{name}_s"], figures.get(f"{name}_bytes")
        text = "never" if seconds is None else f"after {seconds:.2f} s"
        parts.append(f"{label} {text}" + (f" and {format_size(size)}" if isinstance(size, int) else ""))
    return ", ".join(parts)


def _said(value: float, style: str) -> str:
    if style == "bytes":
        return format_size(round(value)) if value else "0"
    return STYLES[style].format(100 * value if style == "share" else value)
