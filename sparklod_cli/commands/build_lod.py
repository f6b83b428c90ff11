"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

from ..codecs.rad.names import SUFFIX as RAD
from ..support.addresses import Place
from ..support.errors import SparklodError
from ..support.printable import MOST, shortened
from ..support.stdin import DASH, name_of
from .build_lod_outputs import Outputs, check_formats
from .command import COMMON, Command, option
from .options.baking import bake_settings, baking_options, check_method, write_options
from .options.cluster import OF_CLUSTERS, check_cluster, cluster_of, cluster_options
from .options.common import General, common_options, output_option, overwrite_option
from .options.resources import OF_BAKES, resources_of, resources_options
from .paths import InputPath, OutputPath, claim_stdout, keep_apart, with_chunks
from .reports import report_baked, report_extracted
from .usage import exclude, options_of

if TYPE_CHECKING:
    from ..api.bake_jobs import Baked, ClusterEngine, Extracted
    from .console import Console

    Pairs = Sequence[tuple[Place, Place]]
    Make = Callable[[Pairs], Iterator[Baked | Extracted | SparklodError]]

EXAMPLES = """
\b
Examples:
  sparklod build-lod scene.ply                          # writes scene-lod.spz
  sparklod build-lod scene.ply --up -y                  # y up, as viewers want it
  sparklod build-lod scene.ply --method quality         # for publishing
  sparklod build-lod scans/*.ply --output-dir web -f
  sparklod build-lod scans/*.ply --output-dir web --workers 4
  sparklod build-lod city.ply -o city-lod.rad --memory 4G --scratch-dir /fast
  sparklod build-lod s3://bucket/city.ply --scheduler tcp://host:8786 --scratch-dir s3://bucket/scratch
  cat scene.ply | sparklod build-lod - -o - | aws s3 cp - s3://bucket/scene-lod.spz
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
  sparklod build-lod scene.ply --format rad             # scene-lod.rad, which Spark streams
  sparklod build-lod scene.ply -o web/scene.rad --cluster-sh
  sparklod build-lod scene-lod.spz --format rad         # the same tree in the other format
  sparklod build-lod scene.sog --encoding ext           # writes scene-lod.npz
  sparklod build-lod scene-lod.spz --unlod -o scene.ply
"""


