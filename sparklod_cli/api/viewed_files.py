"""Splat files and the cameras that look at them, as the whole-file jobs take them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.frame import Point, direction_of
from ..cameras.framing import reach
from ..model.splats import COLUMNS
from ..scenes.pages import TRAVERSED
from ..scenes.reading import read_scenes
from ..support.progress import Progress, silent

if TYPE_CHECKING:
    from ..cameras.frame import Settings
    from ..cameras.path import CameraPath
    from ..cameras.sources import CameraSource
    from ..model.instances import Instance
    from ..render.settings import RenderSettings
    from ..scenes.loaded import Scenes


@dataclass(frozen=True)
class ViewedFiles:
    """Splat files, and the cameras that look at them.

    Attributes:
        instances: at least one.
        cameras: the source of the cameras.
        settings: override those of a camera file.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        threads: to work on.
        progress: called with how much is done.
    """

    instances: Sequence[Instance]
    cameras: CameraSource
    settings: Settings
    precision: str
    threads: int
    progress: Progress = silent

    def read(
        self, *, trees_only: bool = False, through: str | None = None, plain: bool = True, paged: bool = False
    ) -> Scenes:
        """The scenes, with all columns if `plain`; as cuts need them if `paged`."""
        return read_scenes(
            self.instances,
            columns=COLUMNS if plain else TRAVERSED,
            trees_only=trees_only,
            through=through,
            precision=self.precision,
            paged=paged,
            threads=self.threads,
            progress=self.progress,
        )

    def path(self, scenes: Callable[[], Scenes]) -> CameraPath:
        """The cameras; scenes are read only where cameras are chosen for them, or need their up axis."""
        settings = dataclasses.replace(self.settings, up_of_scene=lambda: self._up_of(scenes()))
        return self.cameras.cameras(settings, lambda: scenes().balls())

    def _up_of(self, scenes: Scenes) -> Point:
        """Up axis of the scenes, in the world of the cameras."""
        up = direction_of(scenes.up)
        if scenes.up is None or self.settings.world is None:
            return up
        x, y, z = (np.asarray(up) @ self.settings.world[:3, :3]).tolist()  # the inverse rotation, of any length
        return x, y, z

    def with_planes(self, render: RenderSettings, path: CameraPath, scenes: Callable[[], Scenes]) -> RenderSettings:
        """Settings whose near and far planes enclose the scenes, where the cameras are chosen for them."""
        if not self.cameras.fits_scene:
            return render
        near, far = reach(render.raster.near, render.raster.far, path.cameras, scenes().balls())
        return dataclasses.replace(render, raster=dataclasses.replace(render.raster, near=near, far=far))
