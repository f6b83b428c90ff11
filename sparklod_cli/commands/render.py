"""`sparklod render`: pictures of splat files, as a viewer draws them."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from .camera_options import camera_options
from .camera_values import View
from .command import Command
from .console import Console
from .options.common import common_options, overwrite_option
from .options.types import Real
from .paths import InputPath, OutputPath, claim_stdout, keep_apart
from .render_cameras import check_cameras, framed, least_cameras
from .render_compare import BUDGETS, compare_options
from .render_options import background_from, blend_from, check_size, look_options, manner_from, of_pictures
from .usage import exclude, given, require
from .world_options import cut_options, files_meant, placements_from, viewer_from, world_options

if TYPE_CHECKING:
    from ..lod.settings import LodSettings
    from ..model.instances import Instance
    from ..scenes.finder import CutFinder
    from .render_output import Output

#: Options of cuts, of which --full and files without a tree have none.
CUTS = (
    "budget",
    "preset",
    "lod_splat_scale",
    "lod_render_scale",
    "pixel_scale_limit",
    "cone_fov0",
    "cone_fov",
    "cone_foveate",
    "outside_foveate",
    "behind_foveate",
    "continuous",
    "blend",
    "precision",
)

#: Options that only --compare knows.
COMPARED = ("asserts", "plot", "max_sh")

#: Options that --compare leaves no room for.
NOT_COMPARED = (
    "full",
    "preset",
    "lod_splat_scale",
    "background",
    "alpha",
    "supersample",
    "style",
    "color_by",
    "no_bar",
    "through",
    "diff",
    "gain",
    "sheet",
    "jobs",
)

EXAMPLES = """
\b
Examples:
  sparklod render scene-lod.spz --budget 500k --size 1280x720 -o preview.png
  sparklod render scene.ply --look-at 0,-1,4:0,0,0 --supersample 2 --alpha -o thumbnail.webp
  sparklod render scene-lod.spz --view 0,-1,4:0,0,0 --view 4,-1,0:0,0,0 -o sheet.png
  sparklod render scene-lod.spz --orbit 120 -o orbit.mp4             # or .gif, .webp
  sparklod render scene-lod.spz --camera-path path.json -o 'frames/out.%04d.png' --jobs 4
  sparklod render scene-lod.spz --budget 100k --color-by level -o levels.png
  sparklod render scene-lod.spz --full --through packed --diff scene-lod.spz -o rounding.png
  sparklod render scene-lod.spz --orbit 6 --compare --budget 5%,25% --assert '25%:psnr>30'   # exit status 3
"""


@click.command("render", cls=Command, epilog=EXAMPLES, context_settings={"show_default": True})
@world_options
@functools.partial(camera_options, orbit=1)
@click.option("--view", "views", type=View(), multiple=True, help="As --look-at; several of them make a contact sheet.")
@click.option("--sheet", is_flag=True, help="Put the pictures of all cameras on a contact sheet.")
@functools.partial(cut_options, budgets=BUDGETS)
@click.option("--full", is_flag=True, help="Draw all leaves, however many there are.")
@look_options
@compare_options
@click.option(
    "--diff",
    metavar="FILE",
    type=InputPath(),
    help="Draw how far the picture is from that of another file, and say its PSNR.",
)
@click.option(
    "--gain", metavar="X", type=Real(0, min_open=True), help="Multiplies the difference.  [default: what suits it]"
)
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=OutputPath(),
    help="A .png, .webp or .npy (floats), or out.%04d.png for many; .mp4, .gif or .webp for an animation; - for a PNG"
    " on standard output.  [default: NAME.png, here]",
)
@overwrite_option
@click.option(
    "--jobs",
    metavar="N",
    type=click.IntRange(1, 256),
    default=2,
    help="Pictures to work on at a time: while one is drawn, others are sorted and written.",
)
@functools.partial(common_options, json="Print what was drawn, as one JSON object, on standard output.")
@click.pass_context
def render(ctx: click.Context, /, as_json: bool, quiet: bool, verbose: bool, **settings: Any) -> None:
    """Draw pictures of splat files, as a viewer draws them.

    Of Level-of-Detail files that build-lod wrote, what is drawn is the cut that Spark's traversal finds within the
    budget; of other files, and with --full, all splats. Several files are drawn together.

    Without a camera, the scene is seen from its front, where it fits the image. A camera path makes frames, or an
    animation, by the name of --output.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    start = time.perf_counter()
    check_cameras(ctx, settings)
    if settings["compare"]:
        ctx.exit(_compare(ctx, settings, Console(quiet=quiet, verbose=verbose), as_json=as_json))
    viewer = viewer_from(ctx, settings | {"budget": _one_budget(ctx, settings)})
    if settings["full"]:
        exclude(ctx, CUTS, "--full")
    _check_usage(settings)
    claim_stdout(ctx, "output", as_json=as_json)
    manner = manner_from(ctx, settings)
    placements = placements_from(settings)
    # Before much is read, what is wrong with the output already.
    _output(settings, placements, least_cameras(settings))
    with Console(quiet=quiet, verbose=verbose) as console:
        from ..images import animation
        from ..images.pixels import scale_width
        from ..render.renderer import Renderer
        from .render_job import Job, Wanted, frame_rate

        console.announce_compiling("render")
        _use_threads(settings["threads"])

        @functools.cache
        def finder() -> CutFinder:
            return _read(placements, None if settings["full"] else viewer, settings, console)

        path, look = framed(ctx, settings, manner.raster, lambda: finder().scenes.balls())
        manner = dataclasses.replace(manner, raster=look)
        sheet = _is_sheet(settings)
        output = _output(settings, placements, len(path.cameras))
        if output.form == "npy":
            exclude(ctx, of_pictures(settings["color_by"]), "a .npy, which holds numbers")
        background = background_from(ctx, settings, output.form)
        for camera in path.cameras:
            has_bar = (manner.color_by or settings["diff"]) and not settings["no_bar"]
            wider = scale_width(camera.width, camera.height) if has_bar else 0
            check_size(camera.width + wider, camera.height, manner.supersample, output.form)
        if output.kind in ("animation", "sheet") and len({(at.width, at.height) for at in path.cameras}) > 1:
            raise click.UsageError(
                f"the cameras have pictures of several sizes, which no {output.kind} has; see --size"
            )
        keep_apart(ctx, {**files_meant(settings, placements), "output": output.paths(path.numbers)})
        output.check(path.numbers, overwrite=settings["overwrite"])
        if output.kind == "animation":
            animation.check(output.form, frame_rate(path))
        notes = [*path.notes, *finder().scenes.notes]
        cuts = given(ctx, CUTS)
        if cuts and not finder().scenes.trees:
            say = f"{' and '.join(cuts)} say{'s' * (len(cuts) == 1)}"
            notes.append(f"no file is a Level-of-Detail tree, so all splats are drawn, whatever {say}")
        for note in notes:
            console.say(note)
        console.detail(f"  read in {time.perf_counter() - start:.2f} s")
        painter, other = Renderer(finder(), manner, path.cameras), None
        if settings["diff"] is not None:
            from ..model.instances import Instance

            compared = [Instance(settings["diff"], settings["diff"].stem)]
            plain = settings | {"through": None}
            other = Renderer(
                _read(compared, None if settings["full"] else viewer, plain, console), manner, path.cameras
            )
        wanted = Wanted(
            output=output,
            overwrite=settings["overwrite"],
            background=background,
            bar=not settings["no_bar"],
            gain=settings["gain"],
            jobs=settings["jobs"],
            threads=settings["threads"],
        )
        captions = [camera.name or f"frame {number}" for number, camera in zip(path.numbers, path.cameras, strict=True)]
        job = Job(console, wanted, painter, other, path, captions if sheet else [], start)
        job.run()
        job.report(as_json=as_json)


