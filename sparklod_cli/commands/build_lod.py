"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import click

from ..codecs.file_names import MANIFEST
from ..support import interrupts
from ..support.errors import SparklodError
from ..support.printable import MOST, shortened
from ..support.stdin import DASH, name_of
from .build_lod_inputs import Inputs, check_inputs, input_options, record_of
from .build_lod_jobs import job_of
from .build_lod_outputs import BY_DATE, VERIFY, Outputs, check_formats
from .command import COMMON, Command, option
from .console import say
from .options.baking import STREAMED_SOG, baking_options, check_method, method_of
from .options.cluster import OF_CLUSTERS, check_cluster, cluster_of, cluster_options
from .options.common import General, common_options, output_option, overwrite_option
from .options.refining import check_refining
from .options.resources import HEADING as LARGE
from .options.resources import OF_BAKES, resources_options
from .paths import NAMELESS, Folder, OutputPath, claim_stdout, is_same_place, keep_apart, with_chunks
from .usage import exclude, options_of

EXAMPLES = """
\b
Examples:
  sparklod build-lod scene.ply                          # writes scene-lod.spz
  sparklod build-lod scene.ply --up -y                  # y up, as viewers want it
  sparklod build-lod scene.ply --method quality         # for publishing
  sparklod build-lod scene.ply --method quality --refine    # the closest to full detail, in minutes
  sparklod build-lod scans/*.ply --output-dir web -f --skip-existing
  sparklod build-lod scans/*.ply --output-dir web --workers 4
  sparklod build-lod tiles/*.ply --merge -o city-lod.rad
  sparklod build-lod city.ply -o city-lod.rad --memory 4G --scratch-dir /fast
  sparklod build-lod s3://bucket/city.ply --scheduler tcp://host:8786 --scratch-dir s3://bucket/scratch
  cat scene.ply | sparklod build-lod - -o - | aws s3 cp - s3://bucket/scene-lod.spz
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
  sparklod build-lod scene.ply --format rad             # scene-lod.rad, which Spark streams
  sparklod build-lod scene.ply -o web/scene.rad --cluster-sh
  sparklod build-lod scene-lod.spz --format rad         # the same tree in the other format
  sparklod build-lod scene-lod.spz --refine             # the same tree, fitted: scene-lod-refined.spz
  sparklod build-lod scene.ply -o web/lod-meta.json     # Streamed SOG, which PlayCanvas streams
  sparklod build-lod scene.ply --format streamed-sog --levels 50%,25%,10%    # scene-lod/lod-meta.json
  sparklod build-lod scene.sog --encoding ext           # writes scene-lod.npz
  sparklod build-lod scene-lod.spz --unlod -o scene.ply
  sparklod build-lod scene-lod.spz --unlod -o scene.sog # for PlayCanvas
"""

BOTH = "--output cannot be used with --output-dir"


