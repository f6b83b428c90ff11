"""Options of `sparklod render` that say how pictures look, and the values that they take."""

from __future__ import annotations

import string
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from ..codecs.rounding import ROUND_TRIPS
from ..render.settings import PROFILES, SORTS, RasterSettings
from ..support import defaults
from ..support.defaults import OF_PIXELS
from .options.common import Command
from .options.types import Real
from .usage import exclude, is_given

if TYPE_CHECKING:
    from ..images.pixels import Color
    from ..render.settings import RenderSettings

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}

#: Pixels that are drawn for a picture: the floats of more do not fit into the memory of most machines.
MOST_PIXELS = 1 << 27


#: Options that styles leave nothing to, and those that backends do not have.
UNSTYLED = {
    "points": ("profile", "sort"),
    "billboards": ("profile", "sort"),
    "sorted-billboards": ("profile",),
}
UNKNOWN_TO = {"open3d": ("profile", "sort")}


def of_pictures(color_by: str | None) -> tuple[str, ...]:
    """Options that cannot be used with a file of numbers, by what its numbers are."""
    return ("no_bar", "background", "alpha") if color_by in OF_PIXELS else ("no_bar",)


class Background(click.ParamType):
    """A colour as (red, green, blue), 0..1; None for none."""

    name = "color"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        if value.lower() in COLORS:
            return COLORS[value.lower()]
        digits = value[1:]
        if not value.startswith("#") or len(digits) not in (3, 6) or set(digits) - set(string.hexdigits):
            self.fail(f"{value!r} is not a colour: '#rrggbb', {', '.join(COLORS)}", param, ctx)
        if len(digits) == 3:
            digits = "".join(2 * digit for digit in digits)
        return tuple(byte / 255 for byte in bytes.fromhex(digits))

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "COLOR"


def look_options(command: Command) -> Command:
    """How pictures look."""
    look = RasterSettings()
    for option in reversed(
        (
            click.option(
                "--background",
                type=Background(),
                default="black",
                help="Behind the splats: '#rrggbb', black, white or transparent.",
            ),
            click.option("--alpha", is_flag=True, help="Keep alpha, as --background transparent does."),
            click.option(
                "--supersample",
                metavar="N",
                type=click.IntRange(1, defaults.MAX_SUPERSAMPLE),
                default=1,
                help="Make each pixel the mean of N x N, up to 4 x 4.",
            ),
            click.option(
                "--near",
                metavar="D",
                type=Real(0, defaults.FARTHEST, min_open=True),
                default=look.near,
                show_default=False,
                help="Draw nothing nearer along the axis."
                f"  [default: {look.near:g}, or less where the camera is chosen for the scene]",
            ),
            click.option(
                "--far",
                metavar="D",
                type=Real(0, defaults.FARTHEST, min_open=True),
                default=look.far,
                show_default=False,
                help="Draw nothing farther along the axis."
                f"  [default: {look.far:g}, or more where the camera is chosen for the scene]",
            ),
            click.option(
                "--continuous",
                is_flag=True,
                help="Blend nodes and their children where one replaces the other, so that nothing pops;"
                " draws 18 to 40 % more splats than --budget.",
            ),
            click.option(
                "--blend",
                metavar="X",
                type=Real(1, min_open=True),
                help=f"With --continuous: ratio of pixel scales between which they do.  [default: {defaults.BLEND:g}]",
            ),
            click.option(
                "--style",
                type=click.Choice(defaults.STYLES),
                default=defaults.STYLES[0],
                help="Splats, or what is simpler: opaque points of a pixel, discs in the order of the file, or discs"
                " from far to near.",
            ),
            click.option(
                "--color-by",
                type=click.Choice(defaults.COLOR_BY),
                help="Colours that mean something, without light, and beside the picture a bar that says what.",
            ),
            click.option("--no-bar", is_flag=True, help="Leave that bar out."),
            click.option(
                "--through",
                type=click.Choice(list(ROUND_TRIPS)),
                help="Draw splats as they are after Spark's PackedSplats or ExtSplats, or SPZ, in the file's own cuts.",
            ),
            click.option(
                "--profile",
                type=click.Choice(PROFILES),
                default=look.profile,
                help="How what is more than opaque falls off: as Spark 2 draws it, or as its LoD design has it.",
            ),
            click.option(
                "--sort",
                type=click.Choice(SORTS),
                default=look.sort,
                help="Draw in the order of the distance from the camera, or along its axis.",
            ),
            click.option(
                "--sorting",
                type=click.Choice(defaults.SORTINGS),
                help="With --backend osmesa: exactly, or by 16 bits of the depth, as antimatter15's viewer."
                "  [default: exact]",
            ),
            click.option(
                "--sort-throttle",
                metavar="X",
                type=Real(0, 2),
                help="With --backend osmesa: keep the order while the direction changes by a cosine of less than"
                " this, such as 0.01.  [default: 0]",
            ),
            click.option(
                "--backend",
                type=click.Choice(defaults.BACKENDS),
                default=defaults.BACKENDS[0],
                help="What draws splats.",
            ),
        )
    ):
        command = option(command)
    return command


