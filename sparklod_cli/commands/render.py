"""`sparklod render`: pictures of splat files, as a viewer draws them."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import click

from ..images.output import THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from ..render.settings import OF_PIXELS
from ..system.stdio import DASH
from ..system.units import format_size
from .command import COMMON, Command, check_declared, flag, flags_set, refuse, values_of
from .console import Console, count_of, for_screen, is_terminal, print_json
from .options.cameras import PictureCameras
from .options.common import JSON, General, question_budgets, report_outcomes, table_form
from .options.cut import Inputs, PictureCut, PictureStreaming, check_scenes, files_read, notes_on_loading, viewed_files
from .options.pictures import Appearance, ComparisonOptions, PictureFiles, check_sizes
from .paths import Folder, claim_stdout, keep_apart, name_outputs

if TYPE_CHECKING:
    from ..api.jobs import Compared, DrawnPath
    from ..cameras.sources import CameraPath
    from ..images.output import PictureOutput
    from ..images.sequence import PictureSettings, WrittenPictures
    from ..lod.settings import LodSettings
    from ..model.instances import Instance
    from ..scenes.loaded import Scenes
    from ..tables.columns import TableOutput
    from ..tables.comparison import BudgetSummary


EXAMPLES = """\
  sparklod render scene-lod.spz --budget 500k --size 1280x720 -o preview.png
  sparklod render scene.ply --thumbnail
  sparklod render scene.ply --look-at 0,-1,4:0,0,0 --alpha -o view.webp
  sparklod render scene-lod.spz --orbit 120 -o orbit.mp4    # or .webm, .gif
  sparklod render scene-lod.spz --budget 5% --color-by level -o levels.png
  sparklod render scene-lod.spz \\
    --view 0,-1,4:0,0,0 --view 4,-1,0:0,0,0 -o sheet.png
  sparklod render scene-lod.spz --camera-path path.json \\
    --jobs 4 -o 'frames/out.%04d.png'
  sparklod render scene-lod.rad \\
    --after 1s --bandwidth 20Mbit --latency 60ms -o after-1s.png
  sparklod render scene-lod.spz \\
    --full --through packed --diff scene-lod.spz -o rounding.png
  sparklod render scene-lod.spz --orbit 6 --compare \\
    --budget 5%,25% --assert '25%:psnr>30'                  # exit status 3
