"""Frames of scenes at several detail levels, with and without a network."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.model.instances import Instance
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.simulation.loading import Loader
from sparklod_cli.simulation.results import OF_TREES
from sparklod_cli.viewers.playcanvas import LoadedDetail
from sparklod_cli.viewers.scenes import CutFinder, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import DetailRule, LodSettings, Network, StreamingSettings
from tests.lod.details import row_of_regions
from tests.part_files import write_streamed
from tests.simulation.test_loading import cut_after

CUT = LodSettings(200)
SLOW = StreamingSettings(Network(20_000, 0.1))


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """Six regions along z at three levels; two of them share a chunk file."""
    manifest = write_streamed(tmp_path_factory.mktemp("row"), row_of_regions(environment=5))
    return read_scenes([Instance(manifest, "row")])


def flight(frames: int = 12, seconds: float = 6.0) -> CameraPath:
    """Along the row, from its beginning to its end."""
    cameras = tuple(
        Camera.look_at([0, 0, z], [0, 0, 40], size=(64, 48), time=time)
        for z, time in zip(np.linspace(-6, 16, frames), np.linspace(0, seconds, frames), strict=True)
    )
    return CameraPath(cameras, "flight", (), tuple(range(frames)))


def rows_of(
    scenes: Scenes, path: CameraPath, streaming: StreamingSettings | None = None, cut: LodSettings = CUT
) -> list[Any]:
    return [frame.rows[0] for frame in Simulation(scenes, cut, streaming).run(path, by_instance=True)]


def loaded(scenes: Scenes) -> LoadedDetail:
    (found,) = scenes.with_cuts
    assert isinstance(found, LoadedDetail)
    return found


def test_rows_say_what_is_drawn(row: Scenes) -> None:
    path = flight()
    rows, finder = rows_of(row, path), CutFinder(row, CUT)
    levels = loaded(row).depth
    drawn: set[int] = set()
    for camera, cells in zip(path.cameras, rows, strict=True):
        (index,) = finder.cut(camera).nodes
        before, drawn = drawn, set(index.tolist())
        assert cells["selected"] == len(index) <= 205 and cells["budget_used"] == pytest.approx(len(index) / 200)
        assert cells["leaves"] == int((levels[index] == 0).sum()) == cells["selected"] - cells["interior"]
        assert (cells["level_min"], cells["level_max"]) == (0, int(levels[index].max()))
        assert cells["level_mean"] == pytest.approx(levels[index].mean(), abs=1e-3)
        assert cells["in_frustum"] + cells["outside"] + cells["behind"] == cells["selected"]
        assert (cells["added"], cells["removed"]) == (len(drawn - before), len(before - drawn))
        assert all(cells[name] is None for name in OF_TREES)
        assert cells["stop_reason"] == "budget" and cells["missing"] == 0
    assert any(cells["removed"] for cells in rows)


def test_without_a_network_each_chunk_file_comes_when_it_is_drawn_from(row: Scenes) -> None:
    path = flight()
    scene, finder = loaded(row), CutFinder(row, CUT)
    there: set[int] = set()
    first: set[int] = set()
    for camera, cells in zip(path.cameras, rows_of(row, path), strict=True):
        (part,) = finder.cut(camera).parts
        touched = set(scene.chunk_of(part.index).tolist())
        new = touched - there
        manifest = 0 if there else scene.files.manifest
        assert (cells["chunks_touched"], cells["chunks_new"]) == (len(touched), len(new))
        assert cells["bytes_new"] == int(scene.files.sizes[sorted(new)].sum()) + manifest
        there |= new
        first = first or touched
    assert len(first) < len(there)


def test_a_visitor_who_waits_gets_the_manifest_the_environment_and_coarse_levels_first(row: Scenes) -> None:
    scene, camera = loaded(row), flight().cameras[0]
    files = scene.files
    assert files.environment is not None
    arrivals = list(Loader(row, CUT, StreamingSettings(Network(1e6, 0.0, 1))).arrivals(camera))
    order = [
        int(np.flatnonzero(after.resident & ~before.resident)[0]) for before, after in itertools.pairwise(arrivals)
    ]
    (part,) = CutFinder(row, CUT).cut(camera).parts
    assert set(order) == set(scene.chunk_of(part.index).tolist())
    assert order[0] == files.environment
    levels = [number // 3 for number in order[1:]]
    assert levels == sorted(levels, reverse=True)
    received = files.manifest + np.cumsum(files.sizes[order])
    assert [arrival.bytes for arrival in arrivals[1:]] == received.tolist()
    seconds = received / 1e6
    assert [arrival.seconds for arrival in arrivals[1:]] == pytest.approx(seconds.tolist())
    found: Any = Loader(row, CUT, StreamingSettings(Network(1e6, 0.0, 1))).load(camera)
    assert found["first_picture_s"] == pytest.approx(seconds[0], abs=1e-4)
    assert found["resident_all_bytes"] == received[-1]
    # With a latency: of the manifest, of each meta.json, and at least one of its images.
    late: Any = Loader(row, CUT, StreamingSettings(Network(1e6, 0.1, 1))).load(camera)
    assert late["first_picture_s"] >= seconds[0] + 0.3
    assert late["resident_all_s"] >= seconds[-1] + 0.1 + 0.2 * len(order)


def test_two_files_are_fetched_at_a_time_unless_told_otherwise(row: Scenes) -> None:
    camera = flight().cameras[0]
    times = {
        fetchers: Loader(row, CUT, StreamingSettings(Network(1e9, 1.0, fetchers))).load(camera)["resident_all_s"]
        for fetchers in (None, 1, 2, 3)
    }
    assert times[None] == times[2] and times[1] > times[2] > times[3]  # type: ignore[operator]


def test_underfill_shows_all_regions_sooner_and_comes_to_the_same(row: Scenes) -> None:
    camera = flight().cameras[0]
    under = dataclasses.replace(CUT, detail=DetailRule(underfill=3))
    drawn = {}
    for cut in (CUT, under):
        loader = Loader(row, cut, StreamingSettings(Network(1e6, 0.0, 1)))
        last = loader.load(camera)["resident_all_s"]
        assert isinstance(last, float)
        drawn[cut] = [len(cut_after(loader, camera, share * last)) for share in (0.0, 0.55, 1.01)]
        (index,) = cut_after(loader, camera, 1.01 * last).nodes
        assert index.tolist() == CutFinder(row, cut).cut(camera).nodes[0].tolist()
    assert drawn[CUT][0] == drawn[under][0] == 0


def test_along_a_path_regions_stay_as_they_were_until_their_files_come(row: Scenes) -> None:
    """No region disappears once it was drawn, whatever is under way."""
    rows = rows_of(row, flight(40, 30.0), SLOW)
    drawn = [cells["selected"] for cells in rows]
    assert drawn[0] == 0 and rows[0]["missing"] > 0
    first = next(at for at, cells in enumerate(rows) if cells["selected"] - 5 >= 6 * 16)
    assert all(cells["selected"] - 5 >= 6 * 16 for cells in rows[first:])
    assert any(cells["missing"] for cells in rows[first:]) and rows[-1]["complete_in_s"] is not None
    assert sum(cells["bytes_new"] for cells in rows) <= loaded(row).bytes


def test_a_resting_camera_ends_with_the_cut_of_its_levels(row: Scenes) -> None:
    camera = flight().cameras[3]
    cameras = tuple(dataclasses.replace(camera, time=5.0 * at) for at in range(12))
    rows = rows_of(row, CameraPath(cameras, "rest", (), tuple(range(12))), SLOW)
    assert rows[-1]["missing"] == 0 and rows[-1]["selected"] == len(CutFinder(row, CUT).cut(camera))
    assert rows[0]["stop_reason"] == "missing" and rows[-1]["stop_reason"] == "budget"


def test_scenes_in_memory_have_a_file_for_each_level(tmp_path: Path) -> None:
    scenes = read_scenes([Instance(row_of_regions(environment=5), "row")])
    files = loaded(scenes).files
    assert files.of_run.tolist() == [[0, 1, 2]] * 6 and files.environment == 3
    assert (np.diff(files.sizes[:3]) < 0).all() and files.manifest == 0
    assert rows_of(scenes, flight())[0]["chunks_new"] >= 2
