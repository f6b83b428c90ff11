"""`sparklod build-lod`: bakes Level-of-Detail files."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..codecs.options import SogOptions, WriteOptions
from ..lod.tile_settings import TileSettings
from ..system import interrupts
from ..system.addresses import Address, Place
from ..system.errors import SparklodError
from ..system.printable import MOST, shortened
from ..system.stdio import DASH, name_of
from .build_lod_files import FORMS, VERIFY, BakedFiles, check_formats, check_inputs, record_of
from .build_lod_text import report_baked, report_extracted
from .console import Console, print_json, say
from .option_groups import COMMON, check_declared, command, exclude, flags_set, is_set, parameters_of, values_of
from .options.baking import (
    OF_TREES,
    ClusterOptions,
    DetailOptions,
    PaletteOptions,
    ResourceOptions,
    SelectionOptions,
    TransformOptions,
    TreeOptions,
)
from .options.common import General
from .paths import NAMELESS, Folder, claim_stdout, is_same_place, keep_apart, with_chunks

if TYPE_CHECKING:
    from ..bake.out_of_core.cluster_engine import ClusterEngine
    from ..bake.records import Baked
    from ..bake.settings import BakeSettings
    from ..bake.sources import Source
    from ..extract_leaves import Extracted

    #: Result of a job; None where the output was there already.
    Outcome = Baked | Extracted | None

    #: Makes the outputs of inputs, and yields what came of each, in order.
    Make = Callable[[Sequence[tuple[Source, Place]]], Iterator[Outcome | SparklodError]]

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

        files = self.files
        return BakeSettings(
            **self.tree.settings(only_cuts=files.manifest is not None),
            selection=self.selection.selection(),
            transform=self.transform.transform(),
            up=self.transform.up,
            rgba=self.selection.rgba,
            suffix=files.suffix,
            options=self.write_options(),
            encoding=files.encoding,
            raw=files.is_raw,
            detail=self.detail.settings if files.is_streamed_sog else None,
            tiles=self.tiles if files.is_tiles else None,
            environment=self.detail.environment,
            environment_beyond=self.detail.environment_beyond,
            refine=files.refining.settings(),
            camera_path=files.refining.camera_path,
            converts=files.format_is_chosen,
            unused=tuple(flags_set(ctx, (*OF_TREES, "environment_beyond"))),
        )

    def write_options(self) -> WriteOptions:
        """Return the write options; what nobody chose is left to the library, which may take it from the input."""
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
    instances = files.instances()
    _check(ctx, options, [instance.file for instance in instances if instance.file is not None])
    failed = False
    memory = options.resources.memory
    with general.console() as console, options.cluster.engine(ctx, general, memory, console) as engine:
        make, report = _job_of(ctx, options, console, engine)
        pairs = list(files.jobs(instances, console.say))
        for (source, target), outcome in zip(pairs, make(pairs), strict=True):
            if isinstance(outcome, SparklodError):
                failed = True
                console.error(f"{name_of(source)}: {outcome}")
                record = {**record_of(source), "error": shortened(str(outcome), MOST)}
            elif outcome is None:
                console.say(f"{name_of(source)}  ->  {target}  is there already")
                record = {**record_of(source), "output": str(target), "skipped": True}
            else:
                report(console, source, target, outcome)
                record = {**record_of(source), "output": str(target), **dataclasses.asdict(outcome)}
            if general.as_json:
                print_json(record)
            if interrupts.came():  # while merged splats were fitted, which ended early then
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
        _require_places(inputs)
    targets = [output] if output is not None else [files.target(source) for source in inputs]
    if files.may_replace_inputs and not files.is_merged:
        targets = [target for source, target in zip(inputs, targets, strict=True) if not is_same_place(source, target)]
    if files.is_chunked or files.is_folder or files.manifest is not None:
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
        exclude(ctx, ["workers"], "--scheduler, whose workers run already")
    if is_set(ctx, "refine"):
        exclude(ctx, ["scratch_dir", "resume"], "--refine, which needs the whole tree in memory")
    of_clusters = parameters_of(ClusterOptions)
    if files.unlod:
        exclude(ctx, (*parameters_of(ResourceOptions), *of_clusters, "refine", "skip_existing"), "--unlod")
    else:
        options.tree.check(ctx, only_cuts=files.manifest is not None)
    if DASH in inputs:
        exclude(ctx, of_clusters, "standard input, which workers cannot read; save it to a file first")


def _require_places(inputs: Sequence[Place]) -> None:
    """Raise a `click.UsageError` where an output would be named after an address that is only read."""
    for source in inputs:
        if isinstance(source, Address) and source.is_read_only:
            raise click.UsageError(f"nothing can be written beside {source}; name the output with -o or --output-dir")


def _job_of(
    ctx: click.Context, options: BuildLodOptions, console: Console, engine: ClusterEngine | None
) -> tuple[Make, Callable[..., None]]:
    """Return a function that makes the outputs of inputs, and one that reports an output; loads numpy."""
    files, threads = options.files, options.general.threads
    shared: dict[str, Any] = {"overwrite": files.overwrite, "progress": console.progress}
    if files.unlod:
        console.announce_compiling()
        from ..extract_leaves import extract_leaves

        how: dict[str, Any] = {"suffix": files.suffix, "options": options.write_options(), "threads": threads}
        return _one_by_one(functools.partial(extract_leaves, **how, **shared)), report_extracted
    from ..bake.flow import bake
    from ..bake.stage_shares import stage_shares
    from ..compile_ahead import jobs_of

    settings = options.bake_settings(ctx)
    console.announce_compiling(*jobs_of(settings))
    make: Callable[..., Baked | None] = bake
    if files.skip_existing is not None:
        from ..bake.skipping import bake_unless_there

        make = functools.partial(bake_unless_there, verify=files.skip_existing == VERIFY)
    resources = options.resources.resources()
    if engine is not None:
        resources = dataclasses.replace(resources, memory=engine.memory)
    how = {"settings": settings, "resources": resources, "engine": engine, "threads": threads, "say": console.say}

    def here(source: Source, target: Place) -> Baked | None:
        with console.job(stage_shares(settings)):
            return make(source, target, **how, **shared)

    alone = _one_by_one(here)
    if engine is None:
        return alone, report_baked
    from ..bake.side_by_side import bake_side_by_side

    side_by_side: Make = functools.partial(
        bake_side_by_side,
        make=make,
        settings=settings,
        engine=engine,
        resources=resources,
        bake_large=functools.partial(_outcome, here),
        **shared,
    )
    return lambda pairs: (side_by_side if len(pairs) > 1 else alone)(pairs), report_baked


def _one_by_one(make: Callable[..., Outcome]) -> Make:
    """Return a function that makes outputs of inputs one after the other."""
    return lambda pairs: (_outcome(make, *pair) for pair in pairs)


def _outcome(make: Callable[..., Outcome], source: Source, target: Place) -> Outcome | SparklodError:
    """Return the result for an input, or its error, so that one which fails does not stop the others."""
    try:
        return make(source, target)
    except SparklodError as error:
        return error
