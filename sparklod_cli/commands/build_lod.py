"""`sparklod build-lod`: bakes Level-of-Detail files, and reports what it wrote."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import FORMATS, MANIFEST, TILESET, WRITABLE
from ..codecs.formats import RAD_SUFFIX as RAD
from ..codecs.options import MAX_SH_CODES, SH_CODES, WriteOptions
from ..fitting import FIT_DEVICE_HELP, SEED, SEED_HELP, STEPS
from ..lod.tree_settings import (
    DEFAULT_BASE,
    DEFAULT_GROWTH,
    DETAIL_GROWTH,
    MAX_BASE,
    MAX_GROWTH,
    METHODS,
    MIN_BASE,
    MIN_GROWTH,
    DetailSettings,
    TileSettings,
)
from ..model import MAX_SH_DEGREE
from ..render import DEVICES
from ..system import interrupts
from ..system.addresses import Address, Place
from ..system.errors import SparklodError
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.stdio import DASH, name_of
from ..system.units import format_size, percent_of
from ..system.untrusted import MOST, shortened
from .command import COMMON, Command, OptionalNumber, flag, values_of
from .console import Console, count_of, print_json, say
from .option_groups import (
    EACH_AS_JSON,
    FILE_FORMAT,
    JSON,
    OUTPUT,
    OVERWRITE,
    SCENE_HEADINGS,
    General,
    SceneOptions,
    bake_settings,
    memory_size,
)
from .outputs import (
    ARRAYS,
    FORMS,
    NAMELESS,
    TREE_FORMS,
    NamedPath,
    Target,
    claim_stdout,
    is_same_place,
    keep_apart,
    shown,
    stem_of,
)
from .rules import check, is_set

if TYPE_CHECKING:
    from ..api.bake_jobs import Outcome, Pair
    from ..api.converting import Converted
    from ..bake.settings import Baked, BakeSettings, Source
    from ..codecs.losses import Clamp, Losses
    from ..fitting.fit_settings import Refined
    from ..model.instances import Instance

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
  sparklod build-lod scene-lod.spz --format rad    # the same tree
  sparklod build-lod scene-lod.spz --refine        # the same tree, fitted
  sparklod build-lod scans/*.ply --output-dir web --workers 4
  sparklod build-lod tiles/*.ply --merge -o city-lod.rad
  sparklod build-lod city.ply -o city-lod.rad --memory 4G --scratch-dir /fast
  sparklod build-lod s3://bucket/city.ply \\
    --scheduler tcp://host:8786 --scratch-dir s3://bucket/scratch
  cat scene.ply | sparklod build-lod - -o - | aws s3 cp - s3://bucket/lod.spz
"""

#: Endings of formats that hold no tree.
PLAIN = {ending for form in FORMATS for ending in (*form.suffixes, *form.endings) if not form.trees}

#: Endings of outputs of build-lod, and the formats.
ENDINGS = [form.manifest or form.suffix for form in TREE_FORMS.values() if not form.chunked]
TREES = [suffix for suffix, form in WRITABLE.items() if form.trees]

#: Default builder of trees that detail levels or tiles are cut from.
QUALITY = "quality"

#: Value of --refine without a number, and an example of a useful number.
BY_SIZE, EXAMPLE_STEPS = "default", 2000

#: Values of --skip-existing: read only files whose size or date changed, or all.
BY_DATE, VERIFY = "date", "verify"

#: Headings of `--help`.
TREE, REFINING, LARGE, CLUSTER = "Tree", "Refining", "Large scenes", "Cluster"
DETAIL, TILED = DetailSettings.HEADING, TileSettings.HEADING
HEADINGS = (COMMON, TREE, *SCENE_HEADINGS[1:], DETAIL, TILED, REFINING, LARGE, CLUSTER)


