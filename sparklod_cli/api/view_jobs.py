"""The jobs of `render` and `traverse`: pictures and tables of scenes, written to files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from ..system.progress import Progress, silent
from ..viewers.scenes import CutFinder

if TYPE_CHECKING:
    from ..cameras.sources import CameraPath
    from ..images.picture_files import PictureOutput
    from ..images.sequence import PictureSettings, WrittenPictures
    from ..lod.budget import Budget
    from ..render.render_settings import RenderSettings
    from ..simulation.results import FrameOutputs, Summary
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Filter, Row
    from ..viewers.scenes import Scenes
    from ..viewers.viewer_settings import LodSettings, StreamingSettings


def draw_files(
    scenes: Scenes,
    cameras: CameraPath,
    budget: Budget | None,
    lod: LodSettings,
    render: RenderSettings,
    output: PictureOutput,
    written: PictureSettings,
    *,
    loading: tuple[StreamingSettings, float] | None = None,
    reference: Callable[[], Scenes] | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> WrittenPictures:
    """Draw scenes and write the pictures.

    Args:
        budget: of the cuts; None draws full detail.
        loading: how chunks get to the viewer, and the seconds since a visitor opened the page in front of each camera;
            None where every chunk is resident.
        reference: the scenes whose pictures are subtracted from these.
    """
    from ..images.sequence import write_pictures

    settings = None if budget is None else dataclasses.replace(lod, budget=scenes.splats_of(budget))
    if loading is not None and settings is not None and scenes.with_cuts:
        from ..simulation.frames import Loader

        source: CutFinder = Loader(scenes, settings, *loading)
    else:
        source = CutFinder(scenes, settings)
    other = None
    if reference is not None:
        compared = reference()
        cuts = None if budget is None else dataclasses.replace(lod, budget=compared.splats_of(budget))
        other = CutFinder(compared, cuts)
    return write_pictures(
        source, cameras, output, render, written, reference=other, overwrite=overwrite, progress=progress
    )


def traverse_files(
    scenes: Scenes,
    cameras: CameraPath,
    budget: Budget,
    lod: LodSettings,
    streaming: StreamingSettings,
    outputs: FrameOutputs,
    *,
    by_instance: bool = False,
    asserts: Sequence[Assertion] = (),
    passed: Filter | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> tuple[Summary, list[Outcome], float, str | None]:
    """Simulate what a viewer draws of scenes along a path, and write tables and charts of the frames.

    Args:
        by_instance: make rows of single instances, too.

    Returns:
        the summary of the frames, the outcomes of `asserts`, and what `simulation.frames.write_frames` returns besides.
    """
    from ..simulation.frames import Simulation, write_frames
    from ..simulation.results import EMPTY, LOADING, summarize

    settings = dataclasses.replace(lod, budget=scenes.splats_of(budget))
    simulation = Simulation(scenes, settings, streaming)
    if outputs.indices is not None:
        outputs.check_frames(cameras.numbers, len(scenes.instances))
    loading = None
    if not streaming.network.instant:
        from ..simulation.frames import Loader

        loading = Loader(scenes, settings, streaming).load(cameras.cameras[0])
    rows, in_front, note = write_frames(
        simulation, cameras, outputs, by_instance=by_instance, threads=threads, progress=progress, passed=passed
    )
    outcomes: list[Outcome] = []
    if asserts:
        from ..tables.assertions import check

        nothing: Row = dict.fromkeys(column.name for column in LOADING)
        asserted = [row | (loading or nothing if not at else nothing) for at, row in enumerate(rows)]
        outcomes = check(asserts, asserted, empty=EMPTY)
    return summarize(rows, loading), outcomes, in_front, note
