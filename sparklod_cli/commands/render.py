"""`sparklod render`: pictures of splat files, as a viewer draws them."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ..codecs.formats import ROUND_TRIPS
from ..images.picture_files import JPEG_QUALITY, MOVING, STILL, THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from ..lod.budget import Budget, doubt, parse_budgets
from ..model import MAX_SH_DEGREE
from ..render.render_settings import SORTINGS, RenderSettings, uses_card
from ..system.setting_fields import Quantity, Range, setting, whole
from ..system.units import format_size, parse_time
from ..viewers.viewer_settings import BLEND, StreamingSettings
from .command import COLOR, COMMON, VIEW, Command, common, flag, values_of
from .console import Console, count_of, for_screen, is_terminal, print_json
from .option_groups import ASSERT, JSON, OUTPUT, OVERWRITE, PNG, General, parse_asserts, report_outcomes, table_output
from .outputs import Folder, NamedPath, keep_apart, name_outputs, require_suffix, stem_of
from .rules import check, is_set
from .viewing_options import (
    AROUND_SCENE,
    CAMERAS,
    MOST_DRAWN,
    Cameras,
    CutOptions,
    Inputs,
    check_view,
    files_read,
    scenes_of,
    with_planes,
)

if TYPE_CHECKING:
    from ..api.comparison import BudgetSummary
    from ..cameras.sources import CameraPath
    from ..images.picture_files import PictureOutput
    from ..images.pixels import Color
    from ..images.sequence import PictureSettings, WrittenPictures
    from ..model.instances import Instance
    from ..tables.assertions import Assertion

#: The budgets to compare, unless others are given.
DEFAULT_BUDGETS = "2%,5%,10%,25%,50%"

#: Heading of options of comparisons: of cuts with full detail (`--compare`), and of one file with another (`--diff`).
COMPARISON = "Comparison"

#: Colours whose scale spans the numbers that cameras see, rather than all numbers of the scenes.
COLORS_OF_CUTS = ("level", "chunk", "overdraw")

#: Pixels that are drawn for a picture: the floats of more do not fit into the memory of most machines.
MOST_PIXELS = 1 << 27

#: Pixels along a side of a file, by its form.
MOST_SIDE = {"webp": 16_383, "jpg": 65_500}


@dataclass(frozen=True)
class PictureCameras(Cameras):
    """Options of the cameras of pictures, with `--view`; the default is one camera."""

    orbit: int | None = common(f"{AROUND_SCENE}one camera that sees the whole scene]", CAMERAS)
    views: tuple[Any, ...] = setting(
        "Place a camera as --look-at does; several --view make a contact sheet.", VIEW, flags=("--view",), multiple=True
    )

    still: ClassVar[bool] = True


@dataclass(frozen=True)
class PictureCut(CutOptions):
    """Options of the cuts that pictures show."""

    budget: tuple[Budget, ...] | None = common(
        f"{MOST_DRAWN}; with --compare several, such as 5%,500k.  [default: that of --preset]",
        Quantity("N|P%,...", parse_budgets),
    )
    full: bool = flag("Draw full detail: all leaves, however many there are.", heading=COMMON)
    continuous: bool = flag(
        "Blend nodes with the children that replace them, so that nothing pops; draws 18 to 40 % more splats."
    )
    blend: float | None = setting(
        f"With --continuous: ratio of the pixel scales between which nodes blend.  [default: {BLEND:g}]", Range(above=1)
    )


@dataclass(frozen=True)
class Appearance:
    """Options of the look of pictures."""

    HEADING: ClassVar[str] = "Appearance"

    background: Color | None = common(
        "Colour behind the splats: '#rrggbb', black, white or transparent.  [default: black]", COLOR, (0.0, 0.0, 0.0)
    )
    alpha: bool = flag("Keep alpha, as --background transparent does.")
    render: RenderSettings = field(default_factory=RenderSettings)
    no_bar: bool = flag("Leave out the colour bar of --color-by or --diff.")
    through: str | None = setting(
        "Draw splats as Spark's PackedSplats or ExtSplats, SPZ or RAD round them, in cuts of the file."
        "  [default: as in the file]",
        ROUND_TRIPS,
    )
    sorting: str | None = setting(
        "With --backend osmesa: sort exactly, or by 16 bits of depth as antimatter15's viewer.  [default: exact]",
        SORTINGS,
    )
    sort_throttle: float | None = setting(
        "With --backend osmesa: keep the order while the cosine of view directions is at least 1 - X.  [default: 0]",
        Range(0, 2),
    )

    def settings(self, say: Callable[[str], None]) -> RenderSettings:
        """Return the settings of pictures, with options of the backend; `say` receives a line about the device."""
        options = {"sorting": self.sorting, "throttle": self.sort_throttle}
        known = {name: value for name, value in options.items() if value is not None}
        device = "cuda" if self.render.device != "cpu" and uses_card(self.render.device, say) else "cpu"
        return dataclasses.replace(self.render, device=device, options=known)


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

HEADINGS = (*(COMMON, "Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming"), *("Appearance", COMPARISON, "Output"))


@dataclass(frozen=True)
class RenderOptions:
    """Options of render. The output is a file, a name with a place for a number, a folder, or -."""

    HEADING: ClassVar[str] = "Output"

    output: Path | Folder | None = setting(
        "Output: .png, .jpg, .webp or .npy (floats); out.%04d.png for a picture of each camera; .mp4, .webm, .gif or"
        " .webp for an animation; with --compare .csv, .json or .parquet; a folder for NAME.png; - is standard output."
        "  [default: NAME.png beside the first FILE; with --compare standard output]",
        NamedPath(output=True),
        **OUTPUT,
    )
    overwrite: bool = flag(**OVERWRITE)
    thumbnail: bool = flag(
        f"Draw the whole scene at {THUMBNAIL_SIZE[0]}x{THUMBNAIL_SIZE[1]} pixels, supersampled, as NAME-thumbnail.png.",
        heading=COMMON,
    )
    sheet: bool = flag("Put the pictures of all cameras on one contact sheet.")
    jobs: int = setting("Number of pictures to prepare, draw and write at a time.", whole(1, 256), 2)
    jpeg_quality: int = setting("Quality of a .jpg, from 1 to 100.", whole(1, 100), JPEG_QUALITY)
    inputs: Inputs = field(default_factory=Inputs)
    cameras: PictureCameras = field(default_factory=PictureCameras)
    cut: PictureCut = field(default_factory=PictureCut)
    after: float | None = setting(
        "Draw what the camera sees this long after a page with the files was opened, such as 500ms; with --bandwidth."
        "  [default: when every chunk has arrived]",
        Quantity("TIME", parse_time),
        heading=StreamingSettings.HEADING,
    )
    streaming: StreamingSettings = field(default_factory=StreamingSettings)
    appearance: Appearance = field(default_factory=Appearance)
    compare: bool = flag(
        "Measure how cuts of each --budget differ from full detail, in a table instead of pictures.",
        heading=COMPARISON,
    )
    asserts: tuple[str, ...] = setting(
        "With --compare: condition, such as 'psnr_min>30', or '5%:psnr>30' of one budget; exit status 3 if it fails.",
        **ASSERT,
        heading=COMPARISON,
    )
    plot: Path | None = setting("With --compare: draw charts of the table as a .png.", PNG, heading=COMPARISON)
    max_sh: int = setting(
        "With --compare: highest degree of spherical harmonics to draw.",
        whole(0, MAX_SH_DEGREE),
        MAX_SH_DEGREE,
        heading=COMPARISON,
    )
    diff: Path | None = setting(
        "Draw the difference from the picture of another file, and print its PSNR.", NamedPath(), heading=COMPARISON
    )
    gain: float | None = setting(
        "Factor by which --diff multiplies differences.  [default: chosen for the pictures]",
        Range(above=0),
        heading=COMPARISON,
    )
    as_json: bool = flag("Print what was drawn as one JSON object on standard output.", **JSON)
    general: General = field(default_factory=General)

    def assertions(self, budgets: Sequence[Budget]) -> list[tuple[int | None, Assertion]]:
        """Return the assertions, each with the index of the budget before its colon; None for all budgets."""
        from ..api.comparison import COLUMNS

        parsed: list[tuple[int | None, Assertion]] = []
        texts = [budget.text for budget in budgets]
        for text in self.asserts:
            name, colon, rest = text.rpartition(":")
            name = name.strip()
            if colon and name not in texts:
                raise click.UsageError(f"--assert {text!r}: {name} is not one of the budgets, {', '.join(texts)}")
            (assertion,) = parse_asserts([rest], COLUMNS)
            parsed.append((texts.index(name) if colon else None, dataclasses.replace(assertion, text=text.strip())))
        return parsed


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
    if ctx.params["compare"]:
        name_outputs(ctx, ctx.params["scene"] or next(iter(ctx.params["files"]), None))
    options = values_of(ctx, RenderOptions)
    look = options.appearance
    if options.diff is not None and (look.alpha or look.background is None):
        raise click.UsageError("--diff compares pictures without alpha; name a --background such as black")
    if not look.render.raster.near < look.render.raster.far:
        near, far = look.render.raster.near, look.render.raster.far
        raise click.UsageError(f"--near {near:g} must be less than --far {far:g}")
    if options.compare:
        ctx.exit(_compare(ctx, options))
    if options.thumbnail:
        small = dataclasses.replace(options.cameras, size=THUMBNAIL_SIZE)
        look = dataclasses.replace(look, render=dataclasses.replace(look.render, supersample=THUMBNAIL_SUPERSAMPLE))
        options = dataclasses.replace(options, cameras=small, appearance=look)
    _draw(ctx, options)


def _draw(ctx: click.Context, options: RenderOptions) -> None:
    start = time.perf_counter()
    look, general = options.appearance, options.general
    budget = None if options.cut.full else options.cut.one_budget()
    instances = options.inputs.instances()
    # Errors of the output come before files are read, when only the least number of cameras is known.
    cameras = options.cameras
    if cameras.views:
        least = len(cameras.views)
    elif cameras.dolly or cameras.keyframes:
        least = 2 if cameras.every == 1 else 1
    else:
        least = -(-(cameras.orbit or 1) // cameras.every)
    _output(ctx, options, least).check([], overwrite=True)
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        from ..api.view_jobs import draw_files
        from ..model.instances import instances_of

        if budget is not None and (question := doubt(budget.count)):
            console.say(question)
        console.announce_compiling("pictures")
        lod, render = options.cut.settings(), look.settings(console.say)
        # Full detail, blending and colours of whole scenes need whole files.
        paged = budget is not None and lod.continuous is None and render.color_by in (None, *COLORS_OF_CUTS)
        scenes = scenes_of(options.cut, options.general, instances, console, through=look.through, paged=paged)
        path, diff = options.cameras.path(scenes), options.diff
        render = with_planes(ctx, options.cameras, render, path, scenes)
        output, settings = _place(ctx, options, instances, path)
        check_view(ctx, console, options.cameras, path, scenes(), options.streaming.network, scenes().notes)
        console.detail(f"  read in {time.perf_counter() - start:.2f} s")
        pictures = draw_files(
            scenes(),
            path,
            budget,
            lod,
            render,
            output,
            settings,
            loading=None if options.after is None else (options.streaming, options.after),
            reference=None if diff is None else scenes_of(options.cut, options.general, instances_of([diff]), console),
            overwrite=options.overwrite,
            progress=console.progress,
        )
        console.clear()
        seconds = time.perf_counter() - start
        _report(console, pictures, output, seconds, as_json=options.as_json)
        console.detail(
            f"  {path.format}, {format_size(pictures.bytes)} of {output.form}; {render.style} by"
            f" {render.backend}, from {render.raster.near:g} to {render.raster.far:g} units away"
        )


def _output(ctx: click.Context, options: RenderOptions, cameras: int) -> PictureOutput:
    """Return the output of the pictures of a number of cameras; without a name it is beside the first input."""
    from ..images.picture_files import output_for

    first = options.inputs.scene or options.inputs.files[0]
    named, folder = (
        (None, options.output.path) if isinstance(options.output, Folder) else (options.output, first.parent)
    )
    assert isinstance(folder, Path)  # pictures go to no addresses
    if named is not None:
        require_suffix("--output", named, (f".{form}" for form in dict.fromkeys((*STILL, *MOVING))))
    name = folder / (stem_of(first) + ("-thumbnail" if options.thumbnail else ""))
    try:
        output = output_for(named, name, cameras, sheet=options.sheet or len(options.cameras.views) > 1)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    check(ctx, picture=output.form)
    return output


def _place(
    ctx: click.Context, options: RenderOptions, instances: list[Instance], path: CameraPath
) -> tuple[PictureOutput, PictureSettings]:
    """Return the output of the pictures of a path, and the settings of its files, both checked before the work."""
    from ..images.picture_files import WITH_ALPHA
    from ..images.pixels import check_animation, scale_width
    from ..images.sequence import PictureSettings, frame_rate

    look, output = options.appearance, _output(ctx, options, len(path.cameras))
    background = None if look.alpha else look.background
    if background is None and output.form not in WITH_ALPHA:
        raise click.UsageError(
            f".{output.form} has no alpha; write .png or .webp, or name a --background such as black"
        )
    if output.form == "npy" and not is_set(ctx, "background"):
        background = None  # floats keep alpha unless a background is given
    settings = PictureSettings(
        background=background,
        bar=not look.no_bar,
        gain=options.gain,
        jpeg_quality=options.jpeg_quality,
        jobs=options.jobs,
        threads=options.general.threads,
    )
    bar = (look.render.color_by is not None or options.diff is not None) and settings.bar
    supersample, most = look.render.supersample, MOST_SIDE.get(output.form)
    for camera in path.cameras:
        height, width = camera.height, camera.width + (scale_width(camera.width, camera.height) if bar else 0)
        if width * height * supersample**2 > MOST_PIXELS:
            times = f" x {supersample**2} (--supersample {supersample})" if supersample > 1 else ""
            raise click.UsageError(
                f"{width:,} x {height:,} pixels{times} are more than {MOST_PIXELS:,}; give a smaller --size"
            )
        if most is not None and max(width, height) > most:
            raise click.UsageError(
                f"{width:,} x {height:,} pixels are more than {most:,} a side, the most of .{output.form}; write .png"
            )
    if output.kind in ("animation", "sheet") and len({(each.width, each.height) for each in path.cameras}) > 1:
        raise click.UsageError(
            f"the cameras have pictures of several sizes, and those of one {output.kind} must be alike; give a --size"
        )
    keep_apart(ctx, {**files_read(options.cameras, instances), "output": output.paths(path.numbers)})
    output.check(path.numbers, overwrite=options.overwrite)
    if output.kind == "animation":
        check_animation(output.form, frame_rate(path))
    return output, settings


def _report(
    console: Console, written: WrittenPictures, output: PictureOutput, seconds: float, *, as_json: bool
) -> None:
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
    # What was drawn, such as "60 frames, 1280 x 720, 499,102 to 500,000 splats".
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
    name = "standard output" if output.name is None else output.name
    console.say(f"{name}  {', '.join(parts)}, {seconds:.2f} s")


def _compare(ctx: click.Context, options: RenderOptions) -> int:
    """Compare, write the table and the charts, and print the summary; return the exit status."""
    budgets = options.cut.budget or parse_budgets(DEFAULT_BUDGETS)
    asserts = options.assertions(budgets)
    output, general, overwrite = options.output, options.general, options.overwrite
    assert not isinstance(output, Folder)  # see `name_outputs`
    from ..api.comparison import COLUMNS, check_chart, compare_files

    table = table_output(output, COLUMNS, overwrite=overwrite, as_json=options.as_json)
    instances = options.inputs.instances()
    keep_apart(ctx, files_read(options.cameras, instances))
    with Console(quiet=general.quiet, verbose=general.verbose) as console:
        for question in filter(None, (doubt(budget.count) for budget in budgets)):
            console.say(question)
        console.announce_compiling("pictures")
        start = time.perf_counter()

        def passed(pieces: Iterable[bytes]) -> Iterable[bytes]:
            console.clear()  # a bar and a table do not go together on one screen
            return for_screen(pieces) if is_terminal(sys.stdout) and table.form != "parquet" else pieces

        table.check()
        if options.plot is not None:
            check_chart(options.plot, overwrite=overwrite)
        render = dataclasses.replace(options.appearance.settings(console.say), max_sh=options.max_sh)
        scenes = scenes_of(options.cut, options.general, instances, console, trees_only=True)
        path = options.cameras.path(scenes)
        check_view(ctx, console, options.cameras, path, scenes())
        render = with_planes(ctx, options.cameras, render, path, scenes)
        lod = options.cut.settings()
        if lod.pixel_scale_limit is None and lod.render_scale == 1:  # the budget alone limits cuts
            lod = dataclasses.replace(lod, pixel_scale_limit=0.0)
        leaves, summary, outcomes = compare_files(
            scenes(),
            path,
            budgets,
            lod,
            render,
            table,
            asserts=asserts,
            plot=options.plot,
            overwrite=overwrite,
            passed=passed,
            threads=general.threads,
            progress=console.progress,
        )
        console.clear()
        pictures = len(path.cameras) * len(budgets)
        console.detail(f"  {pictures:,} pictures, {time.perf_counter() - start:.2f} s")
        if options.as_json:
            figures = [dataclasses.asdict(each) for each in summary]
            checked = [each.as_dict() for each in outcomes]
            print_json({"frames": len(path.cameras), "leaves": leaves, "budgets": figures, "asserts": checked})
        texts = _lines(summary, path, leaves)
        if table.form is None and not options.as_json:
            click.echo("\n".join(texts))
        else:
            for line in texts:
                console.say(line)
        places = [
            f", at a budget of {each.worst['budget']:,}" if at is None and each.worst is not None else ""
            for (at, _), each in zip(asserts, outcomes, strict=True)
        ]
        return report_outcomes(console, outcomes, places)


def _lines(summary: Sequence[BudgetSummary], path: CameraPath, leaves: int) -> Iterator[str]:
    """Yield the lines of the summary, with popping if frames follow each other."""
    sizes = list(dict.fromkeys((camera.width, camera.height) for camera in path.cameras))
    size = f"{sizes[0][0]} x {sizes[0][1]}" + (" and others" if len(sizes) > 1 else "")
    yield f"  {count_of(len(path.cameras), 'frame')} of {size}, against {count_of(leaves, 'splat')}, on black and white"
    pops = any(each.popping is not None for each in summary)
    head = f" {'popping':>7} {'most':>5}" if pops else ""
    yield f"  {'budget':>8} {'splats':>10} {'PSNR':>6} {'least':>6} {'SSIM':>6} {'edges':>6}{head}  worst tile"
    for each in summary:
        edges, popping, most = (
            "-" if value is None else f"{value:.2f}" for value in (each.edge_psnr, each.popping, each.popping_max)
        )
        popped = f" {popping:>7} {most:>5}" if pops else ""
        yield (
            f"  {each.text:>8} {round(each.selected):>10,} {each.psnr:>6.2f} {each.psnr_min:>6.2f} {each.ssim:>6.4f}"
            f" {edges:>6}{popped}  {each.worst_tile_psnr:.2f}"
            f" at {each.worst_tile_x}, {each.worst_tile_y} of frame {each.worst_frame:,}"
        )
