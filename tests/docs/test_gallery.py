"""docs/gallery.md, docs/troubleshooting.md: every picture is there, is small, and is drawn by a command on the page."""

from __future__ import annotations

import shutil
from pathlib import Path

import click
import pytest

from sparklod_cli.cli import cli
from tests.conftest import FIXTURES

from .gallery import PAGES, SCENE, commands, folder_of, pictures

#: Bytes of one picture, so that a checkout stays small.
MAX_BYTES = 400_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_each_picture_comes_from_a_command_and_no_other_file_is_there(page: Path) -> None:
    folder = folder_of(page)
    shown = [Path(picture).name for picture in pictures(page)]
    assert shown
    assert len(set(shown)) == len(shown)
    assert set(shown) <= {word for arguments in commands(page) for word in arguments}
    assert {path.name for path in folder.iterdir()} == set(shown)
    assert all(path.stat().st_size <= MAX_BYTES for path in folder.iterdir())


@pytest.mark.parametrize("arguments", [each for page in PAGES for each in commands(page)], ids=" ".join)
def test_each_command_is_understood(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its options exist and take these values; nothing is run."""
    for name in (SCENE, "demo-lod.spz", "demo-quick.spz"):
        shutil.copy(FIXTURES / "sh0.ply", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    name, *rest = arguments
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    command.make_context(name, rest, parent=click.Context(cli, info_name="sparklod"))
