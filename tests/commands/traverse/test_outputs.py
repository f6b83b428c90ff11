"""Outputs of `sparklod traverse`: nodes of cuts, instances, waiting times, and what a terminal shows."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from sparklod_cli.simulation.results import LOADING
from tests.commands.traverse.runs import ORBIT, OTHER, TOWN, TREE, scene_file, table, traverse
from tests.conftest import FIXTURES, Capture


def cut_of(path: Path) -> np.ndarray:
    nodes: np.ndarray = np.load(path)
    assert nodes.dtype == np.uint32
    return nodes


def test_indices_out_writes_the_nodes_of_every_cut(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "new" / "cuts"
    assert traverse(TOWN, *ORBIT, "--budget", "20k", "--indices-out", folder) == 0
    rows = table(capsys.readouterr().out)
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npy", "000001.npy", "000002.npy"]
    for row in rows:
        nodes = cut_of(folder / f"{int(row['frame']):06d}.npy")
        assert nodes.shape == (int(row["selected"]),)
        assert (np.diff(nodes.astype(np.int64)) > 0).all()
    padded = tmp_path / "padded"
    assert traverse(TOWN, *ORBIT, "--budget", "20k", "--indices-out", padded, "--padded") == 0
    for path in folder.iterdir():
        nodes, rows_of_texture = cut_of(path), cut_of(padded / path.name)
        assert rows_of_texture.shape == (2, 16_384)
        assert np.array_equal(rows_of_texture.ravel()[: len(nodes)], nodes)
        assert not rows_of_texture.ravel()[len(nodes) :].any()
    capsys.readouterr()
    assert traverse(TOWN, *ORBIT, "--indices-out", folder) == 1
    assert f"{folder / '000000.npy'} exists, add --overwrite" in capsys.readouterr().err
    assert traverse(TOWN, *ORBIT, "--indices-out", folder, "--overwrite", "--budget", "100", "-q") == 0
    assert len(cut_of(folder / "000000.npy")) <= 100


def test_indices_out_names_instances_and_frames(tmp_path: Path, capsys: Capture) -> None:
    cuts = tmp_path / "cuts"
    assert traverse(TREE, OTHER, *ORBIT, "--every", 2, "--indices-out", cuts, "--per-instance") == 0
    rows = table(capsys.readouterr().out)
    assert [(row["frame"], row["instance"]) for row in rows] == [
        (frame, name) for frame in "02" for name in ("total", "hand-tree-v3", "tree-v3")
    ]
    assert sorted(path.name for path in cuts.iterdir()) == [f"00000{frame}.{at}.npy" for frame in "02" for at in "01"]
    for row in rows:
        if row["instance"] != "total":
            at = 0 if row["instance"] == "hand-tree-v3" else 1
            assert len(cut_of(cuts / f"00000{row['frame']}.{at}.npy")) == int(row["selected"])


def test_indices_out_refuses_a_path_that_is_a_file(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "cuts").touch()
    assert traverse(TREE, *ORBIT, "--indices-out", tmp_path / "cuts") == 2
    assert "cuts" in capsys.readouterr().err


def at_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)


def test_a_terminal_gets_the_summary(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    for quiet in ((), ("-q",)):
        assert traverse(TOWN, *ORBIT, *quiet) == 0
        out, err = capsys.readouterr()
        assert "splats drawn" in out
        assert "frame,time_s" not in out
        assert "splats drawn" not in err  # once is enough


@pytest.mark.parametrize("option", [("--format", "csv"), ("--per-instance",), ("--no-timing",)], ids=str)
def test_a_terminal_gets_the_table_by_output_alone(
    option: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, *option) == 2
    assert f"{option[0]} is of the table, and a terminal gets the summary; redirect" in capsys.readouterr().err
    assert traverse(TOWN, *ORBIT, *option, "-o", "-") == 0
    assert len({row["frame"] for row in table(capsys.readouterr().out)}) == 3


def test_a_terminal_gets_no_summary_that_nobody_wants(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, "--no-summary") == 0
    assert capsys.readouterr() == ("", "")


def test_a_pipe_gets_the_table(capsys: Capture) -> None:
    assert traverse(TOWN, *ORBIT) == 0
    out, err = capsys.readouterr()
    assert len(table(out)) == 3
    assert err == ""


def test_what_must_hold_is_checked_without_a_table(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    at_a_terminal(monkeypatch)
    assert traverse(TOWN, *ORBIT, "--assert", "selected<0") == 3
    out, err = capsys.readouterr()
    assert "splats drawn" in out
    assert err.startswith("error: ")


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
    assert (
        f"error: {tmp_path / 'scene.json'}: instances[1].scale: expected a number up to 1e+12, not 'big'"
        in capsys.readouterr().err
    )


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
    path = tmp_path / "city.json"
    assert traverse("--scene", scene, *settings, *network, "--per-instance", "-o", path) == 0
    whole = "town.spz, demo-lod.spz, sh3-lod.spz: loaded whole by viewers before they draw"
    said = f"{whole}; the waits are those of a RAD with the same nodes\n{path}  table of 300 frames\n"
    assert capsys.readouterr() == ("", said)
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


VIEW = ("--look-at", "1,-1,-2:0,0,0", "--budget", "20k")
SLOW = ("--bandwidth", "800kbit", "--latency", "100ms")


def test_the_summary_tells_what_a_visitor_waits_for(capsys: Capture) -> None:
    assert traverse(TOWN, *VIEW, *SLOW, "--json", "--summary") == 0
    out, err = capsys.readouterr()
    loading = json.loads(out)["loading"]
    assert list(loading) == [column.name for column in LOADING]
    assert 0.1 < loading["first_picture_s"] < loading["resident_90_s"] <= loading["resident_all_s"]
    assert (
        loading["resident_90_bytes"] <= loading["resident_all_bytes"] <= (FIXTURES / "traverse/town.spz").stat().st_size
    )
    assert f"opens      first picture after {loading['first_picture_s']:.2f} s, 90 % after" in err


def test_a_cache_that_is_too_small_never_has_it_all(capsys: Capture) -> None:
    assert traverse(TOWN, *VIEW, *SLOW, "--chunk-cache", "1", "--json", "--summary") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["loading"]["resident_all_s"] is None
    assert "all never" in err


@pytest.mark.parametrize("text, code", [("first_picture_s<1", 0), ("resident_all_s<0.2", 3), ("resident_90_s<9", 0)])
def test_assertions_can_be_about_it(text: str, code: int, capsys: Capture) -> None:
    assert traverse(TOWN, *VIEW, *SLOW, "--assert", text, "--json") == code
    (held,) = json.loads(capsys.readouterr().out)["asserts"]
    assert held["held"] == (code == 0)


def test_an_spz_is_said_to_be_loaded_whole_where_it_is_streamed(tmp_path: Path, capsys: Capture) -> None:
    note = "town.spz: loaded whole by viewers before they draw; the waits are those of a RAD with the same nodes\n"
    assert traverse(TOWN, *VIEW, *SLOW, "-o", tmp_path / "a.csv") == 0
    assert note in capsys.readouterr().err
    assert traverse(TOWN, *VIEW, "-o", tmp_path / "b.csv") == 0
    assert note not in capsys.readouterr().err
    (tmp_path / "town.rad").write_bytes(b"".join(rad.encode(read_scene(TOWN))))
    assert traverse(tmp_path / "town.rad", *VIEW, *SLOW, "-o", tmp_path / "c.csv") == 0
    assert "loaded whole" not in capsys.readouterr().err


def test_without_a_network_nobody_waits(capsys: Capture) -> None:
    assert traverse(TOWN, *VIEW, "--json") == 0
    assert json.loads(capsys.readouterr().out)["loading"] is None
    assert traverse(TOWN, *VIEW, "--assert", "first_picture_s<1", "--json") != 0
    assert "first_picture_s is empty: it needs --bandwidth" in capsys.readouterr().err


def test_a_table_is_confirmed_as_other_outputs_are(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "t.csv"
    assert traverse(TREE, "--orbit", "3", "--output", path) == 0
    assert capsys.readouterr().err == f"{path}  table of 3 frames\n"
    assert traverse(TREE, "--orbit", "3", "--output", path, "--overwrite", "-q") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(os.name != "posix", reason="needs pipes that close")
@pytest.mark.parametrize("more", [(), ("-o", "-"), ("-o", "-", "--format", "json")])
def test_a_reader_that_has_enough_is_no_error(more: tuple[str, ...]) -> None:
    """As of `sparklod traverse ... | head -1`."""
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(TREE), "--orbit", "3000", *more]
    reading, writing = os.pipe()
    with subprocess.Popen(command, stdout=writing, stderr=subprocess.PIPE) as process:
        os.close(writing)
        os.read(reading, 1)
        os.close(reading)
        _, err = process.communicate()
    assert (process.returncode, err) == (1, b"")
