"""Work of `render` and `traverse`: pictures and tables of scenes, written to files."""

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
        loading: network and cache of the viewer, and the seconds since a visitor opened the page in front of each
            camera; None if every chunk is resident.
        reference: returns the scenes whose pictures are subtracted from these.
    """
    from ..images.sequence import write_pictures

    def settings_of(drawn: Scenes) -> LodSettings | None:
        return None if budget is None else dataclasses.replace(lod, budget=drawn.splats_of(budget))

    settings = settings_of(scenes)
    if loading is not None and settings is not None and scenes.with_cuts:
        from ..simulation.frames import Loader

        source: CutFinder = Loader(scenes, settings, *loading)
    else:
        source = CutFinder(scenes, settings)
    compared = None if reference is None else reference()
    other = None if compared is None else CutFinder(compared, settings_of(compared))
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
    """Simulate the frames that a viewer draws along a path, and write tables and charts of them.

    Args:
        by_instance: make rows of single instances, too.

    Returns:
        summary of the frames; outcomes of `asserts`; mean share of the drawn splats in front of the camera; and why the
        charts have no picture of the path.
    """
    from ..simulation.frames import Loader, Simulation, write_frames
    from ..simulation.results import EMPTY, LOADING, summarize

    settings = dataclasses.replace(lod, budget=scenes.splats_of(budget))
    simulation = Simulation(scenes, settings, streaming)
    if outputs.indices is not None:
        outputs.check_frames(cameras.numbers, len(scenes.instances))
    instant = streaming.network.instant
    loading = None if instant else Loader(scenes, settings, streaming).load(cameras.cameras[0])
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
