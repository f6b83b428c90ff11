"""What a visitor waits for who opens a page and rests: closed forms, and the frames of a resting camera."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.simulation.loading import Loader
from sparklod_cli.simulation.results import LOADING
from sparklod_cli.viewers.scenes import Cut, CutFinder, Scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.simulation.paths import SPARK, resting, rows_of

AT = resting(1).cameras[0]
SLOW = StreamingSettings(Network(1e6, 0.1))
CUT = LodSettings(20_000, SPARK)


def cut_after(loader: Loader, camera: Camera, seconds: float) -> Cut:
    loader.seconds = seconds
    return loader.cut(camera)


def test_the_first_picture_takes_a_header_and_a_chunk(rad_town: Scenes) -> None:
    (tree,) = rad_town.with_cuts
    header, first = min(65_536, tree.bytes), int(tree.requests[0][0])
    found: Any = Loader(rad_town, CUT, SLOW).load(AT)
    assert found["first_picture_s"] == pytest.approx(0.1 + header / 1e6 + 0.1 + first / 1e6, abs=1e-4)
    assert list(found) == [column.name for column in LOADING]


def test_the_whole_cut_takes_the_bytes_of_its_chunks(rad_town: Scenes, town: Scenes) -> None:
    """The town's cut is in all three chunks; of SPZ there is no header to wait for."""
    for scenes, header in ((town, 0), (rad_town, min(65_536, rad_town.with_cuts[0].bytes))):
        (tree,) = scenes.with_cuts
        found: Any = Loader(scenes, CUT, SLOW).load(AT)
        assert found["resident_all_bytes"] == header + sum(map(sum, tree.requests))
        least = found["resident_all_bytes"] / 1e6 + 0.1 * (2 + (header > 0))  # chunk 0 is what the others are known by
        assert found["resident_all_s"] == pytest.approx(least, abs=1e-3)
        assert found["first_picture_s"] < found["resident_90_s"] <= found["resident_all_s"]


@pytest.mark.parametrize("budget", [300, 20_000])
def test_the_frames_of_a_resting_camera_say_the_same(rad_town: Scenes, budget: int) -> None:
    """But for the time until the next frame."""
    fps = 50.0
    cut = LodSettings(budget, SPARK)
    rows: list[Any] = rows_of(rad_town, cut, resting(150, fps), SLOW)
    found: Any = Loader(rad_town, cut, SLOW).load(AT)
    first = next(row for row in rows if row["selected"])
    whole = next(row for row in rows if row["missing"] == 0)
    assert 0 <= first["time_s"] - found["first_picture_s"] <= 1 / fps
    assert 0 <= whole["time_s"] - found["resident_all_s"] <= 4 / fps  # of which some make it notice what it wants
    assert sum(row["bytes_new"] for row in rows) >= found["resident_all_bytes"]


def test_shares_are_of_the_splats_of_the_cut(rad_town: Scenes) -> None:
    limit = CUT.limit(AT.fov_y, AT.height)
    whole = rad_town.viewer(CUT).cut(AT, budget=CUT.budget, smallest=limit)
    chunk = whole.indices()[0] >> 16
    shares = []
    for arrival in Loader(rad_town, CUT, SLOW).arrivals(AT):
        assert arrival.share == pytest.approx(np.mean(arrival.resident[chunk]))
        shares.append(arrival.share)
    assert shares[0] == 0
    assert shares[-1] == 1
    assert shares == sorted(shares)


def test_the_picture_after_some_seconds_is_that_of_the_resident_chunks(rad_town: Scenes) -> None:
    loader = Loader(rad_town, CUT, SLOW)
    found: Any = loader.load(AT)
    assert len(cut_after(loader, AT, 0.0)) == 0
    assert len(cut_after(loader, AT, found["first_picture_s"] - 1e-3)) == 0
    sizes = [len(cut_after(loader, AT, found["first_picture_s"] + wait)) for wait in (1e-3, 1e6)]
    assert 0 < sizes[0] < sizes[1]
    whole = CutFinder(rad_town, CUT).cut(AT)
    last = cut_after(loader, AT, found["resident_all_s"] + 1e-3)
    assert [nodes.tolist() for nodes in last.nodes] == [nodes.tolist() for nodes in whole.nodes]


def test_what_does_not_fit_the_cache_never_comes(rad_town: Scenes) -> None:
    cache = dataclasses.replace(SLOW, chunk_cache=1)
    found: Any = Loader(rad_town, CUT, cache).load(AT)
    assert found["first_picture_s"] > 0
    assert found["resident_all_s"] is None
    assert found["resident_all_bytes"] is None
