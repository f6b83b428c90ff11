"""`sparklod traverse` through several trees, by name or from an instances file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from tests.commands.traverse.runs import ORBIT, TOWN, TREE, scene_file, table, traverse
from tests.conftest import Capture


def test_files_of_one_name_get_numbers(tmp_path: Path, capsys: Capture) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(TREE, tmp_path / folder / "door.spz")
    files = (tmp_path / "a" / "door.spz", tmp_path / "b" / "door.spz", tmp_path / "a" / "door.spz")
    assert traverse(*files, *ORBIT, "--per-instance") == 0
    names = [row["instance"] for row in table(capsys.readouterr().out)]
    assert names[:4] == ["total", "door", "door 2", "door 3"]


def test_an_instance_farther_away_has_fewer_nodes(tmp_path: Path, capsys: Capture) -> None:
    shutil.copy(TREE, tmp_path / "tree.spz")
    scene = scene_file(tmp_path, {"file": "tree.spz", "name": "near"}, {"file": "tree.spz", "translation": [0, 0, 500]})
    assert traverse("--scene", scene, "--look-at", "0,0,-9:0,0,0", "--per-instance") == 0
    total, near, far = table(capsys.readouterr().out)
    assert [row["instance"] for row in (total, near, far)] == ["total", "near", "tree"]
    assert int(near["selected"]) > int(far["selected"])
    assert int(total["selected"]) == int(near["selected"]) + int(far["selected"])


def test_a_scene_names_what_is_missing_beside_it(tmp_path: Path, capsys: Capture) -> None:
    assert traverse("--scene", scene_file(tmp_path, {"file": "gone.spz"})) == 1
    assert capsys.readouterr().err == f"error: {tmp_path / 'gone.spz'}: cannot be read: no such file or directory\n"
    assert traverse("--scene", scene_file(tmp_path, {"file": "a"}, {"file": "b", "scale": "big"})) == 1
    assert f"error: {tmp_path / 'scene.json'}: instance 1 has scale 'big'" in capsys.readouterr().err


def test_a_walk_through_a_city_has_a_row_for_every_instance_and_frame(
    built: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Three trees, five instances, ten seconds on foot, over a network."""
    for name in ("demo-lod.spz", "sh3-lod.spz"):
        shutil.copy(built / name, tmp_path / name)
    shutil.copy(TOWN, tmp_path / "town.spz")
    half = 2**-0.5
    scene = scene_file(
        tmp_path,
        {"file": "town.spz"},
        {"file": "town.spz", "name": "suburb", "translation": [9, 0, 1], "rotation": [0, half, 0, half], "scale": 0.8},
        {"file": "demo-lod.spz", "name": "monument", "translation": [0, -0.5, 0], "scale": 0.1, "lod_scale": 2},
        {"file": "demo-lod.spz", "translation": [8, -0.5, 1], "rotation": [0, 1, 0, 0], "scale": 0.2},
        {"file": "sh3-lod.spz", "matrix": [1, 0, 0, 4, 0, 1, 0, -2, 0, 0, 1, 5, 0, 0, 0, 1], "lod_scale": 0.5},
    )
    keys = "-6,-2,-6:0,0,0 0,-1,-3:0,-0.5,0 5,-1,-2:8,-0.5,1 7,-1,4:9,0,1"
    settings = ("--keyframes", keys, "--seconds", 299 / 90, "--fps", 30)
    network = ("--bandwidth", "20Mbit", "--latency", "60ms", "--budget", "100k")
    assert traverse("--scene", scene, *settings, *network, "--per-instance", "-o", tmp_path / "city.json") == 0
    assert capsys.readouterr() == ("", "")
    rows = json.loads((tmp_path / "city.json").read_text())["data"]
    frames, each = [row for row in rows if row["instance"] == "total"], {}
    assert (len(frames), len(rows)) == (300, 1800)
    for row in rows:
        each.setdefault(row["instance"], []).append(row)
    assert list(each) == ["total", "town", "suburb", "monument", "demo-lod", "sh3-lod"]
    for number, total in enumerate(frames):
        parts = [of_one[number] for name, of_one in each.items() if name != "total"]
        for name in ("selected", "leaves", "interior", "in_frustum", "outside", "behind", "added", "removed"):
            assert total[name] == sum(part[name] for part in parts)
        assert total["selected"] == total["leaves"] + total["interior"] <= 100_000
        assert total["selected"] == total["in_frustum"] + total["outside"] + total["behind"]
        assert {part["frame"] for part in parts} == {total["frame"]} == {number}
    for name in each:
        for before, row in zip(each[name], each[name][1:], strict=False):
            assert row["added"] - row["removed"] == row["selected"] - before["selected"]
    sizes = sum((tmp_path / name).stat().st_size for name in ("town.spz", "demo-lod.spz", "sh3-lod.spz"))
    assert sum(row["bytes_new"] for row in frames) <= sizes
    # Nothing is there before its latency is over, and all of it is before the path ends.
    assert all(row["selected"] == 0 for row in frames if row["time_s"] < 0.06)
    assert frames[-1]["missing"] == 0 == frames[-1]["complete_in_s"]
    assert frames[-1]["selected"] > 50_000
    assert traverse("--scene", scene, *settings, *network, "--no-timing", "--assert", "frame_count==300") == 0
    assert len(table(capsys.readouterr().out)) == 300
