"""A visitor who opens a page and rests: closed forms, the frames of a resting camera, and detail levels."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.simulation.frames import Loader
from sparklod_cli.simulation.results import LOADING
from sparklod_cli.viewers.playcanvas import LoadedDetail
from sparklod_cli.viewers.scenes import Cut, CutFinder, Scenes
from sparklod_cli.viewers.viewer_settings import DetailRule, LodSettings, Network, StreamingSettings
from tests.simulation.conftest import SPARK, flight, resting, rows_of

AT = resting(1).cameras[0]
SLOW = StreamingSettings(Network(1e6, 0.1))
CUT = LodSettings(20_000, SPARK)


def cut_after(loader: Loader, camera: Camera, seconds: float) -> Cut:
    loader.seconds = seconds
    return loader.cut(camera)


def test_the_whole_cut_takes_the_bytes_of_its_chunks(rad_town: Scenes, town: Scenes) -> None:
    """The town's cut is in all three chunks; an SPZ has no header to wait for."""
    for scenes, header in ((town, 0), (rad_town, min(65_536, rad_town.with_cuts[0].bytes))):
        (tree,) = scenes.with_cuts
        found: Any = Loader(scenes, CUT, SLOW).load(AT)
        assert list(found) == [column.name for column in LOADING]
        assert found["resident_all_bytes"] == header + sum(map(sum, tree.requests))
        least = found["resident_all_bytes"] / 1e6 + 0.1 * (2 + (header > 0))  # chunk 0 names the others
        assert found["resident_all_s"] == pytest.approx(least, abs=1e-3)
        first = (header + tree.requests[0][0]) / 1e6 + 0.1 * (1 + (header > 0))
        assert found["first_picture_s"] == pytest.approx(first, abs=1e-4)
        assert found["first_picture_s"] < found["resident_90_s"] <= found["resident_all_s"]


@pytest.mark.parametrize("budget", [300, 20_000])
def test_the_frames_of_a_resting_camera_agree_within_a_frame(rad_town: Scenes, budget: int) -> None:
    fps = 50.0
    cut = LodSettings(budget, SPARK)
    rows = rows_of(rad_town, cut, resting(150, fps), SLOW)
    found: Any = Loader(rad_town, cut, SLOW).load(AT)
    first = next(row for row in rows if row["selected"])
    whole = next(row for row in rows if row["missing"] == 0)
    assert 0 <= first["time_s"] - found["first_picture_s"] <= 1 / fps
    assert 0 <= whole["time_s"] - found["resident_all_s"] <= 4 / fps  # in some, chunks are requested
    assert sum(row["bytes_new"] for row in rows) >= found["resident_all_bytes"]


def test_shares_are_of_the_splats_of_the_cut(rad_town: Scenes) -> None:
    limit = CUT.limit(AT.fov_y, AT.height)
    whole = rad_town.viewer(CUT).cut(AT, budget=CUT.budget, smallest=limit)
    chunk = whole.indices()[0] >> 16
    shares = []
    for arrival in Loader(rad_town, CUT, SLOW).arrivals(AT):
        assert arrival.share == pytest.approx(np.mean(arrival.resident[chunk]))
        shares.append(arrival.share)
    assert (shares[0], shares[-1]) == (0, 1)
    assert shares == sorted(shares)


def test_the_picture_after_some_seconds_has_the_resident_chunks(rad_town: Scenes) -> None:
    loader = Loader(rad_town, CUT, SLOW)
    found: Any = loader.load(AT)
    first = found["first_picture_s"]
    sizes = [len(cut_after(loader, AT, seconds)) for seconds in (0.0, first - 1e-3, first + 1e-3, 1e6)]
    assert sizes[0] == sizes[1] == 0 < sizes[2] < sizes[3]
    last = cut_after(loader, AT, found["resident_all_s"] + 1e-3)
    assert [nodes.tolist() for nodes in last.nodes] == [
        nodes.tolist() for nodes in CutFinder(rad_town, CUT).cut(AT).nodes
    ]
    found = Loader(rad_town, CUT, dataclasses.replace(SLOW, chunk_cache=1)).load(AT)
    assert found["first_picture_s"] > 0
    assert found["resident_all_s"] is found["resident_all_bytes"] is None  # it does not fit into the cache


SMALL, START = LodSettings(200), flight().cameras[0]


def network(*values: Any) -> StreamingSettings:
    return StreamingSettings(Network(*values))


def test_the_manifest_the_environment_and_coarse_levels_arrive_first(regions: Scenes) -> None:
    (scene,) = regions.with_cuts
    assert isinstance(scene, LoadedDetail)
    files = scene.files
    arrivals = list(Loader(regions, SMALL, network(1e6, 0.0, 1)).arrivals(START))
    order = [
        int(np.flatnonzero(after.resident & ~before.resident)[0]) for before, after in itertools.pairwise(arrivals)
    ]
    (part,) = CutFinder(regions, SMALL).cut(START).parts
    assert set(order) == set(scene.chunk_of(part.index).tolist())
    assert order[0] == files.environment
    levels = [number // 3 for number in order[1:]]
    assert levels == sorted(levels, reverse=True)
    received = files.manifest + np.cumsum([sum(files.requests[number]) for number in order])
    assert [arrival.bytes for arrival in arrivals[1:]] == received.tolist()
    seconds = received / 1e6
    assert [arrival.seconds for arrival in arrivals[1:]] == pytest.approx(seconds.tolist())
    found: Any = Loader(regions, SMALL, network(1e6, 0.0, 1)).load(START)
    assert found["first_picture_s"] == pytest.approx(seconds[0], abs=1e-4)
    assert found["resident_all_bytes"] == received[-1]
    # With a latency: of the manifest, of each meta.json, and at least one of its images.
    late: Any = Loader(regions, SMALL, network(1e6, 0.1, 1)).load(START)
    assert late["first_picture_s"] >= seconds[0] + 0.3
    assert late["resident_all_s"] >= seconds[-1] + 0.1 + 0.2 * len(order)


def test_two_files_are_fetched_at_a_time_by_default(regions: Scenes) -> None:
    times: dict[Any, Any] = {
        fetchers: Loader(regions, SMALL, network(1e9, 1.0, fetchers)).load(START)["resident_all_s"]
        for fetchers in (None, 1, 2, 3)
    }
    assert times[None] == times[2] and times[1] > times[2] > times[3]


@pytest.mark.parametrize("cut", [SMALL, dataclasses.replace(SMALL, detail=DetailRule(underfill=3))])
def test_levels_end_with_their_whole_cut_with_and_without_underfill(regions: Scenes, cut: LodSettings) -> None:
    loader = Loader(regions, cut, network(1e6, 0.0, 1))
    last: Any = loader.load(START)["resident_all_s"]
    assert len(cut_after(loader, START, 0.0)) == 0
    (index,) = cut_after(loader, START, 1.01 * last).nodes
    assert index.tolist() == CutFinder(regions, cut).cut(START).nodes[0].tolist()
