"""What frames tell of cuts: laws over their rows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.model.instances import TOTAL
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.simulation.results import COLUMNS
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers.scenes import Scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, StreamingSettings
from tests.simulation.paths import OF_THE_PAST, SPARK, around, camera, path_of, resting, rows_of, viewers, without

#: Cells that only the row of all instances has.
OF_ALL = {
    *("stop_reason", "pixel_scale_min", "missing", "traverse_ms"),
    *("chunks_touched", "chunks_new", "bytes_new", "chunks_resident", "complete_in_s"),
}


@pytest.mark.parametrize("viewer", viewers(), ids=str)
def test_columns_of_a_row_agree_with_each_other(three: Scenes, viewer: tuple[LodSettings, StreamingSettings]) -> None:
    path, (settings, streaming) = around(12), viewer
    rows = rows_of(three, settings, path, streaming, by_instance=True)
    assert len(rows) == 12 * 4
    assert all(list(row) == [column.name for column in COLUMNS] for row in rows)
    totals: dict[Any, Row] = {row["frame"]: row for row in rows if row["instance"] == TOTAL}
    before: dict[Any, Row] = {}
    for row in rows:
        cell: dict[str, Any] = row
        where = cell["instance"]
        assert cell["selected"] == cell["leaves"] + cell["interior"]
        assert cell["selected"] == cell["in_frustum"] + cell["outside"] + cell["behind"]
        assert cell["frontier"] <= cell["selected"] <= settings.budget == cell["budget"]
        assert cell["budget_used"] == round(cell["selected"] / settings.budget, 4)
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
def test_a_cut_stops_for_the_reason_it_says(three: Scenes, viewer: tuple[LodSettings, StreamingSettings]) -> None:
    settings, streaming = viewer
    for cell in map(dict[str, Any], rows_of(three, settings, around(6), streaming)):
        assert cell["pixel_scale_limit"] == pytest.approx(settings.limit(around(6).cameras[0].fov_y, 360), rel=1e-5)
        if cell["stop_reason"] == "exhausted":
            assert cell["interior"] == 0 == cell["missing"]
        elif cell["stop_reason"] == "pixel":
            assert cell["interior"] > 0
            assert cell["pixel_scale_min"] is None or cell["pixel_scale_min"] > cell["pixel_scale_limit"]
        elif cell["stop_reason"] == "missing":
            assert cell["missing"] > 0
        else:
            assert cell["stop_reason"] == "budget"
            assert cell["selected"] + 160 > settings.budget or settings.budget < 160


def test_every_stop_reason_occurs(three: Scenes) -> None:
    assert {
        row["stop_reason"]
        for settings, streaming in viewers()
        for row in rows_of(three, settings, around(3), streaming)
    } == {*("budget", "pixel", "exhausted", "missing")}


def test_threads_do_not_change_a_row(three: Scenes) -> None:
    for settings, streaming in (viewers()[0], viewers()[6]):
        first, *others = (
            [
                without(row, {"traverse_ms"})
                for row in rows_of(three, settings, around(25), streaming, by_instance=True, threads=threads)
            ]
            for threads in (1, 2, 5)
        )
        assert all(rows == first for rows in others)


def test_a_frame_does_not_depend_on_those_before(three: Scenes) -> None:
    path, settings = around(9), LodSettings(5_000, SPARK)
    rows = rows_of(three, settings, path, by_instance=True)
    for number, at in enumerate(path.cameras):
        alone = rows_of(three, settings, CameraPath((at,), "a test", (), (number,)), by_instance=True)
        assert [without(row, OF_THE_PAST) for row in alone] == [
            without(row, OF_THE_PAST) for row in rows[4 * number : 4 * number + 4]
        ]
    backwards = rows_of(
        three, settings, CameraPath(path.cameras[::-1], "a test", (), path.numbers[::-1]), by_instance=True
    )
    by_place = {(row["frame"], row["instance"]): without(row, OF_THE_PAST) for row in rows}
    assert all(without(row, OF_THE_PAST) == by_place[row["frame"], row["instance"]] for row in backwards)


def test_frame_numbers_and_names_are_those_of_the_path(town: Scenes) -> None:
    first, second = (
        camera((0, -1, -3), time=0.5),
        dataclasses.replace(camera((1, -2, -4), (0, 0, 1), time=2), name="door"),
    )
    path = CameraPath((first, second), "a test", (), (7, 14))
    rows: list[Any] = rows_of(town, LodSettings(500), path)
    assert [(row["frame"], row["time_s"], row["name"] or "") for row in rows] == [(7, 0.5, ""), (14, 2.0, "door")]
    for row, at in zip(rows, path.cameras, strict=True):
        assert [row[f"position_{axis}"] for axis in "xyz"] == np.round(at.position, 6).tolist()
        assert [row[f"forward_{axis}"] for axis in "xyz"] == pytest.approx(at.forward, abs=1e-6)
    ahead = np.array([-1, 2, 5]) / math.sqrt(30)
    assert [rows[1][f"forward_{axis}"] for axis in "xyz"] == pytest.approx(ahead, abs=1e-6)


def test_the_limit_follows_each_camera(town: Scenes) -> None:
    """A pixel's size over its distance: 2 tan(fov / 2) over the height."""
    lenses = [(60.0, (640, 360)), (60.0, (640, 720)), (90.0, (640, 360)), (20.0, (100, 50))]
    path = path_of([camera((0, -1, -3), fov=fov, size=size) for fov, size in lenses])
    rows: list[Any] = rows_of(town, LodSettings(10**6, render_scale=3.0), path)
    for row, (fov, (width, height)) in zip(rows, lenses, strict=True):
        assert (row["fov_y_deg"], row["width"], row["height"]) == (fov, width, height)
        limit = 3 * 2 * math.tan(math.radians(fov) / 2) / height
        assert row["pixel_scale_limit"] == float(f"{limit:.6g}")
        assert row["pixel_scale_min"] > limit
    assert len({row["pixel_scale_limit"] for row in rows}) == 4
    fixed: list[Any] = rows_of(town, LodSettings(10**6, pixel_scale_limit=0.02), path)
    assert {row["pixel_scale_limit"] for row in fixed} == {0.02}
    assert len({row["selected"] for row in fixed}) == 1  # without foveation it is all that counts


def test_churn_is_0_at_rest_and_1_for_a_jump(town: Scenes) -> None:
    rows: list[Any] = rows_of(town, LodSettings(4_000, SPARK), resting(4))
    assert [(row["added"], row["removed"], row["churn"]) for row in rows[1:]] == [(0, 0, 0.0)] * 3
    assert (rows[0]["added"], rows[0]["removed"], rows[0]["churn"]) == (rows[0]["selected"], 0, None)
    far, near = camera((0, -1e5, 0), (0, 0, 1)), camera((0, -1, -3))
    root, cut, again = map(dict[str, Any], rows_of(town, LodSettings(4_000), path_of([far, near, far])))
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


def test_frames_have_the_share_of_splats_in_front(town: Scenes) -> None:
    at, away = camera((0, -1, -6)), camera((0, -1, -6), (0, -1, -20))
    first, second = Simulation(town, LodSettings(5_000)).run(path_of([at, away]))
    assert (first.in_front, second.in_front) == (1.0, 0.0)
    assert (first.number, second.number) == (0, 1)
    assert second.rows[0]["behind"] == second.rows[0]["selected"] == len(second.cut)
