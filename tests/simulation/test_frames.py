"""Rows of simulated frames: laws, a twin without sparklod, fetched chunks, and scenes at several detail levels."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.model.foveation import Frustum
from sparklod_cli.model.instances import TOTAL, Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.simulation.results import COLUMNS, OF_TREES
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers.loaded_scene import Forest, LoadedScene
from sparklod_cli.viewers.playcanvas import LoadedDetail
from sparklod_cli.viewers.scenes import CutFinder, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.lod.trees import random_tree, row_of_regions, transform
from tests.references import frames as twin
from tests.scenes import random_splats
from tests.simulation.conftest import (
    HAND,
    OF_THE_PAST,
    SPARK,
    TOWN,
    VIEWERS,
    around,
    camera,
    flight,
    path_of,
    resting,
    rows_of,
    without,
)

#: Cells that only the row of all instances has.
OF_ALL = {
    *("stop_reason", "pixel_scale_min", "missing", "traverse_ms"),
    *("chunks_touched", "chunks_new", "bytes_new", "chunks_resident", "complete_in_s"),
}
SUMS = ("selected", "leaves", "interior", "frontier", "in_frustum", "outside", "behind", "added", "removed")

Viewer = tuple[LodSettings, StreamingSettings]


@pytest.mark.parametrize("viewer", VIEWERS, ids=str)
def test_cells_of_rows_agree_with_each_other(three: Scenes, viewer: Viewer) -> None:
    settings, streaming = viewer
    rows = rows_of(three, settings, around(12), streaming, by_instance=True)
    assert len(rows) == 12 * 4
    before: dict[Any, Row] = {}
    for row in rows:
        assert list(row) == [column.name for column in COLUMNS]
        assert row["selected"] == row["leaves"] + row["interior"]
        assert row["selected"] == row["in_frustum"] + row["outside"] + row["behind"]
        assert row["frontier"] <= row["selected"] <= settings.budget == row["budget"]
        assert row["budget_used"] == round(row["selected"] / settings.budget, 4)
        last: Any = before.get(row["instance"], {"selected": 0})
        assert row["added"] - row["removed"] == row["selected"] - last["selected"]
        assert 0 <= row["added"] <= row["selected"]
        assert 0 <= row["removed"] <= last["selected"]
        if row["instance"] in before:
            both = row["selected"] + last["selected"]
            assert row["churn"] == round((row["added"] + row["removed"]) / both if both else 0, 4)
        else:
            assert row["churn"] is None
        if row["selected"]:
            assert 0 <= row["level_min"] <= row["level_mean"] <= row["level_max"] <= 6
        if row["in_frustum"]:
            assert 0 <= row["projected_px_p50"] <= row["projected_px_p95"]
        else:
            assert row["projected_px_p50"] is row["projected_px_p95"] is None
            assert row["overdraw_estimate"] == 0
        before[row["instance"]] = row
    for total in (row for row in rows if row["instance"] == TOTAL):
        parts = [row for row in rows if row["frame"] == total["frame"] and row["instance"] != TOTAL]
        assert [part["instance"] for part in parts] == ["here", "there", "hand"]
        assert all(sum(part[name] for part in parts) == total[name] for name in SUMS)
        for name, of in (("level_min", min), ("level_max", max)):
            cells = [part[name] for part in parts if part[name] is not None]
            assert total[name] == (of(cells) if cells else None)
        assert sum(part["overdraw_estimate"] for part in parts) == pytest.approx(total["overdraw_estimate"], abs=2e-3)
        assert all(part[name] is None for part in parts for name in OF_ALL)


def test_a_cut_stops_for_the_reported_reason(three: Scenes) -> None:
    reasons = set()
    for settings, streaming in VIEWERS:
        for row in rows_of(three, settings, around(6), streaming):
            limit = settings.limit(around(6).cameras[0].fov_y, 360)
            assert row["pixel_scale_limit"] == pytest.approx(limit, rel=1e-5)
            reasons.add(row["stop_reason"])
            if row["stop_reason"] == "exhausted":
                assert row["interior"] == 0 == row["missing"]
            elif row["stop_reason"] == "pixel":
                assert row["interior"] > 0
                assert row["pixel_scale_min"] is None or row["pixel_scale_min"] > row["pixel_scale_limit"]
            elif row["stop_reason"] == "missing":
                assert row["missing"] > 0
            else:
                assert row["selected"] + 160 > settings.budget or settings.budget < 160
    assert reasons == {*("budget", "pixel", "exhausted", "missing")}


def test_threads_do_not_change_a_row(three: Scenes) -> None:
    for settings, streaming in (VIEWERS[0], VIEWERS[6]):
        first, *others = (
            [
                without(row, {"traverse_ms"})
                for row in rows_of(three, settings, around(25), streaming, by_instance=True, threads=threads)
            ]
            for threads in (1, 2, 5)
        )
        assert all(rows == first for rows in others)


def test_a_frame_does_not_depend_on_earlier_ones(three: Scenes) -> None:
    path, settings = around(9), LodSettings(5_000, SPARK)

    def by_place(path: CameraPath) -> dict[Any, Row]:
        rows = rows_of(three, settings, path, by_instance=True)
        return {(row["frame"], row["instance"]): without(row, OF_THE_PAST) for row in rows}

    together, alone = by_place(path), dict[Any, Row]()
    for number, at in enumerate(path.cameras):
        alone |= by_place(CameraPath((at,), "a test", (), (number,)))
    assert together == alone
    assert together == by_place(CameraPath(path.cameras[::-1], "a test", (), path.numbers[::-1]))


def test_frames_have_numbers_names_and_directions_of_their_cameras(town: Scenes) -> None:
    first, second = camera((0, -1, -3), time=0.5), camera((1, -2, -4), (0, 0, 1), time=2)
    path = CameraPath((first, dataclasses.replace(second, name="door")), "a test", (), (7, 14))
    rows = rows_of(town, LodSettings(500), path)
    assert [(row["frame"], row["time_s"], row["name"] or "") for row in rows] == [(7, 0.5, ""), (14, 2.0, "door")]
    for row, at in zip(rows, path.cameras, strict=True):
        assert [row[f"position_{axis}"] for axis in "xyz"] == np.round(at.position, 6).tolist()
        assert [row[f"forward_{axis}"] for axis in "xyz"] == pytest.approx(at.forward, abs=1e-6)
    ahead = np.array([-1, 2, 5]) / math.sqrt(30)
    assert [rows[1][f"forward_{axis}"] for axis in "xyz"] == pytest.approx(ahead, abs=1e-6)


def test_the_pixel_scale_limit_follows_each_camera(town: Scenes) -> None:
    """A pixel's size over its distance: 2 tan(fov / 2) over the height."""
    lenses = [(60.0, (640, 360)), (60.0, (640, 720)), (90.0, (640, 360)), (20.0, (100, 50))]
    path = path_of([camera((0, -1, -3), fov=fov, size=size) for fov, size in lenses])
    rows = rows_of(town, LodSettings(10**6, render_scale=3.0), path)
    for row, (fov, (width, height)) in zip(rows, lenses, strict=True):
        assert (row["fov_y_deg"], row["width"], row["height"]) == (fov, width, height)
        limit = 3 * 2 * math.tan(math.radians(fov) / 2) / height
        assert row["pixel_scale_limit"] == float(f"{limit:.6g}")
        assert row["pixel_scale_min"] > limit
    assert len({row["pixel_scale_limit"] for row in rows}) == 4
    fixed = rows_of(town, LodSettings(10**6, pixel_scale_limit=0.02), path)
    assert {row["pixel_scale_limit"] for row in fixed} == {0.02}
    assert len({row["selected"] for row in fixed}) == 1  # without foveation, lenses do not matter


