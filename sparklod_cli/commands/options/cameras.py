"""Options of the cameras that look at a scene: their source, and settings that override those of their file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ...cameras import DEFAULT_SIZE, ELEVATION, ORBIT
from ...cameras.formats.table import FORMATS, Axes
from ...system.errors import CameraPathError, TooManyCamerasError
from ...system.setting_fields import Range, setting, whole
from ..command import COMMON, POINT, SIZE, VIEW, VIEWS, flag, flag_of, is_set, refuse
from ..paths import InputPath, file_of
from .common import up_option

if TYPE_CHECKING:
    from ...cameras.camera import Matrix
    from ...cameras.frame import Settings
    from ...cameras.sources import CameraSource
    from ...scenes.loaded import Scenes

#: The options that are each a source of cameras, of which one can be given.
SOURCES = ("camera_path", "orbit", "dolly", "look_at", "keyframes", "views")

#: Sources that are paths: their cameras follow each other in time.
PATHS = ("camera_path", "orbit", "dolly", "keyframes")

#: Name of the default source: cameras around the scene.
AROUND = "around"

#: Sources with which these options have an effect, AROUND among them.
ONLY_WITH = {
    "camera_format": ("camera_path",),
    "camera_axes": ("camera_path",),
    "center": ("orbit", "dolly", AROUND),
    "distance": ("orbit", "dolly", AROUND),
    "elevation": ("orbit", "dolly", AROUND),
    "seconds": ("orbit", "dolly", "keyframes", AROUND),
    "world_transform": ("camera_path", "look_at", "views", "keyframes"),
}

#: Characters of a --world-transform given as numbers; any other text names a file.
NUMERIC = set("0123456789+-.,eE ")

#: Durations in seconds, and frames per second.
SECONDS, RATE = Range(above=0, most=1e6, unit="S"), Range(above=0, most=1e6, unit="N")


def _orbit_option(default: str) -> Any:
    help = f"Place N cameras around the scene.  [default, without any source of cameras: {default}]"
    return setting(help, whole(1, 1 << 20), heading=COMMON)


@dataclass(frozen=True)
class Cameras:
    """Values of the options of cameras; None for those not given."""

    HEADING: ClassVar[str] = "Cameras"

    camera_path: Path | None = setting(
        "Read the cameras from a file, or from a folder written by COLMAP.", InputPath(), heading=COMMON
    )
    orbit: int | None = _orbit_option(f"an orbit of {ORBIT}")
    look_at: Any = setting("Place one camera at EYE that looks at TARGET, each x,y,z.", VIEW, heading=COMMON)
    size: tuple[int, int] | None = setting(
        "Width and height of the images, in pixels; the vertical field of view is kept."
        f"  [default: the file's, or {DEFAULT_SIZE[0]}x{DEFAULT_SIZE[1]}]",
        SIZE,
        heading=COMMON,
    )
    dolly: bool = flag("Move the camera straight towards the scene, from far to near.")
    keyframes: Any = setting(
        "Move the camera smoothly through two or more views, separated by spaces or semicolons.", VIEWS
    )
    camera_format: str | None = setting(
        f"Format of --camera-path: {', '.join(form.name for form in FORMATS)}, or auto, which recognises it by its"
        " content.  [default: auto]",
        ("auto", *(form.name for form in FORMATS)),
        metavar="FORMAT",
    )
    camera_axes: str | None = setting(
        "Axes of the matrices of --camera-path: y up (opengl) or down (opencv), camera to world (c2w) or world to"
        " camera (w2c).  [default: those of its format]",
        tuple(axes.value for axes in Axes),
    )
    center: tuple[float, ...] | None = setting(
        "Point that --orbit and --dolly look at.  [default: the middle of the scene]", POINT
    )
    distance: float | None = setting(
        "Distance from that point, in world units: of --orbit, and of the first camera of --dolly."
        "  [default: where the scene fits the image; 4 times that with --dolly]",
        Range(above=0, unit="D"),
    )
    elevation: float | None = setting(
        f"Angle of --orbit and --dolly above that point, in degrees.  [default: {ELEVATION:g}]",
        Range(-89, 89, unit="DEGREES"),
    )
    up: tuple[float, float, float] | None = up_option(
        " For cameras of which only eye and target are known.", "; y in SuperSplat's camera files"
    )
    world_transform: str | None = setting(
        "Transform from the world of the cameras to that of the splats: 16 numbers with commas between, row by row, or"
        " a file of them.",
        metavar="MATRIX",
    )
    fov: float | None = setting(
        "Vertical field of view, in degrees.  [default: the file's, or 60]",
        Range(above=0, below=180, unit="DEGREES"),
    )
    seconds: float | None = setting(
        "Duration of --orbit, of --dolly, and of --keyframes from one view to the next, in seconds.  [default: 2; of"
        " --orbit, N frames at --fps]",
        SECONDS,
    )
    fps: float | None = setting(
        "Frames per second of the path; times are counted by it.  [default: the file's times, or 30]", RATE
    )
    every: int = setting("Take every K-th camera of the path.", whole(1, unit="K"), 1)

    #: Without a source there is one camera that sees the whole scene, in place of an orbit.
    still: ClassVar[bool] = False

    @property
    def source(self) -> str:
        """The source of cameras: one of `SOURCES`, or `AROUND`."""
        return next((name for name in SOURCES if getattr(self, name, None)), AROUND)

    def axis_notes(self, scenes: Scenes) -> list[str]:
        """Return the notes on the axes of splat files, if cameras are upright by these."""
        return scenes.axis_notes if self.up is None and self.camera_path is None else []

    @property
    def all_views(self) -> tuple[Any, ...]:
        return ()

    def check(self, ctx: click.Context) -> None:
        sources = [flag_of(ctx, name) for name in SOURCES if getattr(self, name, None)]
        if len(sources) > 1:
            raise click.UsageError(f"{' and '.join(sources)} cannot be used together; give one source of cameras")
        for name, known in ONLY_WITH.items():
            if is_set(ctx, name) and self.source not in known:
                named = [flag_of(ctx, each) for each in known if each in ctx.params]
                refuse(ctx, [name], f"can only be used with {' or '.join(named)}")
        if self.source not in PATHS and not self._orbits:
            still = "cannot be used with a camera that does not move; give a path, such as --orbit"
            refuse(ctx, ("fps", "every", "seconds"), still)
        if self._orbits and self.seconds is not None:
            refuse(ctx, ["fps"], "cannot be used with --seconds of an orbit, which decides it")
        if self.up is not None and not any(self.up):
            raise click.UsageError("--up 0,0,0 is no direction; give another one")

    @property
    def _orbits(self) -> bool:
        return self.orbit is not None or (self.source == AROUND and not self.still)

    def least_count(self) -> int:
        """Return the least number of cameras known before a file is read."""
        if self.all_views:
            return len(self.all_views)
        if self.dolly or self.keyframes:
            return 2 if self.every == 1 else 1
        return -(-(self.orbit or 1) // self.every)

    def files(self) -> list[Path]:
        """Return the file that --world-transform names, if any."""
        matrix = self.world_transform and file_of(self.world_transform)
        return [matrix] if matrix else []

    def camera_source(self) -> CameraSource:
        """Return the source of the cameras, for the library."""
        from ...cameras import generators, sources

        elevation = ELEVATION if self.elevation is None else self.elevation
        seconds = self.seconds or generators.SECONDS
        if self.camera_path is not None:
            return sources.CameraFile(
                self.camera_path, None if self.camera_format in (None, "auto") else self.camera_format
            )
        if self.all_views or self.look_at:
            return sources.SingleViews(self.all_views or (self.look_at,), named=bool(self.all_views))
        if self.keyframes:
            return sources.Keyframes(self.keyframes, seconds)
        if self.dolly:
            return sources.Dolly(seconds, self.center, self.distance, elevation)
        if self.orbit is None and self.still and self.center is None and self.distance is None:
            return sources.WholeScene(elevation)
        return sources.Orbit(self.orbit or (1 if self.still else ORBIT), self.center, self.distance, elevation)

    def settings(self) -> Settings:
        """Return settings that override those of a camera file.

        Raises:
            CameraPathError: its file holds no transform; names the file.
        """
        from ...cameras.frame import Settings

        fps = (self.orbit or ORBIT) / self.seconds if self._orbits and self.seconds is not None else self.fps
        return Settings(
            axes=Axes(self.camera_axes) if self.camera_axes else None,
            world=None if self.world_transform is None else _world(self.world_transform),
            size=self.size,
            fov_y=None if self.fov is None else math.radians(self.fov),
            fps=fps,
            every=self.every,
            up=self.up,
        )

    @contextlib.contextmanager
    def usage_errors(self) -> Iterator[None]:
        """Turn errors about values of options into usage errors; that of too many cameras names the option."""
        from ...api.jobs import UnfitError

        try:
            yield
        except UnfitError as error:
            raise click.UsageError(str(error)) from None
        except TooManyCamerasError as error:
            if self.camera_path is not None:
                raise
            flag = "--orbit" if self.source == AROUND else f"--{self.source.replace('_', '-')}"
            raise click.UsageError(f"{flag}: {error}") from None


@dataclass(frozen=True)
class PictureCameras(Cameras):
    """Options of the cameras of pictures: without a source there is one camera, and there is `--view`."""

    orbit: int | None = _orbit_option("one camera that sees the whole scene")
    views: tuple[Any, ...] = setting(
        "Place a camera as --look-at does; several --view make a contact sheet.",
        VIEW,
        flags=("--view",),
        multiple=True,
    )

    still: ClassVar[bool] = True

    @property
    def all_views(self) -> tuple[Any, ...]:
        return self.views


def _world(value: str) -> Matrix:
    """Return the (4, 4) matrix of --world-transform, which is a text of numbers or names a file."""
    from ...cameras.sources import read_world_transform, similarity

    if "," in value and not set(value) - NUMERIC:
        try:
            return similarity(value)
        except CameraPathError as error:
            raise click.UsageError(f"--world-transform {error}") from None
    return read_world_transform(Path(value))
