"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import ENCODINGS, FORMATS, MANIFEST, NPZ, RAW_SUFFIXES, TILESET, WRITABLE, ending_of
from ..codecs.formats import RAD_SUFFIX as RAD
from ..codecs.options import RadOptions, SogOptions, WriteOptions
from ..fitting.settings import FitSettings
from ..lod.detail_rule import DetailSettings
from ..lod.tile_settings import TileSettings
from ..system import interrupts
from ..system.addresses import Address, Place
from ..system.errors import SparklodError
from ..system.printable import MOST, shortened
from ..system.stdio import DASH, name_of
from .build_lod_text import report_baked, report_extracted
from .command import (
    COMMON,
    argument,
    check_declared,
    command,
    flag,
    flags_set,
    is_set,
    option,
    parameters_of,
    refuse,
    values_of,
)
from .console import Console, print_json, say
from .options.baking import (
    OF_TREES,
    STREAMED_SOG,
    TILES_3D,
    ClusterOptions,
    DetailOptions,
    PaletteOptions,
    RefineOptions,
    ResourceOptions,
    SelectionOptions,
    TransformOptions,
    TreeOptions,
)
from .options.common import General, output_option, overwrite_flag
from .paths import (
    NAMELESS,
    Folder,
    InputPath,
    OutputPath,
    claim_stdout,
    is_same_place,
    keep_apart,
    require_suffix,
    stem_of,
    with_chunks,
)

if TYPE_CHECKING:
    from ..bake.out_of_core.cluster import ClusterEngine
    from ..bake.settings import Baked, BakeSettings, Source
    from ..bake.simplifying import Extracted
    from ..model.instances import Instance

    #: Result for an input; None where the output exists already.
    Outcome = Baked | Extracted | SparklodError | None

EXAMPLES = """\
  sparklod build-lod scene.ply                     # writes scene-lod.spz
  sparklod build-lod scene.ply --up -y             # y up, as viewers want it
  sparklod build-lod scene.ply --method quality    # for publishing
  sparklod build-lod scene.ply --format rad        # which Spark streams
  sparklod build-lod scans/*.ply --output-dir web -f --skip-existing
  sparklod build-lod scene.ply --method quality --refine      # in minutes
  sparklod build-lod scene.ply -o web/scene.rad --cluster-sh
  sparklod build-lod scene.ply -o web/lod-meta.json           # for PlayCanvas
  sparklod build-lod scene.ply --format streamed-sog --levels 50%,25%,10%
  sparklod build-lod scene.ply --up -y -o city/tileset.json   # for CesiumJS
  sparklod build-lod scene.ply -o city/tileset.json --lat 47.37 --lon 8.54
  sparklod build-lod scene.ply --within 0,1,0,25 --min-opacity 0.02
  sparklod build-lod scene.ply --json | jq .nodes
  sparklod build-lod scene.sog --encoding ext      # writes scene-lod.npz
  sparklod build-lod scene-lod.spz --format rad    # the same tree
  sparklod build-lod scene-lod.spz --refine        # the same tree, fitted
  sparklod build-lod scene-lod.spz --unlod -o scene.ply
  sparklod build-lod scene-lod.spz --unlod -o scene.sog       # for PlayCanvas
  sparklod build-lod scans/*.ply --output-dir web --workers 4
  sparklod build-lod tiles/*.ply --merge -o city-lod.rad
  sparklod build-lod city.ply -o city-lod.rad --memory 4G --scratch-dir /fast
  sparklod build-lod s3://bucket/city.ply \\
    --scheduler tcp://host:8786 --scratch-dir s3://bucket/scratch
  cat scene.ply | sparklod build-lod - -o - | aws s3 cp - s3://bucket/lod.spz
"""


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

#: Names of the formats of cuts.
DETAIL, TILED = DetailOptions.HEADING, TileSettings.HEADING

