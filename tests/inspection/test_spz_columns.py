"""An SPZ file of which only some columns are read gets the report of one that is read as a whole, whatever is wrong."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.spz_streams import ANTIALIASED, HEADER, LOD, MAGIC, Layout
from sparklod_cli.inspection import percentiles
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io import examine_scene
from tests.conftest import FIXTURES

SETTINGS = [
    ReportSettings(),
    ReportSettings(values=True),
    ReportSettings(check=True),
    ReportSettings(chunks=True, values=True, all_quantities=True, check=True),
]
FILES = sorted([*(FIXTURES / "golden").glob("*.spz"), *(FIXTURES / "faults").glob("*.spz")])


def check_both(path: Path) -> None:
    for settings in SETTINGS:
        expected, _ = inspect(path, replace(settings, at_once=True), threads=2)
        for threads in (1, 3):
            found, scene = inspect(path, settings, threads=threads)
            assert repr(found) == repr(expected)  # NaN differs from itself
            assert scene is None


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_of_sound_and_of_broken_files(path: Path) -> None:
    check_both(path)


def random_file(version: int, *, flags: int, count: int = 300, links: int = 0) -> bytes:
    """A file of any codes; its links lead anywhere up to `links`."""
    rng = np.random.default_rng(version)
    layout = Layout(version, count, 2, 12, flags)
    data = HEADER.pack(MAGIC, version, count, 2, 12, flags, 0)
    for stream in layout.streams():
        codes = rng.integers(0, 256, (count, stream.size), np.uint8)
        if stream.name.startswith("child"):
            kind = "<u2" if stream.size == 2 else "<u4"
            codes = rng.integers(0, links, count).astype(kind).view(np.uint8)
        data += codes.tobytes()
    return gzip.compress(data, 1)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # any bits are numbers
@pytest.mark.parametrize("flags", [0, ANTIALIASED, LOD])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_of_any_codes(version: int, flags: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(percentiles, "KEPT", 100)  # so that more numbers pass several times
    monkeypatch.setattr("sparklod_cli.inspection.blocks.CHUNK_NODES", 64)
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(version, flags=flags, links=5))
    check_both(path)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("flags", [0, LOD])
def test_no_code_but_positions_of_version_1_stands_for_an_invalid_splat(
    version: int, flags: int, tmp_path: Path
) -> None:
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(version, flags=flags, count=40_000, links=1))
    splats = examine_scene(path).splats
    assert set(splats.invalid()) == ({"non_finite"} if version == 1 else set())
    splats = replace(splats, center=np.zeros_like(splats.center))
    assert splats.invalid() == {}
