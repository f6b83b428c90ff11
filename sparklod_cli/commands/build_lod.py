"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import WRITABLE
from ..codecs.gpu.table import ENCODINGS, RAW_SUFFIXES
from ..codecs.options import WriteOptions
from ..support import defaults
from ..support.printable import MOST, shortened
from .command import Command
from .console import Console
from .options.common import common_options, overwrite_option
from .options.types import AutoOr, Ball, Numbers, Real
from .paths import DASH, InputPath, OutputPath, claim_stdout, keep_apart
from .reports import report_baked, report_unbaked
from .usage import is_given, refuse

if TYPE_CHECKING:
    from ..bake import Baked
    from ..extract_leaves import Unbaked
    from ..io import Sink

    #: Makes the output of an input through a sink, and reports what came of it.
    Work = Callable[[Path, Path, Sink], Baked | Unbaked]

#: Options that only mean something for a tree that is built, and for SPZ.
OF_BAKING = (
    *("method", "base", "growth", "max_sh", "min_opacity", "min_box", "max_box", "within", "on_invalid", "rgba"),
    "encoding",
)
OF_SPZ = ("spz_version", "fractional_bits", "compression_level")

#: Options of one method only.
OF_METHOD = {"quick": ("base",), "quality": ("growth",)}

#: Names that promise what a tree is not written as.
OTHER_SUFFIXES = {".ply", ".splat", ".ksplat", ".sog", ".json"}

EXAMPLES = """
\b
Examples:
  sparklod build-lod scene.ply                    # writes scene-lod.spz
  sparklod build-lod scans/*.ply --output-dir web --overwrite
  sparklod build-lod scene.ply --method quality   # for what is published
  sparklod build-lod scene.ply -o - | aws s3 cp - s3://bucket/scene-lod.spz
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
  sparklod build-lod scene.sog --encoding ext     # writes scene-lod.npz
  sparklod build-lod scene-lod.spz --unlod -o scene.ply
"""


