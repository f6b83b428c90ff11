"""`sparklod traverse --plot`: charts of a path."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from tests.commands.traverse.runs import ORBIT, TOWN, traverse
from tests.conftest import Capture

pytestmark = pytest.mark.slow


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
    from sparklod_cli.figures import traversal_chart

    shown: list[traversal_chart.PathScene] = []

    def drawn(rows: object, marked: object, title: str, scene: traversal_chart.PathScene) -> traversal_chart.Plot:
        shown.append(scene)
        return traversal_chart.Plot(b"a plot", None)

    monkeypatch.setattr(traversal_chart, "plot", drawn)
    slow = ("--bandwidth", "0.1Mbit", "--latency", "50ms")
    for number, network in enumerate(((), slow)):
        table = tmp_path / f"{number}.csv"
        assert traverse(TOWN, *ORBIT, *network, "--plot", tmp_path / f"{number}.png", "-o", table) == 0
        rows = list(csv.DictReader(io.StringIO(table.read_text())))
        scene = shown[-1]
        assert scene.frame is not None
        assert len(scene.splats) == len(scene.depth) == int(rows[scene.frame]["selected"])
    assert len(shown[1].splats) < len(shown[0].splats)
