"""The cameras that `sparklod traverse` flies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands.traverse.runs import CAMERAS, TOWN, TREE, table, traverse
from tests.conftest import Capture

pytestmark = pytest.mark.slow

AWAY = "axes (--camera-axes, --world-transform, --up)"


def test_cameras_that_look_away_give_a_warning(capsys: Capture) -> None:
    assert traverse(TOWN, "--look-at", "0,-1,-9:0,-1,-20", "--budget", "4k") == 0
    err = capsys.readouterr().err
    assert err.startswith("warning: only 0.0% of the splats lie in front of the cameras")
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
    if path.name.startswith("open3d"):
        pytest.importorskip("open3d")
    assert traverse(TREE, "--camera-path", path, "-q") == 0
    out, err = capsys.readouterr()
    assert len(table(out)) >= 3
    assert err == ""