@dataclass(frozen=True)
class BuildLodOptions:
    """Options of build-lod."""

    inputs: tuple[Place, ...] = setting(
        "", NamedPath(stdin=True, addresses=True), (), argument=True, nargs=-1, metavar="INPUT..."
    )
    merge: bool = flag(
        "Bake all INPUTs as one scene, into the file that --output names: tiles of a city, each where its own"
        " coordinates put it.",
        heading=COMMON,
    )
    scene: Path | None = setting(
        "Merge the files of an instances file, each where it stands there, in place of INPUTs (see docs/build-lod.md).",
        NamedPath(),
        heading=COMMON,
    )
    output: Place | None = setting(
        "Output of a single input, or a folder for all outputs; - is standard output.  [default: NAME-lod.spz beside"
        f" the input; NAME-lod.rad with --format rad, NAME-lod/{MANIFEST} with --format streamed-sog,"
        f" NAME-lod/{TILESET} with --format 3d-tiles,"
        " NAME-lod-refined.spz of a NAME-lod.spz with --refine]",
        NamedPath(output=True, addresses=True),
        **OUTPUT,
    )
    output_dir: Place | None = setting(
        "Folder for the outputs; created if it does not exist.",
        NamedPath(output=True, folder=True, addresses=True),
        heading=COMMON,
    )
    overwrite: bool = flag(**OVERWRITE)
    skip_existing: str | None = setting(
        "Skip inputs whose output exists already, made from the same inputs and settings, as a small file beside it,"
        " NAME.sparklod.json, records. Files whose size and date are unchanged are not read;"
        " --skip-existing=verify reads all, and so finds damage that left both as they were.",
        (BY_DATE, VERIFY),
        heading=LARGE,
        metavar="[=verify]",
        bare=BY_DATE,
    )
    form: str | None = setting(
        "Format of the output. rad is what Spark streams; rad-chunked writes each chunk to a file of its own,"
        " NAME-lod-0.radc and so on, beside NAME-lod.rad; streamed-sog is what PlayCanvas, SuperSplat and Babylon.js"
        f" stream, {MANIFEST} and folders beside it; 3d-tiles is what CesiumJS streams, {TILESET} and a folder beside"
        " it. A Level-of-Detail file of another format keeps its tree. "
        " [default: by the name of FILE, or spz]",
        tuple(TREE_FORMS),
        flags=("--format",),
        heading=COMMON,
    )
    refine: int | None = setting(
        "Fit merged splats to pictures of full detail, in STEPS pictures of cuts: minutes, for cuts that come closer to"
        " it. The leaves stay as they are, and so does the tree of a Level-of-Detail file. Ctrl-C ends it early and"
        " keeps what was gained.  [default, without STEPS: by the size of the tree]",
        OptionalNumber(STEPS, placeholder="STEPS", example=EXAMPLE_STEPS, zero=BY_SIZE),
        is_flag=False,
        flag_value=BY_SIZE,
        heading=REFINING,
    )
    camera_path: Path | None = setting(
        "Cameras that --refine fits for, in the coordinates of the output, in any format that render reads: those of"
        " visitors whose paths are known.  [default: cameras around and inside the scene]",
        NamedPath(),
        heading=REFINING,
    )
    seed: int = setting(SEED_HELP, SEED, 0, heading=REFINING)
    device: str = setting(FIT_DEVICE_HELP, DEVICES, "cpu", heading=REFINING)
    method: str | None = setting(
        "How splats are merged: quick takes seconds; quality takes longer, and its cuts come closer to full detail."
        f"  [default: {METHODS[0]}; quality with --format streamed-sog or 3d-tiles]",
        METHODS,
        heading=COMMON,
    )
    max_sh: int = setting(
        "Highest degree of spherical harmonics to keep.", whole(0, MAX_SH_DEGREE), MAX_SH_DEGREE, heading=COMMON
    )
    base: float = setting(
        "Growth of the voxel grid from level to level, with --method quick. Smaller values give smoother transitions"
        " and more nodes.",
        Range(MIN_BASE, MAX_BASE, unit="N"),
        DEFAULT_BASE,
        heading=TREE,
    )
    growth: float | None = setting(
        "Largest number of nodes for each leaf, with --method quality."
        f"  [default: {DEFAULT_GROWTH:g}; {DETAIL_GROWTH:g} with --format streamed-sog or"
        f" 3d-tiles]",
        Range(MIN_GROWTH, MAX_GROWTH, unit="N"),
        heading=TREE,
    )
    input_scene: SceneOptions = field(default_factory=SceneOptions)
    written: WriteOptions = field(default_factory=WriteOptions)
    cluster_sh: int | None = setting(
        "Write spherical harmonics to RAD as a palette of at most N entries, 2 to 65,536, and a label for each splat:"
        " the file gets smaller, and reflections less exact. N is 65,536 if it is left out. SOG always has a palette;"
        " this chooses its size, which otherwise suits the number of splats.",
        OptionalNumber(SH_CODES, example=MAX_SH_CODES),
        is_flag=False,
        flag_value=str(MAX_SH_CODES),
        heading=FILE_FORMAT,
    )
    detail: DetailSettings = field(default_factory=DetailSettings)
    environment: Path | None = setting(
        "Splats that are always drawn, such as a sky, from a file of any format without a tree; turned and moved as the"
        " scene.",
        NamedPath(),
        heading=DETAIL,
    )
    environment_beyond: float | None = setting(
        "Make splats whose centre is farther than this from the median of all centres the environment, in the input's"
        " units.",
        Range(above=0, unit="RADIUS"),
        heading=DETAIL,
    )
    tiles: TileSettings = field(default_factory=TileSettings)
    memory: int | None = setting(
        "Memory that a bake may take, such as 4G or '600 MB'. A scene that needs more is baked out of core: block by"
        " block, with a scratch folder.  [default: 75 % of what is available]",
        Quantity("SIZE", memory_size),
        heading=LARGE,
    )
    scratch_dir: Place | None = setting(
        "Where a bake out of core makes its scratch folder, which is removed at the end.  [default: beside the output]",
        NamedPath(output=True, folder=True, addresses=True),
        heading=LARGE,
    )
    resume: bool = flag(
        "Go on with a bake out of core that was interrupted; it must be the same bake. Without one, begin.",
        heading=LARGE,
    )
    workers: int | None = setting(
        "Bake on this many processes of this machine, which share --threads and --memory.",
        whole(1, 256),
        heading=CLUSTER,
    )
    scheduler: str | None = setting(
        "Bake on the Dask cluster whose scheduler has this address, as tcp://host:8786.",
        metavar="ADDRESS",
        heading=CLUSTER,
    )
    as_json: bool = flag(EACH_AS_JSON, **JSON)
    general: General = field(default_factory=General)

    @property
    def target(self) -> Target:
        """Target that --output, --output-dir and --format describe; refined RAD files stay RAD."""
        target = Target.of(self.output, self.form, self.output_dir)
        if self.refine is None or self.form is not None or target.kind == "file":
            return target
        are_rad = {source.suffix.lower() for source in self.inputs} == {RAD}
        return dataclasses.replace(target, form=FORMS["rad"]) if are_rad else target

    def output_of(self, source: Place, target: Target) -> Place:
        """Return the output for an input."""
        if target.file is not None:
            return target.file
        form, stem = target.form, stem_of(source)
        is_chosen = self.form is not None or self.refine is not None
        if form.manifest or (is_chosen and source.suffix.lower() in TREES):
            stem = stem.removesuffix("-lod")  # a tree in another format has its name
        name = f"{stem}-lod/{form.manifest}" if form.manifest else f"{stem}-lod{form.suffix}"
        if self.refine is not None and name == source.name:
            name = f"{stem}-lod-refined{form.suffix}"
        return (target.folder or source.parent) / name

    def builder(self, target: Target) -> str:
        """Return the builder of the tree, by --method, or else by the format."""
        return self.method or (QUALITY if target.form.manifest else METHODS[0])

    def settings(self, ctx: click.Context, target: Target) -> BakeSettings:
        """Return the settings of bakes; loads numpy."""
        refine = None
        if self.refine is not None:
            from ..fitting.fit_settings import FitSettings

            refine = FitSettings(self.refine or None, self.seed, device=self.device)
        form = target.form
        names_tree = target.file is not None and target.file != DASH and form.suffix in TREES
        return bake_settings(
            ctx,
            form,
            self.input_scene,
            self.written,
            self.cluster_sh,
            method=self.builder(target),
            base=self.base,
            growth=self.growth or (DETAIL_GROWTH if form.manifest else DEFAULT_GROWTH),
            max_sh=self.max_sh,
            detail=self.detail if form.name == DETAIL else None,
            tiles=self.tiles if form.name == TILED else None,
            environment=self.environment,
            environment_beyond=self.environment_beyond,
            refine=refine,
            camera_path=self.camera_path,
            converts=self.form is not None or names_tree or bool(form.manifest),
        )


