"""`sparklod build-lod`: bakes Level-of-Detail files, and reports what it wrote."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.formats import FORMATS, MANIFEST, NPZ, RAW_SUFFIXES, TILESET, WRITABLE, ending_of
from ..codecs.formats import RAD_SUFFIX as RAD
from ..system import interrupts
from ..system.addresses import Address, Place
from ..system.errors import SparklodError
from ..system.stdio import DASH, name_of
from ..system.units import format_size, percent_of
from ..system.untrusted import MOST, shortened
from .command import COMMON, Command, values_of
from .console import Console, count_of, print_json, say
from .options.baking import (
    CLUSTER,
    DETAIL,
    FILE_FORMAT,
    LARGE,
    MANIFESTS,
    POSITION,
    REFINING,
    SELECTION,
    TILED,
    TREE,
    TREES,
    BuildLodOptions,
)
from .paths import NAMELESS, Folder, claim_stdout, is_same_place, keep_apart, require_suffix, with_chunks
from .rules import check, is_set

if TYPE_CHECKING:
    from ..api.bake_jobs import Outcome, Pair
    from ..bake.converting import Converted
    from ..bake.settings import Baked, Source
    from ..codecs.losses import Clamp, Losses
    from ..fitting.settings import Refined
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

#: Suffixes of formats that hold no tree, and how else their names end.
PLAIN = {ending for form in FORMATS for ending in (*form.suffixes, *form.endings) if not form.trees}

HEADINGS = (COMMON, TREE, SELECTION, POSITION, FILE_FORMAT, "RAD", DETAIL, TILED, REFINING, LARGE, CLUSTER)


#: Options of earlier versions, and what to write instead.
REPLACED = {
    "--unlod": "sparklod convert IN OUT --leaves",
    "--encoding": "sparklod convert IN OUT.npz --layout NAME",
}


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
    output = ctx.params["output"]
    if isinstance(output, Folder):  # an --output that names a folder is an --output-dir
        ctx.params.update(output=None, output_dir=output.path)
    options = values_of(ctx, BuildLodOptions)
    general = options.general
    instances = _check(ctx, options)
    failed, console = False, Console(quiet=general.quiet, verbose=general.verbose)
    with console, contextlib.ExitStack() as stack:
        if options.output is not None and (options.merge or options.scene is not None):
            from ..api.bake_jobs import merged_source

            if any(each.lod_scale != 1 or each.foveation is not None for each in instances):
                viewers = "lod_scale and foveation of instances are for viewers, and no part of a tree"
                console.say(f"{options.scene}: {viewers}")
            pairs: Sequence[Pair] = [(merged_source(options.inputs, instances), options.output)]
        else:
            pairs = [(source, options.target(source)) for source in options.inputs]
        from ..api.bake_jobs import bake_files

        settings = options.bake_settings(ctx)
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
        for (source, target), outcome in zip(pairs, outcomes, strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
            elif outcome is None:
                console.say(f"{name_of(source)}  ->  {target}  exists already")
            else:
                report_baked(console, source, "standard output" if target == DASH else str(target), outcome)
            if options.as_json:
                print_json(record_of(source, target, outcome))
            if interrupts.came.is_set():  # during fitting, which then ends early
                console.clear()
                say("interrupted")
                ctx.exit(interrupts.INTERRUPTED)
    if failed:
        ctx.exit(1)


def _check(ctx: click.Context, options: BuildLodOptions) -> list[Instance]:
    """Return the instances of --scene; raise a `click.UsageError` where options or names of files contradict."""
    if not options.inputs and options.scene is None:
        raise click.MissingParameter(ctx=ctx, param=next(each for each in ctx.command.params if each.name == "inputs"))
    inputs, output, form = options.inputs, options.output, options.output_form
    merges = options.merge or options.scene is not None
    place = "standard output" if output == DASH else "file" if output is not None else "folder"
    check(ctx, place=place, source="standard input" if DASH in inputs else "files", count=len(inputs))
    instances: list[Instance] = []
    if options.scene is not None:
        from ..viewers.instances_file import read_instances

        instances = read_instances(options.scene)
    if output is not None:
        if len(inputs) > 1 and not options.merge:
            raise click.UsageError(
                f"--output takes one input, not {len(inputs)}; add --merge to bake them as one scene, or name a folder"
            )
    elif DASH in inputs:
        raise click.UsageError(NAMELESS)
    elif options.output_dir is None:
        for source in inputs:
            if isinstance(source, Address) and source.is_read_only:
                raise click.UsageError(
                    f"nothing can be written beside {source}; name the output with -o or --output-dir"
                )
    targets = [output] if output is not None else [options.target(source) for source in inputs]
    refines = options.refine is not None and not options.skip_existing and not merges
    if refines and options.overwrite:  # a tree may replace itself, for its leaves and links stay
        targets = [target for source, target in zip(inputs, targets, strict=True) if not is_same_place(source, target)]
    unbundled = form.suffix in WRITABLE and form.suffix == WRITABLE[form.suffix].unbundled
    if form.chunked or unbundled or form.cuts:
        targets = with_chunks(targets)
    named = [instance.file for instance in instances if instance.file is not None]
    keep_apart(ctx, {"output" if options.output_dir is None else "output_dir": targets, "scene": named})
    claim_stdout(ctx, "output", as_json=options.as_json, binary=True)
    check_formats(options)
    check(ctx, format=options.format, method=options.builder)
    return instances


def check_formats(options: BuildLodOptions) -> None:
    """Raise a `click.UsageError` where the options of formats, and the name of the output, contradict each other."""
    form, suffix, output = options.output_form, ending_of(options.name), options.output
    chosen = options.form is not None or output is not None
    suffixes = {source.suffix.lower() for source in options.inputs}
    if options.refine is not None and not chosen and RAD in suffixes and len(suffixes) > 1:
        raise click.UsageError(
            "--refine keeps the format of a Level-of-Detail file, and the inputs are of several; give --format, or"
            " refine the .rad files on their own"
        )
    if form.cuts:
        _check_cuts(options)
        return
    if form.chunked and output == DASH:
        raise click.UsageError("--format rad-chunked writes several files; name the output, or use --format rad")
    if options.form is not None and suffix not in ("", form.suffix):
        raise click.UsageError(f"--format {options.form} writes {form.suffix}, not {suffix}")
    if output is not None and options.form is None:
        require_suffix("--output", output, (*TREES, MANIFEST, TILESET))
    known = f"{', '.join((*TREES, MANIFEST))} or {TILESET}"
    if suffix in (NPZ, *RAW_SUFFIXES):
        raise click.UsageError(f"{suffix} holds arrays; bake a tree, and write it with sparklod convert --layout")
    if suffix in PLAIN:
        raise click.UsageError(f"{suffix} cannot hold a tree; name the output {known}, or write sparklod convert")
    if suffix not in ("", *TREES):
        names = f"{', '.join((*TREES.values(), DETAIL))} or {TILED}"
        raise click.UsageError(f"trees are written as {names}, not as {suffix}; name the output {known}")


def _check_cuts(options: BuildLodOptions) -> None:
    form, output = options.output_form, options.output
    flag = f"--format {MANIFESTS[form.manifest]}"
    if output == DASH:
        raise click.UsageError(f"{flag} writes several files; name the output, such as web/{form.manifest}")
    if output is not None and options.name != form.manifest:
        raise click.UsageError(
            f"{flag} writes {form.manifest} and {form.beside} beside it, not {output.name}; name the output"
            f" {output.parent / output.stem / form.manifest}"
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
