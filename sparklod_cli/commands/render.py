"""`sparklod render`: pictures of splat files, as a viewer draws them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..images.defaults import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from .command import COMMON, Command
from .options import appearance, cameras, comparison, cut, inputs, pictures, streamed_sog, streaming
from .options.camera_options import camera_options
from .options.common import General, common_options
from .paths import claim_stdout, keep_apart, name_outputs
from .usage import exclude, given, options_of

if TYPE_CHECKING:
    from ..api.jobs import ViewedFiles
    from ..cameras.path import CameraPath
    from ..images.output import Output
    from ..images.sequence import PictureSettings
    from ..model.instances import Instance
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
  sparklod render scene-lod.rad --after 1s --bandwidth 20Mbit --latency 60ms -o after-1s.png
  sparklod render scene-lod.spz --full --through packed --diff scene-lod.spz -o rounding.png
  sparklod render scene-lod.spz --orbit 6 --compare --budget 5%,25% --assert '25%:psnr>30'   # exit status 3
"""

HEADINGS = (
    *(COMMON, inputs.HEADING, cameras.HEADING, cut.HEADING, streamed_sog.HEADING, streaming.HEADING),
    *(appearance.HEADING, comparison.HEADING, pictures.HEADING),
)


@dataclass(frozen=True)
class RenderOptions:
    """The values of the options of the command, group by group."""

    inputs: inputs.Inputs
    cameras: cameras.PictureCameras
    cut: cut.PictureCut
    detail: streamed_sog.Detail
    streaming: streaming.PictureStreaming
    appearance: appearance.Appearance
    comparison: comparison.Comparison
    pictures: pictures.Pictures
    general: General

    @classmethod
    def of(cls, ctx: click.Context) -> RenderOptions:
        """The groups of a command line, checked.

        Raises:
            click.UsageError: options contradict each other, or have nothing to do.
        """
        read = options_of(ctx, inputs.Inputs)
        if ctx.params["compare"]:
            name_outputs(ctx, read.first)
        asked = cls(
            read,
            options_of(ctx, cameras.PictureCameras),
            options_of(ctx, cut.PictureCut),
            options_of(ctx, streamed_sog.Detail),
            options_of(ctx, streaming.PictureStreaming),
            options_of(ctx, appearance.Appearance),
            options_of(ctx, comparison.Comparison),
            options_of(ctx, pictures.Pictures),
            options_of(ctx, General),
        )
        asked.comparison.check(ctx, asked.appearance)
        asked.pictures.check(ctx)
        asked.cameras.check(ctx)
        asked.cut.check(ctx)
        asked.detail.check(ctx)
        if asked.cut.full:
            exclude(ctx, streamed_sog.OPTIONS, "--full")
        asked.streaming.check(ctx)
        if asked.streaming.after is not None:
            exclude(ctx, ["full", "continuous", "compare"], "--after")
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
@functools.partial(camera_options, still=True)
@functools.partial(cut.cut_options, pictures=True)
@streamed_sog.detail_options
@functools.partial(streaming.streaming_options, pictures=True)
@appearance.appearance_options
@comparison.comparison_options
@functools.partial(common_options, json="Print what was drawn as one JSON object on standard output.")
@click.pass_context
def render(ctx: click.Context, /, **_: Any) -> None:
    """Draw pictures of splat files as a viewer draws them.

    Of Level-of-Detail files written by build-lod, a picture shows the cut that Spark's traversal finds within the
    budget; of Streamed SOG, the detail levels that PlayCanvas chooses; of other files, and with --full, it shows all
    splats. Several files are drawn together.

    Without a camera, the picture shows the whole scene from its front. A camera path makes a picture for each camera,
    or an animation, by the name of --output.

    Coordinates are those of the files; --up, --world-transform and --camera-axes bring cameras into them.
    """
    asked = RenderOptions.of(ctx)
    if asked.comparison.compare:
        from .render_compare import compare

        ctx.exit(compare(ctx, asked))
    _draw(ctx, asked)