#: Formats of cuts of a tree, by the value of --format: name of the manifest, name of the format, and the files beside
#: the manifest.
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
        "Skip inputs whose output exists already, made from the same inputs and settings, as a small file beside it,"
        " NAME.sparklod.json, records. Files whose size and date are unchanged are not read;"
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
        return self.merge or self.scene is not None

    def jobs(self, instances: Sequence[Instance], say: Callable[[str], None]) -> list[tuple[Source, Place]]:
        """Return pairs of an input and its output; `say` gets a line on attributes of instances that are ignored."""
        from ..bake.settings import Merged

        if not self.is_merged:
            return [(place, self.target(place)) for place in self.inputs]
        assert self.output is not None  # see `check_inputs`
        if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
            say(f"{self.scene}: lod_scale and foveation of instances are for viewers, and no part of a tree")
        merged = Merged.of(self.inputs) if self.scene is None else Merged.of_instances(instances)
        return [(merged, self.output)]

    @property
    def named_suffix(self) -> str:
        """Suffix of the named output, or its name where that is the format's (`ending_of`); empty without one."""
        return ending_of(self.output.name) if self.output is not None and self.output != DASH else ""

    @property
    def suffix(self) -> str:
        """Suffix of the output format; the name of the output may have another one."""
        if self.encoding:
            return NPZ
        if self.form is not None:
            return FORMS[self.form][0]
        refines_rad = self.refining.refine is not None and {each.suffix.lower() for each in self.inputs} == {RAD}
        return self.named_suffix or (RAD if refines_rad else SPZ)

    @property
    def manifest(self) -> str | None:
        """The value of --format where cuts of a tree are written, with files beside a manifest; otherwise None."""
        if self.form in MANIFESTS:
            return self.form
        return None if self.form or self.encoding or self.unlod else self.named_manifest

    @property
    def named_manifest(self) -> str | None:
        """The format whose manifest has the name of the output; None if no format's manifest has it."""
        name = self.output.name if self.output is not None and self.output != DASH else ""
        return next((form for form, (manifest, *_) in MANIFESTS.items() if manifest == name), None)

    @property
    def is_chunked(self) -> bool:
        """Whether the chunks of a RAD are files of their own."""
        return self.form is not None and FORMS[self.form][1]

    def target(self, source: Place) -> Place:
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
    refuse(ctx, ("output_dir", "unlod", "rgba"), f"cannot be used with {flag}")
    if files.output is None:
        raise click.UsageError(f"{flag} makes one file of all inputs; name it with --output")


def record_of(source: Source, target: Place, outcome: Outcome) -> dict[str, Any]:
    """Return the JSON of a result; several inputs that are one scene are "inputs"."""
    from ..bake.settings import Merged

    record: dict[str, Any] = {"input": str(source)}
    if isinstance(source, Merged):
        record = {"inputs": [str(each.file) for each in source.files]}
    if isinstance(outcome, SparklodError):
        return {**record, "error": shortened(str(outcome), MOST)}
    more = {"skipped": True} if outcome is None else dataclasses.asdict(outcome)
    return {**record, "output": str(target), **more}


def check_formats(ctx: click.Context, outputs: BakedFiles) -> None:
    """Raise a `click.UsageError` where the options of formats, and the name of the output, contradict each other."""
    suffix = outputs.named_suffix
    chosen = outputs.form is not None or outputs.encoding is not None or outputs.output is not None
    suffixes = {source.suffix.lower() for source in outputs.inputs}
    if outputs.refining.refine is not None and not chosen and RAD in suffixes and len(suffixes) > 1:
        raise click.UsageError(
            "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
            " refine the .rad files on their own"
        )
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
        known = f"{', '.join((*TREES, MANIFEST))} or {TILESET}"
        if suffix in (NPZ, *RAW_SUFFIXES):
            raise click.UsageError(f"{suffix} is a file of arrays; choose their layout with --encoding")
        if suffix in PLAIN:
            raise click.UsageError(f"{suffix} cannot hold a tree; name the output {known}")
        if suffix not in ("", *TREES):
            names = f"{', '.join((*TREES.values(), DETAIL))} or {TILED}"
            raise click.UsageError(f"trees are written as {names}, not as {suffix}; name the output {known}")
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


BOTH = "--output cannot be used with --output-dir"


