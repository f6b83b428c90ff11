"""The cameras that look at a scene: their source, and settings that override those of their file."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ...cameras.axes import Axes
from ...cameras.defaults import ELEVATION, ORBIT
from ...cameras.formats.table import FORMATS
from ...support.errors import CameraPathError, TooManyCamerasError
from ..command import COMMON, option
from ..paths import InputPath, file_of
from ..usage import flag_of, is_given, refuse
from .common import Command
from .types import Numbers, Real
from .views import Size, View, Views

if TYPE_CHECKING:
    from ...cameras.camera import Matrix
    from ...cameras.frame import Settings
    from ...cameras.sources import CameraSource

HEADING = "Cameras"

#: The options that are each a source of cameras, of which one can be given.
SOURCES = ("camera_path", "orbit", "dolly", "look_at", "keyframes", "views")

#: Sources that are paths: their cameras follow each other in time.
PATHS = ("camera_path", "orbit", "dolly", "keyframes")

#: Name of the default source: cameras around the scene.
AROUND = "around"

#: Options that only mean something with some sources, AROUND among them.
ONLY_WITH = {
    "camera_format": ("camera_path",),
    "camera_axes": ("camera_path",),
    "center": ("orbit", "dolly", AROUND),
    "distance": ("orbit", "dolly", AROUND),
    "elevation": ("orbit", "dolly", AROUND),
    "seconds": ("dolly", "keyframes"),
    "world_transform": ("camera_path", "look_at", "views", "keyframes"),
}

#: Options that say which frames a path has.
OF_PATHS = ("fps", "every")

#: Characters of a --world-transform given as numbers; any other text names a file.
NUMERIC = set("0123456789+-.,eE ")


@dataclass(frozen=True)
class Cameras:
    """The values of the options of `camera_options`; None for those not given.

    Attributes:
        camera_path, orbit, dolly, look_at, keyframes: sources of cameras.
        camera_format, camera_axes: of `camera_path`.
        center, distance, elevation: of orbits and dollies, world units and degrees.
        up: x, y and z.
        seconds: of dollies and between keyframes.
        world_transform: 16 numbers, or the name of a file of them.
        size: width and height, pixels.
        fov: vertical, degrees.
        fps: frames a second.
        every: only every so many cameras are taken.
    """

    camera_path: Path | None
    orbit: int | None
    dolly: bool
    look_at: Any
    keyframes: Any
    camera_format: str | None
    camera_axes: str | None
    center: tuple[float, ...] | None
    distance: float | None
    elevation: float | None
    up: tuple[float, float, float] | None
    seconds: float | None
    world_transform: str | None
    size: tuple[int, int] | None
    fov: float | None
    fps: float | None
    every: int

    #: Without a source there is one camera that sees the whole scene, in place of an orbit.
    still: ClassVar[bool] = False

    @property
    def source(self) -> str:
        """The source of cameras: one of `SOURCES`, or `AROUND`."""
        return next((name for name in SOURCES if getattr(self, name, None)), AROUND)

    @property
    def each_view(self) -> tuple[Any, ...]:
        """The views of `--view`."""
        return ()

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where options contradict each other, or have nothing to do."""
        sources = [flag_of(ctx, name) for name in SOURCES if getattr(self, name, None)]
        if len(sources) > 1:
            raise click.UsageError(f"{' and '.join(sources)} cannot be used together; give one source of cameras")
        for name, known in ONLY_WITH.items():
            if is_given(ctx, name) and self.source not in known:
                named = [flag_of(ctx, each) for each in known if each in ctx.params]
                refuse(ctx, [name], f"can only be used with {' or '.join(named)}")
        if self.source not in PATHS and (self.still or self.source != AROUND):
            refuse(ctx, OF_PATHS, "cannot be used with a camera that does not move; give a path, such as --orbit")
        if self.up is not None and not any(self.up):
            raise click.UsageError("--up 0,0,0 is no direction; give another one")

    def least_count(self) -> int:
        """The number of cameras, or the least number as far as it is known before a file is read."""
        if self.each_view:
            return len(self.each_view)
        if self.dolly or self.keyframes:
            return 2 if self.every == 1 else 1
        return -(-(self.orbit or 1) // self.every)

    def files(self) -> list[Path]:
        """The file that the text of --world-transform names, if it does."""
        matrix = self.world_transform and file_of(self.world_transform)
        return [matrix] if matrix else []

    def camera_source(self) -> CameraSource:
        """The source of the cameras, for the library."""
        from ...cameras import generators, sources

        elevation = ELEVATION if self.elevation is None else self.elevation
        seconds = self.seconds or generators.SECONDS
        if self.camera_path is not None:
            return sources.CameraFile(
                self.camera_path, None if self.camera_format in (None, "auto") else self.camera_format
            )
        if self.each_view or self.look_at:
            return sources.Views(self.each_view or (self.look_at,), named=bool(self.each_view))
        if self.keyframes:
            return sources.Keyframes(self.keyframes, seconds)
        if self.dolly:
            return sources.Dolly(seconds, self.center, self.distance, elevation)
        if self.orbit is None and self.still and self.center is None and self.distance is None:
            return sources.WholeScene(elevation)
        return sources.Orbit(self.orbit or (1 if self.still else ORBIT), self.center, self.distance, elevation)

    def settings(self) -> Settings:
        """Settings that override those of a camera file.

        Raises:
            click.UsageError: the numbers of --world-transform are no transform.
            CameraPathError: its file is none; names the file.
        """
        from ...cameras.frame import Settings

        return Settings(
            axes=Axes(self.camera_axes) if self.camera_axes else None,
            world=None if self.world_transform is None else _world(self.world_transform),
            size=self.size,
            fov_y=None if self.fov is None else math.radians(self.fov),
            fps=self.fps,
            every=self.every,
            up=self.up,
        )

    @contextlib.contextmanager
    def usage_errors(self) -> Iterator[None]:
        """Turns the error that an option asks for too many cameras into a usage error that names the option."""
        try:
            yield
        except TooManyCamerasError as error:
            if self.camera_path is not None:
                raise
            flag = "--orbit" if self.source == AROUND else f"--{self.source.replace('_', '-')}"
            raise click.UsageError(f"{flag}: {error}") from None


@dataclass(frozen=True)
class PictureCameras(Cameras):
    """The values of `camera_options` with `still`: without a source there is one camera, and there is `--view`."""

    views: tuple[Any, ...] = ()

    still: ClassVar[bool] = True

    @property
    def each_view(self) -> tuple[Any, ...]:
        return self.views


def _world(value: str) -> Matrix:
    """The (4, 4) matrix of --world-transform, which is a text of numbers or names a file."""
    from ...cameras.sources import read_world_transform
    from ...cameras.world_transform import similarity

    if "," in value and not set(value) - NUMERIC:
        try:
            return similarity(value)
        except CameraPathError as error:
            raise click.UsageError(f"--world-transform {error}") from None
    return read_world_transform(Path(value))


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
    for each in reversed(
        (
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
                type=Numbers("x", "y", "z"),
                help="Direction that is up, for cameras of which only eye and target are known."
                "  [default: 0,-1,0, as training leaves scenes with y down; 0,1,0 in SuperSplat's files]",
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
                help="Duration of --dolly, and of --keyframes from one view to the next, in seconds.  [default: 2]",
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
    ):
        command = each(command)
    return command
