"""`sparklod traverse` as a shell sees it: exit codes, what goes where, and that files are whole or not there."""

from __future__ import annotations

import csv
import io
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.simulation.columns import COLUMNS
from sparklod_cli.simulation.simulate import Simulation
from tests.conftest import FIXTURES, ROOT

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
OTHER = FIXTURES / "golden" / "tree-v3.spz"
FAULTS, CAMERAS = FIXTURES / "faults", FIXTURES / "cameras"
NAMES = [column.name for column in COLUMNS]
ORBIT = ("--orbit", 3, "--distance", 5, "--center", "0,0,0")

Said = pytest.CaptureFixture[str]


def traverse(*arguments: object) -> int:
    return run(["traverse", *map(str, arguments)])


@pytest.fixture(scope="module", autouse=True)
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two baked trees; from here on nothing is compiled any more, which would be said."""
    folder = tmp_path_factory.mktemp("baked")
    sources = [str(FIXTURES / name) for name in ("demo.ply", "sh3.ply")]
    assert run(["build-lod", *sources, "--output-dir", str(folder), "-q"]) == 0
    settings = ("--budget", "2k", "--per-instance", "--indices-out", folder / "cuts", "-o", folder / "out.csv", "-q")
    assert traverse(TOWN, TREE, *ORBIT, *settings) == 0
    return folder


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_a_table_comes_on_standard_output_and_nothing_else_is_said(capsys: Said) -> None:
    assert traverse(TOWN) == 0
    out, err = capsys.readouterr()
    rows = table(out)
    assert list(rows[0]) == NAMES
    assert [row["frame"] for row in rows] == [str(number) for number in range(60)]
    assert {row["instance"] for row in rows} == {"total"}
    assert {row["budget"] for row in rows} == {"2500000"}
    assert err == ""


def test_two_runs_give_the_same_bytes(capsys: Said) -> None:
    outs = set()
    for threads in (1, 2, 5):
        assert traverse(TOWN, *ORBIT, "--budget", "4k", "--no-timing", "--threads", threads, "--per-instance") == 0
        outs.add(capsys.readouterr().out)
    (out,) = outs
    assert list(table(out)[0]) == [name for name in NAMES if name != "traverse_ms"]


def test_an_output_is_a_file(tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "frames.csv"
    assert traverse(TREE, *ORBIT, "-o", output, "--no-timing") == 0
    assert capsys.readouterr() == ("", "")
    assert len(table(output.read_text())) == 3
    before = output.read_bytes()
    assert traverse(TREE, "--look-at", "0,0,9:0,0,0", "-o", output) == 1
    assert capsys.readouterr().err == f"error: {output} exists, add --overwrite to replace it\n"
    assert output.read_bytes() == before
    assert traverse(TREE, "--look-at", "0,0,9:0,0,0", "-o", output, "--overwrite") == 0
    assert len(table(output.read_text())) == 1
    assert traverse(TREE, *ORBIT, "-o", "-", "--no-timing") == 0
    assert capsys.readouterr().out.encode() == before


def test_json_has_the_same_cells(tmp_path: Path, capsys: Said) -> None:
    settings = (TOWN, *ORBIT, "--budget", "4k", "--no-timing", "--per-instance")
    assert traverse(*settings) == 0
    rows = table(capsys.readouterr().out)
    assert traverse(*settings, "--format", "json") == 0
    data = json.loads(capsys.readouterr().out)["data"]
    assert traverse(*settings, "-o", tmp_path / "frames.JSON") == 0
    assert json.loads((tmp_path / "frames.JSON").read_text())["data"] == data
    texts = [{c.name: c.text(row[c.name]) for c in COLUMNS if c.name in row} for row in data]
    assert texts == rows


def test_parquet_has_the_same_cells(tmp_path: Path, capsys: Said) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    settings = (TOWN, *ORBIT, "--budget", "4k", "--no-timing")
    assert traverse(*settings, "-o", tmp_path / "frames.parquet") == 0
    assert traverse(*settings, "--format", "parquet", "-o", tmp_path / "other") == 0
    assert (tmp_path / "frames.parquet").read_bytes() == (tmp_path / "other").read_bytes()
    assert traverse(*settings, "--format", "json") == 0
    data = json.loads(capsys.readouterr().out)["data"]
    assert parquet.read_table(tmp_path / "frames.parquet").to_pylist() == data


def test_a_name_decides_the_format_unless_it_is_said(tmp_path: Path) -> None:
    for name, form in (("a.csv", None), ("a.JSON", None), ("a.txt", "csv"), ("a", "json"), ("b", None)):
        said = () if form is None else ("--format", form)
        assert traverse(TREE, *ORBIT, "-o", tmp_path / name, *said) == 0
    begins = {path.name: path.read_bytes()[:1] for path in tmp_path.iterdir()}
    assert begins == {"a.csv": b"f", "a.JSON": b"{", "a.txt": b"f", "a": b"{", "b": b"f"}


def test_a_summary_is_said_when_it_is_asked_for(tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "out.csv"
    assert traverse(TOWN, *ORBIT, "--budget", "4k", "--summary", "-o", output) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "3 frames, 0.067 s" in err
    assert "100.0 % at the budget" in err
    for silent in (("--no-summary",), (), ("--summary", "-q")):
        assert traverse(TOWN, *ORBIT, *silent, "-o", output, "--overwrite") == 0
        assert capsys.readouterr() == ("", "")


def test_json_is_the_summary_and_the_table_goes_to_its_file(tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "out.csv"
    assert traverse(TOWN, *ORBIT, "--budget", "4k", "--json", "-o", output, "--assert", "selected<=4k") == 0
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert (summary["frames"], summary["stop_reasons"], err) == (3, {"budget": 1.0}, "")
    assert summary["asserts"] == [{"assert": "selected<=4k", "held": True, "value": summary["asserts"][0]["value"]}]
    selected = [int(row["selected"]) for row in table(output.read_text())]
    assert summary["quantities"]["selected"]["max"] == max(selected) == summary["asserts"][0]["value"]
    assert traverse(TOWN, *ORBIT, "--json") == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 3


def test_what_must_hold(tmp_path: Path, capsys: Said) -> None:
    output = tmp_path / "out.csv"
    settings = (TOWN, *ORBIT, "--budget", "4k", "-o", output, "--overwrite")
    assert traverse(*settings, "--assert", "selected<=4k", "--assert", "missing==0") == 0
    assert capsys.readouterr() == ("", "")
    assert traverse(*settings, "--assert", "selected<=4k", "--assert", "churn_max<0.1", "-q") == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: churn_max<0.1: churn_max is 0.")
    assert err.count("\n") == 1
    assert len(table(output.read_text())) == 3  # the table is there all the same
    output.unlink()
    assert traverse(*settings, "--assert", "selectd<=4k") == 2
    assert "--assert 'selectd<=4k': there is no column 'selectd', did you mean selected?" in capsys.readouterr().err
    assert not output.exists()
    assert traverse(*settings, "--assert", "complete_in_s<1") == 1
    assert "complete_in_s is empty: it needs --bandwidth" in capsys.readouterr().err
    assert traverse(*settings, "--assert", "selected<1", "--json") == 3
    assert json.loads(capsys.readouterr().out)["asserts"][0]["held"] is False


def cut_of(path: Path) -> np.ndarray:
    nodes: np.ndarray = np.load(path)
    assert nodes.dtype == np.uint32
    return nodes


def test_indices_of_every_cut(tmp_path: Path, capsys: Said) -> None:
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


def test_indices_of_instances_and_of_every_second_frame(tmp_path: Path, capsys: Said) -> None:
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


def test_files_of_one_name_get_numbers(tmp_path: Path, capsys: Said) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(TREE, tmp_path / folder / "door.spz")
    files = (tmp_path / "a" / "door.spz", tmp_path / "b" / "door.spz", tmp_path / "a" / "door.spz")
    assert traverse(*files, *ORBIT, "--per-instance") == 0
    names = [row["instance"] for row in table(capsys.readouterr().out)]
    assert names[:4] == ["total", "door", "door 2", "door 3"]


def scene_file(folder: Path, *instances: object) -> Path:
    path = folder / "scene.json"
    path.write_text(json.dumps({"instances": instances}))
    return path


def test_a_scene_file_says_what_stands_where(tmp_path: Path, capsys: Said) -> None:
    shutil.copy(TREE, tmp_path / "tree.spz")
    scene = scene_file(tmp_path, {"file": "tree.spz", "name": "near"}, {"file": "tree.spz", "translation": [0, 0, 500]})
    assert traverse("--scene", scene, "--look-at", "0,0,-9:0,0,0", "--per-instance") == 0
    total, near, far = table(capsys.readouterr().out)
    assert [row["instance"] for row in (total, near, far)] == ["total", "near", "tree"]
    assert int(near["selected"]) > int(far["selected"])
    assert int(total["selected"]) == int(near["selected"]) + int(far["selected"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "a FILE is missing, or --scene"),
        ([TREE, "--scene", "s.json"], "--scene names the files; leave out FILE"),
        ([TREE, "--budget", "many"], "--budget"),
        ([TREE, "--budget", "0"], "the budget is to be more than 0"),
        ([TREE, "--budget", "1e60"], "the budget is to be more than 0, and no more than"),
        ([TREE, "--budget", "5k", "--preset", "quest"], "--budget and --preset exclude each other"),
        ([TREE, "--preset", "phone"], "--preset"),
        ([TREE, "--lod-splat-scale", "0"], "--lod-splat-scale"),
        ([TREE, "--lod-splat-scale", "inf"], "the budget is to be more than 0, and no more than"),
        ([TREE, "--lod-render-scale", "-1"], "--lod-render-scale"),
        ([TREE, "--lod-render-scale", "inf"], "--lod-render-scale inf is beyond"),
        ([TREE, "--pixel-scale-limit", "nan"], "--pixel-scale-limit"),
        ([TREE, "--pixel-scale-limit", "1e39"], "--pixel-scale-limit 1e+39 is beyond"),
        ([TREE, "--pixel-scale-limit", "0.1", "--lod-render-scale", "2"], "exclude each other"),
        ([TREE, "--outside-foveate", "0.5", "--cone-fov", "100"], "--cone-fov cannot be used with --outside-foveate"),
        ([TREE, "--cone-fov0", "181"], "--cone-fov0"),
        ([TREE, "--behind-foveate", "-1"], "--behind-foveate"),
        ([TREE, "--chunk-cache", "0"], "--chunk-cache"),
        ([TREE, "--latency", "60ms"], "--latency only means something with --bandwidth"),
        ([TREE, "--fetchers", "3"], "--fetchers only means something with --bandwidth"),
        ([TREE, "--bandwidth", "20"], "--bandwidth"),
        ([TREE, "--bandwidth", "0Mbit"], "--bandwidth"),
        ([TREE, "--bandwidth", "1Mbit", "--latency", "60"], "--latency"),
        ([TREE, "--precision", "float8"], "--precision"),
        ([TREE, "--orbit", "3", "--dolly"], "--orbit and --dolly cannot go together"),
        ([TREE, "--camera-axes", "opengl-c2w"], "--camera-axes"),
        ([TREE, "--orbit", "0"], "--orbit"),
        ([TREE, "--look-at", "0,0,0:0,0,0"], "looks at the point where it is"),
        ([TREE, "--keyframes", "0,0,0:1,0,0"], "two keyframes"),
        ([TREE, "--size", "0x720"], "--size"),
        ([TREE, "--fov", "180"], "--fov"),
        ([TREE, "--up", "0,0,0"], "--up 0,0,0 is no direction"),
        ([TREE, "--every", "0"], "--every"),
        ([TREE, "--format", "xlsx"], "--format"),
        ([TREE, "-o", "t.xlsx"], "--output t.xlsx: tables are written as .csv, .json, .parquet"),
        ([TREE, "-o", "t.png"], "--output t.png: tables are written as .csv"),
        ([TREE, "-o", "t.spz", "--format", "json"], "t.spz does not end in .json, which --format asks for"),
        ([TREE, "--plot", "t.jpg"], "'t.jpg' does not end in .png, which is what is written"),
        ([TREE, "--json", "-o", "-"], "--json and the table cannot both go to standard output"),
        ([TREE, "--json", "--per-instance"], "--per-instance cannot be used with --json without --output"),
        ([TREE, "--padded"], "--padded only means something with --indices-out"),
        ([TREE, "--assert", "churn"], "--assert 'churn' is not an assertion"),
        ([TREE, "--threads", "0"], "--threads"),
        ([TREE, OTHER, "--budget", "1"], "a budget of 1 splat is less than one for each of 2 instances"),
        ([TREE, OTHER, "--chunk-cache", "1"], "cannot hold the roots of 2 trees"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: list[object], message: str, capsys: Said) -> None:
    assert traverse(*arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert out == ""


def test_an_input_is_never_an_output(tmp_path: Path, capsys: Said) -> None:
    tree, cameras = tmp_path / "tree.spz", tmp_path / "path.json"
    shutil.copy(TREE, tree)
    shutil.copy(CAMERAS / "sparklod.json", cameras)
    scene = scene_file(tmp_path, {"file": "tree.spz"})
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    link = tmp_path / "link.csv"
    link.symlink_to(tree)
    pytest.importorskip("matplotlib")
    for said in (
        (tree, "-o", tree),
        (tree, "-o", link),
        ("--scene", scene, "-o", tree),
        ("--scene", scene, "-o", scene),
        (tree, "--camera-path", cameras, "-o", cameras),
        (tree, "--plot", tree),
    ):
        assert traverse(*said, "--overwrite") == 2
        assert "is an input; write elsewhere" in capsys.readouterr().err
    assert traverse(tree, "-o", tmp_path / "x", "--plot", tmp_path / "x") == 2
    assert "is an output already" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize(
    ("arguments", "named", "message"),
    [
        ([FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([TREE, FAULTS / "missing.spz"], FAULTS / "missing.spz", "no such file"),
        ([FAULTS / "spz-flipped-bit.spz"], FAULTS / "spz-flipped-bit.spz", "corrupt gzip data"),
        ([FAULTS / "tree-cycle.spz"], FAULTS / "tree-cycle.spz", "its tree is broken"),
        ([FIXTURES / "sh2.ply"], FIXTURES / "sh2.ply", "bake it first with sparklod build-lod"),
        ([TREE, "--camera-path", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        ([TREE, "--camera-path", TREE], TREE, "no format that is known"),
        (["--scene", FAULTS / "no.json"], FAULTS / "no.json", "no such file"),
        (["--scene", CAMERAS / "inria.json"], CAMERAS / "inria.json", "has no list of instances"),
        ([TREE, "-o", "no/such/folder/out.csv"], "no/such/folder", "does not exist"),
        ([TREE, "-o", FIXTURES], FIXTURES, "is a directory"),
    ],
    ids=str,
)
def test_a_file_that_fails_is_named_in_a_line(
    arguments: list[object], named: object, message: str, capsys: Said
) -> None:
    assert traverse(*arguments) == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert str(named) in err
    assert message in err
    assert (out, err.count("\n")) == ("", 1)


def test_a_scene_names_what_is_missing_beside_it(tmp_path: Path, capsys: Said) -> None:
    assert traverse("--scene", scene_file(tmp_path, {"file": "gone.spz"})) == 1
    assert capsys.readouterr().err == f"error: {tmp_path / 'gone.spz'}: cannot be read: no such file or directory\n"
    assert traverse("--scene", scene_file(tmp_path, {"file": "a"}, {"file": "b", "scale": "big"})) == 1
    assert f"error: {tmp_path / 'scene.json'}: instance 1 has scale 'big'" in capsys.readouterr().err


AWAY = "axes (--camera-axes, --world-transform, --up)"


def test_cameras_that_look_away_are_wondered_at(capsys: Said) -> None:
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,-1,-20", "--budget", "4k") == 0
    err = capsys.readouterr().err
    assert err.startswith("warning: only 0.0% of the splats lie in front of the cameras")
    assert err.endswith(f"{AWAY}\n")
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,-1,-20", "--budget", "4k", "-q") == 0
    assert capsys.readouterr().err == ""
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,0,0", "--budget", "4k") == 0
    assert capsys.readouterr().err == ""


def test_what_a_path_leaves_out_is_said(tmp_path: Path, capsys: Said) -> None:
    path = json.loads((CAMERAS / "transforms.json").read_text()) | {"k1": 0.25}
    (tmp_path / "transforms.json").write_text(json.dumps(path))
    assert traverse(TREE, "--camera-path", tmp_path / "transforms.json") == 0
    out, err = capsys.readouterr()
    assert "Its lens distortion was left out." in err.splitlines()
    assert len(table(out)) == len(path["frames"])
    assert traverse(TREE, "--camera-path", tmp_path / "transforms.json", "-q") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("path", sorted(CAMERAS.iterdir()), ids=lambda path: path.name)
def test_every_format_of_cameras_is_flown(path: Path, capsys: Said) -> None:
    if path.name.startswith("open3d"):
        pytest.importorskip("open3d")
    assert traverse(TREE, "--camera-path", path, "-q") == 0
    out, err = capsys.readouterr()
    assert len(table(out)) >= 3
    assert err == ""


def test_a_failure_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    fly = Simulation.run

    def falling(self: Simulation, *arguments: Any, **settings: Any) -> Any:
        for frame in fly(self, *arguments, **settings):
            if frame.number == 2:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(Simulation, "run", falling)
    output = tmp_path / "out.csv"
    assert traverse(TREE, *ORBIT, "-o", output) == 130
    assert list(tmp_path.iterdir()) == []
    output.write_text("precious")
    assert traverse(TREE, *ORBIT, "-o", output, "--overwrite") == 130
    assert output.read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert "interrupted" in capsys.readouterr().err


def test_a_polite_kill_leaves_nothing_behind(tmp_path: Path) -> None:
    """As Ctrl-C, which whoever runs tests in the background may have turned off."""
    settings = ("--orbit", "30000", "--budget", "50k", "--threads", "2", "-q", "-o", str(tmp_path / "out.csv"))
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(TOWN), *settings]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE)
    for _ in range(600):
        if list(tmp_path.iterdir()):
            break
        time.sleep(0.05)
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err.strip()) == (130, b"interrupted")
    assert list(tmp_path.iterdir()) == []


def test_a_plot_is_a_picture(tmp_path: Path, capsys: Said) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    assert traverse(TOWN, *ORBIT, "--budget", "4k", "--plot", tmp_path / "path.png", "-o", tmp_path / "out.csv") == 0
    capsys.readouterr()
    with image.open(tmp_path / "path.png") as picture:
        assert picture.width == 1600
    assert traverse(TOWN, *ORBIT, "--plot", tmp_path / "path.png", "-o", tmp_path / "other.csv") == 1
    assert "path.png exists, add --overwrite" in capsys.readouterr().err
    assert not (tmp_path / "other.csv").exists()


def test_a_plot_shows_what_the_frame_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a slow network few chunks are there; the picture is of what was drawn with these."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")
    from sparklod_cli.simulation import plot

    shown: list[plot.Scenery] = []

    def drawn(rows: object, title: str, scenery: plot.Scenery) -> plot.Plot:
        shown.append(scenery)
        return plot.Plot(b"a plot", None)

    monkeypatch.setattr(plot, "plot", drawn)
    slow = ("--bandwidth", "0.1Mbit", "--latency", "50ms")
    for number, network in enumerate(((), slow)):
        table = tmp_path / f"{number}.csv"
        assert traverse(TOWN, *ORBIT, *network, "--plot", tmp_path / f"{number}.png", "-o", table) == 0
        rows = list(csv.DictReader(io.StringIO(table.read_text())))
        scenery = shown[-1]
        assert scenery.frame is not None
        assert len(scenery.splats) == len(scenery.level) == int(rows[scenery.frame]["selected"])
    assert len(shown[1].splats) < len(shown[0].splats)


def test_help_shows_how(capsys: Said) -> None:
    assert traverse("--help") == 0
    out = capsys.readouterr().out
    assert "Examples:" in out
    assert out.count("  sparklod traverse ") >= 5
    for option in ("--scene", "--assert", "--indices-out", "--bandwidth", "--camera-path", "--plot"):
        assert option in out


def test_verbose_says_how_long_it_took(capsys: Said) -> None:
    assert traverse(TREE, *ORBIT, "-v", "--assert", "selected>0") == 0
    err = capsys.readouterr().err
    assert "3 frames of an orbit, " in err
    assert "holds: selected>0" in err


def test_as_a_process() -> None:
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(TREE), "--look-at", "0,-1,-9:0,0,0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert len(table(done.stdout)) == 1
    assert "Traceback" not in done.stderr


def test_a_city(built: Path, tmp_path: Path, capsys: Said) -> None:
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


def test_a_usage_error_makes_no_folder(tmp_path: Path, capsys: Said) -> None:
    """Also one that only shows when the cameras are looked at."""
    folder = tmp_path / "cuts"
    assert traverse(TREE, "--seconds", "2", "--indices-out", folder) == 2
    assert "--seconds" in capsys.readouterr().err
    assert not folder.exists()


def test_indices_do_not_go_where_a_file_is(tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "cuts").touch()
    assert traverse(TREE, *ORBIT, "--indices-out", tmp_path / "cuts") == 2
    assert "cuts" in capsys.readouterr().err
