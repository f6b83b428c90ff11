"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import FORMATS, WRITABLE
from ..codecs.gpu.table import NPZ, RAW_SUFFIXES
from ..support.errors import SparklodError
from ..support.printable import MOST, shortened
from ..support.stdin import DASH, name_of
from .command import COMMON, Command, option
from .options.baking import (
    OF_PLACE,
    OF_SELECTION,
    OF_SPZ,
    OF_TREES,
    bake_settings,
    baking_options,
    check_method,
    write_options,
)
from .options.common import General, common_options, output_option, overwrite_option
from .paths import InputPath, OutputPath, claim_stdout, keep_apart, stem_of
from .reports import report_baked, report_extracted
from .usage import options_of, refuse

if TYPE_CHECKING:
    from ..api.file_jobs import Baked, Extracted
    from .console import Console

#: Suffixes of the formats in which a tree can be written, and the one of files that are given a name.
TREES = tuple(suffix for suffix, form in WRITABLE.items() if form.trees)
SPZ = TREES[0]

#: Suffixes of formats that hold no tree.
PLAIN = {suffix for form in FORMATS for suffix in form.suffixes if not form.trees}

EXAMPLES = """
\b
Examples:
  sparklod build-lod scene.ply                          # writes scene-lod.spz
  sparklod build-lod scene.ply --up -y                  # y up, as viewers want it
  sparklod build-lod scene.ply --method quality         # for publishing
  sparklod build-lod scans/*.ply --output-dir web -f
  cat scene.ply | sparklod build-lod - -o - | aws s3 cp - s3://bucket/scene-lod.spz
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
  sparklod build-lod scene.sog --encoding ext           # writes scene-lod.npz
  sparklod build-lod scene-lod.spz --unlod -o scene.ply
"""


@dataclass(frozen=True)
class Outputs:
    """Where outputs go.

    Attributes:
        output: the file of a single input.
        output_dir: the folder of all of them.
        overwrite: replace files that exist.
        unlod: write the splats of trees.
        encoding: of array files.
    """

    output: Path | None
    output_dir: Path | None
    overwrite: bool
    unlod: bool
    encoding: str | None

    @property
    def suffix(self) -> str:
        """Of the output that was named, if one was."""
        return self.output.suffix.lower() if self.output is not None and self.output != DASH else ""

    @property
    def is_raw(self) -> bool:
        """Whether words go out alone: what is named is no .npz."""
        return self.output is not None and self.suffix != NPZ

    def target(self, source: Path) -> Path:
        """Where an input goes."""
        return self.output or (self.output_dir or source.parent) / self._name(source)

    def _name(self, source: Path) -> str:
        stem = stem_of(source)
        if self.unlod:
            return f"{stem.removesuffix('-lod')}-unlod{SPZ}"
        return f"{stem}-lod{NPZ if self.encoding else SPZ}"


