"""Examples of the README and of the pages run; the commands of the gallery exist."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import click
import numpy as np
import pytest

from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cli import cli
from sparklod_cli.cli import run as cli_run
from sparklod_cli.simulation.results import COLUMNS, LOADING
from sparklod_cli.tables.assertions import check, parse
from tests.cameras.known import text_file
from tests.conftest import FIXTURES, ROOT
from tests.tables.rows import flight

from .gallery import PAGES, SCENE, TUTORIALS, commands, folder_of, pictures
from .shell import blocks

README = (ROOT / "README.md").read_text(encoding="utf-8")
CAMERAS = re.findall(r"```(json|csv)\n(.*?)```", (ROOT / "docs" / "cameras.md").read_text("utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_programs_run_one_after_the_other(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(FIXTURES / "sh1.ply", tmp_path / "scene.ply")
    shutil.copy(FIXTURES / "cameras" / "sparklod.json", tmp_path / "path.json")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for program in blocks((ROOT / page).read_text(encoding="utf-8"), "python"):
        exec(program, names)
    assert (tmp_path / "scene-lod.spz").exists()


def test_the_first_line_of_the_readme_can_be_run_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last command, in a folder that has our fixtures; git ignores what it writes."""
    block = re.search(r"## Try it\n.*?```sh\n(.*?)\n```", README, re.DOTALL)
    assert block
    command = shlex.split(block[1].rpartition("&&")[2])
    assert command.pop(0).endswith("/sparklod")
    (tmp_path / "fixtures").symlink_to(FIXTURES)
    monkeypatch.chdir(tmp_path)
    assert [cli_run(command), cli_run(command)] == [0, 0]
    (written,) = (path.name for path in tmp_path.iterdir() if path.name != "fixtures")
    assert f"/{written}" in (ROOT / ".gitignore").read_text().splitlines()


def test_there_are_examples_of_both_camera_formats() -> None:
    assert {kind for kind, _ in CAMERAS} == {"json", "csv"}


@pytest.mark.parametrize(("kind", "example"), CAMERAS)
def test_examples_of_camera_files_can_be_read(kind: str, example: str) -> None:
    path = read(text_file(example, f"example.{kind}"))
    assert path.notes == ()
    first = path.cameras[0]
    assert np.allclose(first.position, (0, 0, -5))
    assert np.allclose(first.forward, (0, 0, 1))


@pytest.mark.parametrize("text", re.findall(r"--assert '(.*?)'", (ROOT / "docs" / "traverse.md").read_text("utf-8")))
def test_assertions_about_traversals_are_understood(text: str) -> None:
    rows = [row | {column.name: 1 for column in LOADING} for row in flight(20)]
    assert check([parse(text, (*COLUMNS, *LOADING))], rows)


@pytest.mark.parametrize("page", [*PAGES, *TUTORIALS], ids=lambda page: page.stem)
def test_the_pictures_of_a_page_are_all_in_its_folder(page: Path) -> None:
    shown = [Path(picture).name for picture in pictures(page)]
    assert shown
    assert {path.name for path in folder_of(page).iterdir()} == set(shown)


@pytest.mark.parametrize("arguments", [each for page in PAGES for each in commands(page)], ids=" ".join)
def test_commands_of_the_gallery_are_understood(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their options exist and take these values; nothing is run."""
    for name in (SCENE, "demo-lod.spz", "demo-quick.spz"):
        shutil.copy(FIXTURES / "sh0.ply", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    name, *rest = arguments
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    command.make_context(name, rest, parent=click.Context(cli, info_name="sparklod"))