@click.command("build-lod", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@input_options
@output_option(
    "Output of a single input, or a folder for all outputs; - is standard output.  [default: NAME-lod.spz beside the"
    f" input; NAME-lod.rad with --format rad, NAME-lod/{MANIFEST} with --format {STREAMED_SOG}, NAME-lod.npz with"
    " --encoding, NAME-unlod.spz with --unlod, NAME-lod-refined.spz of a NAME-lod.spz with --refine]",
    addresses=True,
)
@option(
    "--output-dir",
    heading=COMMON,
    metavar="DIR",
    type=OutputPath(folder=True, addresses=True),
    help="Folder for the outputs; created if it does not exist.",
    show_default=False,
)
@overwrite_option
@option(
    "--skip-existing",
    heading=LARGE,
    metavar="[=verify]",
    type=click.Choice([BY_DATE, VERIFY]),
    bare=BY_DATE,
    help="Bake nothing whose output is there already, of the same inputs and settings; a small file beside each output,"
    " NAME.sparklod.json, tells of what it is. Files whose size and date are unchanged are not read;"
    " --skip-existing=verify reads all, and so finds damage that left both as they were.",
)
@option(
    "--unlod",
    heading=COMMON,
    is_flag=True,
    help="Write the leaves of Level-of-Detail files instead: the original splats as the file holds them, rounded, with"
    " opacities that make up for it. As SPZ or, by the name of FILE, .rad, .ply, .sog, DIR/meta.json (an unpacked SOG)"
    " or .splat, which has no SH.",
)
@baking_options
@resources_options
@cluster_options
@common_options
@click.pass_context
def build_lod(ctx: click.Context, /, **_: Any) -> None:
    """Bake splat files into Level-of-Detail files for Spark, PlayCanvas, SuperSplat and Babylon.js.

    Reads PLY (also PlayCanvas's compressed PLY), SPZ, RAD, SOG (.sog, or a folder with a meta.json), Streamed SOG
    (its full detail), .splat and .ksplat; merges splats into a tree, and writes the tree as SPZ with Spark's
    extension, or as RAD, which Spark streams, or cuts of it as Streamed SOG, which the others stream. An INPUT of - is
    standard input.

    The axes of the input are kept unless --up or --rotate turns them. Selection goes by the coordinates of the input;
    of merged inputs, by those at which they stand together.

    INPUT, FILE and DIR may be addresses such as s3://bucket/scan.ply (extra cloud).

    An input that fails does not stop the others; the exit status is 1 if any did. With --workers or --scheduler,
    several inputs are baked side by side (extra cluster).
    """
    general, given, outputs = options_of(ctx, General), options_of(ctx, Inputs), _outputs(ctx)
    check_inputs(ctx, given, outputs)
    instances = given.instances()
    _check(ctx, given, [each.file for each in instances if each.file is not None], outputs, general)
    failed = False
    with general.console() as console, cluster_of(ctx, general, console) as engine:
        make, report = job_of(ctx, outputs, general, console, engine)
        pairs = list(given.jobs(instances, outputs, console.say))
        for (source, target), outcome in zip(pairs, make(pairs), strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
                record = {**record_of(source), "error": shortened(str(outcome), MOST)}
            elif outcome is None:
                console.say(f"{name_of(source)}  ->  {target}  is there already")
                record = {**record_of(source), "output": str(target), "skipped": True}
            else:
                report(console, source, target, outcome)
                record = {**record_of(source), "output": str(target), **dataclasses.asdict(outcome)}
            if general.as_json:
                click.echo(json.dumps(record))
            if interrupts.came():  # while merged splats were fitted, which ended early then
                console.clear()
                say("interrupted")
                ctx.exit(interrupts.INTERRUPTED)
    if failed:
        ctx.exit(1)


def _outputs(ctx: click.Context) -> Outputs:
    """Return where outputs go; an --output that names a folder is an --output-dir."""
    output = ctx.params["output"]
    if isinstance(output, Folder):
        if ctx.params["output_dir"] is not None:
            raise click.UsageError(BOTH)
        ctx.params.update(output=None, output_dir=output.path)
    return options_of(ctx, Outputs)


def _check(ctx: click.Context, given: Inputs, named: list[Path], outputs: Outputs, general: General) -> None:
    """Raises a `click.UsageError` where options contradict each other, or the names of files."""
    inputs = given.inputs
    if outputs.output is not None:
        if outputs.output_dir is not None:
            raise click.UsageError(BOTH)
        if len(inputs) > 1 and not given.merge:
            raise click.UsageError(
                f"--output takes one input, not {len(inputs)}; add --merge to bake them as one scene, or name a folder"
            )
    elif DASH in inputs:
        raise click.UsageError(NAMELESS)
    targets = [outputs.output] if outputs.output is not None else [outputs.target(source) for source in inputs]
    if outputs.may_replace_inputs and not given.is_merged:
        targets = [target for source, target in zip(inputs, targets, strict=True) if not is_same_place(source, target)]
    if outputs.is_chunked or outputs.is_folder or outputs.is_streamed_sog:
        targets = with_chunks(targets)
    keep_apart(ctx, {"output" if outputs.output_dir is None else "output_dir": targets, "scene": named})
    claim_stdout(ctx, "output", as_json=general.as_json, binary=True)
    if ctx.params["rgba"] is not None and len(inputs) > 1:
        raise click.UsageError(f"--rgba takes one input, not {len(inputs)}")
    if ctx.params["skip_existing"] and outputs.output == DASH:
        raise click.UsageError("--skip-existing needs an output that can be there already; name a file")
    check_formats(ctx, outputs)
    check_cluster(ctx)
    check_refining(ctx)
    if outputs.unlod:
        exclude(ctx, (*OF_BAKES, *OF_CLUSTERS, "refine", "skip_existing"), "--unlod")
    else:
        check_method(ctx, method_of(ctx, streamed_sog=outputs.is_streamed_sog))
    if DASH in inputs:
        exclude(ctx, OF_CLUSTERS, "standard input, which workers cannot read; save it to a file first")