def test_churn_is_0_at_rest_and_1_after_a_jump(town: Scenes) -> None:
    rows = rows_of(town, LodSettings(4_000, SPARK), resting(4))
    assert [(row["added"], row["removed"], row["churn"]) for row in rows[1:]] == [(0, 0, 0.0)] * 3
    assert (rows[0]["added"], rows[0]["removed"], rows[0]["churn"]) == (rows[0]["selected"], 0, None)
    far, near = camera((0, -1e5, 0), (0, 0, 1)), camera((0, -1, -3))
    root, cut, again = rows_of(town, LodSettings(4_000), path_of([far, near, far]))
    assert (root["selected"], again["selected"]) == (1, 1)
    assert (cut["added"], cut["removed"], cut["churn"]) == (cut["selected"], 1, 1.0)
    assert (again["added"], again["removed"], again["churn"]) == (1, cut["selected"], 1.0)


def test_budgets_and_caches_that_are_too_small_are_refused(three: Scenes) -> None:
    with pytest.raises(ValueError, match="a budget of 2 splats is less than one for each of 3 instances"):
        Simulation(three, LodSettings(2))
    with pytest.raises(ValueError, match="cannot hold the roots of 2 trees"):
        Simulation(three, LodSettings(3), StreamingSettings(chunk_cache=1))
    many = Scenes([three.instances[0]] * 65_536, three.loaded, [three.of_instance[0]] * 65_536)
    with pytest.raises(ValueError, match="65,536 instances are more than 65,535"):
        Simulation(many, LodSettings(10**6))


