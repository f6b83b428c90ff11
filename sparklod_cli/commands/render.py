"""`sparklod render`: pictures of splat files, as a viewer draws them."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from ..images.defaults import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from .command import COMMON, Command
from .options import appearance, cameras, comparison, cut, inputs, pictures
from .options.common import General, common_options
from .paths import claim_stdout, keep_apart
from .usage import exclude, given, is_given, options_of

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..images.output import Output
    from ..model.instances import Instance
    from ..render.settings import RenderSettings
    from ..scenes.finder import CutFinder
    from ..scenes.loaded import Scenes
    from .console import Console

EXAMPLES = """
\b
Examples:
  sparklod render scene-lod.spz --budget 500k --size 1280x720 -o preview.png
  sparklod render scene.ply --thumbnail
  sparklod render scene.ply --look-at 0,-1,4:0,0,0 --supersample 2 --alpha -o view.webp
  sparklod render scene-lod.spz --view 0,-1,4:0,0,0 --view 4,-1,0:0,0,0 -o sheet.png
  sparklod render scene-lod.spz --orbit 120 -o orbit.mp4             # or .webm, .gif, .webp
  sparklod render scene-lod.spz --camera-path path.json -o 'frames/out.%04d.png' --jobs 4
  sparklod render scene-lod.spz --budget 5% --color-by level -o levels.png
  sparklod render scene-lod.spz --full --through packed --diff scene-lod.spz -o rounding.png
  sparklod render scene-lod.spz --orbit 6 --compare --budget 5%,25% --assert '25%:psnr>30'   # exit status 3
"""

HEADINGS = (
    *(COMMON, inputs.HEADING, cameras.HEADING, cut.HEADING, appearance.HEADING, comparison.HEADING, pictures.HEADING),
)


@dataclass(frozen=True)
class Asked:
    """What the options of the command were given, group by group."""

    inputs: inputs.Inputs
    cameras: cameras.PictureCameras
    cut: cut.PictureCut
    appearance: appearance.Appearance
    comparison: comparison.Comparison
    pictures: pictures.Pictures
    general: General

    @classmethod
    def of(cls, ctx: click.Context) -> Asked:
        """The groups of a command line that are in order.

        Raises:
            click.UsageError: options contradict each other, or have nothing to do.
        """
        asked = cls(
            options_of(ctx, inputs.Inputs),
            options_of(ctx, cameras.PictureCameras),
            options_of(ctx, cut.PictureCut),
            options_of(ctx, appearance.Appearance),
            options_of(ctx, comparison.Comparison),
            options_of(ctx, pictures.Pictures),
            options_of(ctx, General),
        )
        asked.comparison.check(ctx, asked.appearance)
        asked.pictures.check(ctx)
        asked.cameras.check(ctx)
        asked.cut.check(ctx)
        asked.appearance.check(ctx)
        claim_stdout(ctx, "output", as_json=asked.general.as_json)
        if not asked.pictures.thumbnail:
            return asked
        small = dataclasses.replace(asked.cameras, size=THUMBNAIL_SIZE)
        fine = dataclasses.replace(asked.appearance, supersample=THUMBNAIL_SUPERSAMPLE)
        return dataclasses.replace(asked, cameras=small, appearance=fine)


@click.command("render", cls=Command, headings=HEADINGS, epilog=EXAMPLES, context_settings={"show_default": True})
@pictures.picture_options
@inputs.input_options
@functools.partial(cameras.camera_options, still=True)
@functools.partial(cut.cut_options, pictures=True)
@appearance.appearance_options
@comparison.comparison_options
@functools.partial(common_options, json="Print what was drawn as one JSON object on standard output.")
@click.pass_context
def render(ctx: click.Context, /, **_: Any) -> None:
    """Draw pictures of splat files as a viewer draws them.

    Of Level-of-Detail files written by build-lod, a picture shows the cut that Spark's traversal finds within the
    budget; of other files, and with --full, it shows all splats. Several files are drawn together.

    Without a camera, the picture shows the whole scene from its front. A camera path makes a picture for each camera,
    or an animation, by the name of --output.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    asked = Asked.of(ctx)
    if asked.comparison.compare:
        from .render_compare import compare

        ctx.exit(compare(ctx, asked))
    _draw(ctx, asked)


