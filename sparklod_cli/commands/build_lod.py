"""`sparklod build-lod`: bakes Level-of-Detail files, and reports what it wrote."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import FORMATS, MANIFEST, TILESET, WRITABLE
from ..codecs.formats import RAD_SUFFIX as RAD
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
from ..render import DEVICES
from ..system import interrupts
from ..system.addresses import Address, Place
from ..system.errors import SparklodError
from ..system.setting_fields import Range, setting, whole
from ..system.stdio import DASH, name_of
from ..system.units import format_size, percent_of
from ..system.untrusted import MOST, shortened
from .command import COMMON, Command, common, flag, values_of
from .console import Console, count_of, print_json, say
from .option_groups import OUTPUT, OVERWRITE
from .outputs import NAMELESS, Folder, NamedPath, is_same_place, stem_of
from .rules import check, is_set
from .writing_options import (
    ARRAYS,
    MEMORY,
    SCENE_HEADINGS,
    TREE_FORMS,
    Form,
    OptionalNumber,
    Writing,
    check_outputs,
    form_of,
)

if TYPE_CHECKING:
    from ..api.bake_jobs import Outcome, Pair
    from ..api.converting import Converted
    from ..bake.settings import Baked, Source
    from ..codecs.losses import Losses
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
        "Bake all INPUTs, such as the tiles of a city, as one scene in their own coordinates; needs --output.",
        heading=COMMON,
    )
    scene: Path | None = common(
        "Merge the files of an instances file, each at its place, instead of INPUTs (see docs/build-lod.md).",
        NamedPath(),
    )
    output: Place | None = setting(
        "Output of a single input, or a folder for all outputs; - is standard output.  [default: NAME-lod.spz beside"
        f" the input; by --format NAME-lod.rad, NAME-lod/{MANIFEST} or NAME-lod/{TILESET}; NAME-lod-refined.spz of a"
        " NAME-lod.spz with --refine]",
        NamedPath(output=True, addresses=True),
        **OUTPUT,
    )
    output_dir: Place | None = common(
        "Folder for the outputs; created if it does not exist.", NamedPath(output=True, folder=True, addresses=True)
    )
    overwrite: bool = flag(**OVERWRITE)
    skip_existing: str | None = setting(
        "Skip inputs whose output was made from the same inputs and settings, which NAME.sparklod.json beside it"
        " records. Files are compared by size and date, with --skip-existing=verify by contents.",
        (BY_DATE, VERIFY),
        heading=LARGE,
        metavar="[=verify]",
        bare=BY_DATE,
    )
    form: str | None = common(
        "Format of the output. Spark streams rad, and rad-chunked with a file for each chunk, NAME-lod-0.radc and so"
        f" on; PlayCanvas, SuperSplat and Babylon.js stream streamed-sog, {MANIFEST} and folders; CesiumJS streams"
        f" 3d-tiles, {TILESET} and a folder. A Level-of-Detail file of another format keeps its tree. "
        " [default: by the name of FILE, or spz]",
        tuple(TREE_FORMS),
        flags=("--format",),
    )
    refine: int | None = setting(
        "Fit merged splats to STEPS pictures of full detail, for cuts that are closer to it; takes minutes. Leaves, and"
        " the tree of a Level-of-Detail file, stay as they are. Ctrl-C ends it early and keeps the gain."
        "  [default, without STEPS: by the size of the tree]",
        OptionalNumber(STEPS, placeholder="STEPS", example=EXAMPLE_STEPS, zero=BY_SIZE),
        is_flag=False,
        flag_value=BY_SIZE,
        heading=REFINING,
    )
    camera_path: Path | None = setting(
        "Cameras that --refine fits for, in the coordinates of the output and any format that render reads."
        "  [default: cameras around and inside the scene]",
        NamedPath(),
        heading=REFINING,
    )
    seed: int = setting(SEED_HELP, SEED, 0, heading=REFINING)
    device: str = setting(FIT_DEVICE_HELP, DEVICES, "cpu", heading=REFINING)
    method: str | None = common(
        "How splats are merged: quick takes seconds; quality takes longer, and its cuts are closer to full detail."
        f"  [default: {METHODS[0]}; quality with --format streamed-sog or 3d-tiles]",
        METHODS,
    )
    writing: Writing = field(default_factory=Writing)
    base: float = setting(
        "Growth of the voxel grid from level to level, with --method quick; less gives smoother transitions.",
        Range(MIN_BASE, MAX_BASE, unit="N"),
        DEFAULT_BASE,
        heading=TREE,
    )
    growth: float | None = setting(
        "Largest number of nodes for each leaf, with --method quality."
        f"  [default: {DEFAULT_GROWTH:g}; {DETAIL_GROWTH:g} with --format streamed-sog or 3d-tiles]",
        Range(MIN_GROWTH, MAX_GROWTH, unit="N"),
        heading=TREE,
    )
    detail: DetailSettings = field(default_factory=DetailSettings)
    environment: Path | None = setting(
        "Splats that are always drawn, such as a sky, from a file without a tree; moved with the scene.",
        NamedPath(),
        heading=DETAIL,
    )
    environment_beyond: float | None = setting(
        "Move splats farther than this from the median of all centres into the environment; in the input's units.",
        Range(above=0, unit="RADIUS"),
        heading=DETAIL,
    )
    tiles: TileSettings = field(default_factory=TileSettings)
    memory: int | None = setting(
        "Memory that a bake may take, such as 4G or '600 MB'; a scene that needs more is baked out of core, block by"
        " block.  [default: 75 % of what is available]",
        MEMORY,
        heading=LARGE,
    )
    scratch_dir: Place | None = setting(
        "Folder for the scratch folder of a bake out of core, removed at the end.  [default: beside the output]",
        NamedPath(output=True, folder=True, addresses=True),
        heading=LARGE,
    )
    resume: bool = flag("Continue the same bake out of core where it was interrupted, if it was.", heading=LARGE)
    workers: int | None = setting(
        "Number of processes that bake, sharing --threads and --memory.", whole(1, 256), heading=CLUSTER
    )
    scheduler: str | None = setting(
        "Address of the scheduler of a Dask cluster that bakes: tcp://host:8786.", metavar="ADDRESS", heading=CLUSTER
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
    writing, general = options.writing, options.writing.general
    form, method, pairs, instances = _check(ctx, options)
    failed, console = False, Console(quiet=general.quiet, verbose=general.verbose)
    with console, contextlib.ExitStack() as stack:
        from ..api.bake_jobs import bake_files, merged_source

        if options.merge or options.scene is not None:
            assert isinstance(options.output, (Path, Address))  # by the rules
            pairs = [(merged_source(options.inputs, instances), options.output)]
            if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
                viewers = "lod_scale and foveation of instances are for viewers, and no part of a tree"
                console.say(f"{options.scene}: {viewers}")
        refine = None
        if options.refine is not None:
            from ..fitting.fit_settings import FitSettings

            refine = FitSettings(options.refine or None, options.seed, device=options.device)
        names_tree = isinstance(options.output, (Path, Address)) and options.output != DASH and form.suffix in TREES
        settings = writing.settings(
            ctx,
            form,
            method=method,
            base=options.base,
            growth=options.growth or (DETAIL_GROWTH if form.manifest else DEFAULT_GROWTH),
            detail=options.detail if form.name == DETAIL else None,
            tiles=options.tiles if form.name == TILED else None,
            environment=options.environment,
            environment_beyond=options.environment_beyond,
            refine=refine,
            camera_path=options.camera_path,
            converts=options.form is not None or names_tree or bool(form.manifest),
        )
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
            failed |= isinstance(outcome, SparklodError)
            report(ctx, console, source, output, outcome, as_json=writing.as_json)
    if failed:
        ctx.exit(1)


def _check(ctx: click.Context, options: BuildLodOptions) -> tuple[Form, str, Sequence[Pair], list[Instance]]:
    """Return the format, the method, the inputs with their outputs, and the instances of --scene.

    Raises a `click.UsageError` if options or names of files contradict each other.
    """
    inputs, output = options.inputs, options.output
    file, folder = (None, output.path) if isinstance(output, Folder) else (output, options.output_dir)
    if not inputs and options.scene is None:
        raise click.MissingParameter(ctx=ctx, param=next(each for each in ctx.command.params if each.name == "inputs"))
    place = "standard output" if file == DASH else "folder" if file is None else "file"
    check(ctx, place=place, source="standard input" if DASH in inputs else "files", count=len(inputs))
    instances: list[Instance] = []
    if options.scene is not None:
        from ..viewers.instances_file import read_instances

        instances = read_instances(options.scene)
    if file is None and DASH in inputs:
        raise click.UsageError(NAMELESS)
    for each in inputs if file is None and folder is None else ():
        if isinstance(each, Address) and each.is_read_only:
            raise click.UsageError(f"nothing can be written beside {each}; name the output with -o or --output-dir")
    form, suffixes = form_of(output, options.form), {source.suffix.lower() for source in inputs}
    if options.refine is not None and options.form is None and file is None and RAD in suffixes:
        if len(suffixes) > 1:
            raise click.UsageError(
                "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
                " refine the .rad files on their own"
            )
        form = TREE_FORMS["rad"]
    known = f"{', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
    if form.suffix in ARRAYS:
        raise click.UsageError(f"{form.suffix} holds arrays; bake a tree, and write it with sparklod convert --layout")
    if form.suffix in PLAIN and not form.manifest:
        raise click.UsageError(f"{form.suffix} cannot hold a tree; name the output {known}, or write sparklod convert")
    if form not in TREE_FORMS.values():
        raise click.UsageError(
            f"trees are written as SPZ, RAD, {DETAIL} or {TILED}, not as {form.suffix}; name the output {known}"
        )
    merges = options.merge or options.scene is not None
    pairs = [(each, file or _output_of(options, form, each, folder)) for each in inputs[: 1 if merges else None]]
    outputs = [target for _, target in pairs] if pairs or file is None else [file]
    if options.refine is not None and options.overwrite and not options.skip_existing and not merges:
        # A tree may replace itself, for its leaves and links stay.
        outputs = [target for source, target in pairs if not is_same_place(source, target)]
    method = options.method or (QUALITY if form.manifest else METHODS[0])
    check_outputs(ctx, form, outputs, ENDINGS, instances, method=method)
    return form, method, pairs, instances


def _output_of(options: BuildLodOptions, form: Form, source: Place, folder: Place | None) -> Place:
    """Return the path of the output for an input, in a folder or else beside it."""
    stem = stem_of(source)
    if form.manifest or ((options.form is not None or options.refine is not None) and source.suffix.lower() in TREES):
        stem = stem.removesuffix("-lod")  # a tree in another format has its name
    name = f"{stem}-lod/{form.manifest}" if form.manifest else f"{stem}-lod{form.suffix}"
    if options.refine is not None and name == source.name:
        name = f"{stem}-lod-refined{form.suffix}"
    return (folder or source.parent) / name


def report(
    ctx: click.Context, console: Console, source: Source, output: Place, outcome: Outcome | Converted, *, as_json: bool
) -> None:
    """Print the result for an input, as JSON, too, if requested; exit after Ctrl-C, which ends fitting early."""
    name = name_of(source)
    if isinstance(outcome, SparklodError):
        console.error(f"{name}: {outcome}")
        result: dict[str, Any] = {"error": shortened(str(outcome), MOST)}
    elif outcome is None:
        console.say(f"{name}  ->  {output}  exists already")
        result = {"output": str(output), "skipped": True}
    else:
        target = "standard output" if output == DASH else str(output)
        for number, line in enumerate(_lines(outcome, name, target, verbose=console.verbose)):
            console.say(f"  {line}" if number else line)
        result = {"output": str(output), **dataclasses.asdict(outcome)}
    if as_json:
        if isinstance(source, (Path, Address)):
            print_json({"input": str(source)} | result)
        else:
            print_json({"inputs": [str(file) for file, _ in source.files]} | result)
    if interrupts.came.is_set():
        console.clear()
        say("interrupted")
        ctx.exit(interrupts.INTERRUPTED)


#: By column of `Splats`: nouns for its values in a bake and in a scene, and the visible effects of clamping them at the
#: lower and at the upper end of their range.
COLUMNS = {
    "center": ("coordinates", "centres", "splats are farther away", "splats are farther away"),
    "scale": ("scales", "scales", "splats are smaller", "splats are larger"),
    "rgb": ("colours", "colours", "colours are darker", "colours are brighter"),
    "sh": ("SH", "reflections (SH)", "reflections are stronger", "reflections are stronger"),
}

_WEAKER = "reflections get weaker; render --diff shows whether it matters"
_THIN, _HARDLY = "mostly how thick flat splats are", "so the loss is hardly visible"
_WIDE_SCALES, _WIDE_RGB = "--rad-scales ln_f16 keeps them", "the loss is hardly visible; --rad-rgb {wide} keeps them"
#: By format and column: advice on values clamped at the lower end, and at the upper one; "{wide}" is the encoding that
#: holds the values.
ADVICE = {
    ("SPZ", "scale"): (
        f"{_THIN}; --format rad keeps them",
        "such splats, of a sky perhaps, shrink; --format rad keeps them",
    ),
    ("SPZ", "rgb"): (f"darker than black, {_HARDLY}", f"brighter than white, {_HARDLY}"),
    ("SPZ", "sh"): (_WEAKER, _WEAKER),
    ("RAD", "center"): ("", "--rad-center f32_lebytes keeps them"),
    ("RAD", "scale"): (f"{_THIN}; {_WIDE_SCALES}", _WIDE_SCALES),
    ("RAD", "rgb"): (_WIDE_RGB, _WIDE_RGB),
    ("RAD", "sh"): ("", "reflections get weaker; --rad-sh {wide} keeps them"),
}

#: Share of splats from which on a scene without a tree gets a line on clamped or faint ones.
LEAST_SHARE = 0.001


def _lines(made: Baked | Converted, name: str, target: str, *, verbose: bool) -> Iterator[str]:
    """Yield a line about an output, then one for each thing that a person should know."""
    from ..bake.settings import Baked
    from ..model.selection import describe

    baked = made if isinstance(made, Baked) else None
    simplified = None if baked is None else baked.simplified
    splats, notes = count_of(made.splats, "splat"), list[str]()
    read = f"{splats}, SH {made.sh_degree}"
    if isinstance(made, Baked):
        contents, *notes = _contents(made)
    else:
        arrays = ", ".join(f"{name} uint32{list(shape)}" for name, shape in made.arrays.items())
        contents, read = arrays or read, splats if made.nodes is None else count_of(made.nodes, "node")
    seconds = sum(made.seconds.values())
    yield f"{name}  {read}  ->  {target}  {contents}, {format_size(made.bytes)}, {seconds:.1f} s"
    yield from notes
    if made.dropped:
        yield f"left out: {describe(made.dropped)}"
    yield from () if baked is None else baked.notes
    stages = ", ".join(f"{stage} {value:.2f} s" for stage, value in made.seconds.items())
    if not isinstance(made, Baked):
        yield from _losses(made, made.splats, made.output_format)
        about = f"{made.format} -> {made.output_format}"
    elif simplified is not None:
        if simplified.faint > LEAST_SHARE * simplified.splats:
            share = percent_of(simplified.faint / simplified.splats)
            yield f"{share} of the splats, merged across wide gaps, are too faint to be drawn; keep more splats"
        yield from _losses(simplified, simplified.splats, made.output_format)
        about = made.format
    else:
        yield from _clamping(made, verbose=verbose) if made.clamps else ()
        tree = f"{made.method} tree" if made.method is not None else "the same tree"
        tree += ", refined" if made.refine is not None else ""
        about = f"{made.format} -> {tree} -> {_encoding(made)}" if verbose else ""
    if verbose:
        yield f"{about}; {stages}"
    if verbose and baked is not None and baked.blocks is not None:
        written, read = (format_size(size or 0) for size in (baked.scratch_bytes_written, baked.scratch_bytes_read))
        yield f"out of core in {count_of(baked.blocks, 'block')}; scratch: {written} written, {read} read"


def _contents(baked: Baked) -> Iterator[str]:
    """Yield the contents of an output in a few words, then lines on its levels and on fitting."""
    made, detail, tiles = baked.simplified, baked.detail, baked.tiles
    if made is not None:
        measured = "" if made.psnr is None else f", PSNR {made.psnr:.2f} dB"
        yield f"{count_of(made.splats, 'splat')} ({percent_of(made.share)}){measured}"
    elif tiles is not None:
        place = ", on the Earth" if tiles.georeferenced else ""
        yield f"{count_of(tiles.tiles, 'tile')} of {count_of(tiles.levels, 'level')}{place}"
        if tiles.levels > 1:
            yield f"splats level by level: {', '.join(f'{count:,}' for count in tiles.splats)}"
    elif detail is not None:
        environment = f", environment of {count_of(detail.environment, 'splat')}" if detail.environment else ""
        yield (
            f"{count_of(len(detail.levels), 'detail level')} of {count_of(detail.regions, 'region')},"
            f" {count_of(detail.chunks, 'chunk file')}{environment}"
        )
        levels = (
            f"{level.splats:,} splats ({percent_of(level.share)}, error at most {level.worst_error:.2g})"
            for level in detail.levels[1:]
        )
        if len(detail.levels) > 1:
            yield f"levels below full detail: {', '.join(levels)}"
    else:
        chunks = f", {count_of(baked.chunks, 'chunk')}" if baked.chunks else ""
        yield f"{count_of(baked.nodes, 'node')}, depth {baked.levels - 1}{chunks}"
    refined = baked.refine if made is None else made.refine
    if refined is not None:
        gains = [
            f"{percent_of(share)} {before:.2f} -> {refined.psnr_after[share]:.2f}"
            for share, before in refined.psnr_before.items()
        ]
        seen = f"held-out PSNR {', '.join(gains)} dB" if gains else "no held-out camera sees anything of it"
        early = "" if refined.is_complete else ", interrupted"
        yield (
            f"refined in {count_of(refined.steps, 'step')}{early}: {seen};"
            f" {percent_of(refined.kept)} of the splats fitted have new values"
        )


def _encoding(baked: Baked) -> str:
    if baked.detail is not None:
        return DETAIL
    if baked.tiles is not None:
        return TILED
    if baked.chunks is None:
        return f"SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits"
    palette = f", a palette of {baked.sh_codes:,} SH" if baked.sh_codes else ""
    encodings = ", ".join(f"{name} {encoding}" for name, encoding in baked.encodings.items())
    return f"RAD LoD, {encodings}{palette}"


def _clamping(baked: Baked, *, verbose: bool) -> Iterator[str]:
    """Yield a line on the visible effects of clamping, and details of it."""
    from ..codecs.losses import clamp_matters
    from ..codecs.rad.property_codings import LARGEST_F16

    form, more = "RAD", "-v says what keeps them"
    if baked.chunks is None:
        form, more = "SPZ", "--format rad keeps more of them"
    shares: dict[str, float] = {}
    for clamp in baked.clamps:
        if clamp_matters(clamp.column, above=clamp.above, visible=clamp.visible, leaves=baked.splats):
            effect = COLUMNS[clamp.column][2 + clamp.above]
            shares[effect] = max(shares.get(effect, 0.0), clamp.visible / baked.splats)
    if shares:
        losses = " and ".join(f"{percent_of(share, 2)} of {effect}" for effect, share in shares.items())
        yield f"{losses} than {form} can hold; {more}"
    for clamp in baked.clamps if verbose else ():
        degree = f" of degree {clamp.degree}" if clamp.degree else ""
        share = f"{count_of(clamp.splats, 'node')} ({percent_of(clamp.splats / baked.nodes)})"
        where, way = ("above", "up") if clamp.above else ("below", "down")
        where = "beyond ±" if clamp.both else f"{where} "
        farthest = clamp.farthest or 0.0  # no -0
        advice = ADVICE[form, clamp.column][clamp.above]
        advice = advice.format(wide="f16" if abs(farthest) <= LARGEST_F16 else "f32")
        yield (
            f"{COLUMNS[clamp.column][0]}{degree} of {share} are {where}{clamp.end:.3g}, {way} to {farthest:.3g},"
            f" and are clamped to what {form} holds: {advice}"
        )


def _losses(losses: Losses, splats: int, form: str) -> Iterator[str]:
    """Yield lines on what a format does not hold of a scene without a tree."""
    parts = ["holds no reflections (SH)"] if losses.drops_sh else []
    parts += [
        f"clamps the {COLUMNS[column][1]} of {percent_of(count / splats)} of the splats"
        for column, count in losses.clamped.items()
        if count >= LEAST_SHARE * splats
    ]
    if parts:
        yield f"{form} {', and '.join(parts)}"
    if losses.up_lost is not None:
        up = losses.up_lost
        yield f"{up} is up, which this format cannot note; give --up={up} to render, traverse and view"
