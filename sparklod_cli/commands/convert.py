"""`sparklod convert`: writes a splat file in another format, and reports what the format does not hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import click

from ..codecs.formats import ENCODINGS, WRITABLE
from ..codecs.options import WriteOptions
from ..system.addresses import Place
from ..system.errors import FormatError, InvalidSplatsError, OutOfMemoryError, naming
from ..system.setting_fields import setting, setting_of
from ..system.stdio import DASH, name_of
from .build_lod import BuildLodOptions, record_of, report_baked, report_converted
from .command import COMMON, Command, flag, values_of
from .console import Console, print_json
from .option_groups import (
    EACH_AS_JSON,
    JSON,
    OVERWRITE,
    SCENE_HEADINGS,
    General,
    SceneOptions,
    bake_settings,
)
from .outputs import (
    ARRAYS,
    FORMS,
    PLAIN_FORMS,
    Folder,
    NamedPath,
    Target,
    claim_stdout,
    keep_apart,
    name_outputs,
    shown,
)
from .rules import check

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
    form: str | None = setting(
        "Format of OUT; rad-chunked writes each chunk of a RAD to a file of its own.  [default: by the name of OUT]",
        NAMES,
        flags=("--format",),
        heading=COMMON,
    )
    leaves: bool = flag(
        "Write the leaves of the tree, the original splats as the file holds them, where OUT could hold the tree.",
        heading=COMMON,
    )
    layout: str | None = setting(
        f"Layout of the arrays in a viewer's memory that {ARRAYS[0]} has, or without names {' and '.join(ARRAYS[1:])}.",
        ENCODINGS,
        heading=COMMON,
    )
    overwrite: bool = flag(**OVERWRITE)
    max_sh: int = setting_of(BuildLodOptions, "max_sh")
    scene: SceneOptions = field(default_factory=SceneOptions)
    written: WriteOptions = field(default_factory=WriteOptions)
    cluster_sh: int | None = setting_of(BuildLodOptions, "cluster_sh")
    as_json: bool = flag(EACH_AS_JSON, **JSON)
    general: General = field(default_factory=General)


@click.command("convert", cls=Command, options=ConvertOptions, examples=EXAMPLES, headings=SCENE_HEADINGS)
@click.pass_context
def convert(ctx: click.Context, /, **_: Any) -> None:
    """Write the splats or the tree of IN in the format that the name of OUT chooses.

    Reads all that build-lod reads. A Level-of-Detail file keeps its tree as .spz and .rad; as .ply, .sog, .glb, .splat
    or DIR/meta.json (an unpacked SOG), and with --leaves, its leaves are written. Splats are selected, turned and moved
    as build-lod does it; a tree is not. IN and OUT may be -, standard input and output, or addresses such as
    s3://bucket/scan.ply (extra cloud).

    --layout writes arrays as viewers have them in memory.
    """
    form = ctx.params["form"]
    if isinstance(ctx.params["output"], Folder) and form is None:
        raise click.UsageError(f"OUT is a folder; name the file in it, or add --format, such as {', '.join(NAMES[:3])}")
    name_outputs(ctx, ctx.params["source"], FORMS[form].suffix if form else "")
    options = values_of(ctx, ConvertOptions)
    general, source, output, target = options.general, options.source, options.output, Target.of(options.output, form)
    _check(ctx, options, target)
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.converting import Converted, convert_file

        console.announce_compiling()
        with naming(name_of(source), (FormatError, InvalidSplatsError, OutOfMemoryError)):
            made = convert_file(
                source,
                output,
                bake_settings(
                    ctx,
                    target.form,
                    options.scene,
                    options.written,
                    options.cluster_sh,
                    max_sh=options.max_sh,
                    converts=True,
                    recodes=True,
                ),
                layout=options.layout,
                leaves=options.leaves,
                overwrite=options.overwrite,
                threads=general.threads,
                progress=console.progress,
                say=console.say,
            )
        if isinstance(made, Converted):
            report_converted(console, source, shown(output), made)
        else:
            report_baked(console, source, shown(output), made)
        if options.as_json:
            print_json(record_of(source, output, made))


def _check(ctx: click.Context, options: ConvertOptions, target: Target) -> None:
    """Raise a `click.UsageError` where options contradict each other, or the name of the output."""
    form, output, endings = target.form, options.output, (*WRITABLE, *ARRAYS)
    if options.form is None and output == DASH:
        raise click.UsageError("standard output has no name, which chooses the format; add --format")
    target.check_name("OUT", WRITABLE)
    if form.manifest:
        raise click.UsageError(f"{form.manifest} consists of cuts of a tree; build-lod -o {output} makes them")
    if form.suffix not in endings:
        raise click.UsageError(f"OUT ends in {', '.join(endings)}, not {form.suffix}")
    if form.suffix in ARRAYS and options.layout is None:
        raise click.UsageError(f"{form.suffix} holds arrays; choose their --layout: {', '.join(ENCODINGS)}")
    check(ctx, format=form.name, suffix=form.suffix)
    keep_apart(ctx, {"output": target.files([output])})
    claim_stdout(ctx, "output", as_json=options.as_json, binary=True)
