"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .. import limits
from .console import Console, count_of, is_terminal
from .options import AutoOr, Ball, Numbers, Real, common_options

if TYPE_CHECKING:
    from ..bake import Baked, Recipe

STDOUT = Path("-")

#: Said when kernels are compiled; {} is how often that happens.
COMPILING = "Compiling for this machine, which takes some 10 seconds; this happens {} ..."

#: What SPZ clamps, for people; see `spz.clamped`.
CLAMPED = {"scale": "scales (4.5e-5 to 380 units)", "rgb": "colours (-0.44 to 1.44)", "sh": "SH (-1 to 0.99)"}

EXAMPLES = """
\b
Examples:
  sparklod build-lod scene.ply                    # writes scene-lod.spz
  sparklod build-lod scans/*.ply --output-dir web --overwrite
  sparklod build-lod scene.ply -o - | aws s3 cp - s3://bucket/scene-lod.spz
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
"""


@click.command("build-lod", epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Output of a single input; - is standard output.  [default: NAME-lod.spz beside the input]",
    show_default=False,
)
@click.option(
    "--output-dir",
    metavar="DIR",
    type=click.Path(path_type=Path, file_okay=False),
    help="Directory for the outputs; made if it is not there.",
    show_default=False,
)
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@click.option(
    "--base",
    metavar="N",
    type=Real(limits.MIN_BASE, limits.MAX_BASE),
    default=limits.DEFAULT_BASE,
    help="Growth of the voxel grid from level to level: nearer 1, smoother transitions and more nodes.",
)
@click.option(
    "--max-sh",
    metavar="N",
    type=click.IntRange(0, limits.MAX_SH_DEGREE),
    default=limits.MAX_SH_DEGREE,
    help="Leave out spherical harmonics above this degree.",
)
@click.option("--min-opacity", metavar="N", type=Real(0, 1), default=0.0, help="Leave out splats of lower opacity.")
@click.option("--min-box", type=Numbers("x", "y", "z"), help="Leave out splats whose centre is below this on any axis.")
@click.option("--max-box", type=Numbers("x", "y", "z"), help="Leave out splats whose centre is above this on any axis.")
@click.option("--within", type=Ball(), help="Leave out splats whose centre is outside this ball.")
@click.option(
    "--on-invalid",
    type=click.Choice(["error", "drop"]),
    default="error",
    help="What to do about splats with numbers that are not finite.",
)
@click.option(
    "--spz-version",
    type=click.Choice([str(version) for version in limits.SPZ_VERSIONS]),
    default=str(limits.DEFAULT_SPZ_VERSION),
    help="2 is 4 to 8 % smaller, 3 keeps rotations ten times as exact.",
)
@click.option(
    "--fractional-bits",
    type=AutoOr(0, limits.MAX_FRACTIONAL_BITS),
    default="auto",
    help="Bits after the binary point of a position; auto suits the extent and the smallest splats.",
)
@click.option(
    "--compression-level",
    metavar="N",
    type=click.IntRange(limits.MIN_COMPRESSION, limits.MAX_COMPRESSION),
    default=limits.DEFAULT_COMPRESSION,
    help="1 is fast, 9 small.",
)
@common_options
@click.pass_context
def build_lod(
    ctx: click.Context,
    /,
    inputs: tuple[Path, ...],
    output: Path | None,
    output_dir: Path | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **settings: Any,
) -> None:
    """Bake splat scenes into Level-of-Detail files for Spark.

    Reads 3D Gaussian Splatting PLY and SPZ, merges splats into a tree, and writes it as SPZ with Spark's extension. The
    axes of the input are kept as they are.

    A file that fails does not stop the others; the exit status is 1 if any did.
    """
    outputs = _outputs(inputs, output, output_dir)
    if output == STDOUT and as_json:
        raise click.UsageError("--json and -o - both want standard output")
    if output == STDOUT and is_terminal(sys.stdout):
        raise click.UsageError("-o - writes binary data; redirect it to a file or a pipe")
    failed = False
    with Console(quiet=quiet, verbose=verbose) as console:
        recipe = _prepare(settings, console)
        from .. import io
        from ..bake import bake
        from ..errors import SparklodError

        for source, target in zip(inputs, outputs, strict=True):
            try:
                if target == STDOUT:
                    write: Callable[[Iterable[bytes]], int] = io.write_stdout
                else:
                    io.check_writable(target, overwrite=overwrite, make_parent=output_dir is not None)
                    write = functools.partial(io.write_whole, target, overwrite=overwrite)
                baked = bake(source, write, recipe, progress=console.progress)
            except SparklodError as error:
                failed = True
                console.error(f"{source}: {error}")
                record: dict[str, Any] = {"input": str(source), "error": str(error)}
            else:
                _report(console, source, target, baked)
                record = {"input": str(source), "output": str(target), **dataclasses.asdict(baked)}
            if as_json:
                click.echo(json.dumps(record))
    if failed:
        ctx.exit(1)


