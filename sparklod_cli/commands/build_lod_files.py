"""Files of `sparklod build-lod`: inputs, outputs with their names and formats, and which options suit these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.file_names import MANIFEST, TILESET
from ..codecs.file_names import RAD_SUFFIX as RAD
from ..codecs.formats import ENCODINGS, FORMATS, NPZ, RAW_SUFFIXES, WRITABLE, ending_of
from ..codecs.options import RadOptions
from ..lod.detail_rule import DetailSettings
from ..lod.tile_settings import TileSettings
from ..system.addresses import Place
from ..system.stdio import DASH
from .option_groups import COMMON, argument, exclude, flag, is_set, option, parameters_of, refuse
from .options.baking import OF_TREES, STREAMED_SOG, TILES_3D, DetailOptions, RefineOptions
from .options.common import output_option, overwrite_flag
from .paths import InputPath, OutputPath, require_suffix, stem_of

if TYPE_CHECKING:
    from ..bake.sources import Source
    from ..model.instances import Instance

#: Suffixes of the formats in which a tree can be written, and what they are called; the first one is the default.
TREES = {suffix: form.name for suffix, form in WRITABLE.items() if form.trees}
SPZ = next(iter(TREES))

#: Suffixes of formats that hold no tree, and how else their names end.
PLAIN = {ending for form in FORMATS for ending in (*form.suffixes, *form.endings) if not form.trees}

#: Values of --skip-existing: read only files whose size or date changed, or all.
BY_DATE, VERIFY = "date", "verify"

#: Values of --format: the suffix of the file, and whether each chunk of a RAD gets a file of its own.
FORMS = {
    "spz": (".spz", False),
    "rad": (".rad", False),
    "rad-chunked": (".rad", True),
    STREAMED_SOG: (".json", False),
    TILES_3D: (".json", False),
}

#: What the formats of cuts are called.
DETAIL, TILED = DetailOptions.HEADING, TileSettings.HEADING

#: By the value of --format, for those that are cuts of a tree: the names of the manifest and of the format, and what is
#: beside the manifest.
MANIFESTS = {STREAMED_SOG: (MANIFEST, DETAIL, "folders"), TILES_3D: (TILESET, TILED, "a folder")}

#: Parameters of formats, the names of these, and how to get one of them.
OF_FORMATS = (
    (("spz_version", "fractional_bits"), ("SPZ",), ""),
    (parameters_of(RadOptions), ("RAD",), "; name the output .rad, or add --format rad"),
    (("compression_level",), ("SPZ", "RAD"), ""),
    (("glb_profile",), ("GLB", TILED), "; GLB is written by --unlod and simplify"),
    (("cluster_sh",), ("RAD", "SOG"), "; name the output .rad, or add --format rad"),
    (
        parameters_of(DetailSettings, DetailOptions),
        (DETAIL,),
        f"; name the output {MANIFEST}, or add --format {STREAMED_SOG}",
    ),
    (parameters_of(TileSettings), (TILED,), f"; name the output {TILESET}, or add --format {TILES_3D}"),
)


@dataclass(frozen=True)
class BakedFiles:
    """Options of inputs and outputs, and of refining, which may replace its input."""

    inputs: tuple[Place, ...] = argument(InputPath(stdin=True, addresses=True), metavar="INPUT...")
    merge: bool = flag(
        "Bake all INPUTs as one scene, into the file that --output names: tiles of a city, each where its own"
        " coordinates put it.",
        heading=COMMON,
    )
    scene: Path | None = option(
        "Merge the files of an instances file, each where it stands there, in place of INPUTs (see docs/build-lod.md).",
        InputPath(),
        heading=COMMON,
    )
    output: Place | None = output_option(
        "Output of a single input, or a folder for all outputs; - is standard output.  [default: NAME-lod.spz beside"
        f" the input; NAME-lod.rad with --format rad, NAME-lod/{MANIFEST} with --format {STREAMED_SOG},"
        f" NAME-lod/{TILESET} with --format {TILES_3D}, NAME-lod.npz with --encoding, NAME-unlod.spz with --unlod,"
        " NAME-lod-refined.spz of a NAME-lod.spz with --refine]",
        addresses=True,
    )
    output_dir: Place | None = option(
        "Folder for the outputs; created if it does not exist.",
        OutputPath(folder=True, addresses=True),
        heading=COMMON,
    )
    overwrite: bool = overwrite_flag()
    skip_existing: str | None = option(
        "Bake nothing whose output is there already, of the same inputs and settings; a small file beside each output,"
        " NAME.sparklod.json, tells of what it is. Files whose size and date are unchanged are not read;"
        " --skip-existing=verify reads all, and so finds damage that left both as they were.",
        (BY_DATE, VERIFY),
        heading="Large scenes",
        metavar="[=verify]",
        bare=BY_DATE,
    )
    unlod: bool = flag(
        "Write the leaves of Level-of-Detail files instead: the original splats as the file holds them, rounded, with"
        " opacities that make up for it. As SPZ or, by the name of FILE, .rad, .ply, .sog, DIR/meta.json (an unpacked"
        " SOG), .glb or .splat, which has no SH.",
        heading=COMMON,
    )
    form: str | None = option(
        "Format of the output. rad is what Spark streams; rad-chunked writes each chunk to a file of its own,"
        " NAME-lod-0.radc and so on, beside NAME-lod.rad; streamed-sog is what PlayCanvas, SuperSplat and Babylon.js"
        f" stream, {MANIFEST} and folders beside it; 3d-tiles is what CesiumJS streams, {TILESET} and a folder beside"
        " it. A Level-of-Detail file of another format keeps its tree. "
        " [default: by the name of FILE, or spz]",
        tuple(FORMS),
        flags=("--format",),
        heading=COMMON,
    )
    refining: RefineOptions = field(default_factory=RefineOptions)
    encoding: str | None = option(
        f"Write arrays in a viewer's memory layout instead: a {NPZ} file, or the words alone if FILE ends in"
        f" {' or '.join(RAW_SUFFIXES)}.",
        tuple(ENCODINGS),
        heading="File format",
    )

    @property
    def is_merged(self) -> bool:
        """Whether all inputs are one scene."""
        return self.merge or self.scene is not None

    def instances(self) -> list[Instance]:
        """Return the instances of the instances file; none without one.

        Raises:
            InstancesFileError: it cannot be read.
        """
        if self.scene is None:
            return []
        from ..scenes.instances_file import read_instances

        return read_instances(self.scene)

    def jobs(self, instances: Sequence[Instance], say: Callable[[str], None]) -> list[tuple[Source, Place]]:
        """Return pairs of an input and its output; `say` gets a line on attributes of instances that are ignored."""
        from ..bake.sources import Merged

        if not self.is_merged:
            return [(place, self.target(place)) for place in self.inputs]
        assert self.output is not None  # see `check_inputs`
        if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
            say(f"{self.scene}: lod_scale and foveation of instances are for viewers, and no part of a tree")
        merged = Merged.of(self.inputs) if self.scene is None else Merged.of_instances(instances)
        return [(merged, self.output)]

    @property
    def named_suffix(self) -> str:
        """Suffix of the named output, or its name where that tells the format, see `ending_of`; empty without one."""
        return ending_of(self.output.name) if self.output is not None and self.output != DASH else ""

    @property
    def is_raw(self) -> bool:
        """Whether the words of arrays are written alone: the named output is no .npz."""
        return self.output is not None and self.named_suffix != NPZ

    @property
    def suffix(self) -> str:
        """Suffix of the format that is written, which the name of the output need not have."""
        if self.encoding:
            return NPZ
        if self.form is not None:
            return FORMS[self.form][0]
        return self.named_suffix or (RAD if self.refining.refine is not None and self._suffixes == {RAD} else SPZ)

    @property
    def _suffixes(self) -> set[str]:
        """Suffixes of the inputs."""
        return {source.suffix.lower() for source in self.inputs}

    @property
    def may_replace_inputs(self) -> bool:
        """Whether an input may be its own output: of a tree that is refined, the leaves and links stay."""
        return self.refining.refine is not None and self.overwrite and not self.skip_existing

    @property
    def manifest(self) -> str | None:
        """The value of --format of an output of cuts of a tree, with files beside a manifest; None for others."""
        if self.form in MANIFESTS:
            return self.form
        return None if self.form or self.encoding or self.unlod else self.named_manifest

    @property
    def named_manifest(self) -> str | None:
        """The format whose manifest has the name of the named output; None where that has another name."""
        name = self.output.name if self.output is not None and self.output != DASH else ""
        return next((form for form, (manifest, *_) in MANIFESTS.items() if manifest == name), None)

    @property
    def is_streamed_sog(self) -> bool:
        """Whether regions at several detail levels are written."""
        return self.manifest == STREAMED_SOG

    @property
    def is_tiles(self) -> bool:
        """Whether 3D Tiles are written."""
        return self.manifest == TILES_3D

    @property
    def is_chunked(self) -> bool:
        """Whether the chunks of a RAD are files of their own."""
        return self.form is not None and FORMS[self.form][1]

    @property
    def is_folder(self) -> bool:
        """Whether the output is the first of several files in its folder."""
        return self.suffix in WRITABLE and self.suffix == WRITABLE[self.suffix].unbundled

    @property
    def format_is_chosen(self) -> bool:
        """Whether somebody chose the format, by --format or by a name."""
        return self.form is not None or self.named_suffix in TREES or self.manifest is not None

    def check_format_of_trees(self) -> None:
        """Raise a `click.UsageError` where trees of several formats would have to be refined as one format."""
        chosen = self.form is not None or self.encoding is not None or self.output is not None
        if self.refining.refine is not None and not chosen and RAD in self._suffixes and len(self._suffixes) > 1:
            raise click.UsageError(
                "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
                " refine the .rad files on their own"
            )

    def target(self, source: Place) -> Place:
        """Return the output path for an input."""
        return self.output or (self.output_dir or source.parent) / self._name(source)

    def _name(self, source: Place) -> str:
        stem = stem_of(source)
        if self.manifest is not None:
            return f"{stem.removesuffix('-lod')}-lod/{MANIFESTS[self.manifest][0]}"
        if self.unlod:
            return f"{stem.removesuffix('-lod')}-unlod{self.suffix}"
        known = self.form is not None or self.refining.refine is not None
        if known and source.suffix.lower() in TREES:  # a tree in another format has its name
            stem = stem.removesuffix("-lod")
        name = f"{stem}-lod{self.suffix}"
        return f"{stem}-lod-refined{self.suffix}" if self.refining.refine is not None and name == source.name else name


def check_inputs(ctx: click.Context, files: BakedFiles) -> None:
    """Raise a `click.UsageError` where there are no inputs, or merging them contradicts other options."""
    if not files.inputs and files.scene is None:
        raise click.MissingParameter(ctx=ctx, param=next(each for each in ctx.command.params if each.name == "inputs"))
    if files.inputs and files.scene is not None:
        raise click.UsageError("INPUT cannot be used with --scene, which names the files")
    if not files.is_merged:
        return
    flag = "--merge" if files.merge else "--scene"
    exclude(ctx, ("output_dir", "unlod", "rgba"), flag)
    if files.output is None:
        raise click.UsageError(f"{flag} makes one file of all inputs; name it with --output")


def record_of(source: Source) -> dict[str, Any]:
    """Return the input as a line of JSON has it: "input", or "inputs" where several are one scene."""
    from ..bake.sources import Merged

    if isinstance(source, Merged):
        return {"inputs": [str(each.file) for each in source.files]}
    return {"input": str(source)}


def check_formats(ctx: click.Context, outputs: BakedFiles) -> None:
    """Raise a `click.UsageError` where the options of formats, and the name of the output, contradict each other."""
    suffix = outputs.named_suffix
    outputs.check_format_of_trees()
    if outputs.manifest is not None:
        _check_manifest(ctx, outputs, outputs.manifest)
        return
    if outputs.is_chunked and outputs.output == DASH:
        raise click.UsageError("--format rad-chunked writes several files; name the output, or use --format rad")
    if outputs.encoding:
        refuse(ctx, ("form",), "cannot be used with --encoding")
        refuse_others(ctx, "--encoding", hints=False)
    if outputs.form is not None and suffix not in ("", outputs.suffix):
        raise click.UsageError(f"--format {outputs.form} writes {outputs.suffix}, not {suffix}")
    if outputs.output is not None and outputs.form is None:
        arrays, trees = (NPZ, *RAW_SUFFIXES), (*TREES, MANIFEST, TILESET)
        require_suffix("--output", outputs.output, arrays if outputs.encoding else WRITABLE if outputs.unlod else trees)
    if outputs.unlod:
        _check_unlod(ctx, outputs)
    elif outputs.encoding:
        if suffix not in ("", NPZ, *RAW_SUFFIXES):
            raise click.UsageError(f"--encoding writes {', '.join((NPZ, *RAW_SUFFIXES))}, not {suffix}")
        return
    else:
        _check_tree(suffix)
    refuse_others(ctx, WRITABLE[outputs.suffix].name, hints=not outputs.unlod)


def refuse_others(ctx: click.Context, written: str, *, hints: bool = True) -> None:
    """Raise a `click.UsageError` where an option of another format than the one that is written was given."""
    for names, formats, hint in OF_FORMATS:
        if written not in formats and not (written == DETAIL and "SOG" in formats):
            refuse(ctx, names, f"is an option of {' and '.join(formats)}, not of {written}{hint if hints else ''}")


def _check_manifest(ctx: click.Context, outputs: BakedFiles, form: str) -> None:
    manifest, written, beside = MANIFESTS[form]
    flag = f"--format {form}"
    refuse(ctx, ("unlod", "encoding"), f"cannot be used with {flag}")
    if outputs.output == DASH:
        raise click.UsageError(f"{flag} writes several files; name the output, such as web/{manifest}")
    if outputs.output is not None and outputs.named_manifest != form:
        raise click.UsageError(
            f"{flag} writes {manifest} and {beside} beside it, not {outputs.output.name}; name the output"
            f" {outputs.output.parent / outputs.output.stem / manifest}"
        )
    refuse_others(ctx, written, hints=False)
    if is_set(ctx, "environment"):
        refuse(ctx, ("environment_beyond",), "cannot be used with --environment")


def _check_unlod(ctx: click.Context, outputs: BakedFiles) -> None:
    suffix = outputs.named_suffix
    if outputs.named_manifest is not None:
        manifest = MANIFESTS[outputs.named_manifest][0]
        raise click.UsageError(f"--unlod writes splats without detail levels, not {manifest}")
    refuse(ctx, (*OF_TREES, "encoding"), "cannot be used with --unlod")
    if suffix not in ("", *WRITABLE):
        raise click.UsageError(f"--unlod writes {', '.join(WRITABLE)}, not {suffix}")


def _check_tree(suffix: str) -> None:
    known = f"{', '.join((*TREES, MANIFEST))} or {TILESET}"
    if suffix in (NPZ, *RAW_SUFFIXES):
        raise click.UsageError(f"{suffix} is a file of arrays; choose their layout with --encoding")
    if suffix in PLAIN:
        raise click.UsageError(f"{suffix} cannot hold a tree; name the output {known}")
    if suffix not in ("", *TREES):
        names = f"{', '.join((*TREES.values(), DETAIL))} or {TILED}"
        raise click.UsageError(f"trees are written as {names}, not as {suffix}; name the output {known}")
