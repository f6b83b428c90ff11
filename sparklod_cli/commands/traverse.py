"""`sparklod traverse`: simulates budgeted cuts along a camera path."""

from __future__ import annotations

import functools
import json
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from .command import COMMON, Command
from .console import Console, for_screen, is_terminal
from .options import cameras, cut, inputs, streamed_sog, streaming
from .options import table as tables
from .options.camera_options import camera_options
from .options.common import General, common_options
from .paths import claim_stdout, keep_apart, name_outputs
from .usage import options_of

if TYPE_CHECKING:
    from ..api.jobs import Traversed
    from ..cameras.path import CameraPath
    from ..scenes.loaded import Scenes

#: Below this share of splats in front of the cameras, path and scene probably do not share their axes.
LEAST_IN_FRONT = 0.05

EXAMPLES = """
\b
Examples:
  sparklod traverse scene-lod.spz --budget 500k            # an orbit; the summary, or CSV into a pipe
  sparklod traverse scene-lod.spz --camera-path path.json -o frames.csv --summary
  sparklod traverse scene-lod.spz --preset quest --assert 'churn_p95<0.2'    # exit status 3
  sparklod traverse scene-lod.spz --dolly --bandwidth 20Mbit --latency 60ms --plot path.png
  sparklod traverse --scene city.json --keyframes '0,-2,9:0,0,0 9,-2,0:0,0,0' --per-instance
  sparklod traverse scene-lod.spz --look-at 0,-1,4:0,0,0 --indices-out cuts --padded
"""

HEADINGS = (
    *(COMMON, inputs.HEADING, cameras.HEADING, cut.HEADING, streamed_sog.HEADING),
    *(streaming.HEADING, tables.HEADING),
)


@click.command("traverse", cls=Command, headings=HEADINGS, epilog=EXAMPLES, context_settings={"show_default": True})
@tables.table_options
@inputs.input_options
@camera_options
@cut.cut_options
@streamed_sog.detail_options
@streaming.streaming_options
@functools.partial(
    common_options, json="Print the summary as one JSON object on standard output; write a table only to --output."
)
@click.pass_context
def traverse(ctx: click.Context, /, **_: Any) -> None:
    """Simulate what a viewer draws of Level-of-Detail files or Streamed SOG along a camera path.

    Finds the cut of every frame as Spark's traversal would find it: the nodes of the trees that a viewer draws within
    its budget. Reports how fine the cuts are, how much changes from frame to frame, and what has to be fetched, as a
    table with a row for each frame. Files are those that build-lod writes; several share one budget.

    Of Streamed SOG, the cut is made of the detail levels that PlayCanvas would choose for the regions of the scene.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    files, where, lod = options_of(ctx, inputs.Inputs), options_of(ctx, cameras.Cameras), options_of(ctx, cut.Cut)
    name_outputs(ctx, files.first)
    network, place, general = (
        options_of(ctx, streaming.Streaming),
        options_of(ctx, tables.Table),
        options_of(ctx, General),
    )
    levels = options_of(ctx, streamed_sog.Detail)
    for group in (where, lod, levels, network):
        group.check(ctx)
    place.check(ctx, as_json=general.as_json)
    claim_stdout(ctx, "output", as_json=general.as_json)
    budget = lod.one_budget()
    instances = files.instances()
    besides = {"scene": files.read(instances), "world_transform": where.files()}
    keep_apart(ctx, besides)
    outputs = place.outputs(as_json=general.as_json)
    asserts = place.assertions()
    start = time.perf_counter()
    with general.console() as console:
        from ..api.jobs import UnfitError, ViewedFiles, traverse_files

        def ready(path: CameraPath, scenes: Scenes) -> None:
            for note in path.notes:
                console.say(note)
            streamed_sog.check_scenes(ctx, scenes)
            keep_apart(ctx, {**besides, "indices_out": outputs.index_files(path.numbers, len(instances))})

        console.announce_compiling()
        screen = outputs.table.on_stdout and is_terminal(sys.stdout)
        files_viewed = ViewedFiles(
            instances, where.camera_source(), where.settings(), lod.precision, general.threads, console.progress
        )
        try:
            with where.usage_errors():
                traversed = traverse_files(
                    files_viewed,
                    budget,
                    lod.settings(1, levels.rule()),
                    network.settings(),
                    outputs,
                    by_instance=place.per_instance,
                    asserts=asserts,
                    ready=ready,
                    passed=for_screen if screen and outputs.table.form != "parquet" else None,
                    bar=not screen,  # a bar and a table do not go together on one screen
                )
        except UnfitError as error:
            raise click.UsageError(str(error)) from None
        written, cameras_read = traversed.frames, len(traversed.path.cameras)
        console.clear()
        console.detail(f"  {cameras_read:,} frames of {traversed.path.format}, {time.perf_counter() - start:.2f} s")
        if written.note:
            console.say(f"{outputs.plot}: {written.note}")
        if written.in_front < LEAST_IN_FRONT:
            console.say(
                f"warning: only {written.in_front:.1%} of the splats lie in front of the cameras; path and scene may"
                " not share their axes (--camera-axes, --world-transform, --up)"
            )
        on_stdout = place.summary_on_stdout(as_json=general.as_json)
        ctx.exit(_report(console, traversed, place.summary, as_json=general.as_json, on_stdout=on_stdout))


def _report(console: Console, traversed: Traversed, summary: bool | None, *, as_json: bool, on_stdout: bool) -> int:
    """Prints the results of a traversal; returns the exit status.

    Args:
        console: prints them on standard error.
        traversed: the results.
        summary: print the summary; None prints it if standard error is a terminal.
        as_json: print it as JSON on standard output.
        on_stdout: print it on standard output, instead of the table.
    """
    from .traverse_text import lines

    whole, outcomes = traversed.summary, traversed.outcomes
    if as_json:
        held = [{"assert": each.assertion.text, "held": each.held, "value": each.value} for each in outcomes]
        click.echo(json.dumps(whole.as_dict() | {"asserts": held}, allow_nan=False))
    if on_stdout and summary is not False:
        click.echo("\n".join(lines(whole)))
    elif summary or (summary is None and is_terminal(sys.stderr)):
        for line in lines(whole):
            console.say(line)
    for outcome in outcomes:
        if not outcome.held:
            console.error(outcome.message())
        else:
            console.detail(f"  holds: {outcome.message()}")
    return 0 if all(outcome.held for outcome in outcomes) else 3
