"""What frames tell of cuts: laws over their rows, and one frame worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.lod.traversal import Cones, Forest, Frustum, Instance
from sparklod_cli.render.camera import Camera
from sparklod_cli.render.camera_path import CameraPath
from sparklod_cli.render.pose import look_at
from sparklod_cli.scene import Scene
from sparklod_cli.simulation.columns import COLUMNS, Row
from sparklod_cli.simulation.simulate import Simulation, Viewer
from sparklod_cli.simulation.streaming import Network
from sparklod_cli.world import TOTAL, Placement, Tree, World, read_world
from tests.conftest import FIXTURES
from tests.lod.forests import random_tree, transform
from tests.references import frames as twin
from tests.scenes import random_splats

TOWN, HAND = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
SPARK = Cones(90, 120, 0.4, 0.2)
UP = (0.0, -1.0, 0.0)

#: Cells of which a frame by itself knows nothing.
OF_THE_PAST = {"added", "removed", "churn", "chunks_new", "bytes_new", "chunks_resident", "traverse_ms"}

#: Cells that only the row of all instances has.
OF_ALL = {
    *("stop_reason", "pixel_scale_min", "missing", "traverse_ms"),
    *("chunks_touched", "chunks_new", "bytes_new", "chunks_resident", "complete_in_s"),
}


def camera(
    eye: Sequence[float],
    target: Sequence[float] = (0, 0, 0),
    *,
    fov: float = 60.0,
    size: tuple[int, int] = (640, 360),
    time: float = 0.0,
) -> Camera:
    focal = size[1] / (2 * math.tan(math.radians(fov) / 2))
    return Camera(look_at(eye, target, UP), *size, (focal, focal), (size[0] / 2, size[1] / 2), time)


def path_of(cameras: Sequence[Camera]) -> CameraPath:
    return CameraPath(tuple(cameras), "a test", (), tuple(range(len(cameras))))


def around(count: int, distance: float = 3.0, seconds: float = 1.0) -> CameraPath:
    turns = 2 * math.pi * np.arange(count) / count
    return path_of(
        [
            camera((distance * math.sin(turn), -1, -distance * math.cos(turn)), time=seconds * number / count)
            for number, turn in enumerate(turns)
        ]
    )


def resting(count: int, fps: float = 30.0) -> CameraPath:
    return path_of([camera((1.0, -1.0, -2.0), time=number / fps) for number in range(count)])


def rows_of(
    world: World, viewer: Viewer, path: CameraPath, *, by_instance: bool = False, threads: int = 1
) -> list[Row]:
    simulation = Simulation(world, viewer, by_instance=by_instance)
    return [row for frame in simulation.run(path, threads=threads) for row in frame.rows]


def without(row: Row, names: set[str]) -> Row:
    return {name: cell for name, cell in row.items() if name not in names}


@pytest.fixture(scope="module")
def town() -> World:
    """165,205 nodes in three chunks."""
    return read_world([Placement(TOWN, "town")])


@pytest.fixture(scope="module")
def three() -> World:
    """The town twice, once turned and larger, and a small tree."""
    return read_world(
        [
            Placement(TOWN, "here"),
            Placement(TOWN, "there", transform(np.random.default_rng(1), scale=1.5, spread=3), 0.5, Frustum(0.3, 0.1)),
            Placement(HAND, "hand"),
        ]
    )


def viewers() -> list[Viewer]:
    return [
        Viewer(20_000, SPARK),
        Viewer(2_000, Cones(), chunk_cache=2),
        Viewer(3, SPARK),
        Viewer(10**9, SPARK, render_scale=40.0),
        Viewer(10**9, Frustum(0.2, 0.1), pixel_scale_limit=0.1),
        Viewer(1_000_000, Cones()),
        Viewer(20_000, SPARK, network=Network(1e6, 0.03), chunk_cache=3),
        Viewer(20_000, SPARK, network=Network(3e4, 0.1, 1)),
    ]


@pytest.mark.parametrize("viewer", viewers(), ids=str)
def test_laws_of_all_rows(three: World, viewer: Viewer) -> None:
    path = around(12)
    rows = rows_of(three, viewer, path, by_instance=True)
    assert len(rows) == 12 * 4
    assert all(list(row) == [column.name for column in COLUMNS] for row in rows)
    totals: dict[Any, Row] = {row["frame"]: row for row in rows if row["instance"] == TOTAL}
    before: dict[Any, Row] = {}
    for row in rows:
        cell: dict[str, Any] = row
        where = cell["instance"]
        assert cell["selected"] == cell["leaves"] + cell["interior"]
        assert cell["selected"] == cell["in_frustum"] + cell["outside"] + cell["behind"]
        assert cell["frontier"] <= cell["selected"] <= viewer.budget == cell["budget"]
        assert cell["budget_used"] == round(cell["selected"] / viewer.budget, 4)
        last: Any = before.get(where, {"selected": 0})
        assert cell["added"] - cell["removed"] == cell["selected"] - last["selected"]
        assert 0 <= cell["added"] <= cell["selected"]
        assert 0 <= cell["removed"] <= last["selected"]
        if where in before:
            both = cell["selected"] + last["selected"]
            assert cell["churn"] == round((cell["added"] + cell["removed"]) / both if both else 0, 4)
        else:
            assert cell["churn"] is None
        if cell["selected"]:
            assert 0 <= cell["level_min"] <= cell["level_mean"] <= cell["level_max"] <= 6
        if cell["in_frustum"]:
            assert 0 <= cell["projected_px_p50"] <= cell["projected_px_p95"]
        else:
            assert cell["projected_px_p50"] is cell["projected_px_p95"] is None
            assert cell["overdraw_estimate"] == 0
        before[where] = row
    for number, total in totals.items():
        parts: list[Any] = [row for row in rows if row["frame"] == number and row["instance"] != TOTAL]
        assert [part["instance"] for part in parts] == ["here", "there", "hand"]
        for name in (
            "selected",
            "leaves",
            "interior",
            "frontier",
            "in_frustum",
            "outside",
            "behind",
            "added",
            "removed",
        ):
            assert sum(part[name] for part in parts) == total[name], name
        for name in ("level_min", "level_max"):
            cells = [part[name] for part in parts if part[name] is not None]
            assert total[name] == (min(cells) if name == "level_min" else max(cells)) if cells else total[name] is None
        assert sum(part["overdraw_estimate"] for part in parts) == pytest.approx(total["overdraw_estimate"], abs=2e-3)
        for part in parts:
            assert all(part[name] is None for name in OF_ALL)


@pytest.mark.parametrize("viewer", viewers(), ids=str)
def test_a_cut_stops_for_the_reason_it_says(three: World, viewer: Viewer) -> None:
    for cell in map(dict[str, Any], rows_of(three, viewer, around(6))):
        assert cell["pixel_scale_limit"] == pytest.approx(viewer.smallest(around(6).cameras[0]), rel=1e-5)
        if cell["stop_reason"] == "exhausted":
            assert cell["interior"] == 0 == cell["missing"]
        elif cell["stop_reason"] == "pixel":
            assert cell["interior"] > 0
            assert cell["pixel_scale_min"] is None or cell["pixel_scale_min"] > cell["pixel_scale_limit"]
        elif cell["stop_reason"] == "missing":
            assert cell["missing"] > 0
        else:
            assert cell["stop_reason"] == "budget"
            assert cell["selected"] + 160 > viewer.budget or viewer.budget < 160


def test_every_reason_comes_up(three: World) -> None:
    assert {row["stop_reason"] for viewer in viewers() for row in rows_of(three, viewer, around(3))} == {
        *("budget", "pixel", "exhausted", "missing")
    }


@pytest.mark.parametrize("capacity", [2, 3, 4])
def test_a_cache_never_holds_more_than_fits(three: World, capacity: int) -> None:
    """The town has three chunks, the small tree one; both roots are always there."""
    for network in (Network(), Network(5e5, 0.02)):
        viewer = Viewer(6_000, SPARK, network=network, chunk_cache=capacity)
        rows: list[Any] = rows_of(three, viewer, around(30))
        assert all(row["chunks_resident"] <= capacity for row in rows)
        assert max(row["chunks_resident"] for row in rows) == capacity
        assert sum(row["chunks_new"] for row in rows) >= capacity
        if capacity == 4:
            assert sum(row["chunks_new"] for row in rows) == 4
            assert sum(row["bytes_new"] for row in rows) == TOWN.stat().st_size + HAND.stat().st_size
        elif network.instant:
            assert any(row["missing"] for row in rows)


def test_what_fits_is_never_missing(three: World) -> None:
    for cache in (None, 4):
        rows = rows_of(three, Viewer(20_000, SPARK, chunk_cache=cache), around(20))
        assert all(row["missing"] == 0 for row in rows)
        assert all(row["complete_in_s"] is None for row in rows)


def test_without_bandwidth_or_latency_all_comes_at_once(three: World) -> None:
    timing = {"traverse_ms"}
    for cache in (None, 2):
        default, infinite = (
            [
                without(row, timing)
                for row in rows_of(three, Viewer(9_000, SPARK, network=network, chunk_cache=cache), around(8))
            ]
            for network in (Network(), Network(math.inf, 0.0, 1))
        )
        assert default == infinite


@pytest.mark.parametrize("network", [Network(6e4, 0.05), Network(2e4, 0.2, 1), Network(math.inf, 0.3)], ids=str)
@pytest.mark.parametrize("budget", [300, 20_000])
def test_a_resting_camera_gets_the_whole_cut(town: World, network: Network, budget: int) -> None:
    """The first frame says when, at the soonest.

    It reckons as if all chunks of the cut were known at once. The viewer knows of those that it has, so it may be
    later: by the latency once more for each level of chunks, of which the town has two, and by the frames in between.
    """
    fps = 100.0
    path = resting(700, fps)
    (instant,) = rows_of(town, Viewer(budget, SPARK), path_of(path.cameras[:1]))
    rows: list[Any] = rows_of(town, Viewer(budget, SPARK, network=network), path)
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


def test_a_tree_of_one_chunk_is_there_when_it_was_promised() -> None:
    world = read_world([Placement(HAND, "hand")])
    size, latency, speed = HAND.stat().st_size, 0.1, 500.0
    rows: list[Any] = rows_of(world, Viewer(100, SPARK, network=Network(speed, latency)), resting(60))
    expected = latency + size / speed
    for row in rows:
        assert row["complete_in_s"] == pytest.approx(max(0, expected - row["time_s"]), abs=1e-4)
        assert (row["selected"] == 0) == (row["time_s"] < expected)
    assert [row["bytes_new"] for row in rows if row["bytes_new"]] == [size]


def test_threads_change_nothing(three: World) -> None:
    for viewer in (viewers()[0], viewers()[6]):
        first, *others = (
            [
                without(row, {"traverse_ms"})
                for row in rows_of(three, viewer, around(25), by_instance=True, threads=threads)
            ]
            for threads in (1, 2, 5)
        )
        assert all(rows == first for rows in others)


def test_a_frame_does_not_depend_on_those_before(three: World) -> None:
    path, viewer = around(9), Viewer(5_000, SPARK)
    rows = rows_of(three, viewer, path, by_instance=True)
    for number, at in enumerate(path.cameras):
        alone = rows_of(three, viewer, CameraPath((at,), "a test", (), (number,)), by_instance=True)
        assert [without(row, OF_THE_PAST) for row in alone] == [
            without(row, OF_THE_PAST) for row in rows[4 * number : 4 * number + 4]
        ]
    backwards = rows_of(
        three, viewer, CameraPath(path.cameras[::-1], "a test", (), path.numbers[::-1]), by_instance=True
    )
    by_place = {(row["frame"], row["instance"]): without(row, OF_THE_PAST) for row in rows}
    assert all(without(row, OF_THE_PAST) == by_place[row["frame"], row["instance"]] for row in backwards)


def test_numbers_and_names_are_those_of_the_path(town: World) -> None:
    first, second = (
        camera((0, -1, -3), time=0.5),
        dataclasses.replace(camera((1, -2, -4), (0, 0, 1), time=2), name="door"),
    )
    path = CameraPath((first, second), "a test", (), (7, 14))
    rows: list[Any] = rows_of(town, Viewer(500), path)
    assert [(row["frame"], row["time_s"], row["name"] or "") for row in rows] == [(7, 0.5, ""), (14, 2.0, "door")]
    for row, at in zip(rows, path.cameras, strict=True):
        assert [row[f"position_{axis}"] for axis in "xyz"] == np.round(at.position, 6).tolist()
        assert [row[f"forward_{axis}"] for axis in "xyz"] == pytest.approx(at.forward, abs=1e-6)
    ahead = np.array([-1, 2, 5]) / math.sqrt(30)
    assert [rows[1][f"forward_{axis}"] for axis in "xyz"] == pytest.approx(ahead, abs=1e-6)


def test_the_limit_follows_each_camera(town: World) -> None:
    """A pixel's size over its distance: 2 tan(fov / 2) over the height."""
    lenses = [(60.0, (640, 360)), (60.0, (640, 720)), (90.0, (640, 360)), (20.0, (100, 50))]
    path = path_of([camera((0, -1, -3), fov=fov, size=size) for fov, size in lenses])
    rows: list[Any] = rows_of(town, Viewer(10**6, render_scale=3.0), path)
    for row, (fov, (width, height)) in zip(rows, lenses, strict=True):
        assert (row["fov_y_deg"], row["width"], row["height"]) == (fov, width, height)
        limit = 3 * 2 * math.tan(math.radians(fov) / 2) / height
        assert row["pixel_scale_limit"] == float(f"{limit:.6g}")
        assert row["pixel_scale_min"] > limit
    assert len({row["pixel_scale_limit"] for row in rows}) == 4
    fixed: list[Any] = rows_of(town, Viewer(10**6, pixel_scale_limit=0.02), path)
    assert {row["pixel_scale_limit"] for row in fixed} == {0.02}
    assert len({row["selected"] for row in fixed}) == 1  # without foveation it is all that counts


