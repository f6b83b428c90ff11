"""An SPZ file that stays codes gets the report of one whose scene is in memory, whatever is wrong with it."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.spz_layout import ANTIALIASED, HEADER, LOD, MAGIC, Layout
from sparklod_cli.inspection import percentiles
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io import read_coded, read_scene
from sparklod_cli.model.splats import COLUMNS
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


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("flags", [0, LOD])
def test_no_code_but_of_version_1_stands_for_an_invalid_splat(version: int, flags: int, tmp_path: Path) -> None:
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(version, flags=flags, count=40_000, links=1))
    coded = read_coded(path)
    assert coded is not None
    assert coded.sound
    assert coded.decode(slice(None))[0].invalid() == {}


def test_version_1_may_hold_invalid_splats(tmp_path: Path) -> None:
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(1, flags=0, count=40_000))
    coded = read_coded(path, columns={"center"})
    assert coded is not None
    assert not coded.sound
    assert set(coded.decode(slice(None))[0].invalid()) == {"non_finite"}


@pytest.mark.parametrize("name", ["hand-v1", "hand-tree-v2", "hand-tree-v3", "hand-v4", "sh3-v3"])
def test_any_part_is_what_all_splats_have_there(name: str) -> None:
    path = FIXTURES / "golden" / f"{name}.spz"
    scene, coded = read_scene(path, threads=2), read_coded(path, threads=2)
    assert coded is not None
    assert (coded.count, coded.sh_degree) == (len(scene), scene.splats.sh_degree)
    for part in (slice(0, 1), slice(1, 3), slice(2, 10_000)):
        splats, tree = coded.decode(part)
        for column in COLUMNS:
            assert np.array_equal(getattr(splats, column), getattr(scene.splats, column)[part])
        assert (tree is None) == (scene.tree is None)
        if tree is not None and scene.tree is not None:
            assert np.array_equal(tree.child_start, scene.tree.child_start[part])
            assert np.array_equal(tree.child_count, scene.tree.child_count[part])
    some, _ = coded.decode(slice(0, 2), {"rgb"})
    assert some.rgb.any()
    assert not some.quat_xyzw.any()


def test_codes_of_columns_that_nobody_wants_are_not_kept() -> None:
    coded = read_coded(FIXTURES / "golden" / "hand-tree-v3.spz", columns={"scale"})
    assert coded is not None
    assert set(coded.codes) == {"scales", "child_counts", "child_starts"}
    assert read_coded(FIXTURES / "sh0.ply") is None


@pytest.mark.parametrize("threads", [1, 3])
def test_codes_can_be_watched_without_being_kept(threads: int, tmp_path: Path) -> None:
    path = tmp_path / "any.spz"
    path.write_bytes(random_file(3, flags=LOD, count=100_000, links=1))
    seen: list[np.ndarray] = []
    coded, whole = read_coded(path, columns=(), watch={"rgb": seen.append}, threads=threads), read_coded(path)
    assert coded is not None
    assert whole is not None
    assert set(coded.codes) == {"child_counts", "child_starts"}
    assert len(seen) > 1
    assert np.array_equal(np.concatenate(seen), whole.codes["colors"])
