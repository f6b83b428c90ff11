"""The cameras that look at a scene: their source, and settings that override those of their file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import click

from ...cameras.axes import Axes
from ...cameras.defaults import ELEVATION, ORBIT
from ...support.errors import CameraPathError, TooManyCamerasError
from ..paths import file_of
from ..usage import flag_of, is_given, refuse

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
    "seconds": ("orbit", "dolly", "keyframes", AROUND),
    "world_transform": ("camera_path", "look_at", "views", "keyframes"),
}

#: Options that say which frames a path has.
OF_PATHS = ("fps", "every")

#: Characters of a --world-transform given as numbers; any other text names a file.
NUMERIC = set("0123456789+-.,eE ")


@dataclass(frozen=True)
class Cameras:
    """The values of the options of `camera_options.camera_options`; None for those not given.

    Attributes:
        camera_path, orbit, dolly, look_at, keyframes: sources of cameras.
        camera_format, camera_axes: of `camera_path`.
        center, distance, elevation: of orbits and dollies, world units and degrees.
        up: x, y and z.
        seconds: of orbits, of dollies and between keyframes.
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
        if self.source not in PATHS and not self._orbits:
            refuse(
                ctx,
                (*OF_PATHS, "seconds"),
                "cannot be used with a camera that does not move; give a path, such as --orbit",
            )
        if self._orbits and self.seconds is not None:
            refuse(ctx, ["fps"], "cannot be used with --seconds of an orbit, which decides it")
        if self.up is not None and not any(self.up):
            raise click.UsageError("--up 0,0,0 is no direction; give another one")

    @property
    def _orbits(self) -> bool:
        """Whether the cameras go around the scene."""
        return self.orbit is not None or (self.source == AROUND and not self.still)

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
