"""`sparklod traverse`: tables, summaries, assertions, nodes of cuts, instances, waiting times, plots, interruptions."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.images import charts, scene_plots
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.simulation.results import COLUMNS, LOADING
from tests.commands.cli import NAMED, Cli
from tests.conftest import ROOT

TOWN, TREE, OTHER = "town.spz", "hand-tree-v3.spz", "tree-v3.spz"
NAMES = [column.name for column in COLUMNS]
ORBIT = "--orbit 3 --distance 5 --center 0,0,0"
VIEW = "--look-at 1,-1,-2:0,0,0 --budget 20k"
SLOW = "--bandwidth 800kbit --latency 100ms"


def rows_of(name: str) -> list[dict[str, str]]:
    with Path(name).open(newline="") as file:
        return list(csv.DictReader(file))


def put_scene(cli: Cli, *instances: dict[str, Any], name: str = "scene.json") -> None:
    """Write an instances file of fixtures."""
    for instance in instances:
        cli.copy(instance["file"])
    cli.put(name, json.dumps({"instances": instances}))


# --- Tables and summaries ---------------------------------------------------------------------------------------------


def test_a_table_comes_on_standard_output_and_nothing_else_is_said(cli: Cli) -> None:
    done = cli(f"traverse {TOWN}")
    assert list(done.rows[0]) == NAMES and done.err == ""
    assert [row["frame"] for row in done.rows] == [str(number) for number in range(60)]
    assert {(row["instance"], row["budget"]) for row in done.rows} == {("total", "2500000")}
    assert len(cli(f"traverse {TREE} --look-at 0,-1,-9:0,0,0").rows) == 1


def test_threads_do_not_change_a_table(cli: Cli) -> None:
    line = f"traverse {TOWN} {ORBIT} --budget 4k --no-timing --per-instance --threads"
    first, *others = (cli(f"{line} {threads}") for threads in (1, 2, 5))
    assert all(other.out == first.out for other in others)
    assert list(first.rows[0]) == [name for name in NAMES if name != "traverse_ms"]


def test_every_format_has_the_same_cells(cli: Cli) -> None:
    line = f"traverse {TOWN} {ORBIT} --budget 4k --no-timing"
    csv_rows, data = cli(line).rows, cli(f"{line} --format json").json["data"]
    for name, more in (("a.csv", ""), ("a.JSON", ""), ("a.txt", "--format csv"), ("a", "--format json")):
        assert cli(f"{line} -o {name} {more}")[1:] == ("", f"{name}  table of 3 frames\n")
    assert rows_of("a.csv") == rows_of("a.txt") == csv_rows
    assert all(json.loads(Path(name).read_text())["data"] == data for name in ("a.JSON", "a"))
    assert cli(f"{line} -o -").rows == csv_rows
    assert csv_rows == [
        {c.name: "" if row[c.name] is None else format(row[c.name], c.digits) for c in COLUMNS if c.name in row}
        for row in data
    ]


@pytest.mark.slow
def test_parquet_has_the_same_cells(cli: Cli) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    line = f"traverse {TOWN} {ORBIT} --budget 4k --no-timing"
    cli(f"{line} -o a.parquet")
    cli(f"{line} --format parquet -o other")
    assert Path("a.parquet").read_bytes() == Path("other").read_bytes()
    assert parquet.read_table("a.parquet").to_pylist() == cli(f"{line} --format json").json["data"]


def test_a_summary_is_printed_on_request(cli: Cli) -> None:
    done = cli(f"traverse {TOWN} {ORBIT} --budget 4k --summary -o a.csv")
    assert done.out == "" and "3 frames, 0.067 s" in done.err and "100.0 % at the budget" in done.err
    for options, lines in (("--no-summary", 1), ("", 1), ("--summary -q", 0)):
        done = cli(f"traverse {TOWN} {ORBIT} {options} -o a.csv -f")
        assert done[1:] == ("", "a.csv  table of 3 frames\n" * lines)
    err = cli(f"traverse {TREE} {ORBIT} -v --assert selected>0").err
    assert "3 frames of an orbit, " in err and "holds: selected>0" in err


def test_json_is_the_summary_and_the_table_goes_to_its_file(cli: Cli) -> None:
    done = cli(f"traverse {TOWN} {ORBIT} --budget 4k --json -o a.csv --assert selected<=4k")
    summary, most = done.json, max(int(row["selected"]) for row in rows_of("a.csv"))
    assert (summary["frames"], summary["stop_reasons"], summary["loading"]) == (3, {"budget": 1.0}, None)
    assert summary["asserts"] == [{"assert": "selected<=4k", "held": True, "value": most}]
    assert summary["quantities"]["selected"]["max"] == most
    assert done.err == "a.csv  table of 3 frames\n"


def test_an_assertion_that_fails_is_exit_status_3(cli: Cli) -> None:
    line = f"traverse {TOWN} {ORBIT} --budget 4k -o a.csv -f --assert"
    cli(f"{line} selected<=4k --assert missing==0")
    done = cli(f"{line} selected<=4k --assert churn_max<0.1 -q", status=3)
    assert done.out == "" and re.fullmatch(r"error: churn_max<0\.1: churn_max is 0\..*\n", done.err)
    assert len(rows_of("a.csv")) == 3  # the table is written all the same
    assert cli(f"{line} selected<1 --json", status=3).json["asserts"][0]["held"] is False


# --- Terminals --------------------------------------------------------------------------------------------------------


def test_a_terminal_gets_the_summary_and_the_table_by_output_alone(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    for quiet in ("", "-q"):
        done = cli(f"traverse {TOWN} {ORBIT} {quiet}")
        assert "splats drawn" in done.out and "frame,time_s" not in done.out and "splats drawn" not in done.err
    for option in ("--format csv", "--per-instance", "--no-timing"):
        said = f"{option.split()[0]} is of the table, and --json and terminals get the summary; redirect"
        assert said in cli(f"traverse {TOWN} {ORBIT} {option}", status=2).err
        assert len({row["frame"] for row in cli(f"traverse {TOWN} {ORBIT} {option} -o -").rows}) == 3
    assert cli(f"traverse {TOWN} {ORBIT} --no-summary")[1:] == ("", "")
    done = cli(f"traverse {TOWN} {ORBIT} --assert selected<0", status=3)
    assert "splats drawn" in done.out and done.err.startswith("error: ")


# --- Cuts and instances -----------------------------------------------------------------------------------------------


def cut_of(name: str) -> np.ndarray:
    nodes: np.ndarray = np.load(name)
    assert nodes.dtype == np.uint32
    return nodes


def test_indices_out_writes_the_nodes_of_every_cut(cli: Cli) -> None:
    line = f"traverse {TOWN} {ORBIT} --budget 20k --indices-out"
    rows = cli(f"{line} new/cuts").rows
    assert cli.made() == [f"new/cuts/00000{frame}.npy" for frame in range(3)]
    cli(f"{line} padded --padded")
    for row in rows:
        name = f"{int(row['frame']):06d}.npy"
        nodes, padded = cut_of(f"new/cuts/{name}"), cut_of(f"padded/{name}")
        assert nodes.shape == (int(row["selected"]),) and (np.diff(nodes.astype(np.int64)) > 0).all()
        assert padded.shape == (2, 16_384)
        assert np.array_equal(padded.ravel()[: len(nodes)], nodes) and not padded.ravel()[len(nodes) :].any()


def test_indices_out_names_instances_and_frames(cli: Cli) -> None:
    rows = cli(f"traverse {TREE} {OTHER} {ORBIT} --every 2 --indices-out cuts --per-instance").rows
    instances = ("total", "hand-tree-v3", "tree-v3")
    assert [(row["frame"], row["instance"]) for row in rows] == [(at, name) for at in "02" for name in instances]
    assert cli.made() == [f"cuts/00000{frame}.{at}.npy" for frame in "02" for at in "01"]
    for row in rows:
        if row["instance"] != "total":
            at = instances.index(row["instance"]) - 1
            assert len(cut_of(f"cuts/00000{row['frame']}.{at}.npy")) == int(row["selected"])


def test_instances_have_names_and_places_of_their_own(cli: Cli) -> None:
    for folder in ("a", "b"):
        cli.put(f"{folder}/door.spz", NAMED[TREE].read_bytes())
    rows = cli(f"traverse a/door.spz b/door.spz a/door.spz {ORBIT} --per-instance").rows
    assert [row["instance"] for row in rows][:4] == ["total", "door", "door 2", "door 3"]
    put_scene(cli, {"file": OTHER, "name": "near"}, {"file": OTHER, "translation": [0, 0, 500]})
    rows = cli("traverse --scene scene.json --look-at 0,0,-9:0,0,0 --per-instance").rows
    assert [row["instance"] for row in rows] == ["total", "near", "tree-v3"]
    total, near, far = (int(row["selected"]) for row in rows)
    assert near > far and total == near + far


def test_a_walk_through_a_city_has_a_row_for_every_instance_and_frame(cli: Cli) -> None:
    """Three trees, five instances, ten seconds on foot, over a network."""
    cli("build-lod demo.ply sh3.ply --output-dir ./ -q")
    half, files = 2**-0.5, ("town.spz", "demo-lod.spz", "sh3-lod.spz")
    put_scene(
        cli,
        {"file": "town.spz"},
        {"file": "town.spz", "name": "suburb", "translation": [9, 0, 1], "rotation": [0, half, 0, half], "scale": 0.8},
        {"file": "demo-lod.spz", "name": "monument", "translation": [0, -0.5, 0], "scale": 0.1, "lod_scale": 2},
        {"file": "demo-lod.spz", "translation": [8, -0.5, 1], "rotation": [0, 1, 0, 0], "scale": 0.2},
        {"file": "sh3-lod.spz", "matrix": [1, 0, 0, 4, 0, 1, 0, -2, 0, 0, 1, 5, 0, 0, 0, 1], "lod_scale": 0.5},
    )
    keys = "-6,-2,-6:0,0,0 0,-1,-3:0,-0.5,0 5,-1,-2:8,-0.5,1 7,-1,4:9,0,1"
    path = f"--keyframes '{keys}' --seconds {299 / 90} --fps 30"
    network = "--bandwidth 20Mbit --latency 60ms --budget 100k --per-instance"
    done = cli(f"traverse --scene scene.json {path} {network} --assert frame_count==300 -o city.json")
    said = f"{', '.join(files)}: loaded whole by viewers before they draw; the waits are those of a RAD"
    assert done.out == "" and done.err.startswith(said)
    rows = json.loads(Path("city.json").read_text())["data"]
    each: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        each.setdefault(row["instance"], []).append(row)
    frames = each["total"]
    assert (len(frames), len(rows)) == (300, 1800)
    assert list(each) == ["total", "town", "suburb", "monument", "demo-lod", "sh3-lod"]
    for number, total in enumerate(frames):
        parts = [of_one[number] for name, of_one in each.items() if name != "total"]
        assert total["selected"] == sum(part["selected"] for part in parts) <= 100_000
    assert sum(row["bytes_new"] for row in frames) <= sum(Path(name).stat().st_size for name in files)
    # Nothing is drawn before its latency is over, and all chunks have arrived before the path ends.
    assert all(row["selected"] == 0 for row in frames if row["time_s"] < 0.06)
    assert frames[-1]["missing"] == 0 == frames[-1]["complete_in_s"] and frames[-1]["selected"] > 50_000


# --- Loading ----------------------------------------------------------------------------------------------------------


def test_the_summary_has_the_waits_of_a_visitor(cli: Cli) -> None:
    line = f"traverse {TOWN} {VIEW} {SLOW} --json"
    done = cli(f"{line} --summary")
    loading = done.json["loading"]
    assert list(loading) == [column.name for column in LOADING]
    assert 0.1 < loading["first_picture_s"] < loading["resident_90_s"] <= loading["resident_all_s"]
    assert loading["resident_90_bytes"] <= loading["resident_all_bytes"] <= NAMED[TOWN].stat().st_size
    assert f"opens      first picture after {loading['first_picture_s']:.2f} s, 90 % after" in done.err
    for text, status in (("first_picture_s<1", 0), ("resident_all_s<0.2", 3), ("resident_90_s<9", 0)):
        (assertion,) = cli(f"{line} --assert {text}", status=status).json["asserts"]
        assert assertion["held"] == (status == 0)
    done = cli(f"{line} --summary --chunk-cache 1")
    assert done.json["loading"]["resident_all_s"] is None and "all never" in done.err


def test_an_spz_over_a_network_is_said_to_be_loaded_whole(cli: Cli) -> None:
    cli("convert town.spz town.rad -q")
    for file, network, note in (("town.spz", SLOW, True), ("town.spz", "", False), ("town.rad", SLOW, False)):
        err = cli(f"traverse {file} {VIEW} {network} -o a.csv -f").err
        assert ("town.spz: loaded whole by viewers before they draw; the waits are" in err) == note


# --- Cameras and plots ------------------------------------------------------------------------------------------------


def test_cameras_have_warnings_and_notes_that_quiet_leaves_out(cli: Cli) -> None:
    away = f"traverse {TOWN} --look-at 0,-1,-9:0,-1,-20 --budget 4k"
    err = cli(away).err
    assert err.startswith("warning: only 0 % of the splats lie in front of the cameras")
    assert err.endswith("axes (--camera-axes, --world-transform, --up)\n")
    path = json.loads(NAMED["transforms.json"].read_text()) | {"k1": 0.25}
    cli.put("distorted.json", json.dumps(path))
    assert "Its lens distortion was ignored.\n" in cli(f"traverse {TREE} --camera-path distorted.json").err
    for line in (f"{away} -q", f"traverse {TREE} --camera-path distorted.json -q"):
        assert cli(line).err == ""


@pytest.mark.slow
def test_a_plot_is_a_picture(cli: Cli) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    cli(f"traverse {TOWN} {ORBIT} --budget 4k --plot a.png -o a.csv")
    with image.open("a.png") as picture:
        assert picture.width == 1600
    assert "a.png exists, add --overwrite" in cli(f"traverse {TOWN} {ORBIT} --plot a.png -o b.csv", status=1).err
    assert cli.made() == ["a.csv", "a.png"]


@pytest.mark.slow
def test_a_plot_shows_the_splats_of_its_frame(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a slow network few chunks are resident; the picture is of the splats drawn with these."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")
    shown: list[scene_plots.PathScene] = []

    def drawn(rows: object, marked: object, title: str, scene: scene_plots.PathScene) -> tuple[bytes, str | None]:
        shown.append(scene)
        return b"a plot", None

    monkeypatch.setattr(charts, "plot", drawn)
    for network in ("", "--bandwidth 0.1Mbit --latency 50ms"):
        cli(f"traverse {TOWN} {ORBIT} {network} --plot a.png -o a.csv -f")
        scene = shown[-1]
        assert scene.frame is not None
        assert len(scene.splats) == len(scene.depth) == int(rows_of("a.csv")[scene.frame]["selected"])
    assert len(shown[1].splats) < len(shown[0].splats)


# --- Interruptions ----------------------------------------------------------------------------------------------------


def test_an_interruption_leaves_no_half_table(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    fly = Simulation.run

    def falling(self: Simulation, *arguments: Any, **settings: Any) -> Any:
        for frame in fly(self, *arguments, **settings):
            if frame.number == 2:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(Simulation, "run", falling)
    assert "interrupted" in cli(f"traverse {TREE} {ORBIT} -o a.csv", status=130).err
    assert cli.made() == []
    cli.put("a.csv", "precious")
    cli(f"traverse {TREE} {ORBIT} -o a.csv -f", status=130)
    assert Path("a.csv").read_text() == "precious" and cli.made() == []


def is_writing(process: int, folder: Path) -> bool:
    """Return whether a process has a file open in a folder; it may not have a name yet."""
    with contextlib.suppress(OSError):  # one that is being closed, or a system without /proc
        if any(str(file.readlink()).startswith(str(folder)) for file in Path(f"/proc/{process}/fd").iterdir()):
            return True
    return any(folder.iterdir())


@pytest.mark.slow
def test_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    """As Ctrl-C, which whoever runs tests in the background may have turned off."""
    settings = f"--orbit 10000 --distance 5 --center 0,0,0 --budget 50k --threads 2 -q -o {tmp_path}/out.csv"
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(NAMED[TOWN]), *settings.split()]
    running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE)
    for _ in range(600):
        if is_writing(running.pid, tmp_path):
            break
        time.sleep(0.05)
    time.sleep(0.1)
    running.send_signal(signal.SIGTERM)
    _, err = running.communicate(timeout=60)
    assert (running.returncode, err.strip()) == (130, b"interrupted")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="needs pipes that close")
@pytest.mark.parametrize("more", ["", "-o -", "-o - --format json"])
def test_a_reader_that_has_enough_is_no_error(more: str) -> None:
    """As of `sparklod traverse ... | head -1`."""
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(NAMED[TREE]), "--orbit", "3000", *more.split()]
    reading, writing = os.pipe()
    with subprocess.Popen(command, stdout=writing, stderr=subprocess.PIPE) as running:
        os.close(writing)
        os.read(reading, 1)
        os.close(reading)
        _, err = running.communicate()
    assert (running.returncode, err) == (1, b"")
