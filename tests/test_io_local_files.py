"""A missing input is reported with the file that was probably meant."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.conftest import FIXTURES

TREE = str(FIXTURES / "golden" / "tree-v3.spz")


@pytest.mark.parametrize(
    ("command", "missing", "meant"),
    [
        (["build-lod", "X"], "scen.ply", "scene.ply"),
        (["inspect", "X"], "scene.pyl", "scene.ply"),
        (["render", "X"], "Scene.ply", "scene.ply"),
        (["view", "X"], "scene.ply2", "scene.ply"),
        (["view", "X"], "wbe-lod", "web-lod"),
        (["traverse", TREE, "--camera-path", "X"], "paht.json", "path.json"),
        (["inspect", TREE, "--expect", "X"], "pth.json", "path.json"),
        (["inspect", "X"], "scene.spz", "scene.ply"),
        (["build-lod", "scene.ply", "--rgba", "X"], "pth.json", "path.json"),
    ],
)
def test_a_missing_input_suggests_the_nearest_name(
    command: list[str],
    missing: str,
    meant: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "web-lod").mkdir()
    (tmp_path / "path.json").write_text("{}")
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "one.ply").read_bytes())
    monkeypatch.chdir(tmp_path)
    for folder in ("", f"{tmp_path}/"):
        assert run([f"{folder}{missing}" if each == "X" else each for each in command]) == 1
        err = capsys.readouterr().err
        assert "cannot be read: no such file or directory, did you mean " in err
        assert err.endswith(f"{meant if command == ['view', 'X'] else folder + meant}?\n")


@pytest.mark.parametrize("name", ["other.spz", "no/scene.ply", "s.ply"])
def test_a_name_that_is_like_no_other_gets_no_suggestion(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.ply").touch()
    assert run(["inspect", f"{tmp_path}/{name}"]) == 1
    assert capsys.readouterr().err.endswith("no such file or directory\n")
