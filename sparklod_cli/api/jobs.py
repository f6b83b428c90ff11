"""Whole-file jobs of the commands: pictures, comparisons and traversals of files, from reading to writing.

Each reads files and cameras, asks its caller for the outputs as early as possible, and does the work.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.frame import Point, direction_of
from ..cameras.framing import reach
from ..model.instances import instances_of
from ..model.splats import COLUMNS
from ..scenes.finder import CutFinder, CutSource
from ..scenes.loaded_scene import TRAVERSED
from ..scenes.reading import read_scenes
from ..system.output import check_writable, write_file
from ..system.progress import Progress, silent
from ..system.threads import on_threads

if TYPE_CHECKING:
    from ..cameras.frame import Settings
    from ..cameras.sources import CameraPath, CameraSource
    from ..images.output import PictureOutput
    from ..images.sequence import PictureSettings, WrittenPictures
    from ..lod.budget import Budget
    from ..lod.settings import LodSettings
    from ..model.instances import Instance
    from ..render.settings import RenderSettings
    from ..scenes.loaded import Scenes
    from ..simulation.results import FrameOutputs, Summary, WrittenFrames
    from ..simulation.streaming_settings import StreamingSettings
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Filter, Row, TableOutput
    from ..tables.comparison import BudgetSummary


@dataclass(frozen=True)
class ViewedFiles:
    """Splat files, and the cameras that look at them.

    Attributes:
        instances: at least one.
        cameras: the source of the cameras.
        settings: override those of a camera file.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
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
        """Return the scenes, with all columns if `plain`; as cuts need them if `paged`."""
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
        """Return the cameras; scenes are read only where cameras are chosen for them, or need their up axis."""
        settings = dataclasses.replace(self.settings, up_of_scene=lambda: self._up_of(scenes()))
        return self.cameras.cameras(settings, lambda: scenes().balls())

    def _up_of(self, scenes: Scenes) -> Point:
        up = direction_of(scenes.up)
        if scenes.up is None or self.settings.world is None:
            return up
        x, y, z = (np.asarray(up) @ self.settings.world[:3, :3]).tolist()  # the inverse rotation, of any length
        return x, y, z

    def with_planes(self, render: RenderSettings, path: CameraPath, scenes: Callable[[], Scenes]) -> RenderSettings:
        """Return settings whose near and far planes enclose the scenes, where the cameras are chosen for them."""
        if not self.cameras.fits_scene:
            return render
        near, far = reach(render.raster.near, render.raster.far, path.cameras, scenes().balls())
        return dataclasses.replace(render, raster=dataclasses.replace(render.raster, near=near, far=far))


#: Colours whose scale spans the numbers that cameras see, rather than all numbers of the scenes.
COLORS_OF_CUTS = ("level", "chunk", "overdraw")


class UnfitError(ValueError):
    """Error for settings that do not fit the scenes: a budget, or a chunk cache, too small for their roots."""


@dataclass(frozen=True)
class DrawnPath:
    """Result of rendering a camera path."""

    pictures: WrittenPictures
    path: CameraPath
    output: PictureOutput
    render: RenderSettings


def draw_files(
    files: ViewedFiles,
    budget: Budget | None,
    lod: LodSettings,
    render: RenderSettings,
    place: Callable[[CameraPath], tuple[PictureOutput, PictureSettings]],
    *,
    fit_planes: bool,
    through: str | None = None,
    loading: tuple[StreamingSettings, float] | None = None,
    reference: Path | None = None,
    overwrite: bool = False,
    ready: Callable[[CameraPath, Scenes], None],
) -> DrawnPath:
    """Draw files and write the pictures.

    Args:
        budget: of the cuts; None draws full detail.
        place: returns the output of the pictures of some cameras; called before a file is read if the cameras do not
            depend on one.
        through: one of `formats.ROUND_TRIPS`, after which splats are drawn.
        loading: how chunks get to the viewer, and and the seconds since a visitor opened the page in front of
            each camera; None where every chunk is resident.
        reference: the file whose pictures are subtracted from these.
        ready: called with the cameras and the scenes before the first picture is drawn.

    Raises:
        UnfitError: the budget is too small for the roots.
        SparklodError: a file cannot be read or written, or a picture cannot be drawn.
    """
    from ..images.sequence import write_pictures

    # What looks at more than cuts is read whole.
    paged = budget is not None and lod.continuous is None and render.color_by in (None, *COLORS_OF_CUTS)
    scenes = functools.cache(lambda: files.read(through=through, paged=paged))
    path = files.path(scenes)
    if fit_planes:
        render = files.with_planes(render, path, scenes)
    output, settings = place(path)
    ready(path, scenes())
    other = None
    source = _source(scenes(), budget, lod, loading)
    if reference is not None:
        plain = dataclasses.replace(files, instances=instances_of([reference]))
        other = _source(plain.read(), budget, lod)
    pictures = write_pictures(
        source, path, output, render, settings, reference=other, overwrite=overwrite, progress=files.progress
    )
    return DrawnPath(pictures, path, output, render)


