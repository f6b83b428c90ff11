"""`sparklod convert`: writes a splat file in another format, and reports what the format does not hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import ENCODINGS, MANIFEST, NPZ, RAW_SUFFIXES, TILESET, WRITABLE, ending_of
from ..codecs.options import WriteOptions
from ..system.addresses import Place
from ..system.errors import FormatError, InvalidSplatsError, OutOfMemoryError, naming
from ..system.setting_fields import setting, setting_of
from ..system.stdio import DASH, name_of
from .build_lod import record_of, report_baked, report_converted
from .command import COMMON, Command, flag, values_of
from .console import Console, print_json
from .options.baking import (
    FILE_FORMAT,
    FORMS,
    POSITION,
    SELECTION,
    BuildLodOptions,
    OutputForm,
    SceneOptions,
    write_options,
)
from .options.common import EACH_AS_JSON, JSON, OVERWRITE, General
from .paths import (
    NAMELESS,
    Folder,
    NamedPath,
    claim_stdout,
    keep_apart,
    require_suffix,
    stem_of,
    with_chunks,
)
from .rules import check

if TYPE_CHECKING:
    from ..bake.settings import BakeSettings

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

#: Values of --format: those of trees, plain formats by their first suffix, and arrays.
TREE_FORMS = ("spz", "rad", "rad-chunked")
NAMES = {
    **{name: FORMS[name] for name in TREE_FORMS},
    **{
        suffix[1:]: OutputForm(suffix)
        for suffix, form in WRITABLE.items()
        if suffix.startswith(".") and suffix[1:] not in FORMS
    },
    **{suffix[1:]: OutputForm(suffix) for suffix in (NPZ, *RAW_SUFFIXES)},
}


@dataclass(frozen=True)
class ConvertOptions:
    """Options of convert."""

    source: Place = setting("", NamedPath(stdin=True, addresses=True), argument=True, metavar="IN", required=True)
    output: Place = setting("", NamedPath(output=True, addresses=True), argument=True, metavar="OUT", required=True)
    form: str | None = setting(
        "Format of OUT; rad-chunked writes each chunk of a RAD to a file of its own.  [default: by the name of OUT]",
        tuple(NAMES),
        flags=("--format",),
        heading=COMMON,
    )
    leaves: bool = flag(
        "Write the leaves of the tree, the original splats as the file holds them, where OUT could hold the tree.",
        heading=COMMON,
    )
    layout: str | None = setting(
        f"Layout of the arrays in a viewer's memory that {NPZ} has, or without names {' and '.join(RAW_SUFFIXES)}.",
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

    @property
    def output_form(self) -> OutputForm:
        """Format of the output, by --format, or else by the name of the output."""
        return OutputForm(ending_of(self.output.name)) if self.form is None else NAMES[self.form]

    def settings(self, ctx: click.Context) -> BakeSettings:
        """Return the settings of the conversion; loads numpy."""
        from ..bake.settings import BakeSettings

        form = self.output_form
        return BakeSettings(
            max_sh=self.max_sh,
            **self.scene.settings(ctx),
            suffix=form.suffix,
            options=write_options(self.written, self.cluster_sh, chunked=form.chunked),
            converts=True,
            recodes=True,
        )


HEADINGS = (COMMON, SELECTION, POSITION, FILE_FORMAT, "RAD")


@click.command("convert", cls=Command, options=ConvertOptions, examples=EXAMPLES, headings=HEADINGS)
@click.pass_context
def convert(ctx: click.Context, /, **_: Any) -> None:
    """Write the splats or the tree of IN in the format that the name of OUT chooses.

    Reads all that build-lod reads. A Level-of-Detail file keeps its tree as .spz and .rad; as .ply, .sog, .glb, .splat
    or DIR/meta.json (an unpacked SOG), and with --leaves, its leaves are written. Splats are selected, turned and moved
    as build-lod does it; a tree is not. IN and OUT may be -, standard input and output, or addresses such as
    s3://bucket/scan.ply (extra cloud).

    --layout writes arrays as viewers have them in memory.
    """
    output = ctx.params["output"]
    if isinstance(output, Folder):
        ctx.params["output"] = output.path / _name_in_folder(ctx)
    options = values_of(ctx, ConvertOptions)
    general, source, target = options.general, options.source, options.output
    _check(ctx, options)
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..bake.converting import Converted
        from ..bake.converting import convert as convert_file

        settings = options.settings(ctx)
        console.announce_compiling()
        with naming(name_of(source), (FormatError, InvalidSplatsError, OutOfMemoryError)):
            made = convert_file(
                source,
                target,
                settings,
                layout=options.layout,
                leaves=options.leaves,
                overwrite=options.overwrite,
                threads=general.threads,
                progress=console.progress,
                say=console.say,
            )
        named = "standard output" if target == DASH else str(target)
        if isinstance(made, Converted):
            report_converted(console, source, named, made)
        else:
            report_baked(console, source, named, made)
        if options.as_json:
            print_json(record_of(source, target, made))


def _name_in_folder(ctx: click.Context) -> str:
    source, form = ctx.params["source"], ctx.params["form"]
    if source == DASH:
        raise click.UsageError(NAMELESS)
    if form is None:
        raise click.UsageError(
            f"OUT is a folder; name the file in it, or add --format, such as {', '.join(TREE_FORMS)}"
        )
    return f"{stem_of(source)}{NAMES[form].suffix}"


def _check(ctx: click.Context, options: ConvertOptions) -> None:
    """Raise a `click.UsageError` where options contradict each other, or the name of the output."""
    output, form = options.output, options.output_form
    known, arrays = tuple(WRITABLE), (NPZ, *RAW_SUFFIXES)
    if options.form is None:
        if output == DASH:
            raise click.UsageError("standard output has no name, which chooses the format; add --format")
        require_suffix("OUT", output, known)
        if output.name in (MANIFEST, TILESET):
            raise click.UsageError(f"{output.name} consists of cuts of a tree; build-lod -o {output} makes them")
        if form.suffix not in (*known, *arrays):
            raise click.UsageError(f"OUT ends in {', '.join((*known, *arrays))}, not {form.suffix}")
    elif ending_of(output.name) not in ("", form.suffix):
        raise click.UsageError(f"--format {options.form} writes {form.suffix}, not {ending_of(output.name)}")
    if form.chunked and output == DASH:
        raise click.UsageError("--format rad-chunked writes several files; name the output, or use --format rad")
    if form.suffix in arrays and options.layout is None:
        raise click.UsageError(f"{form.suffix} holds arrays; choose their --layout: {', '.join(ENCODINGS)}")
    check(ctx, format="--layout" if form.suffix in arrays else WRITABLE[form.suffix].name, suffix=form.suffix)
    unbundled = form.suffix in WRITABLE and form.suffix == WRITABLE[form.suffix].unbundled
    keep_apart(ctx, {"output": with_chunks([output]) if form.chunked or unbundled else [output]})
    claim_stdout(ctx, "output", as_json=options.as_json, binary=True)
