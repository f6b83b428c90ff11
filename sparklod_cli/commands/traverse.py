"""`sparklod traverse`: simulates budgeted cuts along a camera path."""

from __future__ import annotations

import functools
from typing import Any

import click

from ..tables.files import FORMS
from .camera_options import camera_options, cameras_from
from .command import Command
from .console import Console
from .options.common import common_options, overwrite_option, table_form
from .paths import OutputPath, claim_stdout, keep_apart
from .usage import exclude
from .world_options import files_meant, placements_from, streaming_from, viewer_from, viewer_options, world_options

#: Below this share of splats in front of the cameras, path and scene probably do not share their axes.
LEAST_IN_FRONT = 0.05

#: Options of the table.
OF_TABLES = ("form", "per_instance", "no_timing")

EXAMPLES = """
\b
Examples:
  sparklod traverse scene-lod.spz --budget 500k            # an orbit, CSV on standard output
  sparklod traverse scene-lod.spz --camera-path path.json -o frames.csv --summary
  sparklod traverse scene-lod.spz --preset quest --assert 'churn_p95<0.2'    # exit status 3
  sparklod traverse scene-lod.spz --dolly --bandwidth 20Mbit --latency 60ms --plot path.png
  sparklod traverse --scene city.json --keyframes '0,-2,9:0,0,0 9,-2,0:0,0,0' --per-instance
  sparklod traverse scene-lod.spz --look-at 0,-1,4:0,0,0 --indices-out cuts --padded
"""


@click.command("traverse", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@world_options
@camera_options
@viewer_options
@click.option("-o", "--output", metavar="FILE", type=OutputPath(), help="Of the table.  [default: standard output]")
@overwrite_option
@click.option(
    "--format",
    "form",
    type=click.Choice(list(FORMS)),
    help="Of the table.  [default: by the name of --output, or csv]",
)
@click.option("--per-instance", is_flag=True, help="A row for each instance, too.")
@click.option("--no-timing", is_flag=True, help="Leave out traverse_ms, so that two runs give the same bytes.")
@click.option(
    "--summary/--no-summary",
    default=None,
    help="Say on standard error what the frames come to.  [default: if that is a terminal]",
)
@click.option(
    "--assert",
    "asserts",
    metavar="TEXT",
    multiple=True,
    help="What must hold, such as 'churn_p95<0.2'; the exit status is 3 if it does not.",
)
@click.option(
    "--plot", metavar="FILE", type=OutputPath(suffixes=[".png"]), help="Draw the table and the path as a .png."
)
@click.option(
    "--indices-out",
    metavar="DIR",
    type=OutputPath(folder=True),
    help="Write the nodes of every cut as .npy of uint32.",
)
@click.option("--padded", is_flag=True, help="Fill them up to rows of 16,384, as Spark's index texture has them.")
@functools.partial(
    common_options, json="Print the summary, as one JSON object, on standard output; the table goes to --output alone."
)
@click.pass_context
def traverse(ctx: click.Context, /, as_json: bool, quiet: bool, verbose: bool, **settings: Any) -> None:
    """Simulate what a viewer draws of Level-of-Detail files along a camera path.

    Finds for every frame the cut that Spark's traversal would find: the nodes of the trees that it draws within its
    budget. Tells how fine they are, how many change from frame to frame, and what has to be fetched, as a table with a
    row a frame. Files are those that build-lod writes; several are drawn together, within one budget.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    from ..scenes.reading import TRAVERSED, read_scenes
    from ..simulation import columns
    from ..simulation.frames import Simulation
    from ..tables import assertions
    from .traverse_job import Job, Wanted

    viewer = viewer_from(ctx, settings)
    placements = placements_from(settings)
    keep_apart(ctx, files_meant(settings, placements))
    form = table_form("--output", settings["output"], settings["form"])
    try:
        asserts = [assertions.parse(text, columns.COLUMNS) for text in settings["asserts"]]
    except assertions.BadAssertionError as error:
        raise click.UsageError(f"--assert {error}") from None
    wanted = Wanted(
        output=settings["output"],
        form=form,
        columns=columns.select(timing=not settings["no_timing"]),
        summary=settings["summary"],
        as_json=as_json,
        asserts=asserts,
        plot=settings["plot"],
        indices=settings["indices_out"],
        padded=settings["padded"],
        overwrite=settings["overwrite"],
    )
    claim_stdout(ctx, "output", as_json=as_json)
    if as_json and wanted.output is None:
        exclude(ctx, OF_TABLES, "--json without --output, which writes no table")
    if wanted.padded and wanted.indices is None:
        raise click.UsageError("--padded only means something with --indices-out")
    with Console(quiet=quiet, verbose=verbose) as console:
        from ..model.splats import COLUMNS

        console.announce_compiling("traverse")
        wanted.check()
        world = read_scenes(
            placements,
            trees_only=True,
            columns=TRAVERSED if wanted.plot is None else COLUMNS,
            precision=settings["precision"],
            threads=settings["threads"],
            progress=console.progress,
        )
        path = cameras_from(settings, world.balls)
        try:
            simulation = Simulation(world, viewer, streaming_from(settings), by_instance=settings["per_instance"])
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        for note in path.notes:
            console.say(note)
        job = Job(console, wanted, simulation, path)
        keep_apart(ctx, {**files_meant(settings, placements), "indices_out": job.index_files()})
        job.run(settings["threads"])
        if job.in_front < LEAST_IN_FRONT:
            console.say(
                f"warning: only {job.in_front:.1%} of the splats lie in front of the cameras; path and scene may not"
                " share their axes (--camera-axes, --world-transform, --up)"
            )
        ctx.exit(job.report())