@click.command("build-lod", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=InputPath(stdin=True, addresses=True))
@output_option(
    "Output of a single input; - is standard output.  [default: NAME-lod.spz beside the input;"
    " NAME-lod.rad with --format rad, NAME-lod.npz with --encoding, NAME-unlod.spz with --unlod]",
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
    "--unlod",
    heading=COMMON,
    is_flag=True,
    help="Write the original splats of Level-of-Detail files instead, as SPZ or, by the name of FILE, .rad, .ply or"
    " .splat.",
)
@baking_options
@resources_options
@cluster_options
@common_options
@click.pass_context
def build_lod(ctx: click.Context, /, inputs: tuple[Place, ...], **_: Any) -> None:
    """Bake splat files into Level-of-Detail files for Spark.

    Reads PLY (also PlayCanvas's compressed PLY), SPZ, RAD, SOG (.sog, or a folder with a meta.json), .splat and
    .ksplat; merges splats into a tree, and writes the tree as SPZ with Spark's extension, or as RAD, which Spark
    streams. An INPUT of - is standard input.

    The axes of the input are kept unless --up or --rotate turns them. Selection goes by the coordinates of the input.

    INPUT, FILE and DIR may be addresses such as s3://bucket/scan.ply (pip install 'sparklod[cloud]').

    An input that fails does not stop the others; the exit status is 1 if any did. With --workers or --scheduler,
    several inputs are baked side by side (pip install 'sparklod[cluster]').
    """
    general, outputs = options_of(ctx, General), options_of(ctx, Outputs)
    _check(ctx, inputs, outputs, general)
    failed = False
    with general.console() as console, cluster_of(ctx, general, console) as engine:
        pairs = [(source, outputs.target(source)) for source in inputs]
        make, report = _job(ctx, outputs, general, console, engine)
        for (source, target), outcome in zip(pairs, make(pairs), strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
                record: dict[str, Any] = {"input": str(source), "error": shortened(str(outcome), MOST)}
            else:
                report(console, source, target, outcome)
                record = {"input": str(source), "output": str(target), **dataclasses.asdict(outcome)}
            if general.as_json:
                click.echo(json.dumps(record))
    if failed:
        ctx.exit(1)


def _check(ctx: click.Context, inputs: tuple[Place, ...], outputs: Outputs, general: General) -> None:
    """Raises a `click.UsageError` where options contradict each other, or the names of files."""
    if outputs.output is not None:
        if outputs.output_dir is not None:
            raise click.UsageError("--output cannot be used with --output-dir")
        if len(inputs) > 1:
            raise click.UsageError(f"--output takes one input, not {len(inputs)}; use --output-dir")
    elif DASH in inputs:
        raise click.UsageError("standard input has no name to derive one from; give --output")
    targets = [outputs.target(source) for source in inputs]
    if outputs.is_chunked:
        targets = with_chunks(targets)
    keep_apart(ctx, {"output" if outputs.output_dir is None else "output_dir": targets})
    claim_stdout(ctx, "output", as_json=general.as_json, binary=True)
    if ctx.params["rgba"] is not None and len(inputs) > 1:
        raise click.UsageError(f"--rgba takes one input, not {len(inputs)}")
    check_formats(ctx, outputs)
    check_cluster(ctx)
    if outputs.unlod:
        exclude(ctx, (*OF_BAKES, *OF_CLUSTERS), "--unlod")
    else:
        check_method(ctx)
    if DASH in inputs:
        exclude(ctx, OF_CLUSTERS, "standard input, which workers cannot read; save it to a file first")


def _job(
    ctx: click.Context, outputs: Outputs, general: General, console: Console, engine: ClusterEngine | None
) -> tuple[Make, Callable[..., None]]:
    """What makes outputs of inputs, and what reports one; the point where numpy and numba are loaded."""
    from ..api.bake_jobs import bake, bake_side_by_side, extract_leaves

    shared: dict[str, Any] = {"overwrite": outputs.overwrite, "progress": console.progress}
    make: Callable[..., Baked | Extracted]
    if outputs.unlod:
        make = functools.partial(extract_leaves, suffix=outputs.suffix, options=write_options(ctx), **shared)
        return _one_by_one(functools.partial(make, threads=general.threads)), report_extracted
    settings = bake_settings(ctx, suffix=outputs.suffix, raw=outputs.is_raw, converts=outputs.format_is_asked_for)
    more = [] if outputs.suffix != RAD else ["rad"] if settings.options.rad.sh_codes is None else ["rad", "palette"]
    console.announce_compiling(settings.method, *more)
    resources = resources_of(ctx)
    shared |= {"settings": settings, "threads": general.threads, "say": console.say}
    if engine is None:
        return _one_by_one(functools.partial(bake, resources=resources, **shared)), report_baked
    resources = dataclasses.replace(resources, memory=engine.memory)
    make = functools.partial(bake, resources=resources, engine=engine, **shared)
    if len(ctx.params["inputs"]) == 1:
        return _one_by_one(make), report_baked
    return functools.partial(
        bake_side_by_side,
        settings=settings,
        engine=engine,
        resources=resources,
        bake_large=functools.partial(_outcome, make),
        overwrite=outputs.overwrite,
        progress=console.progress,
    ), report_baked


def _one_by_one(make: Callable[..., Baked | Extracted]) -> Make:
    """Makes outputs of inputs one after the other."""
    return lambda pairs: (_outcome(make, *pair) for pair in pairs)


def _outcome(make: Callable[..., Baked | Extracted], source: Place, target: Place) -> Baked | Extracted | SparklodError:
    """What came of an input, so that one which fails does not stop the others."""
    try:
        return make(source, target)
    except SparklodError as error:
        return error