@dataclass(frozen=True)
class BuildLodOptions:
    """Options of the command, group by group."""

    files: BakedFiles = field(default_factory=BakedFiles)
    tree: TreeOptions = field(default_factory=TreeOptions)
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    transform: TransformOptions = field(default_factory=TransformOptions)
    written: WriteOptions = field(default_factory=WriteOptions)
    palette: PaletteOptions = field(default_factory=PaletteOptions)
    detail: DetailOptions = field(default_factory=DetailOptions)
    tiles: TileSettings = field(default_factory=TileSettings)
    resources: ResourceOptions = field(default_factory=ResourceOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    general: General = field(default_factory=General)

    def bake_settings(self, ctx: click.Context) -> BakeSettings:
        """Return the settings of bakes; loads numpy."""
        from ..bake.settings import BakeSettings

        files, refining = self.files, self.files.refining
        return BakeSettings(
            **self.tree.settings(only_cuts=files.manifest is not None),
            selection=self.selection.selection(),
            transform=self.transform.transform(),
            up=self.transform.up,
            rgba=self.selection.rgba,
            suffix=files.suffix,
            options=self.write_options(),
            encoding=files.encoding,
            raw=files.output is not None and files.named_suffix != NPZ,
            detail=self.detail.settings if files.manifest == STREAMED_SOG else None,
            tiles=self.tiles if files.manifest == TILES_3D else None,
            environment=self.detail.environment,
            environment_beyond=self.detail.environment_beyond,
            refine=None
            if refining.refine is None
            else FitSettings(refining.refine or None, refining.seed, device=refining.device),
            camera_path=refining.camera_path,
            converts=files.form is not None or files.named_suffix in TREES or files.manifest is not None,
            unused=tuple(flags_set(ctx, (*OF_TREES, "environment_beyond"))),
        )

    def write_options(self) -> WriteOptions:
        """Return the write options; defaults are left to the library, which may take them from the input."""
        form, codes = self.files.form, self.palette.cluster_sh
        rad = dataclasses.replace(self.written.rad, chunked=form is not None and FORMS[form][1], sh_codes=codes)
        return dataclasses.replace(self.written, rad=rad, sog=SogOptions(codes))


HEADINGS = (
    *(COMMON, "Tree", "Selection", "Rotation, scale and position", "File format", "RAD", "Streamed SOG", "3D Tiles"),
    *("Refining", "Large scenes", "Cluster"),
)


@command("build-lod", BuildLodOptions, examples=EXAMPLES, headings=HEADINGS)
def build_lod(ctx: click.Context, /, **_: Any) -> None:
    """Bake splat files into Level-of-Detail files for Spark, PlayCanvas, SuperSplat, Babylon.js and CesiumJS.

    Reads PLY (also PlayCanvas's compressed PLY), SPZ, RAD, SOG (.sog, or a folder with a meta.json), Streamed SOG and
    3D Tiles (their full detail), .splat, .ksplat, GLB, .gltf, .hier (its full detail), and checkpoints of gsplat and
    nerfstudio (.pt, .ckpt); merges splats into a tree, and writes the tree as SPZ with Spark's extension, or as RAD,
    which Spark streams, or cuts of it as 3D Tiles, which CesiumJS streams, or as Streamed SOG, which the others stream.
    An INPUT of - is standard input.

    The axes of the input are kept unless --up or --rotate turns them. Selection goes by the coordinates of the input;
    of merged inputs, by those at which they stand together.

    INPUT, FILE and DIR may be addresses such as s3://bucket/scan.ply (extra cloud).

    An input that fails does not stop the others; the exit status is 1 if any did. With --workers or --scheduler,
    several inputs are baked side by side (extra cluster).
    """
    output = ctx.params["output"]
    if isinstance(output, Folder):  # an --output that names a folder is an --output-dir
        if ctx.params["output_dir"] is not None:
            raise click.UsageError(BOTH)
        ctx.params.update(output=None, output_dir=output.path)
    options = values_of(ctx, BuildLodOptions)
    files, general = options.files, options.general
    check_inputs(ctx, files)
    instances: list[Instance] = []
    if files.scene is not None:
        from ..scenes.instances_file import read_instances

        instances = read_instances(files.scene)
    _check(ctx, options, [instance.file for instance in instances if instance.file is not None])
    failed = False
    cluster, console = options.cluster, Console(quiet=general.quiet, verbose=general.verbose)
    engines: contextlib.AbstractContextManager[ClusterEngine | None] = contextlib.nullcontext()
    if cluster.workers is not None or cluster.scheduler is not None:
        engines = cluster.engine(ctx, general, options.resources.memory, console)
    with console, engines as engine:
        report: Callable[..., None] = report_extracted if files.unlod else report_baked
        pairs = files.jobs(instances, console.say)
        for (source, target), outcome in zip(pairs, _outcomes(ctx, options, pairs, console, engine), strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
            elif outcome is None:
                console.say(f"{name_of(source)}  ->  {target}  exists already")
            else:
                report(console, source, target, outcome)
            if general.as_json:
                print_json(record_of(source, target, outcome))
            if interrupts.came():  # during fitting, which then ends early
                console.clear()
                say("interrupted")
                ctx.exit(interrupts.INTERRUPTED)
    if failed:
        ctx.exit(1)


def _check(ctx: click.Context, options: BuildLodOptions, named: list[Path]) -> None:
    """Raise a `click.UsageError` where options contradict each other, or the names of files; `named` by --scene."""
    files = options.files
    inputs, output = files.inputs, files.output
    if output is not None:
        if files.output_dir is not None:
            raise click.UsageError(BOTH)
        if len(inputs) > 1 and not files.merge:
            raise click.UsageError(
                f"--output takes one input, not {len(inputs)}; add --merge to bake them as one scene, or name a folder"
            )
    elif DASH in inputs:
        raise click.UsageError(NAMELESS)
    elif files.output_dir is None:
        for source in inputs:
            if isinstance(source, Address) and source.is_read_only:
                raise click.UsageError(
                    f"nothing can be written beside {source}; name the output with -o or --output-dir"
                )
    targets = [output] if output is not None else [files.target(source) for source in inputs]
    refines = files.refining.refine is not None and not files.skip_existing and not files.is_merged
    if refines and files.overwrite:  # a tree may replace itself, for its leaves and links stay
        targets = [target for source, target in zip(inputs, targets, strict=True) if not is_same_place(source, target)]
    unbundled = files.suffix in WRITABLE and files.suffix == WRITABLE[files.suffix].unbundled
    if files.is_chunked or unbundled or files.manifest is not None:
        targets = with_chunks(targets)
    keep_apart(ctx, {"output" if files.output_dir is None else "output_dir": targets, "scene": named})
    claim_stdout(ctx, "output", as_json=options.general.as_json, binary=True)
    if options.selection.rgba is not None and len(inputs) > 1:
        raise click.UsageError(f"--rgba takes one input, not {len(inputs)}")
    if files.skip_existing and output == DASH:
        raise click.UsageError("--skip-existing needs an output that can be there already; name a file")
    check_formats(ctx, files)
    check_declared(ctx)
    if is_set(ctx, "scheduler"):
        refuse(ctx, ["workers"], "cannot be used with --scheduler, whose workers run already")
    if is_set(ctx, "refine"):
        refuse(ctx, ["scratch_dir", "resume"], "cannot be used with --refine, which needs the whole tree in memory")
    of_clusters = parameters_of(ClusterOptions)
    if files.unlod:
        refuse(
            ctx,
            (*parameters_of(ResourceOptions), *of_clusters, "refine", "skip_existing"),
            "cannot be used with --unlod",
        )
    else:
        options.tree.check(ctx, only_cuts=files.manifest is not None)
    if DASH in inputs:
        refuse(
            ctx, of_clusters, "cannot be used with standard input, which workers cannot read; save it to a file first"
        )


def _outcomes(
    ctx: click.Context,
    options: BuildLodOptions,
    pairs: Sequence[tuple[Source, Place]],
    console: Console,
    engine: ClusterEngine | None,
) -> Iterator[Outcome]:
    """Make the output of each input, and return the results in order; loads numpy.

    An error is the result of its input, so that it does not stop the others.
    """
    files, threads = options.files, options.general.threads
    shared: dict[str, Any] = {"overwrite": files.overwrite, "progress": console.progress}
    job: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    make: Callable[..., Any]

    def outcome(source: Source, target: Place) -> Outcome:
        try:
            with job():
                result: Baked | Extracted | None = make(source, target)
                return result
        except SparklodError as error:
            return error

    if files.unlod:
        console.announce_compiling()
        from ..bake.simplifying import extract_leaves

        written: dict[str, Any] = {"suffix": files.suffix, "options": options.write_options()}
        make = functools.partial(extract_leaves, **written, threads=threads, **shared)
        return (outcome(*pair) for pair in pairs)
    from ..bake.flow import bake, stage_shares
    from ..bake.settings import Resources

    settings = options.bake_settings(ctx)
    console.announce_compiling(settings)
    bake_one: Callable[..., Baked | None] = bake
    if files.skip_existing is not None:
        from ..bake.skipping import bake_unless_there

        bake_one = functools.partial(bake_unless_there, verify=files.skip_existing == VERIFY)
    limits, memory = options.resources, options.resources.memory if engine is None else engine.memory
    how: dict[str, Any] = {"settings": settings, "resources": Resources(memory, limits.scratch_dir, limits.resume)}
    how["engine"] = engine
    job = functools.partial(console.job, stage_shares(settings))
    make = functools.partial(bake_one, **how, threads=threads, say=console.say, **shared)
    if engine is None or len(pairs) < 2:
        return (outcome(*pair) for pair in pairs)
    from ..bake.side_by_side import bake_side_by_side

    return bake_side_by_side(pairs, make=bake_one, bake_large=outcome, **how, **shared)