def manner_from(ctx: click.Context, settings: Mapping[str, Any]) -> RenderSettings:
    """The manner that the options of `look_options` ask for."""
    from ..render.settings import RenderSettings

    style, by = settings["style"], settings["color_by"]
    if not settings["near"] < settings["far"]:
        raise click.UsageError(f"--near {settings['near']:g} is not less than --far {settings['far']:g}")
    if style != "splats" and is_given(ctx, "backend"):
        raise click.UsageError(f"--backend draws splats, and has no --style {style}")
    exclude(ctx, UNSTYLED.get(style, ()), f"--style {style}")
    exclude(ctx, UNKNOWN_TO.get(settings["backend"], ()), f"--backend {settings['backend']}")
    if by == "overdraw":
        exclude(ctx, ["sort"], "--color-by overdraw, which counts splats")
    if by == "overdraw" and (style != "splats" or is_given(ctx, "backend")):
        raise click.UsageError("--color-by overdraw counts splats; leave out --style and --backend")
    if settings["no_bar"] and by is None and settings["diff"] is None:
        raise click.UsageError("--no-bar only means something with --color-by or --diff")
    options = {
        name: settings[option]
        for option, name in (("sorting", "sorting"), ("sort_throttle", "throttle"))
        if settings[option] is not None
    }
    if options and settings["backend"] != "osmesa":
        raise click.UsageError("--sorting and --sort-throttle only mean something with --backend osmesa")
    return RenderSettings(
        raster=RasterSettings(settings["near"], settings["far"], settings["profile"], settings["sort"]),
        style=style,
        backend=settings["backend"],
        color_by=by,
        supersample=settings["supersample"],
        options=options,
    )


def blend_from(settings: Mapping[str, Any]) -> float | None:
    """The width of continuous cuts, None for ordinary ones."""
    if not settings["continuous"]:
        if settings["blend"] is not None:
            raise click.UsageError("--blend only means something with --continuous")
        return None
    return settings["blend"] or defaults.BLEND


def background_from(ctx: click.Context, settings: Mapping[str, Any], form: str) -> Color | None:
    """What is behind the splats; None keeps alpha, which floats do unless a background is asked for."""
    color: Color | None = settings["background"]
    given = is_given(ctx, "background")
    if settings["alpha"] and given and color is not None:
        raise click.UsageError("--alpha keeps what --background would fill; leave one of them out")
    if settings["alpha"] or (form == "npy" and not given):
        color = None
    if color is None and form in ("gif", "mp4"):
        raise click.UsageError(f".{form} has no alpha; write .webp or .png, or name a --background")
    return color


def check_size(width: int, height: int, supersample: int, form: str) -> None:
    """Raises a `click.UsageError` where a picture is larger than can be drawn, or written."""
    if width * height * supersample**2 > MOST_PIXELS:
        times = f" x {supersample**2} (--supersample {supersample})" if supersample > 1 else ""
        raise click.UsageError(f"{width:,} x {height:,} pixels{times} are more than {MOST_PIXELS:,}; see --size")
    if form == "webp" and max(width, height) > 16383:
        raise click.UsageError(
            f"{width:,} x {height:,} pixels are more than 16,383 a side, which .webp has; write .png"
        )