def test_churn_of_one_who_rests_and_of_one_who_jumps(town: World) -> None:
    rows: list[Any] = rows_of(town, Viewer(4_000, SPARK), resting(4))
    assert [(row["added"], row["removed"], row["churn"]) for row in rows[1:]] == [(0, 0, 0.0)] * 3
    assert (rows[0]["added"], rows[0]["removed"], rows[0]["churn"]) == (rows[0]["selected"], 0, None)
    far, near = camera((0, -1e5, 0), (0, 0, 1)), camera((0, -1, -3))
    root, cut, again = map(dict[str, Any], rows_of(town, Viewer(4_000), path_of([far, near, far])))
    assert (root["selected"], again["selected"]) == (1, 1)
    assert (cut["added"], cut["removed"], cut["churn"]) == (cut["selected"], 1, 1.0)
    assert (again["added"], again["removed"], again["churn"]) == (1, cut["selected"], 1.0)


def test_budgets_and_caches_that_are_too_small(three: World) -> None:
    with pytest.raises(ValueError, match="a budget of 2 splats is less than one for each of 3 instances"):
        Simulation(three, Viewer(2))
    with pytest.raises(ValueError, match="cannot hold the roots of 2 trees"):
        Simulation(three, Viewer(3, chunk_cache=1))
    many = World(three.trees, three.forest, three.placements[:1] * 65_536, three.instances[:1] * 65_536)
    with pytest.raises(ValueError, match="65,536 instances are more than 65,535"):
        Simulation(many, Viewer(10**6))


