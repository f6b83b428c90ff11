"""One law for every format: the blocks of a stream, of whatever range, are the rows of the decoded scene."""

from __future__ import annotations

import os
import pickle
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.merging import Placed, merged
from sparklod_cli.codecs.reader import Reader
from sparklod_cli.codecs.sog.sog_container import SogFiles
from sparklod_cli.io.reading import MOST, Merged, open_reader, read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, HasTreeError, OutputError, UnreadableError
from tests.bake.out_of_core.plain import reader_of
from tests.codecs.cases import put
from tests.codecs.test_round_trip import CASES, star
from tests.codecs.writers import WRITERS
from tests.conftest import FIXTURES
from tests.scenes import random_splats

COUNT = 2600  # no multiple of a block, a chunk of compressed PLY, or a chunk of the RAD by hand
RANGES = ((0, COUNT), (0, 1), (COUNT - 1, COUNT), (255, 257), (300, 300), (999, 2001), (700, 1400), (123, 2345))


def assert_rows(blocks: list[Splats], expected: Splats) -> None:
    found = Splats.concat(blocks) if blocks else Splats.empty(0, expected.sh_degree)
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), column)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("form", "way"), CASES)
@pytest.mark.slow
def test_the_blocks_of_any_range_are_the_rows_of_the_scene(
    form: str, way: str, threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sparklod_cli.codecs.reader.BLOCK_SPLATS", 700)
    case = WRITERS[form][way]
    splats = random_splats(COUNT, sh_degree=2)
    path = put(case.write(Scene(splats, star(COUNT) if case.lod else None)), tmp_path, form)
    if case.lod:
        with open_reader(path) as reader, pytest.raises(HasTreeError, match="is a Level-of-Detail file already"):
            next(reader.blocks())
        return
    scene = read_scene(path)
    with open_reader(path, scratch=tmp_path, threads=threads) as stream:
        facts = {name: getattr(scene, name) for name in ("format", "antialiased", "notes")}
        assert {name: getattr(stream, name) for name in facts} == facts
        assert (stream.count, stream.sh_degree) == (COUNT, scene.splats.sh_degree)
        assert stream.header.items() <= scene.header.items()
        assert_rows(list(stream.blocks()), scene.splats)
        for start, stop in RANGES:
            assert_rows(list(stream.blocks(start, stop)), scene.splats.take(slice(start, stop)))


@pytest.mark.parametrize(("form", "way"), [("PLY", "binary"), ("PLY", "ascii"), ("SPZ", "3"), ("SOG", "2 folder")])
def test_reads_may_be_interleaved_pickled_and_find_what_was_unpacked(form: str, way: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    scratch = tmp_path / "scratch"
    path = put(WRITERS[form][way].write(Scene(random_splats(COUNT, sh_degree=1))), tmp_path / "in", form)
    expected = read_scene(path).splats
    with open_reader(path, scratch=scratch) as stream:
        one, other = stream.blocks(0, 100), stream.blocks(100, 200)
        both = [next(one), next(other)]
        assert_rows(both, expected.take(slice(0, 200)))
        again: Reader = pickle.loads(pickle.dumps(stream))
    unpacked = {each: each.stat().st_mtime_ns for each in scratch.glob("*")}
    assert len(unpacked) == (way != "binary")
    assert_rows(list(again.blocks(50, 60)), expected.take(slice(50, 60)))  # the files stay
    with open_reader(path, scratch=scratch) as stream:
        assert_rows(list(stream.blocks()), expected)
    assert {each: each.stat().st_mtime_ns for each in scratch.glob("*")} == unpacked


def test_nothing_is_left_among_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(WRITERS["SPZ"]["3"].write(Scene(random_splats(99))), tmp_path, "SPZ")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    with open_reader(path) as stream:
        list(stream.blocks())
    assert not list(scratch.iterdir())


def test_a_file_that_changes_is_noticed(tmp_path: Path) -> None:
    path = put(WRITERS["PLY"]["binary"].write(Scene(random_splats(99))), tmp_path, "PLY")
    with open_reader(path) as stream:
        put(WRITERS["PLY"]["binary"].write(Scene(random_splats(98))), tmp_path, "PLY")
        with pytest.raises(FormatError, match="it was changed while it was read"):
            list(stream.blocks())


def test_several_files_are_one_scene_and_one_that_is_named_twice_is_read_twice(tmp_path: Path) -> None:
    turned = Transform.from_parts(rotate=(0, 90, 0), translate=(9, 0, 0))
    paths, scenes = {}, {}
    for form, way, degree in (("PLY", "binary", 1), ("SPZ", "3", 2)):
        (tmp_path / form).mkdir()
        source = Scene(random_splats(99, sh_degree=degree))
        paths[form] = put(WRITERS[form][way].write(source), tmp_path / form, form)
        scenes[form] = read_scene(paths[form])
    order = ("PLY", "SPZ", "PLY")
    files = [*((paths[form], Transform()) for form in order[:2]), (paths["PLY"], turned)]
    parts = [Placed(reader_of(scenes[form]), form) for form in order[:2]]
    parts += [Placed(reader_of(scenes["PLY"]), "", turned)]
    expected = merged(parts).scene().splats
    for scratch in (None, tmp_path):
        with open_reader(Merged(tuple(files)), scratch=scratch) as stream:
            assert_rows([stream.scene().splats], expected)
            assert_rows(list(stream.blocks(150, 250)), expected.take(slice(150, 250)))
        assert len(list(tmp_path.glob("*.unpacked"))) == (scratch is not None)


def test_errors_on_one_of_several_files_name_it(tmp_path: Path) -> None:
    good, bad, tree = tmp_path / "good.ply", tmp_path / "bad.ply", FIXTURES / "golden/tree-v3.spz"
    good.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    bad.write_bytes((FIXTURES / "sh1-ascii.ply").read_bytes()[:-300])
    for file, kind, text in (
        (tree, HasTreeError, "it is a Level-of-Detail file"),
        (bad / "x", UnreadableError, "cannot"),
    ):
        with pytest.raises(kind, match=rf"{file.name}: {text}"), open_reader(Merged.of([good, file])):
            pass
    with open_reader(Merged.of([good, bad])) as stream, pytest.raises(FormatError, match=r"bad\.ply: "):
        list(stream.blocks())


def test_a_scratch_folder_without_room_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(WRITERS["SPZ"]["3"].write(Scene(random_splats(99))), tmp_path, "SPZ")
    monkeypatch.setattr(tempfile, "tempdir", str(path))
    for scratch in (None, path):
        with open_reader(path, scratch=scratch) as stream, pytest.raises(OutputError, match="scratch folder"):
            list(stream.blocks())


def test_short_reads_decode_the_palette_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    pixels = SogFiles.pixels
    monkeypatch.setattr(SogFiles, "pixels", lambda *given: calls.append(given[1:3]) or pixels(*given))
    path = put(WRITERS["SOG"]["2"].write(Scene(random_splats(99, sh_degree=1))), tmp_path, "SOG")
    with open_reader(path) as stream:
        for start in range(9):
            assert len(next(stream.blocks(start, start + 9))) == 9
    assert calls.count(("shN", 0)) == 1


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files")
def test_few_of_many_files_are_open_at_a_time(tmp_path: Path) -> None:
    for number in range(3 * MOST):
        (tmp_path / f"{number}.ply").write_bytes((FIXTURES / "one.ply").read_bytes())
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    with open_reader(Merged.of(sorted(tmp_path.glob("*.ply")))) as reader:
        assert len(reader.scene()) == 3 * MOST
        assert len(os.listdir("/proc/self/fd")) <= before + 2 * MOST  # noqa: PTH208
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208


@pytest.mark.parametrize(("form", "way"), CASES)
def test_several_threads_read_one_reader(form: str, way: str, tmp_path: Path) -> None:
    case = WRITERS[form][way]
    if case.lod:
        return
    path = put(case.write(Scene(random_splats(COUNT, sh_degree=1))), tmp_path, form)
    expected = read_scene(path).splats
    starts = range(0, COUNT - 100, 50)
    with open_reader(path) as reader, ThreadPoolExecutor(4) as pool:
        for start, splats in zip(starts, pool.map(lambda at: reader.read(at, at + 100)[0], starts), strict=True):
            assert_rows([splats], expected.take(slice(start, start + 100)))