def test_splats_behind_the_camera_are_counted(town: Scenes) -> None:
    at, away = camera((0, -1, -6)), camera((0, -1, -6), (0, -1, -20))
    first, second = Simulation(town, LodSettings(5_000)).run(path_of([at, away]))
    assert first.rows[0]["behind"] == 0
    assert (first.number, second.number) == (0, 1)
    assert second.rows[0]["behind"] == second.rows[0]["selected"] == len(second.cut)


def small_forest(seed: int) -> tuple[Scenes, list[twin.Instance]]:
    """Two trees of a few hundred nodes and three instances of them, for the package and for the twin."""
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, count, 5) for count in (300, 120)]
    spots = [np.eye(4), transform(rng, scale=0.6, spread=2), transform(rng, scale=1.4, spread=4)]
    of, weights, own = (0, 1, 0), (1.0, 2.5, 0.7), Frustum(0.3, 0.1)
    made = []
    for number, tree in enumerate(trees):
        splats = random_splats(len(tree.size))
        made.append(LoadedScene(Path(f"{number}.spz"), 1000, Scene(splats, tree.tree), splats, number))
    as_nodes = [
        twin.Nodes(tree.center.astype(float), tree.size.astype(float), tree.tree.child_count, tree.tree.child_start)
        for tree in trees
    ]
    cones = twin.cones(SPARK.fov0, SPARK.fov, SPARK.foveate, SPARK.behind)
    instances, twins = [], []
    for number, (tree, spot, weight) in enumerate(zip(of, spots, weights, strict=True)):
        foveation = own if number == 1 else None
        instances.append(Instance(Path(f"{tree}.spz"), f"{number}", spot, weight, foveation))
        twins.append(
            twin.Instance(as_nodes[tree], spot, weight, twin.frustum(own.outside, own.behind) if foveation else cones)
        )
    scenes = Scenes(instances, made, [made[tree] for tree in of])
    scenes.__dict__["forest"] = Forest(trees)  # of other sizes than those of the splats
    return scenes, twins