def _source(
    scenes: Scenes, budget: Budget | None, lod: LodSettings, loading: tuple[StreamingSettings, float] | None = None
) -> CutSource:
    settings = None if budget is None else dataclasses.replace(lod, budget=scenes.splats_of(budget))
    try:
        if loading is None or settings is None or not scenes.with_cuts:
            return CutFinder(scenes, settings)
        from ..simulation.frames import LoadingCuts

        return LoadingCuts(scenes, settings, *loading)
    except ValueError as error:
        raise UnfitError(str(error)) from None


@dataclass(frozen=True)
class Compared:
    """Result of a comparison.

    Attributes:
        pictures: how many were compared.
        leaves: splats of full detail, all instances together.
    """

    pictures: int
    path: CameraPath
    leaves: int
    summary: list[BudgetSummary]
    outcomes: list[Outcome]


@dataclass(frozen=True)
class Traversed:
    """Result of a traversal."""

    frames: WrittenFrames
    path: CameraPath
    summary: Summary
    outcomes: list[Outcome]


def compare_files(
    files: ViewedFiles,
    budgets: Sequence[Budget],
    lod: LodSettings,
    render: RenderSettings,
    table: TableOutput,
    *,
    fit_planes: bool,
    asserts: Sequence[tuple[int | None, Assertion]] = (),
    plot: Path | None = None,
    overwrite: bool = False,
    ready: Callable[[CameraPath, Scenes], None],
    passed: Filter | None = None,
) -> Compared:
    """Measure how far cuts of files are from full detail, and write the table and the charts.

    Args:
        table: where the rows go, at once when all are known.
        asserts: assertions, each with the index of its budget; None for all budgets.
        passed: what the bytes of the table are passed through on their way to standard output.

    Raises:
        UnfitError: there are both trees and Streamed SOG, or too many instances.
        SparklodError: a file cannot be read or written, has no levels, or a picture cannot be drawn.
    """
    from ..tables.assertions import check
    from ..tables.comparison import EMPTY, rows_by_budget, summarize
    from .views import Comparison

    table.check()
    if plot is not None:
        from ..figures.charts import load_matplotlib

        check_writable(plot, overwrite=overwrite)
        load_matplotlib()
    scenes = files.read(trees_only=True)
    path = files.path(lambda: scenes)
    if fit_planes:
        render = files.with_planes(render, path, lambda: scenes)
    ready(path, scenes)
    with on_threads(files.threads):
        try:
            comparison = Comparison(scenes, lod, budgets, render)
        except ValueError as error:
            raise UnfitError(str(error)) from None
        rows = list(comparison.run(path, threads=files.threads, progress=files.progress))
    table.write(rows, passed=passed)
    groups = rows_by_budget(rows, len(budgets))
    if plot is not None:
        from ..figures.charts import plot_comparison as chart

        series = list(zip((budget.text for budget in budgets), groups, strict=True))
        write_file(plot, [chart(series, scenes.title)], overwrite=overwrite)
    outcomes = [each for at, what in asserts for each in check([what], rows if at is None else groups[at], empty=EMPTY)]
    summary = summarize(rows, [budget.text for budget in budgets])
    return Compared(len(rows), path, comparison.leaves, summary, outcomes)


def traverse_files(
    files: ViewedFiles,
    budget: Budget,
    lod: LodSettings,
    streaming: StreamingSettings,
    outputs: FrameOutputs,
    *,
    by_instance: bool = False,
    asserts: Sequence[Assertion] = (),
    ready: Callable[[CameraPath, Scenes], None],
    passed: Filter | None = None,
    bar: bool = True,
) -> Traversed:
    """Simulate what a viewer draws of files along a path, and write tables and charts of the frames.

    Args:
        by_instance: make rows of single instances, too.
        bar: report the number of frames done.

    Raises:
        UnfitError: the budget, or the chunk cache, is too small for the roots.
        SparklodError: a file cannot be read or written, or is no tree.
    """
    from ..simulation.frames import Loader, Simulation
    from ..simulation.results import EMPTY, LOADING, summarize, write_frames
    from ..tables.assertions import check

    outputs.check()
    scenes = files.read(trees_only=True, plain=outputs.plot is not None, paged=True)
    path = files.path(lambda: scenes)
    settings = dataclasses.replace(lod, budget=scenes.splats_of(budget))
    try:
        simulation = Simulation(scenes, settings, streaming, by_instance=by_instance)
    except ValueError as error:
        raise UnfitError(str(error)) from None
    ready(path, scenes)
    outputs.check_frames(path.numbers, len(files.instances))
    progress = files.progress if bar else silent
    loading = None if streaming.network.instant else Loader(scenes, settings, streaming).load(path.cameras[0])
    frames = write_frames(simulation, path, outputs, threads=files.threads, progress=progress, passed=passed)
    nothing: Row = dict.fromkeys(column.name for column in LOADING)
    asserted = [row | (loading or nothing if not at else nothing) for at, row in enumerate(frames.rows)]
    return Traversed(frames, path, summarize(frames.rows, loading), check(asserts, asserted, empty=EMPTY))
