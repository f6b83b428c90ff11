"""Options of `sparklod render`: the look of pictures, comparisons, and the files that pictures are written to."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import click

from ...codecs.formats import ROUND_TRIPS
from ...images.output import JPEG_QUALITY, MOVING, STILL, THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE
from ...model import MAX_SH_DEGREE
from ...render.devices import uses_card
from ...render.settings import SORTINGS, RenderSettings
from ...system.setting_fields import Range, setting, whole
from ..command import COLOR, COMMON, flag, is_set, refuse
from ..paths import Folder, InputPath, require_suffix, stem_of
from .common import assert_errors, assert_option, output_option, overwrite_flag, plot_option

if TYPE_CHECKING:
    from ...cameras.camera import Camera
    from ...images.output import PictureOutput
    from ...images.pixels import Color
    from ...lod.budget import Budget
    from ...tables.assertions import Assertion

#: Options without an effect on some styles and backends.
UNSTYLED = {
    "points": ("profile", "sort"),
    "billboards": ("profile", "sort"),
    "sorted-billboards": ("profile",),
}
UNKNOWN_TO = {"open3d": ("profile", "sort")}

#: The budgets to compare, unless others are given.
DEFAULT_BUDGETS = "2%,5%,10%,25%,50%"

#: Options without an effect on --compare and --thumbnail.
NOT_COMPARED = (
    *("full", "preset", "lod_splat_scale", "background", "alpha", "supersample", "style", "color_by", "no_bar"),
    *("through", "diff", "gain", "sheet", "jobs", "thumbnail", "jpeg_quality"),
)
NO_THUMBNAIL = (
    *("size", "supersample", "camera_path", "orbit", "dolly", "look_at", "views", "keyframes", "center", "distance"),
    *("sheet", "fps", "every"),
)

#: Pixels that are drawn for a picture: the floats of more do not fit into the memory of most machines.
MOST_PIXELS = 1 << 27

#: Pixels along a side of a file, by its form.
MOST_SIDE = {"webp": 16_383, "jpg": 65_500}


@dataclass(frozen=True)
class Appearance:
    """Options of the look of pictures."""

    HEADING: ClassVar[str] = "Appearance"

    background: Color | None = setting(
        "Colour behind the splats: '#rrggbb', black, white or transparent.", COLOR, "black", heading=COMMON
    )
    alpha: bool = flag("Keep alpha, as --background transparent does.")
    render: RenderSettings = field(default_factory=RenderSettings)
    no_bar: bool = flag("Leave out the colour bar of --color-by or --diff.")
    through: str | None = setting(
        "Draw splats as Spark's PackedSplats or ExtSplats, SPZ or RAD round them; cuts stay those of the file."
        "  [default: as in the file]",
        ROUND_TRIPS,
    )
    sorting: str | None = setting(
        "With --backend osmesa: sort exactly, or by 16 bits of the depth as antimatter15's viewer does (counting16)."
        "  [default: exact]",
        SORTINGS,
        needs="backend=osmesa",
    )
    sort_throttle: float | None = setting(
        "With --backend osmesa: keep the order until the cosine between the view directions falls below 1 - X, such as"
        " 0.01.  [default: 0]",
        Range(0, 2),
        needs="backend=osmesa",
    )

    def check(self, ctx: click.Context) -> None:
        render, raster = self.render, self.render.raster
        if not raster.near < raster.far:
            raise click.UsageError(f"--near {raster.near:g} must be less than --far {raster.far:g}")
        if render.style != "splats":
            refuse(
                ctx,
                ["backend", "device"],
                f"cannot be used with --style {render.style}, which every picture gets from one renderer",
            )
        refuse(ctx, UNSTYLED.get(render.style, ()), f"cannot be used with --style {render.style}")
        refuse(ctx, UNKNOWN_TO.get(render.backend, ()), f"cannot be used with --backend {render.backend}")
        if render.backend != "numba":
            refuse(ctx, ["device"], f"cannot be used with --backend {render.backend}")
        if render.color_by == "overdraw":
            refuse(
                ctx,
                ["sort", "style", "backend", "device"],
                "cannot be used with --color-by overdraw, which counts splats",
            )
        if is_set(ctx, "background") and self.background is not None:
            refuse(ctx, ["alpha"], "cannot be used with --background, which fills what is transparent")

    @property
    def keeps_alpha(self) -> bool:
        return self.alpha or self.background is None

    def background_for(self, ctx: click.Context, form: str) -> Color | None:
        """Return the background of a file of some form; None keeps alpha, as floats do unless a background is given."""
        from ...images.output import WITH_ALPHA

        if self.keeps_alpha and form not in WITH_ALPHA:
            raise click.UsageError(f".{form} has no alpha; write .png or .webp, or name a --background such as black")
        return None if self.keeps_alpha or (form == "npy" and not is_set(ctx, "background")) else self.background

    def settings(self, say: Callable[[str], None]) -> RenderSettings:
        """Return the settings of pictures with the options of the backend; `say` receives a line on the device.

        Raises:
            BackendError: a card is requested, and none is usable.
        """
        options = {"sorting": self.sorting, "throttle": self.sort_throttle}
        known = {name: value for name, value in options.items() if value is not None}
        device = "cuda" if uses_card(self.render.device, say) else "cpu"
        return dataclasses.replace(self.render, device=device, options=known)


@dataclass(frozen=True)
class ComparisonOptions:
    """Options of comparisons: of cuts with full detail (`--compare`), and of one file with another (`--diff`)."""

    HEADING: ClassVar[str] = "Comparison"

    compare: bool = flag(
        "Measure how far the cuts of each --budget are from full detail, as a table instead of pictures.",
        excludes=NOT_COMPARED,
    )
    asserts: tuple[str, ...] = assert_option(
        "With --compare: a condition that must hold, such as 'psnr_min>30', or '5%:psnr>30' for one of the budgets; the"
        " exit status is 3 if it does not.",
        needs="compare",
    )
    plot: Path | None = plot_option("With --compare: draw charts of the table as a .png.", needs="compare")
    max_sh: int = setting(
        "With --compare: highest degree of spherical harmonics to draw.",
        whole(0, MAX_SH_DEGREE),
        MAX_SH_DEGREE,
        needs="compare",
    )
    diff: Path | None = setting(
        "Draw the difference from the picture of another file, and print its PSNR.", InputPath()
    )
    gain: float | None = setting(
        "Factor by which --diff multiplies differences.  [default: chosen for the pictures]",
        Range(above=0),
        needs="diff",
    )

    def check(self, ctx: click.Context, appearance: Appearance) -> None:
        if self.compare:
            return
        if self.diff is None:
            if appearance.render.color_by is None:
                refuse(ctx, ["no_bar"], "can only be used with --color-by or --diff")
            return
        refuse(ctx, ["color_by"], "cannot be used with --diff, which compares the splats' own colours")
        if appearance.keeps_alpha:
            raise click.UsageError("--diff compares pictures without alpha; name a --background such as black")

    def budgets(self, budgets: Sequence[Budget] | None) -> Sequence[Budget]:
        """Return the budgets to compare: those given, or `DEFAULT_BUDGETS`."""
        from ...lod.budget import parse_budgets

        return parse_budgets(DEFAULT_BUDGETS) if budgets is None else budgets

    def assertions(self, budgets: Sequence[Budget]) -> list[tuple[int | None, Assertion]]:
        """Return the assertions, each with the index of the budget before its colon; None for all budgets."""
        from ...tables import assertions
        from ...tables.comparison import COLUMNS

        parsed: list[tuple[int | None, Assertion]] = []
        texts = [budget.text for budget in budgets]
        for text in self.asserts:
            name, colon, rest = text.rpartition(":")
            name = name.strip()
            if colon and name not in texts:
                raise click.UsageError(f"--assert {text!r}: {name} is not one of the budgets, {', '.join(texts)}")
            with assert_errors():
                assertion = dataclasses.replace(assertions.parse(rest, COLUMNS), text=text.strip())
            parsed.append((texts.index(name) if colon else None, assertion))
        return parsed


@dataclass(frozen=True)
class PictureFiles:
    """Options of the files of pictures.

    The output is a file, a name with a place for a number, a folder for files named after the input, or -.
    """

    HEADING: ClassVar[str] = "Output"

    output: Path | Folder | None = output_option(
        "Write a .png, .jpg, .webp or .npy (floats), or with out.%04d.png one for each camera; a .mp4, .webm, .gif or"
        " .webp for an animation; with --compare a .csv, .json or .parquet; or into the folder FILE as NAME.png; - is"
        " standard output.  [default: NAME.png beside the first FILE; with --compare standard output]"
    )
    overwrite: bool = overwrite_flag()
    thumbnail: bool = flag(
        f"Draw a small picture of the whole scene: {THUMBNAIL_SIZE[0]}x{THUMBNAIL_SIZE[1]} pixels, each the mean of"
        f" {THUMBNAIL_SUPERSAMPLE} x {THUMBNAIL_SUPERSAMPLE} samples, to NAME-thumbnail.png.",
        heading=COMMON,
        excludes=NO_THUMBNAIL,
    )
    sheet: bool = flag("Put the pictures of all cameras on one contact sheet.")
    jobs: int = setting(
        "Number of pictures to work on at a time: while one is drawn, others are sorted and written.", whole(1, 256), 2
    )
    jpeg_quality: int = setting("Quality of a .jpg, from 1 to 100.", whole(1, 100), JPEG_QUALITY)

    def place(self, ctx: click.Context, scene: Path, cameras: int, *, sheet: bool) -> PictureOutput:
        """Return the output of the pictures of some cameras.

        Args:
            scene: the file beside which an output goes that has no name, and whose name it has.
        """
        from ...images.output import output_for

        named, folder = (None, self.output.path) if isinstance(self.output, Folder) else (self.output, scene.parent)
        assert isinstance(folder, Path)  # pictures go to no addresses
        if named is not None:
            require_suffix("--output", named, (f".{form}" for form in dict.fromkeys((*STILL, *MOVING))))
        name = folder / (stem_of(scene) + ("-thumbnail" if self.thumbnail else ""))
        try:
            output = output_for(named, name, cameras, sheet=sheet)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        if output.form != "jpg":
            refuse(ctx, ["jpeg_quality"], "can only be used with a .jpg")
        return output


def check_sizes(output: PictureOutput, cameras: Sequence[Camera], supersample: int, *, bar: bool) -> None:
    """Raise a `click.UsageError` where a picture is larger than can be drawn, or than its file can be."""
    from ...images.pixels import scale_width

    for camera in cameras:
        width = camera.width + (scale_width(camera.width, camera.height) if bar else 0)
        height, most = camera.height, MOST_SIDE.get(output.form)
        if width * height * supersample**2 > MOST_PIXELS:
            times = f" x {supersample**2} (--supersample {supersample})" if supersample > 1 else ""
            raise click.UsageError(
                f"{width:,} x {height:,} pixels{times} are more than {MOST_PIXELS:,}; give a smaller --size"
            )
        if most is not None and max(width, height) > most:
            raise click.UsageError(
                f"{width:,} x {height:,} pixels are more than {most:,} a side, the most of .{output.form}; write .png"
            )
    if output.kind in ("animation", "sheet") and len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise click.UsageError(
            f"the cameras have pictures of several sizes, and those of one {output.kind} must be alike; give a --size"
        )
