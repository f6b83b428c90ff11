"""The identity of a bake changes with whatever changes the bytes of its output, and with nothing else."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import pytest

from sparklod_cli.bake.identity import NO_PART, BakeIdentity
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import UnreadableError
from tests.conftest import FIXTURES

SETTINGS = BakeSettings()
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
    path.write_bytes((FIXTURES / "demo.ply").read_bytes())
    return path


def test_the_same_identity_has_the_same_digest(scene: Path) -> None:
    first, second = BakeIdentity.of(scene, SETTINGS), BakeIdentity.of(scene, BakeSettings(unused=("--up",)))
    assert first == second
    assert first.digest == second.digest
    assert first.differences(second) == []


@pytest.mark.parametrize("name", OTHERS)
def test_every_setting_is_part_of_it(scene: Path, name: str) -> None:
    first, second = BakeIdentity.of(scene, SETTINGS), BakeIdentity.of(scene, OTHERS[name])
    assert first.digest != second.digest
    (difference,) = second.differences(first)
    assert difference.startswith(f"{name} was ")


def test_all_settings_are_named_once(scene: Path) -> None:
    names = {field.name for field in dataclasses.fields(BakeSettings)} - {*NO_PART}
    assert {name.split(".")[0] for name in BakeIdentity.of(scene, SETTINGS).settings} == {*names, "sparklod"}


@pytest.mark.parametrize("at", [0, 100, -1])
def test_another_content_is_another_identity(scene: Path, at: int) -> None:
    before, times = BakeIdentity.of(scene, SETTINGS), scene.stat()
    data = bytearray(scene.read_bytes())
    data[at] ^= 1
    scene.write_bytes(data)
    os.utime(scene, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert BakeIdentity.of(scene, SETTINGS).differences(before) == [f"{scene} changed since"]


def test_a_file_of_another_time_is_another_input(scene: Path) -> None:
    before = BakeIdentity.of(scene, SETTINGS)
    os.utime(scene, ns=(0, 0))
    assert BakeIdentity.of(scene, SETTINGS).digest != before.digest


def test_the_name_of_a_file_does_not_matter(scene: Path) -> None:
    before = BakeIdentity.of(scene, SETTINGS)
    assert BakeIdentity.of(scene.rename(scene.with_name("moved.ply")), SETTINGS).digest == before.digest


def test_colours_are_an_input(scene: Path, tmp_path: Path) -> None:
    colors = tmp_path / "colors.npy"
    colors.write_bytes(b"one")
    settings = BakeSettings(rgba=colors)
    before = BakeIdentity.of(scene, settings)
    colors.write_bytes(b"two")
    assert BakeIdentity.of(scene, settings).differences(before) == [f"{colors} changed since"]


def test_files_that_an_input_names_are_inputs(tmp_path: Path) -> None:
    folder = tmp_path / "sog"
    folder.mkdir()
    (folder / "meta.json").write_text('{"version": 2, "means": {"files": ["means.webp"]}}')
    (folder / "means.webp").write_bytes(b"one")
    before = BakeIdentity.of(folder, SETTINGS)
    (folder / "means.webp").write_bytes(b"two")
    assert BakeIdentity.of(folder, SETTINGS).differences(before) == [f"{folder / 'means.webp'} changed since"]


def test_it_can_be_written_and_read(scene: Path) -> None:
    identity = BakeIdentity.of(scene, OTHERS["transform.rotation"])
    read = BakeIdentity.from_record(json.loads(json.dumps(dataclasses.asdict(identity))))
    assert read == identity
    assert read.digest == identity.digest
    for record in ({}, [], {"inputs": 3}, {"inputs": [{}], "settings": {}}, None):
        with pytest.raises(ValueError, match=r"."):
            BakeIdentity.from_record(record)


def test_a_missing_input_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UnreadableError, match="cannot be read: no such file"):
        BakeIdentity.of(tmp_path / "none.ply", SETTINGS)
