"""`sparklod traverse` as a shell sees it: the table, the summary, what must hold, plots and cameras."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli.simulation.results import COLUMNS
from tests.commands.traverse.runs import CAMERAS, NAMES, ORBIT, TOWN, TREE, table, traverse
from tests.conftest import ROOT, Capture

pytestmark = pytest.mark.slow


def test_a_table_comes_on_standard_output_and_nothing_else_is_said(capsys: Capture) -> None:
    assert traverse(TOWN) == 0
    out, err = capsys.readouterr()
    rows = table(out)
    assert list(rows[0]) == NAMES
    assert [row["frame"] for row in rows] == [str(number) for number in range(60)]
    assert {row["instance"] for row in rows} == {"total"}
    assert {row["budget"] for row in rows} == {"2500000"}
    assert err == ""


def test_two_traversals_give_the_same_bytes(capsys: Capture) -> None:
    outs = set()
    for threads in (1, 2, 5):
        assert traverse(TOWN, *ORBIT, "--budget", "4k", "--no-timing", "--threads", threads, "--per-instance") == 0
        outs.add(capsys.readouterr().out)
    (out,) = outs
    assert list(table(out)[0]) == [name for name in NAMES if name != "traverse_ms"]


def test_an_output_is_a_file(tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "frames.csv"
    assert traverse(TREE, *ORBIT, "-o", output, "--no-timing") == 0
    assert capsys.readouterr() == ("", f"{output}  table of 3 frames\n")
    assert len(table(output.read_text())) == 3
    before = output.read_bytes()
    assert traverse(TREE, "--look-at", "0,0,9:0,0,0", "-o", output) == 1
    assert capsys.readouterr().err == f"error: {output} exists, add --overwrite to replace it\n"
    assert output.read_bytes() == before
    assert traverse(TREE, "--look-at", "0,0,9:0,0,0", "-o", output, "--overwrite") == 0
    assert len(table(output.read_text())) == 1
    assert traverse(TREE, *ORBIT, "-o", "-", "--no-timing") == 0
    assert capsys.readouterr().out.encode() == before


def test_json_has_the_same_cells(tmp_path: Path, capsys: Capture) -> None:
    settings = (TOWN, *ORBIT, "--budget", "4k", "--no-timing", "--per-instance")
    assert traverse(*settings) == 0
    rows = table(capsys.readouterr().out)
    assert traverse(*settings, "--format", "json") == 0
    data = json.loads(capsys.readouterr().out)["data"]
    assert traverse(*settings, "-o", tmp_path / "frames.JSON") == 0
    assert json.loads((tmp_path / "frames.JSON").read_text())["data"] == data
    texts = [
        {c.name: "" if row[c.name] is None else format(row[c.name], c.digits) for c in COLUMNS if c.name in row}
        for row in data
    ]
    assert texts == rows


def test_parquet_has_the_same_cells(tmp_path: Path, capsys: Capture) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    settings = (TOWN, *ORBIT, "--budget", "4k", "--no-timing")
    assert traverse(*settings, "-o", tmp_path / "frames.parquet") == 0
    assert traverse(*settings, "--format", "parquet", "-o", tmp_path / "other") == 0
    assert (tmp_path / "frames.parquet").read_bytes() == (tmp_path / "other").read_bytes()
    assert traverse(*settings, "--format", "json") == 0
    data = json.loads(capsys.readouterr().out)["data"]
    assert parquet.read_table(tmp_path / "frames.parquet").to_pylist() == data


def test_the_suffix_decides_the_format_unless_an_option_does(tmp_path: Path) -> None:
    for name, form in (("a.csv", None), ("a.JSON", None), ("a.txt", "csv"), ("a", "json")):
        said = () if form is None else ("--format", form)
        assert traverse(TREE, *ORBIT, "-o", tmp_path / name, *said) == 0
    begins = {path.name: path.read_bytes()[:1] for path in tmp_path.iterdir()}
    assert begins == {"a.csv": b"f", "a.JSON": b"{", "a.txt": b"f", "a": b"{"}


def test_a_summary_is_said_when_it_is_asked_for(tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "out.csv"
    assert traverse(TOWN, *ORBIT, "--budget", "4k", "--summary", "-o", output) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "3 frames, 0.067 s" in err
    assert "100.0 % at the budget" in err
    for silent, said in ((("--no-summary",), True), ((), True), (("--summary", "-q"), False)):
        assert traverse(TOWN, *ORBIT, *silent, "-o", output, "--overwrite") == 0
        assert capsys.readouterr() == ("", f"{output}  table of 3 frames\n" if said else "")


def test_json_is_the_summary_and_the_table_goes_to_its_file(tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "out.csv"
    assert traverse(TOWN, *ORBIT, "--budget", "4k", "--json", "-o", output, "--assert", "selected<=4k") == 0
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert (summary["frames"], summary["stop_reasons"]) == (3, {"budget": 1.0})
    assert err == f"{output}  table of 3 frames\n"
    assert summary["asserts"] == [{"assert": "selected<=4k", "held": True, "value": summary["asserts"][0]["value"]}]
    selected = [int(row["selected"]) for row in table(output.read_text())]
    assert summary["quantities"]["selected"]["max"] == max(selected) == summary["asserts"][0]["value"]
    assert traverse(TOWN, *ORBIT, "--json") == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 3


def test_an_assertion_that_does_not_hold_is_exit_code_3(tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "out.csv"
    settings = (TOWN, *ORBIT, "--budget", "4k", "-o", output, "--overwrite")
    assert traverse(*settings, "--assert", "selected<=4k", "--assert", "missing==0") == 0
    assert capsys.readouterr() == ("", f"{output}  table of 3 frames\n")
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


def test_verbose_says_how_long_it_took(capsys: Capture) -> None:
    assert traverse(TREE, *ORBIT, "-v", "--assert", "selected>0") == 0
    err = capsys.readouterr().err
    assert "3 frames of an orbit, " in err
    assert "holds: selected>0" in err


def test_a_process_writes_a_row_for_a_view() -> None:
    command = [sys.executable, "-m", "sparklod_cli", "traverse", str(TREE), "--look-at", "0,-1,-9:0,0,0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert len(table(done.stdout)) == 1
    assert "Traceback" not in done.stderr


def test_a_plot_is_a_picture(tmp_path: Path, capsys: Capture) -> None:
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
    from sparklod_cli.images import charts, scene_plots

    shown: list[scene_plots.PathScene] = []

    def drawn(rows: object, marked: object, title: str, scene: scene_plots.PathScene) -> tuple[bytes, str | None]:
        shown.append(scene)
        return b"a plot", None

    monkeypatch.setattr(charts, "plot", drawn)
    slow = ("--bandwidth", "0.1Mbit", "--latency", "50ms")
    for number, network in enumerate(((), slow)):
        table = tmp_path / f"{number}.csv"
        assert traverse(TOWN, *ORBIT, *network, "--plot", tmp_path / f"{number}.png", "-o", table) == 0
        rows = list(csv.DictReader(io.StringIO(table.read_text())))
        scene = shown[-1]
        assert scene.frame is not None
        assert len(scene.splats) == len(scene.depth) == int(rows[scene.frame]["selected"])
    assert len(shown[1].splats) < len(shown[0].splats)


AWAY = "axes (--camera-axes, --world-transform, --up)"


def test_cameras_that_look_away_give_a_warning(capsys: Capture) -> None:
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,-1,-20", "--budget", "4k") == 0
    err = capsys.readouterr().err
    assert err.startswith("warning: only 0 % of the splats lie in front of the cameras")
    assert err.endswith(f"{AWAY}\n")
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,-1,-20", "--budget", "4k", "-q") == 0
    assert capsys.readouterr().err == ""
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,0,0", "--budget", "4k") == 0
    assert capsys.readouterr().err == ""


def test_notes_on_a_camera_file_are_printed(tmp_path: Path, capsys: Capture) -> None:
    path = json.loads((CAMERAS / "transforms.json").read_text()) | {"k1": 0.25}
    (tmp_path / "transforms.json").write_text(json.dumps(path))
    assert traverse(TREE, "--camera-path", tmp_path / "transforms.json") == 0
    out, err = capsys.readouterr()
    assert "Its lens distortion was ignored." in err.splitlines()
    assert len(table(out)) == len(path["frames"])
    assert traverse(TREE, "--camera-path", tmp_path / "transforms.json", "-q") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("path", sorted(CAMERAS.iterdir()), ids=lambda path: path.name)
def test_every_camera_format_can_be_traversed(path: Path, capsys: Capture) -> None:
    assert traverse(TREE, "--camera-path", path, "-q") == 0
    out, err = capsys.readouterr()
    assert len(table(out)) >= 3
    assert err == ""