def _draw(ctx: click.Context, asked: RenderOptions) -> None:
    """Draws pictures."""
    start = time.perf_counter()
    look, general = asked.appearance, asked.general
    budget = None if asked.cut.full else asked.cut.one_budget()
    instances = asked.inputs.instances()
    # What is wrong with the output is said before much is read.
    _output(ctx, asked, asked.cameras.least_count())
    with general.console() as console:
        from ..api.jobs import draw_files
        from .render_text import report

        console.announce_compiling()

        def place(path: CameraPath) -> tuple[Output, PictureSettings]:
            return _place(ctx, asked, instances, path)

        def ready(path: CameraPath, scenes: Scenes) -> None:
            streamed_sog.check_scenes(ctx, scenes)
            for note in (*path.notes, *scenes.notes, *_upside_down(asked, scenes)):
                console.say(note)
            console.detail(f"  read in {time.perf_counter() - start:.2f} s")

        with usage_errors(asked):
            drawn = draw_files(
                viewed_files(asked, instances, console),
                budget,
                asked.cut.settings(1, asked.detail.rule()),
                look.settings(),
                place,
                fit_planes=fit_planes(ctx),
                through=look.through,
                loading=asked.streaming.loading(),
                reference=asked.comparison.diff,
                overwrite=asked.pictures.overwrite,
                ready=ready,
            )
        console.clear()
        report(console, drawn, time.perf_counter() - start, as_json=general.as_json)


def viewed_files(asked: RenderOptions, instances: list[Instance], console: Console) -> ViewedFiles:
    """The files and the cameras that look at them."""
    from ..api.jobs import ViewedFiles

    return ViewedFiles(
        instances,
        asked.cameras.camera_source(),
        asked.cameras.settings(),
        asked.cut.precision,
        asked.general.threads,
        console.progress,
    )


def fit_planes(ctx: click.Context) -> bool:
    """Whether the near and the far plane may move apart, so that a view of the whole scene clips nothing."""
    return not given(ctx, ["near", "far"])


@contextlib.contextmanager
def usage_errors(asked: RenderOptions) -> Iterator[None]:
    """Turns errors that the values of options cause into usage errors."""
    from ..api.jobs import UnfitError

    try:
        with asked.cameras.usage_errors():
            yield
    except UnfitError as error:
        raise click.UsageError(str(error)) from None


def _upside_down(asked: RenderOptions, scenes: Scenes) -> list[str]:
    """Notes on files whose format has y up, where cameras assume that it is down.

    The default stays: SPZ files converted from trained PLY often keep y down, and so do those of build-lod.
    """
    if scenes.up is not None or asked.cameras.up is not None or asked.cameras.camera_path is not None:
        return []
    plain = (loaded for loaded in scenes.loaded if loaded.scene.format.startswith("SPZ") and not loaded.is_tree)
    return [
        f"{loaded.name}: SPZ has y up by its specification, but cameras assume y down, as in trained scenes; give"
        " --up y if the scene is upside down"
        for loaded in plain
    ]


def _output(ctx: click.Context, asked: RenderOptions, cameras: int) -> Output:
    """Where the pictures of some cameras go."""
    assert asked.inputs.first is not None  # or there would be no instances
    return asked.pictures.place(
        ctx, asked.inputs.first, cameras, sheet=asked.pictures.sheet or len(asked.cameras.views) > 1
    )


def _place(
    ctx: click.Context, asked: RenderOptions, instances: list[Instance], path: CameraPath
) -> tuple[Output, PictureSettings]:
    """Where the pictures of a path go, and how they become files.

    Raises:
        click.UsageError: they do not fit into the output, or it would replace an input.
        SparklodError: a file cannot be written, before work goes into it.
    """
    from ..images import animation
    from ..images.sequence import PictureSettings, frame_rate

    look, output = asked.appearance, _output(ctx, asked, len(path.cameras))
    if output.form == "npy":
        exclude(ctx, look.of_pictures(), "a .npy, which holds numbers")
    settings = PictureSettings(
        background=look.background_for(ctx, output.form),
        bar=not look.no_bar,
        gain=asked.comparison.gain,
        jpeg_quality=asked.pictures.jpeg_quality,
        jobs=asked.pictures.jobs,
        threads=asked.general.threads,
    )
    bar = (look.color_by is not None or asked.comparison.diff is not None) and settings.bar
    pictures.check_sizes(output, path.cameras, look.supersample, bar=bar)
    keep_apart(ctx, {**files_read(asked, instances), "output": output.paths(path.numbers)})
    output.check(path.numbers, overwrite=asked.pictures.overwrite)
    if output.kind == "animation":
        animation.check(output.form, frame_rate(path))
    return output, settings


def files_read(asked: RenderOptions, instances: list[Instance]) -> dict[str, list[Path]]:
    """For `keep_apart`: by the name of an option, the files that it names without being one."""
    return {"scene": asked.inputs.read(instances), "world_transform": asked.cameras.files()}