def _draw(ctx: click.Context, asked: Asked) -> None:
    """Draws pictures."""
    start = time.perf_counter()
    budget = asked.cut.one_budget()
    instances = asked.inputs.instances()
    _place(ctx, asked, instances, asked.cameras.least())  # before much is read, what is wrong with the output already
    with asked.general.console() as console:
        from ..images.sequence import PictureSettings, write_pictures
        from ..scenes.finder import CutFinder
        from .render_text import report

        console.announce_compiling("render")

        @functools.cache
        def scenes() -> Scenes:
            return read(asked, instances, console, through=asked.appearance.through)

        path, settings = seen(ctx, asked, scenes)
        output = _place(ctx, asked, instances, len(path.cameras))
        background = _check_output(ctx, asked, instances, path, output)
        notes = [*path.notes, *scenes().notes]
        unused = given(ctx, cut.CUTS)
        if unused and not scenes().trees:
            notes.append(f"no file is a Level-of-Detail tree, so all splats are drawn, whatever {' and '.join(unused)}")
        for note in notes:
            console.say(note)
        console.detail(f"  read in {time.perf_counter() - start:.2f} s")

        def finder(of: Scenes) -> CutFinder:
            lod = None if asked.cut.full else asked.cut.settings(budget.of(of.leaves))
            try:
                return CutFinder(of, lod)
            except ValueError as error:
                raise click.UsageError(str(error)) from None

        written = write_pictures(
            finder(scenes()),
            path,
            output,
            settings,
            PictureSettings(
                background=background,
                bar=not asked.appearance.no_bar,
                gain=asked.comparison.gain,
                jpeg_quality=asked.pictures.jpeg_quality,
                jobs=asked.pictures.jobs,
                threads=asked.general.threads,
            ),
            reference=None if asked.comparison.diff is None else finder(_reference(asked, console)),
            overwrite=asked.pictures.overwrite,
            progress=console.progress,
        )
        console.clear()
        report(console, written, output, path, settings, time.perf_counter() - start, as_json=asked.general.as_json)


def _reference(asked: Asked, console: Console) -> Scenes:
    """The file that --diff names, as it is."""
    from ..model.instances import instances_of

    assert asked.comparison.diff is not None
    return read(asked, instances_of([asked.comparison.diff]), console)


def read(
    asked: Asked,
    instances: list[Instance],
    console: Console,
    *,
    through: str | None = None,
    trees_only: bool = False,
) -> Scenes:
    """Reads the files of instances.

    Args:
        asked: on the command line.
        instances: of them.
        console: shows how much is read.
        through: what splats are rounded by.
        trees_only: refuse files without trees.
    """
    from ..scenes.reading import read_scenes

    return read_scenes(
        instances,
        trees_only=trees_only,
        through=through,
        precision=asked.cut.precision,
        threads=asked.general.threads,
        progress=console.progress,
    )


def seen(ctx: click.Context, asked: Asked, scenes: Callable[[], Scenes]) -> tuple[CameraPath, RenderSettings]:
    """The cameras, and how pictures are drawn.

    Near and far have the whole scene between them where the cameras are chosen for it.

    Args:
        ctx: of the command.
        asked: on its command line.
        scenes: gives what is looked at; called only where cameras are chosen for it.
    """
    from ..cameras.framing import reach

    settings = asked.appearance.settings(max_sh=asked.comparison.max_sh)
    balls = functools.cache(lambda: scenes().balls())
    path = asked.cameras.read(balls)
    if not asked.cameras.where().fits_scene or is_given(ctx, "near") or is_given(ctx, "far"):
        return path, settings
    near, far = reach(settings.raster.near, settings.raster.far, path.cameras, balls())
    return path, dataclasses.replace(settings, raster=dataclasses.replace(settings.raster, near=near, far=far))


def _place(ctx: click.Context, asked: Asked, instances: list[Instance], cameras: int) -> Output:
    """Where the pictures of some cameras go."""
    scene = asked.inputs.scene or instances[0].file
    assert scene is not None
    return asked.pictures.place(ctx, scene, cameras, sheet=asked.pictures.sheet or len(asked.cameras.views) > 1)


def _check_output(ctx: click.Context, asked: Asked, instances: list[Instance], path: CameraPath, output: Output) -> Any:
    """The background of pictures that can be written.

    Raises:
        click.UsageError: they do not fit into the output, or it would replace an input.
        SparklodError: a file cannot be written, before work goes into it.
    """
    from ..images import animation
    from ..images.sequence import frame_rate

    look = asked.appearance
    if output.form == "npy":
        exclude(ctx, look.of_pictures(), "a .npy, which holds numbers")
    background = look.behind(ctx, output.form)
    bar = (look.color_by is not None or asked.comparison.diff is not None) and not look.no_bar
    pictures.check_sizes(output, path.cameras, look.supersample, bar=bar)
    keep_apart(ctx, {**read_besides(asked, instances), "output": output.paths(path.numbers)})
    output.check(path.numbers, overwrite=asked.pictures.overwrite)
    if output.kind == "animation":
        animation.check(output.form, frame_rate(path))
    return background


def read_besides(asked: Asked, instances: list[Instance]) -> dict[str, Any]:
    """For `keep_apart`, the files that are read without being parameters themselves."""
    return {"scene": asked.inputs.read(instances), "world_transform": asked.cameras.files()}