@pytest.mark.parametrize("seed", range(6))
def test_rows_and_cuts_are_those_of_a_twin(seed: int) -> None:
    scenes, twins = small_forest(seed)
    rng = np.random.default_rng(100 + seed)
    for budget, render_scale in ((3, 1.0), (150, 1.0), (100_000, 40.0), (100_000, 0.0)):
        eye, target = rng.normal(0, 2, 3), rng.normal(0, 1, 3)
        at = camera(eye, target, fov=70, size=(500, 300))
        right, up, back = at.camera_to_world[:3, :3].T
        seen = twin.Eye(eye, right, up, -back, math.radians(70), 500, 300)
        settings = LodSettings(budget, SPARK, render_scale=render_scale)
        (row,) = rows_of(scenes, settings, path_of([at]))
        drawn = twin.frame(twins, seen, budget, seen.pixel * render_scale)
        assert twin.differing(drawn.cells, row) == []
        assert [set(part.tolist()) for part in CutFinder(scenes, settings).cut(at).nodes] == [
            {node for number, node in drawn.cut if number == instance} for instance in range(3)
        ]


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [2, 3, 4, None])
def test_a_cache_never_holds_more_chunks_than_its_capacity(three: Scenes, capacity: int | None) -> None:
    """The town has three chunks, the small tree one; both roots are always resident."""
    for network in (Network(), Network(5e5, 0.02)):
        rows = rows_of(three, LodSettings(20_000, SPARK), around(30), StreamingSettings(network, capacity))
        assert max(row["chunks_resident"] for row in rows) == (capacity or 4)
        fetched = sum(row["chunks_new"] for row in rows)
        if capacity in (None, 4):
            assert fetched == 4
            assert sum(row["bytes_new"] for row in rows) == TOWN.stat().st_size + HAND.stat().st_size
        else:
            assert fetched >= capacity
        if network.instant:
            assert any(row["missing"] for row in rows) == (capacity in (2, 3))
            assert capacity in (2, 3) or all(row["complete_in_s"] is None for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("cache", [None, 2])
def test_without_bandwidth_or_latency_chunks_arrive_at_once(three: Scenes, cache: int | None) -> None:
    default, infinite = (
        [
            without(row, {"traverse_ms"})
            for row in rows_of(three, LodSettings(9_000, SPARK), around(8), StreamingSettings(network, cache))
        ]
        for network in (Network(), Network(math.inf, 0.0, 1))
    )
    assert default == infinite


@pytest.mark.slow
@pytest.mark.parametrize("network", [Network(6e4, 0.05), Network(2e4, 0.2, 1), Network(math.inf, 0.3)], ids=str)
@pytest.mark.parametrize("budget", [300, 20_000])
def test_a_resting_camera_gets_the_whole_cut(town: Scenes, network: Network, budget: int) -> None:
    """The first frame predicts the earliest time, as if all chunks of the cut were known at once.

    The viewer knows those of resident chunks. It may be later by a latency for each level of chunks, of which the town
    has two, and by the frames in between.
    """
    fps = 100.0
    path = resting(700, fps)
    (instant,) = rows_of(town, LodSettings(budget, SPARK), path_of(path.cameras[:1]))
    rows = rows_of(town, LodSettings(budget, SPARK), path, StreamingSettings(network))
    missing = [row["missing"] for row in rows]
    assert missing[0] > 0
    complete = missing.index(0)
    assert not any(missing[complete:])
    late = OF_THE_PAST | {"time_s", "frame", "complete_in_s"}
    assert all(without(row, late) == without(instant, late) for row in rows[complete:])
    promised = rows[0]["complete_in_s"]
    assert 0 < promised <= rows[complete]["time_s"] + 1e-4
    assert rows[complete]["time_s"] <= promised + network.latency + 3 / fps
    for row in rows[:complete]:
        assert row["complete_in_s"] > 0
        assert row["time_s"] + row["complete_in_s"] >= promised - 1e-3  # never sooner than once promised
    assert all(row["complete_in_s"] == 0 for row in rows[complete:])
    assert all(row["churn"] == 0 for row in rows[complete + 1 :])


@pytest.mark.slow
def test_a_tree_of_one_chunk_arrives_when_predicted() -> None:
    hand = read_scenes([Instance(HAND, "hand")])
    size, latency, speed = HAND.stat().st_size, 0.1, 500.0
    rows = rows_of(hand, LodSettings(100, SPARK), resting(60), StreamingSettings(Network(speed, latency)))
    expected = latency + size / speed
    for row in rows:
        assert row["complete_in_s"] == pytest.approx(max(0, expected - row["time_s"]), abs=1e-4)
        assert (row["selected"] == 0) == (row["time_s"] < expected)
    assert [row["bytes_new"] for row in rows if row["bytes_new"]] == [size]


CUT = LodSettings(200)
SLOW = StreamingSettings(Network(20_000, 0.1))


def loaded(scenes: Scenes) -> LoadedDetail:
    (scene,) = scenes.with_cuts
    assert isinstance(scene, LoadedDetail)
    return scene


def test_rows_of_detail_levels_describe_their_cuts_and_files(regions: Scenes) -> None:
    path, scene = flight(), loaded(regions)
    finder, files = CutFinder(regions, CUT), scene.files
    drawn, resident, first = set[int](), set[int](), set[int]()
    rows = rows_of(regions, CUT, path)
    for at, row in zip(path.cameras, rows, strict=True):
        (part,) = finder.cut(at).parts
        index = part.index
        before, drawn = drawn, set(index.tolist())
        assert row["selected"] == len(index) <= 205 and row["budget_used"] == pytest.approx(len(index) / 200)
        level = scene.depth[index]
        assert row["leaves"] == int((level == 0).sum()) == row["selected"] - row["interior"]
        assert (row["level_min"], row["level_max"]) == (0, int(level.max()))
        assert row["level_mean"] == pytest.approx(level.mean(), abs=1e-3)
        assert row["in_frustum"] + row["outside"] + row["behind"] == row["selected"]
        assert (row["added"], row["removed"]) == (len(drawn - before), len(before - drawn))
        assert all(row[name] is None for name in OF_TREES)
        assert row["stop_reason"] == "budget" and row["missing"] == 0
        touched = set(scene.chunk_of(index).tolist())
        new = touched - resident
        manifest = 0 if resident else files.manifest
        assert (row["chunks_touched"], row["chunks_new"]) == (len(touched), len(new))
        assert row["bytes_new"] == sum(sum(files.requests[number]) for number in new) + manifest
        resident |= new
        first = first or touched
    assert any(row["removed"] for row in rows)
    assert len(first) < len(resident)


def test_regions_once_drawn_are_drawn_until_other_files_arrive(regions: Scenes) -> None:
    rows = rows_of(regions, CUT, flight(40, 30.0), SLOW)
    drawn = [row["selected"] for row in rows]
    assert drawn[0] == 0 and rows[0]["missing"] > 0
    first = next(at for at, row in enumerate(rows) if row["selected"] - 5 >= 6 * 16)
    assert all(row["selected"] - 5 >= 6 * 16 for row in rows[first:])
    assert any(row["missing"] for row in rows[first:]) and rows[-1]["complete_in_s"] is not None
    assert sum(row["bytes_new"] for row in rows) <= loaded(regions).bytes


def test_a_resting_camera_ends_with_the_cut_of_its_levels(regions: Scenes) -> None:
    at = flight().cameras[3]
    rows = rows_of(regions, CUT, path_of([dataclasses.replace(at, time=5.0 * step) for step in range(12)]), SLOW)
    assert rows[-1]["missing"] == 0 and rows[-1]["selected"] == len(CutFinder(regions, CUT).cut(at))
    assert rows[0]["stop_reason"] == "missing" and rows[-1]["stop_reason"] == "budget"


def test_a_scene_in_memory_has_a_file_for_each_level() -> None:
    scenes = read_scenes([Instance(row_of_regions(environment=5), "row")])
    files = loaded(scenes).files
    assert files.of_run.tolist() == [[0, 1, 2]] * 6 and files.environment == 3
    assert files.requests[:3] == sorted(files.requests[:3], reverse=True) and files.manifest == 0
    assert rows_of(scenes, CUT, flight())[0]["chunks_new"] >= 2
