"""Streamed SOG from Python: of a tree, with its levels and an environment, as `build-lod` writes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from tests.api.runs import DEMO
from tests.scenes import random_splats


@pytest.fixture(scope="module")
def tree() -> sparklod.Tree:
    return sparklod.build_lod(sparklod.Scene(random_splats(400, extent=9)), method="quality", growth=2)


def test_a_tree_is_written_at_its_levels(tree: sparklod.Tree, tmp_path: Path) -> None:
    path = tmp_path / "web" / "lod-meta.json"
    sky = sparklod.Scene(random_splats(30, extent=99))
    told: list[str] = []
    how: dict[str, Any] = {"detail": sparklod.DetailSettings(levels=(0.5, 0.1)), "environment": sky}
    made = sparklod.write(path, tree, **how, progress=lambda stage, *_: told.append(stage))
    assert (made.path, made.format) == (path, "Streamed SOG")
    assert made.bytes == sum(each.stat().st_size for each in path.parent.rglob("*") if each.is_file())
    assert told
    found = json.loads(path.read_text())
    assert found["counts"][0] == 400 and found["counts"][1:] == pytest.approx([200, 40], abs=2)
    scene = sparklod.read(path.parent)
    assert type(scene) is sparklod.Scene and len(scene.splats) == 430
    with pytest.raises(sparklod.OutputError, match="exists"):
        sparklod.write(path, tree)
    sparklod.write(path, tree, overwrite=True)
    assert len(sparklod.read(path).splats) == 400


def test_the_bytes_are_those_of_the_command(tmp_path: Path) -> None:
    of_command, of_python = tmp_path / "command", tmp_path / "python"
    arguments = [str(DEMO), "-o", str(of_command / "lod-meta.json"), "--max-sh", "0", "--levels", "20%"]
    assert run(["build-lod", *arguments]) == 0
    tree = sparklod.build_lod(sparklod.read(DEMO), method="quality", growth=2, max_sh=0)
    sparklod.write(of_python / "lod-meta.json", tree, detail=sparklod.DetailSettings(levels=(0.2,)))
    names = sorted(each.relative_to(of_command) for each in of_command.rglob("*") if each.is_file())
    assert names == sorted(each.relative_to(of_python) for each in of_python.rglob("*") if each.is_file())
    assert all((of_command / name).read_bytes() == (of_python / name).read_bytes() for name in names)


@pytest.mark.parametrize(
    ("name", "how", "error", "message"),
    [
        ("a.spz", {"detail": sparklod.DetailSettings()}, ValueError, "leave them out, or write a lod-meta.json"),
        ("a.rad", {"environment": "sky"}, ValueError, "detail and environment are of Streamed SOG"),
        ("lod-meta.json", {"detail": (0.5,)}, TypeError, r"detail is \(0.5,\); give DetailSettings"),
        ("lod-meta.json", {"environment": "sky.ply"}, TypeError, "'sky.ply'; read reads a file"),
        ("lod-meta.json", {"rad": sparklod.RadOptions()}, ValueError, "chunked and rad are of RAD"),
        ("lod-meta.json", {"spz_version": 2}, ValueError, "are of SPZ"),
    ],
)
def test_options_that_do_not_suit_are_refused(
    name: str, how: dict[str, Any], error: type[Exception], message: str, tree: sparklod.Tree, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        sparklod.write(tmp_path / name, tree, **how)
    assert not list(tmp_path.iterdir())


def test_it_takes_a_tree_and_an_environment_without_one(tree: sparklod.Tree, tmp_path: Path) -> None:
    path, plain = tmp_path / "lod-meta.json", sparklod.Scene(random_splats(9))
    with pytest.raises(sparklod.FormatError, match="are cuts of a tree; build_lod makes one, best by method='quality'"):
        sparklod.write(path, plain)
    with pytest.raises(sparklod.FormatError, match="the environment has a tree; extract_leaves gives its splats"):
        sparklod.write(path, tree, environment=tree)
    with pytest.raises(sparklod.InvalidSplatsError, match="the environment has no splats to write"):
        sparklod.write(path, tree, environment=sparklod.Scene(plain.splats.take(slice(0, 0))))
    assert not list(tmp_path.iterdir())