#: Options of earlier versions, and what to write instead.
REPLACED = {"--unlod": "sparklod convert IN OUT --leaves", "--encoding": "sparklod convert IN OUT.npz --layout NAME"}


@click.command(
    "build-lod", cls=Command, options=BuildLodOptions, examples=EXAMPLES, headings=HEADINGS, replaced=REPLACED
)
@click.pass_context
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
    options = values_of(ctx, BuildLodOptions)
    general, target = options.general, options.target
    instances = _check(ctx, options, target)
    failed, console = False, Console(quiet=general.quiet, verbose=general.verbose)
    with console, contextlib.ExitStack() as stack:
        from ..api.bake_jobs import bake_files, merged_source

        pairs: Sequence[Pair] = [(source, options.output_of(source, target)) for source in options.inputs]
        if target.file is not None and (options.merge or options.scene is not None):
            pairs = [(merged_source(options.inputs, instances), target.file)]
            if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
                viewers = "lod_scale and foveation of instances are for viewers, and no part of a tree"
                console.say(f"{options.scene}: {viewers}")
        settings = options.settings(ctx, target)
        console.announce_compiling(settings)
        outcomes = bake_files(
            pairs,
            settings,
            overwrite=options.overwrite,
            threads=general.threads,
            progress=console.progress,
            job=console.job,
            say=console.say,
            skip=options.skip_existing,
            memory=options.memory,
            scratch_dir=options.scratch_dir,
            resume=options.resume,
            scheduler=options.scheduler,
            workers=options.workers,
            cluster_threads=general.threads if options.scheduler is None or is_set(ctx, "threads") else None,
        )
        stack.enter_context(contextlib.closing(outcomes))
        for (source, output), outcome in zip(pairs, outcomes, strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
            elif outcome is None:
                console.say(f"{name_of(source)}  ->  {output}  exists already")
            else:
                report_baked(console, source, shown(output), outcome)
            if options.as_json:
                print_json(record_of(source, output, outcome))
            exit_if_interrupted(ctx, console)
    if failed:
        ctx.exit(1)


def exit_if_interrupted(ctx: click.Context, console: Console) -> None:
    """Exit after Ctrl-C during fitting, which then ends early and writes its output."""
    if interrupts.came.is_set():
        console.clear()
        say("interrupted")
        ctx.exit(interrupts.INTERRUPTED)


def _check(ctx: click.Context, options: BuildLodOptions, target: Target) -> list[Instance]:
    """Return the instances of --scene; raise a `click.UsageError` where options or names of files contradict."""
    inputs, merges = options.inputs, options.merge or options.scene is not None
    if not inputs and options.scene is None:
        raise click.MissingParameter(ctx=ctx, param=next(each for each in ctx.command.params if each.name == "inputs"))
    source = "standard input" if DASH in inputs else "files"
    check(ctx, place=target.kind, source=source, count=len(inputs))
    instances: list[Instance] = []
    if options.scene is not None:
        from ..viewers.instances_file import read_instances

        instances = read_instances(options.scene)
    if target.file is not None and len(inputs) > 1 and not options.merge:
        raise click.UsageError(
            f"--output takes one input, not {len(inputs)}; add --merge to bake them as one scene, or name a folder"
        )
    if target.file is None and DASH in inputs:
        raise click.UsageError(NAMELESS)
    if target.file is None and target.folder is None:
        for each in inputs:
            if isinstance(each, Address) and each.is_read_only:
                raise click.UsageError(f"nothing can be written beside {each}; name the output with -o or --output-dir")
    outputs = [options.output_of(each, target) for each in inputs] if target.file is None else [target.file]
    if options.refine is not None and options.overwrite and not options.skip_existing and not merges:
        # A tree may replace itself, for its leaves and links stay.
        outputs = [output for each, output in zip(inputs, outputs, strict=True) if not is_same_place(each, output)]
    named = [instance.file for instance in instances if instance.file is not None]
    keep_apart(ctx, {"output": target.files(outputs), "scene": named})
    claim_stdout(ctx, "output", as_json=options.as_json, binary=True)
    _check_format(options, target)
    check(ctx, format=target.form.name, method=options.builder(target))
    return instances


def _check_format(options: BuildLodOptions, target: Target) -> None:
    """Raise a `click.UsageError` where the format is not clear, or holds no tree."""
    suffixes = {source.suffix.lower() for source in options.inputs}
    keeps_format = options.refine is not None and options.form is None and options.output is None
    if keeps_format and RAD in suffixes and len(suffixes) > 1:
        raise click.UsageError(
            "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
            " refine the .rad files on their own"
        )
    target.check_name("--output", ENDINGS)
    form, known = target.form, f"{', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
    if form.suffix in ARRAYS:
        raise click.UsageError(f"{form.suffix} holds arrays; bake a tree, and write it with sparklod convert --layout")
    if form.suffix in PLAIN and not form.manifest:
        raise click.UsageError(f"{form.suffix} cannot hold a tree; name the output {known}, or write sparklod convert")
    if form not in TREE_FORMS.values():
        raise click.UsageError(
            f"trees are written as SPZ, RAD, {DETAIL} or {TILED}, not as {form.suffix}; name the output {known}"
        )


def record_of(source: Source, target: Place, outcome: Outcome | Converted) -> dict[str, Any]:
    """Return the JSON of a result; several inputs that are one scene are "inputs"."""
    if isinstance(source, (Path, Address)):
        record: dict[str, Any] = {"input": str(source)}
    else:
        record = {"inputs": [str(file) for file, _ in source.files]}
    if isinstance(outcome, SparklodError):
        return {**record, "error": shortened(str(outcome), MOST)}
    more = {"skipped": True} if outcome is None else dataclasses.asdict(outcome)
    return {**record, "output": str(target), **more}


#: What clamping does to a scene and what to do about it, by column of `Splats` and whether the upper end clamps.
CLAMPED_BY_SPZ = {
    ("scale", False): ("scales", "mostly how thick flat splats are; --format rad keeps them"),
    ("scale", True): ("scales", "such splats, of a sky perhaps, shrink; --format rad keeps them"),
    ("rgb", False): ("colours", "darker than black, so the loss is hardly visible"),
    ("rgb", True): ("colours", "brighter than white, so the loss is hardly visible"),
    ("sh", False): ("SH", "reflections get weaker; render --diff shows whether it matters"),
    ("sh", True): ("SH", "reflections get weaker; render --diff shows whether it matters"),
}
_THIN, _WIDE = "mostly how thick flat splats are; --rad-scales ln_f16 keeps them", "--rad-scales ln_f16 keeps them"
_FAR, _COLORS = "--rad-center f32_lebytes keeps them", "the loss is hardly visible; --rad-rgb {wide} keeps them"
#: The visible effect of clamping values below the lower end, and above the upper one.
CONSEQUENCES = {
    "center": ("splats are farther away", "splats are farther away"),
    "scale": ("splats are smaller", "splats are larger"),
    "rgb": ("colours are darker", "colours are brighter"),
    "sh": ("reflections are stronger", "reflections are stronger"),
}
#: "{wide}" is the encoding that holds the values.
CLAMPED_BY_RAD = {
    ("center", True): ("coordinates", _FAR),
    ("scale", False): ("scales", _THIN),
    ("scale", True): ("scales", _WIDE),
    ("rgb", False): ("colours", _COLORS),
    ("rgb", True): ("colours", _COLORS),
    ("sh", True): ("SH", "reflections get weaker; --rad-sh {wide} keeps them"),
}

#: Words for columns of which leaves have values that an output clamps, and the share of splats from which it is said.
COLUMNS = {"center": "centres", "scale": "scales", "rgb": "colours", "sh": "reflections (SH)"}
LEAST_SHARE = 0.001


def report_baked(console: Console, source: Source, target: str, baked: Baked) -> None:
    """Print a line about the file, and one for each thing that a person should know."""
    made, detail, tiles = baked.simplified, baked.detail, baked.tiles
    if made is not None:
        measured = "" if made.psnr is None else f", PSNR {made.psnr:.2f} dB"
        contents = f"{count_of(made.splats, 'splat')} ({percent_of(made.share)}){measured}"
    elif tiles is not None:
        place = ", on the Earth" if tiles.georeferenced else ""
        contents = f"{count_of(tiles.tiles, 'tile')} of {count_of(tiles.levels, 'level')}{place}"
    elif detail is not None:
        environment = f", environment of {count_of(detail.environment, 'splat')}" if detail.environment else ""
        contents = (
            f"{count_of(len(detail.levels), 'detail level')} of {count_of(detail.regions, 'region')},"
            f" {count_of(detail.chunks, 'chunk file')}{environment}"
        )
    else:
        chunks = f", {count_of(baked.chunks, 'chunk')}" if baked.chunks else ""
        contents = f"{count_of(baked.nodes, 'node')}, depth {baked.levels - 1}{chunks}"
    console.say(
        f"{name_of(source)}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {target} "
        f" {contents}, {format_size(baked.bytes)}, {sum(baked.seconds.values()):.1f} s"
    )
    if detail is not None and len(detail.levels) > 1:
        levels = (
            f"{level.splats:,} splats ({percent_of(level.share)}, error at most {level.worst_error:.2g})"
            for level in detail.levels[1:]
        )
        console.say(f"  levels below full detail: {', '.join(levels)}")
    if tiles is not None and tiles.levels > 1:
        console.say(f"  splats level by level: {', '.join(f'{count:,}' for count in tiles.splats)}")
    refine = baked.refine if made is None else made.refine
    if refine is not None:
        console.say(f"  {_refined(refine)}")
    if baked.dropped:
        from ..model.selection import describe

        console.say(f"  left out: {describe(baked.dropped)}")
    for note in baked.notes:
        console.say(f"  {note}")
    if made is not None:
        if made.faint > LEAST_SHARE * made.splats:
            share = percent_of(made.faint / made.splats)
            console.say(
                f"  {share} of the splats, merged across wide gaps, are too faint to be drawn; keep more splats"
            )
        _report_losses(console, made, made.splats, baked.output_format)
        console.detail(f"  {baked.format}; {_stages(baked.seconds)}")
        return
    if baked.clamps and (consequences := _consequences(baked)):
        console.say(f"  {consequences}")
    if not console.verbose:
        return
    for clamp in baked.clamps:
        console.say(f"  {_clamped(clamp, baked)}")
    tree = f"{baked.method} tree" if baked.method is not None else "the same tree"
    tree += ", refined" if baked.refine is not None else ""
    console.say(f"  {baked.format} -> {tree} -> {_written(baked)}; {_stages(baked.seconds)}")
    if baked.blocks is not None:
        written, read = (format_size(size or 0) for size in (baked.scratch_bytes_written, baked.scratch_bytes_read))
        console.say(f"  out of core in {count_of(baked.blocks, 'block')}; scratch: {written} written, {read} read")


def _refined(refined: Refined) -> str:
    gains = [
        f"{percent_of(share)} {before:.2f} -> {refined.psnr_after[share]:.2f}"
        for share, before in refined.psnr_before.items()
    ]
    seen = f"held-out PSNR {', '.join(gains)} dB" if gains else "no held-out camera sees anything of it"
    early = "" if refined.is_complete else ", interrupted"
    return (
        f"refined in {count_of(refined.steps, 'step')}{early}: {seen};"
        f" {percent_of(refined.kept)} of the splats fitted have new values"
    )


def _written(baked: Baked) -> str:
    if baked.detail is not None:
        return "Streamed SOG"
    if baked.tiles is not None:
        return "3D Tiles"
    if baked.chunks is None:
        return f"SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits"
    palette = f", a palette of {baked.sh_codes:,} SH" if baked.sh_codes else ""
    encodings = ", ".join(f"{name} {encoding}" for name, encoding in baked.encodings.items())
    return f"RAD LoD, {encodings}{palette}"


def _consequences(baked: Baked) -> str:
    """Return a line on the visible effects of clamping; empty without any."""
    from ..codecs.losses import clamp_matters

    shares: dict[str, float] = {}
    for clamp in baked.clamps:
        if clamp_matters(clamp.column, above=clamp.above, visible=clamp.visible, leaves=baked.splats):
            text = CONSEQUENCES[clamp.column][clamp.above]
            shares[text] = max(shares.get(text, 0.0), clamp.visible / baked.splats)
    if not shares:
        return ""
    form, more = (
        ("SPZ", "--format rad keeps more of them") if baked.chunks is None else ("RAD", "-v says what keeps them")
    )
    losses = " and ".join(f"{percent_of(share, 2)} of {text}" for text, share in shares.items())
    return f"{losses} than {form} can hold; {more}"


def _clamped(clamp: Clamp, baked: Baked) -> str:
    """Return a line on clamped values: the number of nodes, the largest value, and the consequence."""
    from ..codecs.rad.property_codings import LARGEST_F16

    form, table = ("SPZ", CLAMPED_BY_SPZ) if baked.chunks is None else ("RAD", CLAMPED_BY_RAD)
    name, advice = table[clamp.column, clamp.above]
    share = f"{count_of(clamp.splats, 'node')} ({percent_of(clamp.splats / baked.nodes)})"
    name += f" of degree {clamp.degree}" if clamp.degree else ""
    where, way = ("above", "up") if clamp.above else ("below", "down")
    where = "beyond ±" if clamp.both else f"{where} "
    farthest = clamp.farthest or 0.0  # no -0
    advice = advice.format(wide="f16" if abs(farthest) <= LARGEST_F16 else "f32")
    return (
        f"{name} of {share} are {where}{clamp.end:.3g}, {way} to {farthest:.3g}, and are clamped to what {form} holds:"
        f" {advice}"
    )


def report_converted(console: Console, source: Place, target: str, made: Converted) -> None:
    """Print a line about splats or arrays, and what their format does not hold."""
    from ..model.selection import describe

    read = count_of(made.splats if made.nodes is None else made.nodes, "splat" if made.nodes is None else "node")
    arrays = ", ".join(f"{name} uint32{list(shape)}" for name, shape in made.arrays.items())
    written = arrays or f"{count_of(made.splats, 'splat')}, SH {made.sh_degree}"
    seconds = sum(made.seconds.values())
    console.say(f"{name_of(source)}  {read}  ->  {target}  {written}, {format_size(made.bytes)}, {seconds:.1f} s")
    if made.dropped:
        console.say(f"  left out: {describe(made.dropped)}")
    _report_losses(console, made, made.splats, made.output_format)
    console.detail(f"  {made.format} -> {made.output_format}; {_stages(made.seconds)}")


def _report_losses(console: Console, losses: Losses, splats: int, form: str) -> None:
    lines = ["holds no reflections (SH)"] if losses.drops_sh else []
    lines += [
        f"clamps the {COLUMNS[column]} of {percent_of(count / splats)} of the splats"
        for column, count in losses.clamped.items()
        if count >= LEAST_SHARE * splats
    ]
    if lines:
        console.say(f"  {form} {', and '.join(lines)}")
    if losses.up_lost is not None:
        up = losses.up_lost
        console.say(f"  {up} is up, which this format cannot note; give --up={up} to render, traverse and view")


def _stages(seconds: dict[str, float]) -> str:
    return ", ".join(f"{stage} {value:.2f} s" for stage, value in seconds.items())
