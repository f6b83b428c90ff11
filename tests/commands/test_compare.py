"""Comparisons of cuts with full detail: laws over their rows, and `sparklod render --compare`."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import sparklod_cli as sparklod
from sparklod_cli.api.comparison import COLUMNS, Comparison, measured, rows_by_budget, summarize
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.images.metrics import MOST_PSNR, on_background
from sparklod_cli.lod.budget import parse_budgets
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.instances import Instance
from sparklod_cli.render.render_settings import RenderSettings
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers.scenes import Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.commands.cli import Cli
from tests.conftest import FIXTURES

TREE = FIXTURES / "traverse" / "town.spz"
LOD = LodSettings(1, Cones(), pixel_scale_limit=0.0)
RENDER = RenderSettings()


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """A few hundred splats with SH, as a tree, twice."""
    baked = tmp_path_factory.mktemp("compare") / "sh3.spz"
    bake(FIXTURES / "sh3.ply", baked, BakeSettings())
    there = np.eye(4)
    there[:3, 3] = 3, 0, 1
    return read_scenes([Instance(baked, "here"), Instance(baked, "there", there)])


def path_of(count: int, size: tuple[int, int] = (96, 70)) -> CameraPath:
    cameras = []
    for at in range(count):
        eye = (6 * math.sin(at), -1.0, -6 * math.cos(at))
        pose = look_at(eye, (1.5, 0, 0.5), (0.0, -1.0, 0.0))
        cameras.append(Camera(pose, *size, (80.0, 80.0), (size[0] / 2, size[1] / 2), at / 10, f"view, {at}"))
    return CameraPath(tuple(cameras), "a test", (), tuple(range(5, 5 + count)))


def rows(
    scenes: Scenes,
    budgets: str,
    *,
    count: int = 3,
    lod: LodSettings = LOD,
    render: RenderSettings = RENDER,
    threads: int = 1,
) -> list[Row]:
    return list(Comparison(scenes, lod, parse_budgets(budgets), render).run(path_of(count), threads=threads))


def column(table: list[Row], name: str) -> list[Any]:
    return [row[name] for row in table]


def test_a_budget_of_all_splats_is_full_detail(twice: Scenes) -> None:
    for row in rows(twice, "100%,150%,1M"):
        assert row["psnr_black"] == row["psnr_white"] == row["psnr"] == row["worst_tile_psnr"] == MOST_PSNR
        assert row["ssim_black"] == row["ssim_white"] == row["ssim"] == 1
        assert row["edge_psnr_black"] == row["edge_psnr_white"] == row["edge_psnr"] == MOST_PSNR
    for row in rows(twice, "100%", lod=dataclasses.replace(LOD, continuous=1.25)):
        assert (row["psnr"], row["ssim"]) == (MOST_PSNR, 1)


def test_larger_budgets_come_nearer_to_full_detail(twice: Scenes) -> None:
    table = rows(twice, "5%,15%,40%,80%")
    for name in ("psnr", "ssim", "edge_psnr"):
        means = [np.mean(column(group, name)) for group in rows_by_budget(table, 4)]
        assert means == sorted(means)
        assert means[0] < means[-1]
    assert 5 < min(column(table, "psnr")) < max(column(table, "psnr")) < MOST_PSNR


@pytest.mark.parametrize("width", [None, 1.25])
def test_rows_tell_what_was_drawn(twice: Scenes, width: float | None) -> None:
    table = rows(twice, "10%,50%", lod=dataclasses.replace(LOD, continuous=width))
    leaves = Comparison(twice, LOD, parse_budgets("10%"), RENDER).leaves
    assert column(table, "frame") == [5, 5, 6, 6, 7, 7]
    assert column(table, "name")[::2] == ["view, 0", "view, 1", "view, 2"]
    assert column(table, "budget") == [leaves // 10, leaves // 2] * 3
    for row in table:
        assert list(row) == [each.name for each in COLUMNS]
        budget, selected, psnr = (row[name] for name in ("budget", "selected", "psnr"))
        assert isinstance(budget, int) and isinstance(selected, int) and isinstance(psnr, float)
        assert selected <= budget if width is None else budget <= selected <= 4 * budget
        assert psnr == pytest.approx(np.mean([row["psnr_black"], row["psnr_white"]]), abs=1e-3)
        assert row["ssim"] == pytest.approx(np.mean([row["ssim_black"], row["ssim_white"]]), abs=1e-5)
        assert row["edge_psnr"] == pytest.approx(np.mean([row["edge_psnr_black"], row["edge_psnr_white"]]), abs=1e-3)
        assert row["edge_psnr"] < psnr, "edges differ most"
        assert row["worst_tile_psnr"] <= min(row["psnr_black"], row["psnr_white"]) + 1e-3
        assert row["worst_tile_x"] in (0, 64) and row["worst_tile_y"] in (0, 64)


def film(count: int, step: float, *, size: tuple[int, int] = (96, 70), jump: int = -1) -> CameraPath:
    """Cameras in steps of so many radians around the scene; from one on, they stand opposite."""
    cameras = []
    for at in range(count):
        turn = step * at + math.pi * (jump >= 0 and at >= jump)
        pose = look_at((1.5 + 6 * math.sin(turn), -1.0, -6 * math.cos(turn)), (1.5, 0, 0.5), (0.0, -1.0, 0.0))
        cameras.append(Camera(pose, *size, (80.0, 80.0), (size[0] / 2, size[1] / 2), at / 10))
    return CameraPath(tuple(cameras), "a test", (), tuple(range(count)))


def popped(scenes: Scenes, budgets: str, path: CameraPath, *, threads: int = 1) -> list[list[Any]]:
    """The popping of each budget."""
    given = parse_budgets(budgets)
    table = list(Comparison(scenes, LOD, given, RENDER).run(path, threads=threads))
    return [column(group, "popping") for group in rows_by_budget(table, len(given))]


def test_frames_that_follow_each_other_pop_where_the_cut_changes(twice: Scenes) -> None:
    coarse, full = popped(twice, "10%,100%", film(4, 0.05))
    assert full == [None, 0, 0, 0] and coarse[0] is None and min(coarse[1:]) > 0
    assert popped(twice, "10%", film(3, 0.0)) == [[None, 0, 0]]  # a camera that does not move
    (values,) = popped(twice, "10%", film(6, 0.05, jump=3))
    assert [value is None for value in values] == [True, False, False, True, False, False]
    assert popped(twice, "10%", path_of(3)) == [[None] * 3], "views around a scene"


def test_a_change_of_the_cut_pops_by_what_it_changes(twice: Scenes) -> None:
    """Two frames of one camera, but of different budgets: what differs are the pictures of the two cuts."""
    path = film(2, 0.0)
    coarse, fine = (Comparison(twice, LOD, parse_budgets(text), RENDER) for text in ("10%", "40%"))
    (first, _), (_, second) = (list(each._pictures(path, 1)) for each in (coarse, fine))
    changed = dataclasses.replace(second, before=first)
    both = (on_background(first.image, gray) - on_background(second.image, gray) for gray in (0.0, 1.0))
    by_hand = 255 * np.mean([math.sqrt((change.astype(np.float64) ** 2).mean()) for change in both])
    assert measured(changed)["popping"] == pytest.approx(by_hand, abs=1e-4)
    assert by_hand > 1


def test_threads_do_not_change_a_comparison(twice: Scenes) -> None:
    assert rows(twice, "10%,50%", threads=1) == rows(twice, "10%,50%", threads=3)
    assert popped(twice, "10%,50%", film(5, 0.05)) == popped(twice, "10%,50%", film(5, 0.05), threads=3)


def test_spherical_harmonics_can_be_left_out(twice: Scenes) -> None:
    plain = dataclasses.replace(RENDER, max_sh=0)
    assert rows(twice, "100%", count=1, render=plain)[0]["psnr"] == MOST_PSNR
    assert rows(twice, "10%", count=1, render=plain) != rows(twice, "10%", count=1)


def test_summaries_are_by_budget(twice: Scenes) -> None:
    budgets = parse_budgets("10%,50%")
    table = rows(twice, "10%,50%")
    for at, each in enumerate(summarize(table, [budget.text for budget in budgets])):
        mine = table[at::2]
        assert (each.text, each.frames, each.budget) == (budgets[at].text, 3, mine[0]["budget"])
        assert each.psnr == pytest.approx(np.mean(column(mine, "psnr")))
        assert (each.psnr_min, each.psnr_max) == (min(column(mine, "psnr")), max(column(mine, "psnr")))
        assert each.ssim_min == min(column(mine, "ssim"))
        (worst,) = [row for row in mine if row["worst_tile_psnr"] == each.worst_tile_psnr]
        assert (each.worst_frame, each.worst_tile_x) == (worst["frame"], worst["worst_tile_x"])


# --- The command ------------------------------------------------------------------------------------------------------

LINE = "render town.spz --orbit 2 --distance 6 --size 96x70 --compare"
VIEW = "--size 160x90 --look-at 0,-3,9:0,0,0"


def test_the_table_goes_to_standard_output_and_its_summary_to_standard_error(cli: Cli) -> None:
    done = cli(f"{LINE} --budget 10%,50%")
    assert done.out.splitlines()[0] == ",".join(column.name for column in COLUMNS)
    assert len(done.rows) == 2 * 2
    assert [line.split()[0] for line in done.err.splitlines()] == ["2", "budget", "10%", "50%"]
    assert max(map(len, done.err.splitlines())) <= 100


def test_a_terminal_gets_the_summary(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    line = f"render town.spz {VIEW} --compare --budget 5% -q"
    assert cli(line).out.startswith("frame,time_s,")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    out = cli(line).out
    assert "psnr_black" not in out and "worst tile" in out


def test_json_is_the_summary(cli: Cli) -> None:
    done = cli(f"{LINE} --budget 10%,50% --json -o a.json --assert psnr_min>1 --assert '50%: ssim_min > 2'", status=3)
    assert [each["text"] for each in done.json["budgets"]] == ["10%", "50%"]
    assert [each["held"] for each in done.json["asserts"]] == [True, False]
    assert len(json.loads(Path("a.json").read_text())["data"]) == 4


def test_assertions_are_of_all_budgets_or_of_one(cli: Cli) -> None:
    table = cli(f"{LINE} --budget 10%,50%").rows
    between = sum(min(float(row["psnr"]) for row in table[at::2]) for at in (0, 1)) / 2
    cli(f"{LINE} --budget 10%,50% --assert 50%:psnr_min>{between}")
    err = cli(f"{LINE} --budget 10%,50% --assert psnr_min>{between}", status=3).err
    assert "psnr_min is" in err and f"at a budget of {int(table[0]['budget']):,}" in err


def test_popping_is_reported_along_a_path(cli: Cli) -> None:
    film = "render town.spz --dolly --seconds 0.2 --size 96x70 --compare --budget 2%,50% --json"
    asserts = "--assert 2%:popping_max>0.01 --assert popping<0.001 --assert edge_psnr_min>1"
    done = cli(f"{film} {asserts}", status=3)
    assert [each["held"] for each in done.json["asserts"]] == [True, False, True]
    assert 0 < done.json["budgets"][1]["popping"] < done.json["budgets"][0]["popping"]
    columns = ["budget", "splats", "PSNR", "least", "SSIM", "edges", "popping", "most"]
    assert done.err.splitlines()[1].split()[:8] == columns
    assert max(map(len, done.err.splitlines()[:4])) <= 100
    err = cli(f"{LINE} --budget 10% --assert popping<1", status=1).err  # of single views
    assert "popping is empty" in err and "turns" in err


def test_a_scene_without_edges_has_no_psnr_of_them(cli: Cli) -> None:
    """A haze: splats so faint that nothing in the picture is steep."""
    scene = sparklod.read(FIXTURES / "sh3.ply")
    faint = dataclasses.replace(scene.splats, opacity=scene.splats.opacity * np.float32(0.01))
    cli.put("haze.spz", sparklod.build_lod(sparklod.Scene(faint)))
    line = "render haze.spz --size 96x70 --compare --budget 10%"
    done = cli(line)
    assert [row["edge_psnr"] for row in done.rows] == [""]
    assert done.err.splitlines()[-1].split()[5] == "-"
    assert "edge_psnr is empty: full detail has no edges" in cli(f"{line} --assert edge_psnr>1", status=1).err


@pytest.mark.slow
def test_a_chart_is_a_picture(cli: Cli) -> None:
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")
    images = []
    for _ in range(2):
        cli(f"{LINE} --budget 5%,20%,500k --plot a.png -f")
        images.append(Image.open(io.BytesIO(Path("a.png").read_bytes())))
    assert images[0].size[0] == 1600 and images[0].tobytes() == images[1].tobytes()
    assert len(set(np.asarray(images[0].convert("RGB")).reshape(-1, 3)[::7].sum(axis=1).tolist())) > 20


@pytest.mark.slow
@pytest.mark.parametrize("source", ["", "--dolly --every 20"])
def test_a_scene_of_any_size_is_compared_as_it_is_drawn(source: str, cli: Cli) -> None:
    """Wherever cameras are chosen for the scene, near and far are, too."""
    cli.copy("town.spz")
    cli.put("huge.json", json.dumps({"instances": [{"file": "town.spz", "scale": 5000}]}))  # beyond the usual far plane
    huge, usual = (
        [float(row["psnr"]) for row in cli(f"render {scene} --size 160x90 {source} --compare --budget 0.5%,100%").rows]
        for scene in ("--scene huge.json", "town.spz")
    )
    assert all(psnr < 60 for psnr in huge[::2]), "something was in the pictures"
    np.testing.assert_allclose(usual[::2], huge[::2], atol=0.2)


def test_a_continuous_cut_is_nearly_the_ordinary_one(cli: Cli) -> None:
    for name, more in (("ordinary", ""), ("blended", "--continuous"), ("hardly", "--continuous --blend 1.0001")):
        cli(f"render town.spz {VIEW} --budget 5k -q -o {name}.npy {more}")
    ordinary, blended, hardly = (np.load(f"{name}.npy") for name in ("ordinary", "blended", "hardly"))
    assert np.abs(hardly - ordinary).mean() < np.abs(blended - ordinary).mean() < 0.05
    assert (blended != ordinary).any()