def _outputs(inputs: tuple[Path, ...], output: Path | None, output_dir: Path | None) -> list[Path]:
    """Where each input goes; a usage error where two would go to one place."""
    if output is not None:
        if output_dir is not None:
            raise click.UsageError("-o and --output-dir exclude each other")
        if len(inputs) > 1:
            raise click.UsageError(f"-o takes one input, not {len(inputs)}; use --output-dir")
        outputs = [output]
    else:
        outputs = [(output_dir or source.parent) / f"{source.stem}-lod.spz" for source in inputs]
    sources = {os.path.realpath(source) for source in inputs}
    first: dict[str, Path] = {}
    for source, target in zip(inputs, outputs, strict=True):
        place = os.path.realpath(target)
        if place in sources and target != STDOUT:
            raise click.UsageError(f"{target} is an input; write elsewhere")
        if place in first:
            raise click.UsageError(f"{first[place]} and {source} would both be written to {target}")
        first[place] = source
    return outputs


def _prepare(settings: dict[str, Any], console: Console) -> Recipe:
    """The recipe that the options ask for; the point where numpy and numba are loaded."""
    from .. import jit
    from ..bake import Recipe
    from ..codecs import spz
    from ..selection import Selection

    jit.use_threads(settings["threads"])
    jit.on_first_compile(
        lambda: console.say(COMPILING.format("once" if jit.CACHE_FOLDER else "every time, as no cache can be written"))
    )
    return Recipe(
        base=settings["base"],
        max_sh=settings["max_sh"],
        selection=Selection(
            drop_invalid=settings["on_invalid"] == "drop",
            min_opacity=settings["min_opacity"],
            min_box=settings["min_box"],
            max_box=settings["max_box"],
            within=settings["within"],
        ),
        spz=spz.Options(
            version=int(settings["spz_version"]),
            fractional_bits=settings["fractional_bits"],
            compression_level=settings["compression_level"],
            threads=settings["threads"],
        ),
    )


def _report(console: Console, source: Path, target: Path, baked: Baked) -> None:
    from ..selection import describe

    seconds = sum(baked.seconds.values())
    size = f"{baked.bytes / 1e6:.1f} MB" if baked.bytes >= 1e5 else f"{baked.bytes / 1e3:.1f} kB"
    console.say(
        f"{source}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {target} "
        f" {count_of(baked.nodes, 'node')}, {count_of(baked.levels, 'level')}, {size}, {seconds:.1f} s"
    )
    if baked.dropped:
        console.say(f"  dropped {describe(baked.dropped)}")
    for note in baked.notes:
        console.say(f"  {note}")
    if baked.clamped:
        counts = ", ".join(f"{CLAMPED[name]} of {count_of(count, 'node')}" for name, count in baked.clamped.items())
        console.say(f"  clamped to what SPZ holds: {counts}")
    stages = ", ".join(f"{stage} {value:.2f} s" for stage, value in baked.seconds.items())
    console.detail(f"  {baked.format} -> SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits; {stages}")
