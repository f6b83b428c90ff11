"""`--skip-existing`: an output is baked again if its recipe or any of its bytes changed, whatever its date."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from pathlib import Path

import pytest

from sparklod_cli.bake import identity, skipping
from sparklod_cli.bake.identity import NO_PART, BakeIdentity
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.bake.skipping import SUFFIX, bake_unless_there
from sparklod_cli.codecs.formats import RadOptions, WriteOptions
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import OutputError
from tests.conftest import FIXTURES

SETTINGS = BakeSettings()
STREAMED = BakeSettings(suffix=".json", detail=DetailSettings(levels=(0.3,)))
CHUNKED = BakeSettings(suffix=".rad", options=WriteOptions(rad=RadOptions(chunked=True)))
OTHERS = {
    "method": BakeSettings(method="quality"),
    "base": BakeSettings(base=1.3),
    "max_sh": BakeSettings(max_sh=1),
    "selection.within": BakeSettings(selection=Selection(within=((0, 0, 0), 2.0))),
    "transform.rotation": BakeSettings(transform=Transform.from_parts(up="-y")),
    "options.rad.sh_codes": BakeSettings(options=WriteOptions(rad=RadOptions(sh_codes=16))),
    "suffix": BakeSettings(suffix=".rad"),
    "environment_beyond": BakeSettings(environment_beyond=9.0),
}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes((FIXTURES / "sh2.ply").read_bytes())
    return path


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "a.spz"


def damage(path: Path, *, keep_date: bool, at: int | None = None) -> None:
    """Flip a bit in the middle of a file, or in the version that a header notes, since the names in it are needed."""
    times = path.stat()
    data = bytearray(path.read_bytes())
    place = data.find(b"sparklod ") + len("sparklod ")
    data[at if at is not None else place if b"sparklod " in data else len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + (not keep_date)))


@pytest.mark.parametrize("name", OTHERS)
def test_each_setting_is_part_of_the_identity(scene: Path, name: str) -> None:
    first, same = BakeIdentity.of(scene, SETTINGS), BakeIdentity.of(scene, BakeSettings(unused=("--up",)))
    assert first == same
    assert first.digest == same.digest
    assert first.differences(same) == []
    other = BakeIdentity.of(scene, OTHERS[name])
    assert first.digest != other.digest
    (difference,) = other.differences(first)
    assert difference.startswith(f"{name} was ")
    fields = {field.name for field in dataclasses.fields(BakeSettings)} - {*NO_PART}
    assert {name.split(".")[0] for name in other.settings} == {*fields, "sparklod"}
    read = BakeIdentity.from_record(json.loads(json.dumps(dataclasses.asdict(other))))
    assert read == other
    assert read.digest == other.digest


@pytest.mark.parametrize("at", [0, 100, -1])
def test_content_and_date_of_an_input_are_part_of_the_identity_but_not_its_name(scene: Path, at: int) -> None:
    before = BakeIdentity.of(scene, SETTINGS)
    scene = scene.rename(scene.with_name("moved.ply"))
    assert BakeIdentity.of(scene, SETTINGS).digest == before.digest
    damage(scene, keep_date=True, at=at)
    after = BakeIdentity.of(scene, SETTINGS)
    assert after.differences(before) == [f"{scene} changed since"]
    os.utime(scene, ns=(0, 0))
    assert BakeIdentity.of(scene, SETTINGS).digest != after.digest


def test_colours_and_files_that_an_input_names_are_inputs(scene: Path, tmp_path: Path) -> None:
    colors, folder = tmp_path / "colors.npy", tmp_path / "sog"
    folder.mkdir()
    (folder / "meta.json").write_text('{"version": 2, "means": {"files": ["means.webp"]}}')
    for source, file, settings in (
        (scene, colors, BakeSettings(rgba=colors)),
        (folder, folder / "means.webp", SETTINGS),
    ):
        file.write_bytes(b"one")
        before = BakeIdentity.of(source, settings)
        file.write_bytes(b"two")
        assert BakeIdentity.of(source, settings).differences(before) == [f"{file} changed since"]


@pytest.mark.parametrize(("name", "settings"), [("a.spz", SETTINGS), ("a.rad", CHUNKED)])
def test_the_same_bake_is_skipped_whatever_the_dates(scene: Path, name: str, settings: BakeSettings) -> None:
    target = scene.with_name(name)
    assert bake_unless_there(scene, target, settings) is not None
    assert bake_unless_there(scene, target, settings) is None
    for path in (scene, target):
        os.utime(path, ns=(0, 0))
    moved = scene.rename(scene.with_name("moved.ply"))
    assert bake_unless_there(moved, target, settings) is None


def test_another_setting_or_input_is_refused_or_baked(scene: Path, target: Path) -> None:
    bake_unless_there(scene, target, SETTINGS)
    other = BakeSettings(base=1.3)
    with pytest.raises(OutputError, match=r"a\.spz exists, but base was 1\.5 and is 1\.3; add --overwrite"):
        bake_unless_there(scene, target, other)
    assert bake_unless_there(scene, target, other, overwrite=True) is not None
    assert bake_unless_there(scene, target, other, overwrite=True) is None
    damage(scene, keep_date=False, at=-40)
    with pytest.raises(OutputError, match=r"scene\.ply changed since"):
        bake_unless_there(scene, target, other)
    assert bake_unless_there(scene, target, SETTINGS, overwrite=True) is not None


def test_a_truncated_or_missing_output_is_baked(scene: Path, target: Path) -> None:
    bake_unless_there(scene, target, SETTINGS)
    whole = target.read_bytes()
    target.write_bytes(whole[:-1])
    with pytest.raises(OutputError, match="changed since it was baked"):
        bake_unless_there(scene, target, SETTINGS)
    bake_unless_there(scene, target, SETTINGS, overwrite=True)
    assert target.read_bytes() == whole
    target.unlink()
    assert bake_unless_there(scene, target, SETTINGS) is not None


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


def test_files_of_unchanged_size_and_date_are_not_read(
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


def test_verify_finds_a_changed_input_whose_date_was_set_back(
    scene: Path, target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identity, "SAMPLE_BYTES", 1)  # so that the sample misses the damage, as in a large file
    bake_unless_there(scene, target, SETTINGS)
    damage(scene, keep_date=True)
    assert bake_unless_there(scene, target, SETTINGS) is None
    with pytest.raises(OutputError, match=r"scene\.ply changed since"):
        bake_unless_there(scene, target, SETTINGS, verify=True)


@pytest.mark.parametrize("record", [None, "", "[]", "{}", '{"bake": {"inputs": 3}}', "\x00"])
def test_an_output_without_a_valid_record_is_refused(scene: Path, target: Path, record: str | None) -> None:
    bake_unless_there(scene, target, SETTINGS)
    note = target.with_name(target.name + SUFFIX)
    note.unlink()
    if record is not None:
        note.write_text(record)
    with pytest.raises(OutputError, match="there is no record of its inputs and settings"):
        bake_unless_there(scene, target, SETTINGS)
    assert bake_unless_there(scene, target, SETTINGS, overwrite=True) is not None
    assert bake_unless_there(scene, target, SETTINGS) is None
    scene.write_bytes(scene.read_bytes()[:-10])
    with pytest.raises(Exception, match=r"."):
        bake_unless_there(scene, target, SETTINGS, overwrite=True)
    assert not note.exists()  # a bake that fails leaves none
