"""Frames whose chunks are fetched: what a cache holds, and when a cut is complete."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sparklod_cli.model.instances import Instance
from sparklod_cli.viewers.scenes import Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.simulation.paths import HAND, OF_THE_PAST, SPARK, TOWN, around, path_of, resting, rows_of, without

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("capacity", [2, 3, 4])
def test_a_cache_never_holds_more_than_fits(three: Scenes, capacity: int) -> None:
    """The town has three chunks, the small tree one; both roots are always there."""
    for network in (Network(), Network(5e5, 0.02)):
        streaming = StreamingSettings(network, capacity)
        rows: list[Any] = rows_of(three, LodSettings(6_000, SPARK), around(30), streaming)
        assert all(row["chunks_resident"] <= capacity for row in rows)
        assert max(row["chunks_resident"] for row in rows) == capacity
        assert sum(row["chunks_new"] for row in rows) >= capacity
        if capacity == 4:
            assert sum(row["chunks_new"] for row in rows) == 4
            assert sum(row["bytes_new"] for row in rows) == TOWN.stat().st_size + HAND.stat().st_size
        elif network.instant:
            assert any(row["missing"] for row in rows)


def test_chunks_that_fit_the_cache_are_never_missing(three: Scenes) -> None:
    for cache in (None, 4):
        rows = rows_of(three, LodSettings(20_000, SPARK), around(20), StreamingSettings(chunk_cache=cache))
        assert all(row["missing"] == 0 for row in rows)
        assert all(row["complete_in_s"] is None for row in rows)


def test_without_bandwidth_or_latency_chunks_arrive_at_once(three: Scenes) -> None:
    timing = {"traverse_ms"}
    for cache in (None, 2):
        default, infinite = (
            [
                without(row, timing)
                for row in rows_of(three, LodSettings(9_000, SPARK), around(8), StreamingSettings(network, cache))
            ]
            for network in (Network(), Network(math.inf, 0.0, 1))
        )
        assert default == infinite


@pytest.mark.parametrize("network", [Network(6e4, 0.05), Network(2e4, 0.2, 1), Network(math.inf, 0.3)], ids=str)
@pytest.mark.parametrize("budget", [300, 20_000])
def test_a_resting_camera_gets_the_whole_cut(town: Scenes, network: Network, budget: int) -> None:
    """The first frame says when, at the soonest.

    It reckons as if all chunks of the cut were known at once. The viewer knows of those that it has, so it may be
    later: by the latency once more for each level of chunks, of which the town has two, and by the frames in between.
    """
    fps = 100.0
    path = resting(700, fps)
    (instant,) = rows_of(town, LodSettings(budget, SPARK), path_of(path.cameras[:1]))
    rows: list[Any] = rows_of(town, LodSettings(budget, SPARK), path, StreamingSettings(network))
    missing = [row["missing"] for row in rows]
    assert missing[0] > 0
    complete = missing.index(0)
    assert not any(missing[complete:])
    late = OF_THE_PAST | {"time_s", "frame", "complete_in_s"}
    assert all(without(row, late) == without(instant, late) for row in rows[complete:])
    promised = rows[0]["complete_in_s"]
    assert promised > 0
    assert promised <= rows[complete]["time_s"] + 1e-4
    assert rows[complete]["time_s"] <= promised + network.latency + 3 / fps
    for row in rows[:complete]:
        assert row["complete_in_s"] > 0
        assert row["time_s"] + row["complete_in_s"] >= promised - 1e-3  # never sooner than once promised
    assert all(row["complete_in_s"] == 0 for row in rows[complete:])
    assert all(row["churn"] == 0 for row in rows[complete + 1 :])


def test_a_tree_of_one_chunk_arrives_when_predicted() -> None:
    hand = read_scenes([Instance(HAND, "hand")])
    size, latency, speed = HAND.stat().st_size, 0.1, 500.0
    rows: list[Any] = rows_of(hand, LodSettings(100, SPARK), resting(60), StreamingSettings(Network(speed, latency)))
    expected = latency + size / speed
    for row in rows:
        assert row["complete_in_s"] == pytest.approx(max(0, expected - row["time_s"]), abs=1e-4)
        assert (row["selected"] == 0) == (row["time_s"] < expected)
    assert [row["bytes_new"] for row in rows if row["bytes_new"]] == [size]
