"""An output that is there is baked anew if its recipe or its bytes are other ones, and else not, whatever its date."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sparklod_cli.bake import BakeSettings, bake_unless_there
from sparklod_cli.bake.skipping import SUFFIX
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.support.errors import OutputError
from tests.conftest import FIXTURES

SETTINGS = BakeSettings()
CHUNKED = BakeSettings(suffix=".rad", options=WriteOptions(rad=RadOptions(chunked=True)))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes((FIXTURES / "sh2.ply").read_bytes())
    return path


def note_of(target: Path) -> Path:
    return target.with_name(target.name + SUFFIX)


@pytest.mark.parametrize(("name", "settings"), [("a.spz", SETTINGS), ("a.rad", CHUNKED)])
def test_the_same_bake_is_skipped_whatever_the_dates(scene: Path, name: str, settings: BakeSettings) -> None:
    target = scene.with_name(name)
    assert bake_unless_there(scene, target, settings) is not None
    assert bake_unless_there(scene, target, settings) is None
    for path in (scene, target):
        os.utime(path, ns=(0, 0))
    moved = scene.rename(scene.with_name("moved.ply"))
    assert bake_unless_there(moved, target, settings) is None


def test_another_setting_is_refused_or_baked(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    other = BakeSettings(base=1.3)
    with pytest.raises(OutputError, match=r"a\.spz is there, but base was 1\.5 and is 1\.3; add --overwrite"):
        bake_unless_there(scene, target, other)
    assert bake_unless_there(scene, target, other, overwrite=True) is not None
    assert bake_unless_there(scene, target, other, overwrite=True) is None
    assert bake_unless_there(scene, target, SETTINGS, overwrite=True) is not None


def test_another_input_of_the_same_size_and_date_elsewhere_is_baked(scene: Path, tmp_path: Path) -> None:
    target, times = tmp_path / "a.spz", scene.stat()
    bake_unless_there(scene, target, SETTINGS)
    data = bytearray(scene.read_bytes())
    data[-40] ^= 1
    scene.write_bytes(data)
    os.utime(scene, ns=(times.st_atime_ns, times.st_mtime_ns + 1))
    with pytest.raises(OutputError, match=r"scene\.ply changed since"):
        bake_unless_there(scene, target, SETTINGS)


def test_an_output_that_is_damaged_replaced_or_gone_is_baked(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    whole = target.read_bytes()
    for data in (whole[:-1], whole[:100] + b"?" + whole[101:]):
        target.write_bytes(data)
        with pytest.raises(OutputError, match="changed since it was baked"):
            bake_unless_there(scene, target, SETTINGS)
        bake_unless_there(scene, target, SETTINGS, overwrite=True)
        assert target.read_bytes() == whole
    target.unlink()
    assert bake_unless_there(scene, target, SETTINGS) is not None


def test_a_chunk_that_is_gone_is_missed(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.rad"
    bake_unless_there(scene, target, CHUNKED)
    (chunk,) = tmp_path.glob("*.radc")
    chunk.unlink()
    assert bake_unless_there(scene, target, CHUNKED, overwrite=True) is not None
    assert chunk.exists()


@pytest.mark.parametrize("note", [None, "", "[]", "{}", '{"recipe": {"inputs": 3}}', "\x00"])
def test_an_output_without_a_note_is_not_trusted(scene: Path, tmp_path: Path, note: str | None) -> None:
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    note_of(target).unlink()
    if note is not None:
        note_of(target).write_text(note)
    with pytest.raises(OutputError, match="nothing tells of what it was made"):
        bake_unless_there(scene, target, SETTINGS)
    assert bake_unless_there(scene, target, SETTINGS, overwrite=True) is not None
    assert bake_unless_there(scene, target, SETTINGS) is None


def test_a_bake_that_fails_leaves_no_note(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    scene.write_bytes(scene.read_bytes()[:-10])
    with pytest.raises(Exception, match=r"."):
        bake_unless_there(scene, target, SETTINGS, overwrite=True)
    assert not note_of(target).exists()
