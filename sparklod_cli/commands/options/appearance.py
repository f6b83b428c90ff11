"""The look of pictures: shape and colours of splats, renderer, background."""

from __future__ import annotations

import functools
import string
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from ...codecs.rounding import ROUND_TRIPS
from ...render.backends import BACKENDS
from ...render.settings import COLOR_BY, OF_PIXELS, PROFILES, SORTINGS, SORTS, STYLES, RasterSettings, RenderSettings
from ...support import defaults
from ..command import COMMON, option, with_options
from ..usage import exclude, is_given, require
from .common import Command
from .types import Real

if TYPE_CHECKING:
    from ...images.pixels import Color

HEADING = "Appearance"

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}

#: Options that styles have no use for, and those that backends do not have.
UNSTYLED = {
    "points": ("profile", "sort"),
    "billboards": ("profile", "sort"),
    "sorted-billboards": ("profile",),
}
UNKNOWN_TO = {"open3d": ("profile", "sort")}

#: Options of one backend only, with what the backend calls them.
OF_OSMESA = {"sorting": "sorting", "sort_throttle": "throttle"}


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


@dataclass(frozen=True)
class Appearance:
    """The values of the options of `appearance_options`; None for those not given.

    Attributes:
        background: red, green and blue, 0..1; None for none.
        alpha: keep alpha.
        supersample: samples along each side of a pixel.
        near, far: world units.
        style: one of `STYLES`.
        color_by: one of `COLOR_BY`.
        no_bar: leave the colour bar out.
        through: a key of `rounding.ROUND_TRIPS`.
        profile: one of `PROFILES`.
        sort: one of `SORTS`.
        backend: one of `BACKENDS`.
        sorting, sort_throttle: of the backend osmesa.
    """

    background: Color | None
    alpha: bool
    supersample: int
    near: float
    far: float
    style: str
    color_by: str | None
    no_bar: bool
    through: str | None
    profile: str
    sort: str
    backend: str
    sorting: str | None
    sort_throttle: float | None

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where options contradict each other, or have nothing to do."""
        if not self.near < self.far:
            raise click.UsageError(f"--near {self.near:g} must be less than --far {self.far:g}")
        if self.style != "splats":
            exclude(ctx, ["backend"], f"--style {self.style}, which every picture gets from one renderer")
        exclude(ctx, UNSTYLED.get(self.style, ()), f"--style {self.style}")
        exclude(ctx, UNKNOWN_TO.get(self.backend, ()), f"--backend {self.backend}")
        if self.color_by == "overdraw":
            exclude(ctx, ["sort", "style", "backend"], "--color-by overdraw, which counts splats")
        if self.backend != "osmesa":
            require(ctx, OF_OSMESA, "--backend osmesa")
        if is_given(ctx, "background") and self.background is not None:
            exclude(ctx, ["alpha"], "--background, which fills what is transparent")

    @property
    def keeps_alpha(self) -> bool:
        """Whether pictures of pixels keep alpha."""
        return self.alpha or self.background is None

    def background_for(self, ctx: click.Context, form: str) -> Color | None:
        """The background of a file of some form; None keeps alpha, as floats do unless a background is given.

        Raises:
            click.UsageError: a file of this form has no alpha.
        """
        from ...images.output import WITH_ALPHA

        if self.keeps_alpha and form not in WITH_ALPHA:
            raise click.UsageError(f".{form} has no alpha; write .png or .webp, or name a --background such as black")
        return None if self.keeps_alpha or (form == "npy" and not is_given(ctx, "background")) else self.background

    def settings(self, *, supersample: int | None = None, max_sh: int = defaults.MAX_SH_DEGREE) -> RenderSettings:
        """How pictures are drawn.

        Args:
            supersample: in place of --supersample.
            max_sh: degrees of spherical harmonics above this are left out.
        """
        return RenderSettings(
            raster=RasterSettings(self.near, self.far, self.profile, self.sort),
            style=self.style,
            backend=self.backend,
            color_by=self.color_by,
            supersample=supersample or self.supersample,
            max_sh=max_sh,
            options={
                called: getattr(self, name) for name, called in OF_OSMESA.items() if getattr(self, name) is not None
            },
        )

    def of_pictures(self) -> tuple[str, ...]:
        """Options that cannot be used with a file of numbers, by what its numbers are."""
        return ("no_bar", "background", "alpha") if self.color_by in OF_PIXELS else ("no_bar",)


def appearance_options(command: Command) -> Command:
    """The options of `Appearance`."""
    add = functools.partial(option, heading=HEADING)
    raster = RasterSettings()
    return with_options(
        command,
        option(
            "--background",
            heading=COMMON,
            type=Background(),
            default="black",
            help="Colour behind the splats: '#rrggbb', black, white or transparent.",
        ),
        add("--alpha", is_flag=True, help="Keep alpha, as --background transparent does."),
        add(
            "--supersample",
            metavar="N",
            type=click.IntRange(1, defaults.MAX_SUPERSAMPLE),
            default=1,
            help="Draw each pixel as the mean of N x N samples, up to 4 x 4.",
        ),
        add(
            "--color-by",
            type=click.Choice(COLOR_BY),
            help="Colour splats by a quantity, unlit, with a colour bar beside the picture.  [default: their own"
            " colours]",
        ),
        add("--no-bar", is_flag=True, help="Leave out the colour bar of --color-by or --diff."),
        add(
            "--style",
            type=click.Choice(STYLES),
            default=STYLES[0],
            help="Shape of each splat: its Gaussian, one opaque pixel (points), or an opaque disc, in the order of"
            " the file (billboards) or from far to near (sorted-billboards).",
        ),
        add(
            "--near",
            metavar="D",
            type=Real(0, defaults.FARTHEST, min_open=True),
            default=raster.near,
            show_default=False,
            help="Distance of the near plane along the optical axis, in world units; nearer splats are left out."
            f"  [default: {raster.near:g}, or less where the camera is chosen for the scene]",
        ),
        add(
            "--far",
            metavar="D",
            type=Real(0, defaults.FARTHEST, min_open=True),
            default=raster.far,
            show_default=False,
            help="Distance of the far plane along the optical axis, in world units; farther splats are left out."
            f"  [default: {raster.far:g}, or more where the camera is chosen for the scene]",
        ),
        add(
            "--through",
            type=click.Choice(list(ROUND_TRIPS)),
            help="Draw splats as Spark's PackedSplats or ExtSplats, SPZ or RAD round them; cuts stay those of the"
            " file.  [default: as in the file]",
        ),
        add(
            "--profile",
            type=click.Choice(PROFILES),
            default=raster.profile,
            help="Falloff of splats with a LoD opacity above 1: as Spark 2 draws it (spark), or as its LoD design"
            " describes it (shifted).",
        ),
        add(
            "--sort",
            type=click.Choice(SORTS),
            default=raster.sort,
            help="Order of the splats: by distance from the camera (radial), or along its axis (z).",
        ),
        add(
            "--backend",
            type=click.Choice(list(BACKENDS)),
            default=next(iter(BACKENDS)),
            help="Renderer: numba is the reference, osmesa is OpenGL in software, open3d is a quick look.",
        ),
        add(
            "--sorting",
            type=click.Choice(SORTINGS),
            help="With --backend osmesa: sort exactly, or by 16 bits of the depth as antimatter15's viewer does"
            " (counting16).  [default: exact]",
        ),
        add(
            "--sort-throttle",
            metavar="X",
            type=Real(0, 2),
            help="With --backend osmesa: keep the order until the cosine between the view directions falls below"
            " 1 - X, such as 0.01.  [default: 0]",
        ),
    )