def small_world(seed: int) -> tuple[World, list[twin.Placed]]:
    """Two trees of a few hundred nodes and three instances of them, as the package and the twin have them."""
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, count, 5) for count in (300, 120)]
    spots = [np.eye(4), transform(rng, scale=0.6, spread=2), transform(rng, scale=1.4, spread=4)]
    of, weights = (0, 1, 0), (1.0, 2.5, 0.7)
    own, of_all = Frustum(0.3, 0.1), SPARK
    placements = [
        Placement(Path(f"{tree}.spz"), f"{number}", spot, weight, own if number == 1 else None)
        for number, (tree, spot, weight) in enumerate(zip(of, spots, weights, strict=True))
    ]
    as_nodes = [
        twin.Nodes(tree.center.astype(float), tree.size.astype(float), tree.tree.child_count, tree.tree.child_start)
        for tree in trees
    ]
    made = [
        Tree(
            Path(f"{number}.spz"), 1000, Scene(random_splats(len(nodes.size)), tree.tree), nodes.level.astype(np.int32)
        )
        for number, (tree, nodes) in enumerate(zip(trees, as_nodes, strict=True))
    ]
    instances = [Instance(tree, spot, weight) for tree, spot, weight in zip(of, spots, weights, strict=True)]
    cones = twin.cones(of_all.fov0, of_all.fov, of_all.foveate, of_all.behind)
    weighting = [cones, twin.frustum(own.outside, own.behind), cones]
    placed = [
        twin.Placed(as_nodes[tree], spot, weight, how)
        for tree, spot, weight, how in zip(of, spots, weights, weighting, strict=True)
    ]
    return World(made, Forest(trees), placements, instances), placed


