"""Options that say which cameras look at a scene, and what becomes of them, shared by the commands that need any."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..cameras.axes import Axes
from ..cameras.formats.table import FORMATS, NAMES
from ..support.errors import CameraPathError, SparklodError, TooManyCamerasError
from .camera_values import Size, View, Views
from .options.common import Command
from .options.types import Numbers, Real
from .paths import InputPath

if TYPE_CHECKING:
    from ..cameras.camera import Matrix
    from ..cameras.formats.source import Parsed
    from ..cameras.frame import Frame, Settings
    from ..cameras.path import CameraPath
    from ..model.balls import Balls

    #: Gives what the splats cover.
    Scene = Callable[[], Balls]

#: The options that each are a source of cameras, of which one is taken, and the one that is where none is given.
SOURCES = {
    "camera_path": "--camera-path",
    "orbit": "--orbit",
    "dolly": "--dolly",
    "look_at": "--look-at",
    "keyframes": "--keyframes",
}
DEFAULT_ORBIT = 60

#: Options that only mean something with some sources.
ONLY_WITH = {
    "camera_format": ("camera_path",),
    "camera_axes": ("camera_path",),
    "center": ("orbit", "dolly"),
    "distance": ("orbit", "dolly"),
    "elevation": ("orbit", "dolly"),
    "seconds": ("dolly", "keyframes"),
    "fps": ("camera_path", "orbit", "dolly", "keyframes"),
    "every": ("camera_path", "orbit", "dolly", "keyframes"),
    "world_transform": ("camera_path", "look_at", "keyframes"),
}

DEFAULT_ELEVATION = 15.0

#: Of the options of `ONLY_WITH` that are something where nobody says anything.
DEFAULTS = {"every": 1}

#: What numbers with commas between are made of; anything else names a file.
NUMERIC = set("0123456789+-.,eE ")

#: Bytes of a camera path's file. COLMAP's images.txt has all points that its images see.
LARGEST = 1 << 31


def camera_options(command: Command, *, orbit: int = DEFAULT_ORBIT) -> Command:
    """The options of this module, in the order of the help; `cameras_from` takes what they are given.

    Args:
        command: that gets them.
        orbit: how many cameras there are around the scene where no source of cameras is given.
    """
    for option in reversed(
        (
            click.option(
                "--camera-path",
                metavar="FILE",
                type=InputPath(),
                help="Cameras of a file, or of a folder that COLMAP wrote.",
            ),
            click.option(
                "--camera-format",
                type=click.Choice(["auto", *(form.name for form in FORMATS)]),
                help="What --camera-path is; auto tells it by its content.  [default: auto]",
            ),
            click.option(
                "--camera-axes",
                type=click.Choice([axes.value for axes in Axes]),
                help="What the matrices of --camera-path mean, if not what its format says:"
                " y up (opengl) or down (opencv), camera to world (c2w) or world to camera (w2c).",
            ),
            click.option(
                "--orbit",
                metavar="N",
                type=click.IntRange(1, 1 << 20),
                help=f"N cameras around the scene.  [default, without another source of cameras: {orbit}]",
            ),
            click.option("--dolly", is_flag=True, help="Straight towards the scene, from far to near."),
            click.option("--look-at", type=View(), help="One camera, as x,y,z:x,y,z."),
            click.option("--keyframes", type=Views(), help="Smoothly from view to view, each as in --look-at."),
            click.option(
                "--center", type=Numbers("x", "y", "z"), help="What --orbit and --dolly look at.  [default: the scene]"
            ),
            click.option(
                "--distance",
                metavar="D",
                type=Real(0, min_open=True),
                help="Distance of --orbit, and of the first camera of --dolly, from there, in world units."
                "  [default: where the scene fits the image; 4 times that]",
            ),
            click.option(
                "--elevation",
                metavar="DEGREES",
                type=Real(-89, 89),
                help=f"Of --orbit and --dolly above there.  [default: {DEFAULT_ELEVATION:g}]",
            ),
            click.option(
                "--up",
                type=Numbers("x", "y", "z"),
                help="Which way is up, for cameras of which only eye and target are known."
                "  [default: 0,-1,0, since y is down in scenes as training leaves them; 0,1,0 in SuperSplat's files]",
            ),
            click.option(
                "--seconds",
                metavar="S",
                type=Real(0, 1e6, min_open=True),
                help="Duration of --dolly, and of --keyframes from key to key.  [default: 2]",
            ),
            click.option(
                "--world-transform",
                metavar="MATRIX",
                help="From the world of the cameras to that of the splats: 16 numbers with commas between, row by row,"
                " or a file of them.",
            ),
            click.option(
                "--size",
                type=Size(),
                help="Of the images; what is in view from top to bottom stays.  [default: the file's, or 1280x720]",
            ),
            click.option(
                "--fov",
                metavar="DEGREES",
                type=Real(0, 180, min_open=True, max_open=True),
                help="Vertical field of view.  [default: the file's, or 60]",
            ),
            click.option(
                "--fps",
                metavar="N",
                type=Real(0, 1e6, min_open=True),
                help="Frames a second.  [default: the file's times, or 30]",
            ),
            click.option(
                "--every",
                metavar="K",
                type=click.IntRange(1),
                default=DEFAULTS["every"],
                show_default=True,
                help="Every Kth camera only.",
            ),
        )
    ):
        command = option(command)
    return command


def cameras_from(settings: Mapping[str, Any], scene: Scene, *, orbit: int = DEFAULT_ORBIT) -> CameraPath:
    """The cameras that the options of `camera_options` ask for.

    Args:
        settings: what click gave the command, by the parameters' names; others are not looked at.
        scene: gives what the splats cover; called only where --orbit or --dolly need to know it.
        orbit: as for `camera_options`.

    Raises:
        click.UsageError: options contradict one another.
        CameraPathError: a file cannot be read, or a camera makes no sense; the text names the file.
    """
    source = _source(settings)
    if source == "orbit":
        settings = {**settings, "orbit": settings["orbit"] or orbit}
    for option, sources in ONLY_WITH.items():
        if settings[option] not in (None, DEFAULTS.get(option)) and source not in sources:
            names = " or ".join(SOURCES[name] for name in sources)
            raise click.UsageError(f"--{option.replace('_', '-')} only means something with {names}")

    from ..cameras.path import GENERATED, cameras_of

    how = _settings(settings)
    if source == "camera_path":
        return _read(settings["camera_path"], settings["camera_format"], how)
    try:
        return cameras_of(_generated(source, settings, how, scene), GENERATED[source], how)
    except TooManyCamerasError as error:
        raise click.UsageError(f"{SOURCES[source]}: {error}") from None


def _source(settings: Mapping[str, Any]) -> str:
    given = [name for name in SOURCES if settings[name]]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(SOURCES[name] for name in given)} cannot go together")
    return given[0] if given else "orbit"


def _settings(settings: Mapping[str, Any]) -> Settings:
    from ..cameras.frame import Settings

    axes, fov, world, up = (settings[name] for name in ("camera_axes", "fov", "world_transform", "up"))
    if up is not None and not any(up):
        raise click.UsageError("--up 0,0,0 is no direction")
    return Settings(
        axes=Axes(axes) if axes else None,
        world=None if world is None else _world(world),
        size=settings["size"],
        fov_y=None if fov is None else math.radians(fov),
        fps=settings["fps"],
        every=settings["every"],
        up=up,
    )


def _world(value: str) -> Matrix:
    """(4, 4) of the text of --world-transform, or of the file that it names."""
    from .. import io
    from ..cameras.world_transform import similarity

    if "," in value and not set(value) - NUMERIC:
        try:
            return similarity(value)
        except CameraPathError as error:
            raise click.UsageError(f"--world-transform {error}") from None
    try:
        return similarity(io.read_text(Path(value)))
    except CameraPathError as error:
        raise CameraPathError(f"{value}: --world-transform {error}") from None
    except SparklodError as error:
        raise CameraPathError(str(error)) from None


def _read(path: Path, form: str | None, how: Settings) -> CameraPath:
    from .. import io
    from ..cameras.formats.source import Files
    from ..cameras.path import read

    try:
        contents = io.read_together(path, NAMES, LARGEST)
    except SparklodError as error:
        raise CameraPathError(str(error)) from None
    try:
        return read(Files(path, contents), format=None if form in (None, "auto") else form, settings=how)
    except CameraPathError as error:
        raise CameraPathError(f"{path}: {error}") from None


def _generated(source: str, settings: Mapping[str, Any], how: Settings, scene: Scene) -> Parsed:
    from ..cameras import generators
    from ..cameras.formats.source import Parsed
    from ..cameras.frame import DEFAULT_FPS, DEFAULT_UP

    fps, up = how.fps or DEFAULT_FPS, how.up or DEFAULT_UP
    seconds = settings["seconds"] or generators.SECONDS
    if source == "look_at":
        eye, target = settings["look_at"]
        return Parsed([generators.frame_looking(eye, target, up)])
    if source == "keyframes":
        keys = [generators.Key(eye, target) for eye, target in settings["keyframes"]]
        return Parsed(generators.between(keys, fps, up, seconds=seconds))
    center, distance = settings["center"], settings["distance"]
    elevation = DEFAULT_ELEVATION if settings["elevation"] is None else settings["elevation"]
    tilt = math.radians(elevation)
    count = settings["orbit"] if source == "orbit" else max(2, round(seconds * fps))
    if center is None or distance is None:
        origin = (0.0, 0.0, 0.0)
        if source == "orbit":
            around = generators.orbit(count, origin, 1, tilt, up)
        else:
            around = generators.dolly(2, origin, 1, 1, tilt, up)
        center, fits = _place(around, center, scene(), how)
        distance = distance or (fits if source == "orbit" else generators.DOLLY_START * fits)
    if source == "orbit":
        return Parsed(generators.orbit(count, center, distance, tilt, up))
    return Parsed(generators.dolly(count, center, distance, distance / generators.DOLLY_ZOOM, tilt, up))


def _place(frames: Sequence[Frame], center: Any, scene: Balls, how: Settings) -> tuple[Any, float]:
    """What cameras of these directions look at, (3,), and how far from there they all have the scene in their pictures.

    Args:
        frames: at least one.
        center: (3,) where it is known; None for the middle of the scene.
        scene: all that the splats cover.
        how: what the user says.
    """
    import numpy as np

    from ..cameras.frame import camera_of
    from ..cameras.framing import covered, distance, middle_of, some

    kept = covered(scene)
    middle = middle_of(kept) if center is None else np.asarray(center, np.float64)
    try:
        cameras = [camera_of(frame.matrix, frame.lens, 0, "", how) for frame in some(frames)]
    except ValueError as error:
        raise CameraPathError(f"the camera {error}") from None
    return middle, distance(cameras, middle, kept)