def _one_budget(ctx: click.Context, settings: Mapping[str, Any]) -> int | None:
    """The budget of a picture, None where none is given."""
    require(ctx, COMPARED, "--compare")
    budgets = settings["budget"]
    if budgets is None:
        return None
    if len(budgets) > 1 or budgets[0].count is None:
        texts = ",".join(budget.text for budget in budgets)
        raise click.UsageError(f"--budget {texts} only means something with --compare; a picture takes one count")
    count: int = budgets[0].count
    return count


def _compare(ctx: click.Context, settings: dict[str, Any], console: Console, *, as_json: bool) -> int:
    """What --compare does; the exit status."""
    exclude(ctx, NOT_COMPARED, "--compare")
    claim_stdout(ctx, "output", as_json=as_json)
    viewer = viewer_from(ctx, settings | {"budget": None})
    manner = manner_from(ctx, settings)
    with console:
        from ..scenes.reading import read_scenes
        from .render_compare import run, wanted_from

        wanted = wanted_from(settings, settings["budget"], output=settings["output"], as_json=as_json)
        placements = placements_from(settings)
        keep_apart(ctx, files_meant(settings, placements))
        console.announce_compiling("render")
        _use_threads(settings["threads"])
        world = read_scenes(
            placements,
            trees_only=True,
            precision=settings["precision"],
            threads=settings["threads"],
            progress=console.progress,
        )
        path, look = framed(ctx, settings, manner.raster, world.balls)
        for note in path.notes:
            console.say(note)
        how = dataclasses.replace(manner, raster=look, max_sh=settings["max_sh"])
        viewer = dataclasses.replace(viewer, continuous=blend_from(settings))
        return run(console, world, viewer, path, how, wanted, threads=settings["threads"])


def _check_usage(settings: Mapping[str, Any]) -> None:
    if settings["diff"] is None and settings["gain"] is not None:
        raise click.UsageError("--gain only means something with --diff")
    if settings["diff"] is not None:
        if settings["color_by"] is not None:
            raise click.UsageError("--diff is between colours as they are; leave out --color-by")
        if settings["alpha"] or settings["background"] is None:
            raise click.UsageError("--diff is between pictures without alpha; name a --background")


def _is_sheet(settings: Mapping[str, Any]) -> bool:
    return settings["sheet"] or len(settings["views"]) > 1


def _output(settings: Mapping[str, Any], placements: list[Instance], cameras: int) -> Output:
    from .render_output import output_for

    name = settings["scene"] or placements[0].file
    assert name is not None
    return output_for(settings["output"], name.stem or name.name, cameras, sheet=_is_sheet(settings))


def _read(
    placements: list[Instance], viewer: LodSettings | None, settings: Mapping[str, Any], console: Console
) -> CutFinder:
    from ..scenes.finder import CutFinder
    from ..scenes.reading import read_scenes

    try:
        scenes = read_scenes(
            placements,
            through=settings["through"],
            precision=settings["precision"],
            threads=settings["threads"],
            progress=console.progress,
        )
        blended = None if viewer is None else dataclasses.replace(viewer, continuous=blend_from(settings))
        return CutFinder(scenes, blended)
    except ValueError as error:
        raise click.UsageError(str(error)) from None


def _use_threads(count: int) -> None:
    from ..support import jit

    jit.use_threads(count)
