"""The options that say which cameras look at a scene; `cameras.Cameras` has their values."""

from __future__ import annotations

import functools

import click

from ...cameras.axes import Axes
from ...cameras.defaults import ELEVATION, ORBIT
from ...cameras.formats.table import FORMATS
from ..command import COMMON, option, with_options
from ..paths import InputPath
from .cameras import HEADING
from .common import Command
from .types import Direction, Numbers, Real
from .views import Size, View, Views


def camera_options(command: Command, *, still: bool = False) -> Command:
    """The options of `Cameras`.

    Args:
        command: that gets them.
        still: there is `--view`, and without a source one camera that sees the whole scene, in place of an orbit.
    """
    add = functools.partial(option, heading=HEADING)
    common = functools.partial(option, heading=COMMON)
    default = "one camera that sees the whole scene" if still else f"an orbit of {ORBIT}"
    view = add(
        "--view",
        "views",
        type=View(),
        multiple=True,
        help="Place a camera as --look-at does; several --view make a contact sheet.",
    )
    return with_options(
        command,
        common(
            "--camera-path",
            metavar="FILE",
            type=InputPath(),
            help="Read the cameras from a file, or from a folder written by COLMAP.",
        ),
        common(
            "--orbit",
            metavar="N",
            type=click.IntRange(1, 1 << 20),
            help=f"Place N cameras around the scene.  [default, without any source of cameras: {default}]",
        ),
        common("--look-at", type=View(), help="Place one camera at EYE that looks at TARGET, each x,y,z."),
        common(
            "--size",
            type=Size(),
            help="Width and height of the images, in pixels; the vertical field of view is kept."
            "  [default: the file's, or 1280x720]",
        ),
        *([view] if still else []),
        add("--dolly", is_flag=True, help="Move the camera straight towards the scene, from far to near."),
        add(
            "--keyframes",
            type=Views(),
            help="Move the camera smoothly through two or more views, separated by spaces or semicolons.",
        ),
        add(
            "--camera-format",
            type=click.Choice(["auto", *(form.name for form in FORMATS)]),
            help="Format of --camera-path; auto recognises it by its content.  [default: auto]",
        ),
        add(
            "--camera-axes",
            type=click.Choice([axes.value for axes in Axes]),
            help="Axes of the matrices of --camera-path: y up (opengl) or down (opencv), camera to world (c2w) or"
            " world to camera (w2c).  [default: those of its format]",
        ),
        add(
            "--center",
            type=Numbers("x", "y", "z"),
            help="Point that --orbit and --dolly look at.  [default: the middle of the scene]",
        ),
        add(
            "--distance",
            metavar="D",
            type=Real(0, min_open=True),
            help="Distance from that point, in world units: of --orbit, and of the first camera of --dolly."
            "  [default: where the scene fits the image; 4 times that with --dolly]",
        ),
        add(
            "--elevation",
            metavar="DEGREES",
            type=Real(-89, 89),
            help=f"Angle of --orbit and --dolly above that point, in degrees.  [default: {ELEVATION:g}]",
        ),
        add(
            "--up",
            type=Direction(),
            help="Direction that is up, as an axis such as -y or as x,y,z, for cameras of which only eye and target are"
            " known.  [default: the axis that the files note, or -y, as training leaves scenes with y down; y in"
            " SuperSplat's files]",
        ),
        add(
            "--world-transform",
            metavar="MATRIX",
            help="Transform from the world of the cameras to that of the splats: 16 numbers with commas between,"
            " row by row, or a file of them.",
        ),
        add(
            "--fov",
            metavar="DEGREES",
            type=Real(0, 180, min_open=True, max_open=True),
            help="Vertical field of view, in degrees.  [default: the file's, or 60]",
        ),
        add(
            "--seconds",
            metavar="S",
            type=Real(0, 1e6, min_open=True),
            help="Duration of --orbit, of --dolly, and of --keyframes from one view to the next, in seconds.  [default:"
            " 2; of --orbit, N frames at --fps]",
        ),
        add(
            "--fps",
            metavar="N",
            type=Real(0, 1e6, min_open=True),
            help="Frames per second of the path; times are counted by it.  [default: the file's times, or 30]",
        ),
        add(
            "--every",
            metavar="K",
            type=click.IntRange(1),
            default=1,
            show_default=True,
            help="Take every K-th camera of the path.",
        ),
    )