@click.command("build-lod", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=InputPath())
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=OutputPath(),
    help="Output of a single input; - is standard output.  [default: NAME-lod.spz beside the input;"
    " NAME-lod.npz with --encoding, NAME-unlod.spz with --unlod]",
    show_default=False,
)
@click.option(
    "--output-dir",
    metavar="DIR",
    type=OutputPath(folder=True),
    help="Directory for the outputs; made if it is not there.",
    show_default=False,
)
@overwrite_option
@click.option(
    "--method",
    type=click.Choice(defaults.METHODS),
    default=defaults.METHODS[0],
    help="How to merge: quick takes next to no time, cuts of quality are nearer to full detail.",
)
@click.option(
    "--base",
    metavar="N",
    type=Real(defaults.MIN_BASE, defaults.MAX_BASE),
    default=defaults.DEFAULT_BASE,
    help="With --method quick: growth of the voxel grid from level to level; nearer 1, smoother transitions and more"
    " nodes.",
)
@click.option(
    "--growth",
    metavar="N",
    type=Real(defaults.MIN_GROWTH, defaults.MAX_GROWTH),
    default=defaults.DEFAULT_GROWTH,
    help="With --method quality: at most so many nodes a leaf.",
)
@click.option(
    "--max-sh",
    metavar="N",
    type=click.IntRange(0, defaults.MAX_SH_DEGREE),
    default=defaults.MAX_SH_DEGREE,
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
    help="What to do about invalid splats: numbers that are not finite, or negative scales.",
)
@click.option(
    "--rgba",
    metavar="FILE",
    type=InputPath(),
    help="Take colours and opacities from a .npy or raw file of (N, 4) bytes or floats 0..1; alpha 0 drops a splat.",
)
@click.option(
    "--encoding",
    type=click.Choice(list(ENCODINGS)),
    help="Write the tree as arrays in a viewer's memory layout: .npz, or the words alone if FILE is .bin or .raw.",
)
@click.option(
    "--unlod",
    is_flag=True,
    help="The way back: write the splats of Level-of-Detail files, as SPZ or, if FILE ends so, as .ply or .splat.",
)
@click.option(
    "--spz-version",
    type=click.Choice([str(version) for version in defaults.SPZ_VERSIONS]),
    default=str(defaults.DEFAULT_SPZ_VERSION),
    help="2 is 4 to 8 % smaller, 3 keeps rotations ten times as exact.",
)
@click.option(
    "--fractional-bits",
    type=AutoOr(0, defaults.MAX_FRACTIONAL_BITS),
    default="auto",
    help="Bits after the binary point of a position; auto suits the extent and the smallest splats.",
)
@click.option(
    "--compression-level",
    metavar="N",
    type=click.IntRange(defaults.MIN_COMPRESSION, defaults.MAX_COMPRESSION),
    default=defaults.DEFAULT_COMPRESSION,
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

    Reads PLY (3D Gaussian Splatting's and PlayCanvas's compressed one), SPZ, SOG (.sog, or a folder with a meta.json),
    .splat and .ksplat, merges splats into a tree, and writes it as SPZ with Spark's extension. The axes of the input
    are kept as they are.

    A file that fails does not stop the others; the exit status is 1 if any did.
    """
    outputs = _outputs(inputs, output, output_dir, settings)
    keep_apart(ctx, {"output" if output_dir is None else "output_dir": outputs})
    _check_usage(ctx, inputs, output, settings)
    claim_stdout(ctx, "output", as_json=as_json, binary=True)
    failed = False
    with Console(quiet=quiet, verbose=verbose) as console:
        work = _unlod(ctx, settings, console) if settings["unlod"] else _bake(settings, output, console)
        from .. import io
        from ..support.errors import SparklodError

        for source, target in zip(inputs, outputs, strict=True):
            try:
                if target == DASH:
                    write: Sink = io.write_stdout
                else:
                    io.check_writable(target, overwrite=overwrite, make_parent=output_dir is not None)
                    write = functools.partial(io.write_whole, target, overwrite=overwrite)
                result = work(source, target, write)
            except SparklodError as error:
                failed = True
                console.error(f"{source}: {error}")
                record: dict[str, Any] = {"input": str(source), "error": shortened(str(error), MOST)}
            else:
                record = {"input": str(source), "output": str(target), **dataclasses.asdict(result)}
            if as_json:
                click.echo(json.dumps(record))
    if failed:
        ctx.exit(1)


def _check_usage(ctx: click.Context, inputs: tuple[Path, ...], output: Path | None, settings: dict[str, Any]) -> None:
    """A usage error where options contradict each other or the name of the output."""
    suffix = output.suffix.lower() if output is not None and output != DASH else ""
    if settings["unlod"]:
        refuse(ctx, OF_BAKING, "is of no use with --unlod, which writes what there is")
        if suffix and suffix not in WRITABLE:
            raise click.UsageError(f"--unlod writes {', '.join(WRITABLE)}, not {suffix}")
        if suffix not in ("", ".spz"):
            refuse(ctx, OF_SPZ, f"is of SPZ, not of {suffix}")
    elif settings["encoding"]:
        refuse(ctx, OF_SPZ, "is of SPZ, not of --encoding")
        if suffix not in ("", ".npz", *RAW_SUFFIXES):
            known = ", ".join((".npz", *RAW_SUFFIXES))
            raise click.UsageError(f"--encoding writes {known}, not {suffix}")
    elif suffix in OTHER_SUFFIXES:
        raise click.UsageError(f"{suffix} holds no tree, which is written as SPZ; name the output .spz")
    elif suffix in (".npz", *RAW_SUFFIXES):
        raise click.UsageError(f"a {suffix} output needs --encoding")
    elif suffix not in ("", ".spz"):
        raise click.UsageError(f"a tree is written as SPZ, not as {suffix}; name the output .spz")
    for method, names in OF_METHOD.items():
        if method != settings["method"]:
            refuse(ctx, names, f"is of --method {method}, not of {settings['method']}")
    if settings["rgba"] is not None and len(inputs) > 1:
        raise click.UsageError(f"--rgba takes one input, not {len(inputs)}")


def _outputs(
    inputs: tuple[Path, ...], output: Path | None, output_dir: Path | None, settings: dict[str, Any]
) -> list[Path]:
    """Where each input goes; a usage error where two would go to one place."""
    if output is not None:
        if output_dir is not None:
            raise click.UsageError("-o and --output-dir exclude each other")
        if len(inputs) > 1:
            raise click.UsageError(f"-o takes one input, not {len(inputs)}; use --output-dir")
        outputs = [output]
    else:
        outputs = [(output_dir or source.parent) / _output_name(source, settings) for source in inputs]
    return outputs


def _output_name(source: Path, settings: dict[str, Any]) -> str:
    # The meta.json of an unpacked SOG is called as its folder.
    stem = source.absolute().parent.name if source.name == "meta.json" else source.stem
    if settings["unlod"]:
        return f"{stem.removesuffix('-lod')}-unlod.spz"
    return f"{stem}-lod.npz" if settings["encoding"] else f"{stem}-lod.spz"


def _bake(settings: dict[str, Any], output: Path | None, console: Console) -> Work:
    """What bakes a file and reports it; the point where numpy and numba are loaded."""
    from ..bake import Recipe, bake
    from ..model.selection import Selection
    from ..support import jit

    jit.use_threads(settings["threads"])
    console.announce_compiling(settings["method"])
    recipe = Recipe(
        method=settings["method"],
        base=settings["base"],
        growth=settings["growth"],
        max_sh=settings["max_sh"],
        selection=Selection(
            drop_invalid=settings["on_invalid"] == "drop",
            min_opacity=settings["min_opacity"],
            min_box=settings["min_box"],
            max_box=settings["max_box"],
            within=settings["within"],
        ),
        rgba=settings["rgba"],
        encoding=settings["encoding"],
        raw=output is not None and output.suffix.lower() != ".npz",
        spz=WriteOptions(
            spz_version=int(settings["spz_version"]),
            fractional_bits=settings["fractional_bits"],
            compression_level=settings["compression_level"],
        ),
        threads=settings["threads"],
    )

    def work(source: Path, target: Path, write: Sink) -> Baked:
        baked = bake(source, write, recipe, progress=console.progress)
        report_baked(console, source, target, baked)
        return baked

    return work


def _unlod(ctx: click.Context, settings: dict[str, Any], console: Console) -> Work:
    """What writes the leaves of a file and reports it."""
    from ..extract_leaves import Target, unlod

    chosen = is_given(ctx, "spz_version")

    def work(source: Path, target: Path, write: Sink) -> Unbaked:
        how = Target(
            suffix=".spz" if target == DASH else target.suffix.lower() or ".spz",
            options=WriteOptions(
                spz_version=int(settings["spz_version"]) if chosen else None,
                fractional_bits=settings["fractional_bits"],
                compression_level=settings["compression_level"],
            ),
            threads=settings["threads"],
        )
        unbaked = unlod(source, write, how, progress=console.progress)
        report_unbaked(console, source, target, unbaked)
        return unbaked

    return work
