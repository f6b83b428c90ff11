"""An output that is there is baked anew if its recipe or its bytes are other ones, and else not, whatever its date."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from sparklod_cli.bake import identity, skipping
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.bake.skipping import SUFFIX, bake_unless_there
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.system.errors import OutputError
from tests.conftest import FIXTURES

SETTINGS = BakeSettings()
STREAMED = BakeSettings(suffix=".json", detail=DetailSettings(levels=(0.3,)))
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
    with pytest.raises(OutputError, match=r"a\.spz exists, but base was 1\.5 and is 1\.3; add --overwrite"):
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


def damage(path: Path, *, keep_date: bool) -> None:
    """Flips a bit in the middle of a file, or in the version that a header notes, since the names in it are needed."""
    times = path.stat()
    data = bytearray(path.read_bytes())
    place = data.find(b"sparklod ") + len("sparklod ")
    data[place if b"sparklod " in data else len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + (not keep_date)))


@pytest.mark.parametrize("name", ["a.spz", "a.rad", "a-0.radc", "web/lod-meta.json", "web/0_0/sh0.webp"])
def test_damage_in_any_file_is_found(scene: Path, tmp_path: Path, name: str) -> None:
    """By its date, or where that was set back, by `verify` alone."""
    settings = {"a.spz": SETTINGS, "web": STREAMED}.get(name.split("/")[0], CHUNKED)
    target = tmp_path / {"a-0.radc": "a.rad", "web/0_0/sh0.webp": "web/lod-meta.json"}.get(name, name)
    target.parent.mkdir(exist_ok=True)
    bake_unless_there(scene, target, settings)
    damage(tmp_path / name, keep_date=False)
    file = re.escape(Path(name).name)
    with pytest.raises(OutputError, match=rf"{file} was changed since it was baked"):
        bake_unless_there(scene, target, settings)
    bake_unless_there(scene, target, settings, overwrite=True)
    damage(tmp_path / name, keep_date=True)
    assert bake_unless_there(scene, target, settings) is None
    with pytest.raises(OutputError, match=rf"{file} was changed since it was baked"):
        bake_unless_there(scene, target, settings, verify=True)
    bake_unless_there(scene, target, settings, overwrite=True, verify=True)
    assert bake_unless_there(scene, target, settings, verify=True) is None


def test_nothing_is_read_whose_size_and_date_are_unchanged(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "a.rad"
    bake_unless_there(scene, target, CHUNKED)
    read: list[str] = []
    content_of = identity.content_of
    for module in (identity, skipping):
        monkeypatch.setattr(module, "content_of", lambda file: read.append(file.name) or content_of(file))
    assert bake_unless_there(scene, target, CHUNKED) is None
    assert read == []
    assert bake_unless_there(scene, target, CHUNKED, verify=True) is None
    assert sorted(read) == ["a-0.radc", "a.rad", "scene.ply"]


def test_an_input_whose_date_was_set_back_is_found_by_verify(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identity, "SAMPLE_BYTES", 1)  # so that the sample misses the damage, as in a large file
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    damage(scene, keep_date=True)
    assert bake_unless_there(scene, target, SETTINGS) is None
    with pytest.raises(OutputError, match=r"scene\.ply changed since"):
        bake_unless_there(scene, target, SETTINGS, verify=True)


@pytest.mark.parametrize("note", [None, "", "[]", "{}", '{"bake": {"inputs": 3}}', "\x00"])
def test_an_output_without_a_note_is_not_trusted(scene: Path, tmp_path: Path, note: str | None) -> None:
    target = tmp_path / "a.spz"
    bake_unless_there(scene, target, SETTINGS)
    note_of(target).unlink()
    if note is not None:
        note_of(target).write_text(note)
    with pytest.raises(OutputError, match="there is no record of its inputs and settings"):
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