@click.command("build-lod", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=InputPath(stdin=True))
@output_option(
    "Output of a single input; - is standard output.  [default: NAME-lod.spz beside the input;"
    " NAME-lod.npz with --encoding, NAME-unlod.spz with --unlod]"
)
@option(
    "--output-dir",
    heading=COMMON,
    metavar="DIR",
    type=OutputPath(folder=True),
    help="Folder for the outputs; created if it does not exist.",
    show_default=False,
)
@overwrite_option
@option(
    "--unlod",
    heading=COMMON,
    is_flag=True,
    help="Write the original splats of Level-of-Detail files instead, as SPZ or, by the name of FILE, .ply or .splat.",
)
@baking_options
@common_options
@click.pass_context
def build_lod(ctx: click.Context, /, inputs: tuple[Path, ...], **_: Any) -> None:
    """Bake splat files into Level-of-Detail files for Spark.

    Reads PLY (also PlayCanvas's compressed PLY), SPZ, SOG (.sog, or a folder with a meta.json), .splat and .ksplat;
    merges splats into a tree, and writes the tree as SPZ with Spark's extension. An INPUT of - is standard input.

    The axes of the input are kept unless --up or --rotate turns them. Selection goes by the coordinates of the input.

    An input that fails does not stop the others; the exit status is 1 if any did.
    """
    general, outputs = options_of(ctx, General), options_of(ctx, Outputs)
    _check(ctx, inputs, outputs, general)
    failed = False
    with general.console() as console:
        make, report = _job(ctx, outputs, console)
        shared = {"overwrite": outputs.overwrite, "threads": general.threads, "progress": console.progress}
        for source in inputs:
            target = outputs.target(source)
            try:
                result = make(source, target, **shared)
                report(console, source, target, result)
            except SparklodError as error:
                failed = True
                console.error(f"{name_of(source)}: {error}")
                record: dict[str, Any] = {"input": str(source), "error": shortened(str(error), MOST)}
            else:
                record = {"input": str(source), "output": str(target), **dataclasses.asdict(result)}
            if general.as_json:
                click.echo(json.dumps(record))
    if failed:
        ctx.exit(1)


def _check(ctx: click.Context, inputs: tuple[Path, ...], outputs: Outputs, general: General) -> None:
    """Raises a `click.UsageError` where options contradict each other, or the names of files."""
    if outputs.output is not None:
        if outputs.output_dir is not None:
            raise click.UsageError("--output cannot be used with --output-dir")
        if len(inputs) > 1:
            raise click.UsageError(f"--output takes one input, not {len(inputs)}; use --output-dir")
    elif DASH in inputs:
        raise click.UsageError("standard input has no name to derive one from; give --output")
    targets = [outputs.target(source) for source in inputs]
    keep_apart(ctx, {"output" if outputs.output_dir is None else "output_dir": targets})
    claim_stdout(ctx, "output", as_json=general.as_json, binary=True)
    if ctx.params["rgba"] is not None and len(inputs) > 1:
        raise click.UsageError(f"--rgba takes one input, not {len(inputs)}")
    suffix = outputs.suffix
    if outputs.unlod:
        refuse(ctx, (*OF_TREES, *OF_SELECTION, *OF_PLACE, "encoding"), "cannot be used with --unlod")
        if suffix not in ("", *WRITABLE):
            raise click.UsageError(f"--unlod writes {', '.join(WRITABLE)}, not {suffix}")
        if suffix not in ("", SPZ):
            refuse(ctx, OF_SPZ, f"is an option of SPZ, not of {suffix}")
        return
    check_method(ctx)
    if outputs.encoding:
        refuse(ctx, OF_SPZ, "is an option of SPZ, not of --encoding")
        if suffix not in ("", NPZ, *RAW_SUFFIXES):
            raise click.UsageError(f"--encoding writes {', '.join((NPZ, *RAW_SUFFIXES))}, not {suffix}")
    elif suffix in (NPZ, *RAW_SUFFIXES):
        raise click.UsageError(f"{suffix} is a file of arrays; choose their layout with --encoding")
    elif suffix in PLAIN:
        raise click.UsageError(f"{suffix} cannot hold a tree; name the output {SPZ}")
    elif suffix not in ("", *TREES):
        raise click.UsageError(f"trees are written as SPZ, not as {suffix}; name the output {SPZ}")


def _job(
    ctx: click.Context, outputs: Outputs, console: Console
) -> tuple[Callable[..., Baked | Extracted], Callable[..., None]]:
    """What makes an output of an input, and what reports it; the point where numpy and numba are loaded."""
    from ..api.file_jobs import bake, extract_leaves

    if outputs.unlod:
        return functools.partial(extract_leaves, options=write_options(ctx)), report_extracted
    settings = bake_settings(ctx, raw=outputs.is_raw)
    console.announce_compiling(settings.method)
    return functools.partial(bake, settings=settings), report_baked
