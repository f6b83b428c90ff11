"""docs/gallery.md: every picture is there, is small, and is what a command on the page draws."""

from __future__ import annotations

import shutil
from pathlib import Path

import click
import pytest

from sparklod_cli.cli import cli
from tests.conftest import FIXTURES

from .gallery import FOLDER, SCENE, commands, pictures

#: Bytes of one picture, so that a checkout stays small.
MAX_BYTES = 400_000


def test_each_picture_comes_from_a_command_and_no_other_file_is_there() -> None:
    shown = [Path(picture).name for picture in pictures()]
    assert shown
    assert len(set(shown)) == len(shown)
    assert set(shown) <= {word for arguments in commands() for word in arguments}
    assert {path.name for path in FOLDER.iterdir()} == set(shown)
    assert all(path.stat().st_size <= MAX_BYTES for path in FOLDER.iterdir())


@pytest.mark.parametrize("arguments", commands(), ids=" ".join)
def test_each_command_is_understood(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its options exist and take these values; nothing is run."""
    for name in (SCENE, "demo-lod.spz", "demo-quick.spz"):
        shutil.copy(FIXTURES / "sh0.ply", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    name, *rest = arguments
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    command.make_context(name, rest, parent=click.Context(cli, info_name="sparklod"))