"""

HEADINGS = (
    *(COMMON, "Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming"),
    *("Appearance", "Comparison", "Output"),
)


@dataclass(frozen=True)
class _RenderGeneral(General):
    as_json: bool = flag("Print what was drawn as one JSON object on standard output.", flags=JSON)


@dataclass(frozen=True)
class RenderOptions:
    """Options of the command, group by group."""

    pictures: PictureFiles = field(default_factory=PictureFiles)
    inputs: Inputs = field(default_factory=Inputs)
    cameras: PictureCameras = field(default_factory=PictureCameras)
    cut: PictureCut = field(default_factory=PictureCut)
    streaming: PictureStreaming = field(default_factory=PictureStreaming)
    appearance: Appearance = field(default_factory=Appearance)
    comparison: ComparisonOptions = field(default_factory=ComparisonOptions)
    general: _RenderGeneral = field(default_factory=_RenderGeneral)

    @classmethod
    def of(cls, ctx: click.Context) -> RenderOptions:
        """Return the options of a command line, checked."""
        if ctx.params["compare"]:
            name_outputs(ctx, values_of(ctx, Inputs).first)
        check_declared(ctx)
        options = values_of(ctx, cls)
        options.comparison.check(ctx, options.appearance)
        options.cameras.check(ctx)
        options.streaming.check(ctx)
        options.appearance.check(ctx)
        claim_stdout(ctx, "output", as_json=options.general.as_json)
        if not options.pictures.thumbnail:
            return options
        small = dataclasses.replace(options.cameras, size=THUMBNAIL_SIZE)
        fine = dataclasses.replace(options.appearance.render, supersample=THUMBNAIL_SUPERSAMPLE)
        look = dataclasses.replace(options.appearance, render=fine)
        return dataclasses.replace(options, cameras=small, appearance=look)


@click.command("render", cls=Command, options=RenderOptions, examples=EXAMPLES, headings=HEADINGS)
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
    options = RenderOptions.of(ctx)
    if options.comparison.compare:
        ctx.exit(_compare(ctx, options))
    _draw(ctx, options)


def _draw(ctx: click.Context, options: RenderOptions) -> None:
    start = time.perf_counter()
    look, general = options.appearance, options.general
    budget = None if options.cut.full else options.cut.one_budget()
    instances = options.inputs.instances()
    # What is wrong with the output is said before much is read.
    _output(ctx, options, options.cameras.least_count()).try_place()
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.jobs import draw_files

        question_budgets(console, budget)
        console.announce_compiling("pictures")

        def place(path: CameraPath) -> tuple[PictureOutput, PictureSettings]:
            return _place(ctx, options, instances, path)

        def ready(path: CameraPath, scenes: Scenes) -> None:
            check_scenes(ctx, scenes)
            loading = notes_on_loading(scenes, options.streaming.streaming.network)
            for note in (*path.notes, *scenes.notes, *options.cameras.axis_notes(scenes), *loading):
                console.say(note)
            console.detail(f"  read in {time.perf_counter() - start:.2f} s")

        with options.cameras.usage_errors():
            drawn = draw_files(
                viewed_files(options, instances, console),
                budget,
                options.cut.settings(),
                look.settings(console.say),
                place,
                fit_planes=fit_planes(ctx),
                through=look.through,
                loading=options.streaming.loading(),
                reference=options.comparison.diff,
                overwrite=options.pictures.overwrite,
                ready=ready,
            )
        console.clear()
        _report(console, drawn, time.perf_counter() - start, as_json=general.as_json)


def fit_planes(ctx: click.Context) -> bool:
    """Return whether the near and the far plane may move apart, so that a view of the whole scene clips nothing."""
    return not flags_set(ctx, ["near", "far"])


def _output(ctx: click.Context, options: RenderOptions, cameras: int) -> PictureOutput:
    assert options.inputs.first is not None  # or there would be no instances
    return options.pictures.place(
        ctx, options.inputs.first, cameras, sheet=options.pictures.sheet or len(options.cameras.views) > 1
    )


def _place(
    ctx: click.Context, options: RenderOptions, instances: list[Instance], path: CameraPath
) -> tuple[PictureOutput, PictureSettings]:
    """Return the output of the pictures of a path, and how they become files.

    Raises:
        SparklodError: a file cannot be written, before work goes into it.
    """
    from ..images.pixels import check_animation
    from ..images.sequence import PictureSettings, frame_rate

    look, output = options.appearance, _output(ctx, options, len(path.cameras))
    if output.form == "npy":
        without = ("no_bar",) if look.render.color_by not in OF_PIXELS else ("no_bar", "background", "alpha")
        refuse(ctx, without, "cannot be used with a .npy, which holds numbers")
    settings = PictureSettings(
        background=look.background_for(ctx, output.form),
        bar=not look.no_bar,
        gain=options.comparison.gain,
        jpeg_quality=options.pictures.jpeg_quality,
        jobs=options.pictures.jobs,
        threads=options.general.threads,
    )
    bar = (look.render.color_by is not None or options.comparison.diff is not None) and settings.bar
    check_sizes(output, path.cameras, look.render.supersample, bar=bar)
    keep_apart(ctx, {**files_read(options, instances), "output": output.paths(path.numbers)})
    output.check(path.numbers, overwrite=options.pictures.overwrite)
    if output.kind == "animation":
        check_animation(output.form, frame_rate(path))
    return output, settings


def _report(console: Console, drawn: DrawnPath, seconds: float, *, as_json: bool) -> None:
    written, output, settings = drawn.pictures, drawn.output, drawn.render
    if not any(frame["splats"] for frame in written.frames):
        console.say("warning: the picture is empty, for the first chunk has not arrived yet (--after)")
    elif written.empty:
        console.say(
            "warning: nothing is in view; cameras and scene may not share their axes (--camera-axes,"
            " --world-transform, --up), or nothing lies between --near and --far"
        )
    if as_json:
        whole = {
            "output": str(output.name),
            "format": output.form,
            "kind": output.kind,
            "bytes": written.bytes,
            "frames": written.frames,
            "seconds": round(seconds, 3),
        }
        print_json(whole if written.gain is None else whole | {"gain": written.gain})
    name = "standard output" if output.name is None else output.name
    console.say(f"{name}  {_describe(written)}, {seconds:.2f} s")
    console.detail(
        f"  {drawn.path.format}, {format_size(written.bytes)} of {output.form}; {settings.style} by {settings.backend},"
        f" from {settings.raster.near:g} to {settings.raster.far:g} units away"
    )


def _describe(written: WrittenPictures) -> str:
    """Return what was drawn, such as "60 frames, 1280 x 720, 499,102 to 500,000 splats"."""
    frames = written.frames
    sizes = dict.fromkeys(f"{frame['width']} x {frame['height']}" for frame in frames)
    splats = sorted({frame["splats"] for frame in frames})
    parts = [count_of(len(frames), "frame")] if len(frames) > 1 else []
    parts.append(next(iter(sizes)) + (" and others" if len(sizes) > 1 else ""))
    least = "" if splats[0] == splats[-1] else f"{splats[0]:,} to "
    parts.append(least + count_of(splats[-1], "splat"))
    if written.gain is not None:
        worst = min(frame["psnr_db"] for frame in frames)
        parts.append(f"PSNR {worst:.2f} dB" + (" or more" if len(frames) > 1 else ""))
        parts.append(f"differences times {written.gain:g}" if written.gain != 1 else "differences as they are")
    return ", ".join(parts)


def _compare(ctx: click.Context, options: RenderOptions) -> int:
    """Compare, writes the table and the charts, and print the summary; returns the exit status."""
    budgets = options.comparison.budgets(options.cut.budget)
    asserts = options.comparison.assertions(budgets)
    table = _table(options)
    instances = options.inputs.instances()
    from ..api.jobs import compare_files

    keep_apart(ctx, files_read(options, instances))
    with Console(quiet=options.general.quiet, verbose=options.general.verbose) as console:
        question_budgets(console, *budgets)
        console.announce_compiling("pictures")
        start = time.perf_counter()

        def ready(path: CameraPath, scenes: Scenes) -> None:
            for note in (*path.notes, *options.cameras.axis_notes(scenes)):
                console.say(note)
            check_scenes(ctx, scenes)

        def passed(pieces: Iterable[bytes]) -> Iterable[bytes]:
            console.clear()  # a bar and a table do not go together on one screen
            return for_screen(pieces) if is_terminal(sys.stdout) and table.form != "parquet" else pieces

        with options.cameras.usage_errors():
            compared = compare_files(
                viewed_files(options, instances, console),
                budgets,
                _limited(options),
                dataclasses.replace(options.appearance.settings(console.say), max_sh=options.comparison.max_sh),
                table,
                fit_planes=fit_planes(ctx),
                asserts=asserts,
                plot=options.comparison.plot,
                overwrite=options.pictures.overwrite,
                ready=ready,
                passed=passed,
            )
        console.clear()
        console.detail(f"  {compared.pictures:,} pictures, {time.perf_counter() - start:.2f} s")
        return _report_compared(console, options, compared, [at for at, _ in asserts])


def _table(options: RenderOptions) -> TableOutput:
    from ..tables.columns import TableOutput
    from ..tables.comparison import COLUMNS

    output = options.pictures.output
    assert not isinstance(output, Folder)  # see `name_outputs`
    nowhere = _on_screen(options) or (output is None and options.general.as_json)
    return TableOutput(
        path=None if output == DASH else output,
        form=None if nowhere else table_form("--output", output),
        columns=COLUMNS,
        overwrite=options.pictures.overwrite,
    )


def _on_screen(options: RenderOptions) -> bool:
    """Return whether the summary is printed instead of the table, which would scroll by on a terminal."""
    return options.pictures.output is None and not options.general.as_json and is_terminal(sys.stdout)


def _limited(options: RenderOptions) -> LodSettings:
    """Return settings of cuts that only the budget limits, not the size of a pixel, unless a limit was given."""
    settings = options.cut.settings()
    if settings.pixel_scale_limit is None and settings.render_scale == 1:
        return dataclasses.replace(settings, pixel_scale_limit=0.0)
    return settings


def _report_compared(console: Console, options: RenderOptions, compared: Compared, about: Sequence[int | None]) -> int:
    """Print the results of a comparison; return the exit status.

    Args:
        about: for each assertion the index of its budget; None for all budgets.
    """
    summary, outcomes = compared.summary, compared.outcomes
    if options.general.as_json:
        asserts = [each.as_dict() for each in outcomes]
        figures = [each.as_dict() for each in summary]
        frames = len(compared.path.cameras)
        whole = {"frames": frames, "leaves": compared.leaves, "budgets": figures, "asserts": asserts}
        print_json(whole)
    texts = _lines(summary, compared.path, compared.leaves)
    if _on_screen(options):
        click.echo("\n".join(texts))
    else:
        for line in texts:
            console.say(line)
    places = [
        f", at a budget of {each.worst['budget']:,}" if at is None and each.worst is not None else ""
        for at, each in zip(about, outcomes, strict=True)
    ]
    return report_outcomes(console, outcomes, places)


def _lines(summary: Sequence[BudgetSummary], path: CameraPath, leaves: int) -> Iterator[str]:
    """Yield the summary as a person reads it; with popping where frames follow each other."""
    sizes = list(dict.fromkeys((camera.width, camera.height) for camera in path.cameras))
    size = f"{sizes[0][0]} x {sizes[0][1]}" + (" and others" if len(sizes) > 1 else "")
    yield f"  {count_of(len(path.cameras), 'frame')} of {size}, against {count_of(leaves, 'splat')}, on black and white"
    pops = any(each.popping is not None for each in summary)
    head = f" {'popping':>7} {'most':>5}" if pops else ""
    yield f"  {'budget':>8} {'splats':>10} {'PSNR':>6} {'least':>6} {'SSIM':>6} {'edges':>6}{head}  worst tile"
    for each in summary:
        popped = f" {_or_dash(each.popping):>7} {_or_dash(each.popping_max):>5}" if pops else ""
        yield (
            f"  {each.text:>8} {round(each.selected):>10,} {each.psnr:>6.2f} {each.psnr_min:>6.2f} {each.ssim:>6.4f}"
            f" {_or_dash(each.edge_psnr):>6}{popped}  {each.worst_tile_psnr:.2f}"
            f" at {each.worst_tile_x}, {each.worst_tile_y} of frame {each.worst_frame:,}"
        )


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