@pytest.mark.parametrize("seed", range(6))
def test_rows_are_as_worked_out_without_sparklod(seed: int) -> None:
    world, placed = small_world(seed)
    rng = np.random.default_rng(100 + seed)
    for budget, render_scale in ((3, 1.0), (150, 1.0), (100_000, 40.0), (100_000, 0.0)):
        eye, target = rng.normal(0, 2, 3), rng.normal(0, 1, 3)
        at = camera(eye, target, fov=70, size=(500, 300))
        right, up, back = at.camera_to_world[:3, :3].T
        seen = twin.Eye(eye, right, up, -back, math.radians(70), 500, 300)
        (row,) = rows_of(world, Viewer(budget, SPARK, render_scale=render_scale), path_of([at]))
        drawn = twin.frame(placed, seen, budget, seen.pixel * render_scale)
        assert twin.differing(drawn.cells, row) == []
        simulation = Simulation(world, Viewer(budget, SPARK, render_scale=render_scale))
        cut = simulation.cut(at).indices()
        assert [set(part.tolist()) for part in cut] == [
            {node for number, node in drawn.cut if number == instance} for instance in range(3)
        ]


def test_frames_tell_how_much_is_in_front(town: World) -> None:
    at, away = camera((0, -1, -6)), camera((0, -1, -6), (0, -1, -20))
    first, second = Simulation(town, Viewer(5_000)).run(path_of([at, away]))
    assert (first.in_front, second.in_front) == (1.0, 0.0)
    assert (first.number, second.number) == (0, 1)
    assert second.rows[0]["behind"] == second.rows[0]["selected"] == len(second.cut)
