"""`sparklod convert`: writes a splat file in another format, and reports what the format does not hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import click

from ..codecs.formats import ENCODINGS, WRITABLE
from ..system.addresses import Place
from ..system.errors import FormatError, InvalidSplatsError, OutOfMemoryError, naming
from ..system.setting_fields import setting
from ..system.stdio import DASH, name_of
from .build_lod import report
from .command import COMMON, Command, common, flag, values_of
from .console import Console
from .option_groups import OVERWRITE
from .outputs import Folder, NamedPath, name_outputs
from .writing_options import ARRAYS, FORMS, PLAIN_FORMS, SCENE_HEADINGS, Form, Writing, check_outputs, form_of

EXAMPLES = """\
  sparklod convert scene.ply scene.sog              # for PlayCanvas
  sparklod convert scene-lod.spz scene-lod.rad      # the same tree
  sparklod convert scene-lod.rad scene.ply          # its leaves
  sparklod convert scene-lod.rad small.spz --leaves
  sparklod convert scan.spz scan.ply --up -y
  sparklod convert web/lod-meta.json scene.spz      # its full detail
  sparklod convert scene.sog scene/meta.json        # an unpacked SOG
  sparklod convert scene.ply scene.glb --glb-profile cesium
  sparklod convert scene-lod.rad web/scene-lod.rad --format rad-chunked
  sparklod convert scene-lod.spz tree.npz --layout lodtree
  curl -s https://example.com/a.ply | sparklod convert - - --format spz > a.spz
"""

#: Values of --format.
NAMES = ("spz", "rad", "rad-chunked", *PLAIN_FORMS)


@dataclass(frozen=True)
class ConvertOptions:
    """Options of convert."""

    source: Place = setting("", NamedPath(stdin=True, addresses=True), argument=True, metavar="IN", required=True)
    output: Place = setting("", NamedPath(output=True, addresses=True), argument=True, metavar="OUT", required=True)
    form: str | None = common(
        "Format of OUT; rad-chunked writes each chunk of a RAD to a file of its own.  [default: by the name of OUT]",
        NAMES,
        flags=("--format",),
    )
    leaves: bool = flag(
        "Write the leaves of the tree, which are the original splats, even if OUT can hold the tree.",
        heading=COMMON,
    )
    layout: str | None = common(
        f"Layout of arrays in a viewer's memory, for {ARRAYS[0]} or, without names, {' and '.join(ARRAYS[1:])}.",
        ENCODINGS,
    )
    overwrite: bool = flag(**OVERWRITE)
    writing: Writing = field(default_factory=Writing)


@click.command("convert", cls=Command, options=ConvertOptions, examples=EXAMPLES, headings=SCENE_HEADINGS)
@click.pass_context
def convert(ctx: click.Context, /, **_: Any) -> None:
    """Write the splats or the tree of IN in the format that the name of OUT chooses.

    Reads all that build-lod reads. The tree of a Level-of-Detail file is kept if OUT is .spz or .rad; all other formats
    (.ply, .sog, .glb, .splat, and DIR/meta.json, an unpacked SOG) get its leaves, and so do .spz and .rad with
    --leaves. Splats are selected, turned and moved as by build-lod; a tree is not. IN and OUT may be -, standard input
    and output, or addresses such as s3://bucket/scan.ply, which need the extra cloud.

    --layout writes the arrays that a viewer has in memory instead of a splat file.
    """
    choice = ctx.params["form"]
    if isinstance(ctx.params["output"], Folder) and choice is None:
        raise click.UsageError(f"OUT is a folder; name the file in it, or add --format, such as {', '.join(NAMES[:3])}")
    name_outputs(ctx, ctx.params["source"], FORMS[choice].suffix if choice else "")
    options = values_of(ctx, ConvertOptions)
    writing, general, source, output = options.writing, options.writing.general, options.source, options.output
    form = form_of(output, choice)
    _check(ctx, options, form)
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.converting import convert_file

        console.announce_compiling()
        with naming(name_of(source), (FormatError, InvalidSplatsError, OutOfMemoryError)):
            made = convert_file(
                source,
                output,
                writing.settings(ctx, form, converts=True, recodes=True),
                layout=options.layout,
                leaves=options.leaves,
                overwrite=options.overwrite,
                threads=general.threads,
                progress=console.progress,
                say=console.say,
            )
        report(ctx, console, source, output, made, as_json=writing.as_json)


def _check(ctx: click.Context, options: ConvertOptions, form: Form) -> None:
    """Raise a `click.UsageError` where options contradict each other, or the name of the output."""
    endings = (*WRITABLE, *ARRAYS)
    if options.form is None and options.output == DASH:
        raise click.UsageError("standard output has no name, which chooses the format; add --format")
    if form.manifest:
        raise click.UsageError(f"{form.manifest} consists of cuts of a tree; build-lod -o {options.output} makes them")
    if form.suffix not in endings:
        raise click.UsageError(f"OUT ends in {', '.join(endings)}, not {form.suffix}")
    if form.suffix in ARRAYS and options.layout is None:
        raise click.UsageError(f"{form.suffix} holds arrays; choose their --layout: {', '.join(ENCODINGS)}")
    check_outputs(ctx, form, [options.output], WRITABLE, suffix=form.suffix)
