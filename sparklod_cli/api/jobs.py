"""Whole-file jobs of the commands: pictures, comparisons and traversals of files, from reading to writing.

The outputs are checked before, so that no work is lost.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.frame import Point, direction_of
from ..cameras.framing import reach
from ..model.instances import instances_of
from ..model.splats import COLUMNS
from ..system.progress import Progress, silent
from ..viewers.loaded_scene import TRAVERSED
from ..viewers.read_scenes import read_scenes
from ..viewers.scenes import CutFinder

if TYPE_CHECKING:
    from ..cameras.frame import Settings
    from ..cameras.sources import CameraPath, CameraSource
    from ..images.output import PictureOutput
    from ..images.sequence import PictureSettings, WrittenPictures
    from ..lod.budget import Budget
    from ..model.instances import Instance
    from ..render.settings import RenderSettings
    from ..simulation.frames import WrittenFrames
    from ..simulation.results import FrameOutputs, Summary
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Filter, Row
    from ..viewers.scenes import Scenes
    from ..viewers.viewer_settings import LodSettings, StreamingSettings


@dataclass(frozen=True)
class ViewedFiles:
    """Splat files, and the cameras that look at them; both are read when they are first needed.

    Attributes:
        instances: at least one.
        cameras: the source of the cameras.
        settings: override those of a camera file.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        trees_only: refuse files without a tree or detail levels.
        through: one of `formats.ROUND_TRIPS`, after which splats are drawn.
        plain: read all columns of splats.
        paged: read splats as cuts need them.
    """

    instances: Sequence[Instance]
    cameras: CameraSource
    settings: Settings
    precision: str
    threads: int
    progress: Progress = silent
    trees_only: bool = False
    through: str | None = None
    plain: bool = True
    paged: bool = False

    @functools.cached_property
    def scenes(self) -> Scenes:
        return read_scenes(
            self.instances,
            columns=COLUMNS if self.plain else TRAVERSED,
            trees_only=self.trees_only,
            through=self.through,
            precision=self.precision,
            paged=self.paged,
            threads=self.threads,
            progress=self.progress,
        )

    @functools.cached_property
    def path(self) -> CameraPath:
        """The cameras; scenes are read only where cameras are chosen for them, or need their up axis."""
        settings = dataclasses.replace(self.settings, up_of_scene=self._up)
        return self.cameras.cameras(settings, lambda: self.scenes.balls())

    def _up(self) -> Point:
        up = direction_of(self.scenes.up)
        if self.scenes.up is None or self.settings.world is None:
            return up
        x, y, z = (np.asarray(up) @ self.settings.world[:3, :3]).tolist()  # the inverse rotation, of any length
        return x, y, z

    def with_planes(self, render: RenderSettings) -> RenderSettings:
        """Return settings whose near and far planes enclose the scenes, where the cameras are chosen for them."""
        if not self.cameras.fits_scene:
            return render
        near, far = reach(render.raster.near, render.raster.far, self.path.cameras, self.scenes.balls())
        return dataclasses.replace(render, raster=dataclasses.replace(render.raster, near=near, far=far))


class UnfitError(ValueError):
    """Error for settings that do not fit the scenes: a budget, or a chunk cache, too small for their roots."""


def draw_files(
    files: ViewedFiles,
    budget: Budget | None,
    lod: LodSettings,
    render: RenderSettings,
    output: PictureOutput,
    settings: PictureSettings,
    *,
    loading: tuple[StreamingSettings, float] | None = None,
    reference: Path | None = None,
    overwrite: bool = False,
) -> WrittenPictures:
    """Draw files and write the pictures.

    Args:
        budget: of the cuts; None draws full detail.
        loading: how chunks get to the viewer, and the seconds since a visitor opened the page in front of each camera;
            None where every chunk is resident.
        reference: the file whose pictures are subtracted from these.

    Raises:
        UnfitError: the budget is too small for the roots.
        SparklodError: a file cannot be read or written, or a picture cannot be drawn.
    """
    from ..images.sequence import write_pictures

    source, other = _source(files.scenes, budget, lod, loading), None
    if reference is not None:
        plain = dataclasses.replace(files, instances=instances_of([reference]), through=None, paged=False)
        other = _source(plain.scenes, budget, lod)
    return write_pictures(
        source, files.path, output, render, settings, reference=other, overwrite=overwrite, progress=files.progress
    )


def _source(
    scenes: Scenes, budget: Budget | None, lod: LodSettings, loading: tuple[StreamingSettings, float] | None = None
) -> CutFinder:
    settings = None if budget is None else dataclasses.replace(lod, budget=scenes.splats_of(budget))
    try:
        if loading is None or settings is None or not scenes.with_cuts:
            return CutFinder(scenes, settings)
        from ..simulation.loading import Loader

        return Loader(scenes, settings, *loading)
    except ValueError as error:
        raise UnfitError(str(error)) from None


def traverse_files(
    files: ViewedFiles,
    budget: Budget,
    lod: LodSettings,
    streaming: StreamingSettings,
    outputs: FrameOutputs,
    *,
    by_instance: bool = False,
    asserts: Sequence[Assertion] = (),
    passed: Filter | None = None,
    bar: bool = True,
) -> tuple[WrittenFrames, Summary, list[Outcome]]:
    """Simulate what a viewer draws of files along a path, and write tables and charts of the frames.

    Args:
        by_instance: make rows of single instances, too.
        bar: report the number of frames done.

    Returns:
        the frames written, their summary, and the outcomes of `asserts`.

    Raises:
        UnfitError: the budget, or the chunk cache, is too small for the roots.
        SparklodError: a file cannot be read or written, or is no tree.
    """
    from ..simulation.frames import Simulation, write_frames
    from ..simulation.results import EMPTY, LOADING, summarize

    scenes, path = files.scenes, files.path
    settings = dataclasses.replace(lod, budget=scenes.splats_of(budget))
    try:
        simulation = Simulation(scenes, settings, streaming)
    except ValueError as error:
        raise UnfitError(str(error)) from None
    if outputs.indices is not None:
        outputs.check_frames(path.numbers, len(files.instances))
    progress = files.progress if bar else silent
    loading = None
    if not streaming.network.instant:
        from ..simulation.loading import Loader

        loading = Loader(scenes, settings, streaming).load(path.cameras[0])
    frames = write_frames(
        simulation,
        path,
        outputs,
        by_instance=by_instance,
        threads=files.threads,
        progress=progress,
        passed=passed,
    )
    outcomes: list[Outcome] = []
    if asserts:
        from ..tables.assertions import check

        nothing: Row = dict.fromkeys(column.name for column in LOADING)
        asserted = [row | (loading or nothing if not at else nothing) for at, row in enumerate(frames.rows)]
        outcomes = check(asserts, asserted, empty=EMPTY)
    return frames, summarize(frames.rows, loading), outcomes
