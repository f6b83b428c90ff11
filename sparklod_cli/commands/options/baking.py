"""Options of `sparklod build-lod`: which splats, how they are merged, where they stand, and how they are written."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from ...codecs.gpu.table import ENCODINGS, NPZ, RAW_SUFFIXES
from ...codecs.rad.layout import OPTIONS as PROPERTIES
from ...codecs.rad.layout import choices
from ...codecs.streamed_sog.names import MANIFEST
from ...lod.builders import BUILDERS, METHODS
from ...support import defaults
from ..command import COMMON, option, with_options
from ..paths import InputPath
from ..usage import given, is_given, refuse
from .common import Command
from .detail import detail_of, detail_options
from .refining import fit_settings_of, refining_options
from .types import AutoOr, Ball, Codes, Numbers, Real

if TYPE_CHECKING:
    from ...bake.settings import BakeSettings
    from ...codecs.options import WriteOptions

TREE, SELECTION, PLACE, FORMAT = "Tree", "Selection", "Rotation, scale and position", "File format"
RAD = "RAD"

#: The value of --format for regions at several detail levels.
STREAMED_SOG = "streamed-sog"

#: Values of --format: the suffix of the file, and whether each chunk of a RAD gets a file of its own.
FORMS = {
    "spz": (".spz", False),
    "rad": (".rad", False),
    "rad-chunked": (".rad", True),
    STREAMED_SOG: (".json", False),
}

#: What builds the tree unless somebody chooses, and what builds that which a Streamed SOG is cut from.
METHOD, METHOD_OF_DETAIL = METHODS[0], "quality"

#: What the properties of RAD are called in --help.
NAMES = {
    "center": "centres",
    "alpha": "opacities",
    "rgb": "colours",
    "scales": "scales",
    "orientation": "rotations",
    "sh": "spherical harmonics",
}

#: Parameters of the headings above, of which a file that is only converted back has nothing.
OF_TREES = ("method", "base", "growth", "max_sh")
OF_SELECTION = ("min_opacity", "min_box", "max_box", "within", "on_invalid", "rgba")
OF_PLACE = ("up", "rotate", "scale", "translate")
OF_SPZ = ("spz_version", "fractional_bits")
OF_RAD = tuple(f"rad_{name}" for name in PROPERTIES)
OF_BOTH = ("compression_level",)
OF_PALETTES = ("cluster_sh",)

OPTIONS: tuple[Callable[[Command], Command], ...] = (
    option(
        "--format",
        "form",
        heading=COMMON,
        type=click.Choice(list(FORMS)),
        help="Format of the output. rad is what Spark streams; rad-chunked writes each chunk to a file of its own,"
        " NAME-lod-0.radc and so on, beside NAME-lod.rad; streamed-sog is what PlayCanvas, SuperSplat and Babylon.js"
        f" stream, {MANIFEST} and folders beside it. A Level-of-Detail file of another format keeps its tree. "
        " [default: by the name of FILE, or spz]",
        show_default=False,
    ),
    option(
        "--method",
        heading=COMMON,
        type=click.Choice(METHODS),
        help="How splats are merged. quick takes seconds; quality takes longer, and its cuts come closer to full"
        f" detail.  [default: {METHOD}; {METHOD_OF_DETAIL} with --format {STREAMED_SOG}]",
        show_default=False,
    ),
    option(
        "--max-sh",
        heading=COMMON,
        metavar="N",
        type=click.IntRange(0, defaults.MAX_SH_DEGREE),
        default=defaults.MAX_SH_DEGREE,
        help="Highest degree of spherical harmonics to keep.",
    ),
    option(
        "--min-opacity",
        heading=COMMON,
        metavar="N",
        type=Real(0, 1),
        default=0.0,
        help="Leave out splats whose opacity is lower than this.",
    ),
    option(
        "--within",
        heading=COMMON,
        type=Ball(),
        help="Leave out splats whose centre is outside this ball, in the input's coordinates.",
    ),
    option(
        "--up",
        heading=COMMON,
        type=click.Choice(defaults.UP_AXES),
        default=defaults.UP_AXES[0],
        help="Axis of the input that points up; the scene is turned so that it becomes +y, which the output notes for"
        " render, traverse and view. Scenes as trained are mostly -y.",
    ),
    option(
        "--base",
        heading=TREE,
        metavar="N",
        type=Real(defaults.MIN_BASE, defaults.MAX_BASE),
        default=defaults.DEFAULT_BASE,
        help="Growth of the voxel grid from level to level, with --method quick. Smaller values give smoother"
        " transitions and more nodes.",
    ),
    option(
        "--growth",
        heading=TREE,
        metavar="N",
        type=Real(defaults.MIN_GROWTH, defaults.MAX_GROWTH),
        help="Largest number of nodes for each leaf, with --method quality. "
        f" [default: {defaults.DEFAULT_GROWTH:g}; {defaults.DETAIL_GROWTH:g} with --format {STREAMED_SOG}]",
        show_default=False,
    ),
    option(
        "--min-box",
        heading=SELECTION,
        type=Numbers("x", "y", "z"),
        help="Leave out splats whose centre is below this on any axis, in the input's coordinates.",
    ),
    option(
        "--max-box",
        heading=SELECTION,
        type=Numbers("x", "y", "z"),
        help="Leave out splats whose centre is above this on any axis, in the input's coordinates.",
    ),
    option(
        "--on-invalid",
        heading=SELECTION,
        type=click.Choice(["error", "drop"]),
        default="error",
        help="Whether to fail on invalid splats or leave them out: numbers that are not finite, negative scales.",
    ),
    option(
        "--rgba",
        heading=SELECTION,
        metavar="FILE",
        type=InputPath(),
        help="Replace colours and opacities by those of a .npy or raw file of (N, 4) bytes or floats 0..1; splats of"
        " alpha 0 are left out.",
    ),
    option(
        "--rotate",
        heading=PLACE,
        type=Numbers("x", "y", "z"),
        default="0,0,0",
        help="Turn the scene by these angles in degrees, about x, then y, then z, after --up.",
    ),
    option(
        "--scale",
        heading=PLACE,
        metavar="X",
        type=Real(0, min_open=True),
        default=1.0,
        help="Multiply the size of the scene by this, about its origin, after --rotate.",
    ),
    option(
        "--translate",
        heading=PLACE,
        type=Numbers("x", "y", "z"),
        default="0,0,0",
        help="Move the scene by this, in world units, after --scale.",
    ),
    option(
        "--encoding",
        heading=FORMAT,
        type=click.Choice(list(ENCODINGS)),
        help=f"Write arrays in a viewer's memory layout instead: a {NPZ} file, or the words alone if FILE ends"
        f" in {' or '.join(RAW_SUFFIXES)}.",
    ),
    option(
        "--spz-version",
        heading=FORMAT,
        type=click.Choice([str(version) for version in defaults.SPZ_VERSIONS]),
        default=str(defaults.DEFAULT_SPZ_VERSION),
        help="SPZ version: 2 gives files 4 to 8 % smaller, 3 rotations ten times as exact.",
    ),
    option(
        "--fractional-bits",
        heading=FORMAT,
        type=AutoOr(0, defaults.MAX_FRACTIONAL_BITS),
        default="auto",
        help="Bits after the binary point of SPZ positions; auto goes by the extent of the scene and its smallest"
        " splats.",
    ),
    option(
        "--compression-level",
        heading=FORMAT,
        metavar="N",
        type=click.IntRange(defaults.MIN_COMPRESSION, defaults.MAX_COMPRESSION),
        default=defaults.DEFAULT_COMPRESSION,
        help="Compression of SPZ and RAD, from 1 (fast) to 9 (small).",
    ),
    *(
        option(
            f"--rad-{name}",
            heading=RAD,
            type=click.Choice(choices(name)),
            default="auto",
            help=f"Encoding of {NAMES[name]}; auto suits the scene.",
        )
        for name in PROPERTIES
    ),
    option(
        "--cluster-sh",
        heading=FORMAT,
        type=Codes(defaults.MIN_SH_CODES, defaults.MAX_SH_CODES),
        is_flag=False,
        flag_value=str(defaults.MAX_SH_CODES),
        help="Write spherical harmonics to RAD as a palette of at most N entries, 2 to 65,536, and a label for each"
        " splat: the file gets smaller, and reflections less exact. N is 65,536 if it is left out. SOG always has a"
        " palette; this chooses its size, which otherwise suits the number of splats.",
    ),
)


def baking_options(command: Command) -> Command:
    """Adds the options of this module; `bake_settings` and `write_options` take what they are given."""
    return with_options(command, *OPTIONS, refining_options, detail_options)


def method_of(ctx: click.Context, *, streamed_sog: bool) -> str:
    """The method that was asked for, or that suits the output."""
    asked: str | None = ctx.params["method"]
    return asked or (METHOD_OF_DETAIL if streamed_sog else METHOD)


def check_method(ctx: click.Context, chosen: str) -> None:
    """Raises a `click.UsageError` where the number of one method is given with another, which was chosen."""
    for method, row in BUILDERS.items():
        if method != chosen:
            refuse(ctx, [row.setting], f"is an option of --method {method}, not of {chosen}")


def bake_settings(ctx: click.Context, *, suffix: str, raw: bool, streamed_sog: bool, converts: bool) -> BakeSettings:
    """What the options ask for; loads numpy.

    Args:
        ctx: of the command.
        suffix: of the format of the output.
        raw: write the words of --encoding alone.
        streamed_sog: write that.
        converts: somebody chose the format of the output, so that the tree of an input is kept.
    """
    from ...bake.settings import BakeSettings
    from ...model.selection import Selection
    from ...model.transforms import Transform

    asked = ctx.params
    growth = defaults.DETAIL_GROWTH if streamed_sog else defaults.DEFAULT_GROWTH
    try:
        transform = Transform.from_parts(
            up=asked["up"], rotate=asked["rotate"], scale=asked["scale"], translate=asked["translate"]
        )
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    return BakeSettings(
        method=method_of(ctx, streamed_sog=streamed_sog),
        base=asked["base"],
        growth=growth if asked["growth"] is None else asked["growth"],
        max_sh=asked["max_sh"],
        selection=Selection(
            drop_invalid=asked["on_invalid"] == "drop",
            min_opacity=asked["min_opacity"],
            min_box=asked["min_box"],
            max_box=asked["max_box"],
            within=asked["within"],
        ),
        transform=transform,
        up=asked["up"] if is_given(ctx, "up") else None,
        rgba=asked["rgba"],
        suffix=suffix,
        options=write_options(ctx),
        encoding=asked["encoding"],
        raw=raw,
        detail=detail_of(ctx) if streamed_sog else None,
        environment=asked["environment"],
        environment_beyond=asked["environment_beyond"],
        refine=fit_settings_of(ctx),
        camera_path=asked["camera_path"],
        converts=converts,
        unused=tuple(given(ctx, (*OF_TREES, *OF_SELECTION, *OF_PLACE, "environment_beyond"))),
    )


def write_options(ctx: click.Context) -> WriteOptions:
    """How to write; what nobody chose is left to the library, which may take it from the input."""
    from ...codecs.options import RadOptions, SogOptions, WriteOptions

    asked = ctx.params
    return WriteOptions(
        spz_version=int(asked["spz_version"]) if is_given(ctx, "spz_version") else None,
        fractional_bits=asked["fractional_bits"],
        compression_level=asked["compression_level"],
        rad=RadOptions(
            **{name: asked[f"rad_{name}"] for name in PROPERTIES},
            chunked=asked["form"] is not None and FORMS[asked["form"]][1],
            sh_codes=asked["cluster_sh"],
        ),
        sog=SogOptions(sh_codes=asked["cluster_sh"]),
    )
