"""One law for every format: the blocks of a stream, of whatever range, are the rows of the decoded scene."""

from __future__ import annotations

import contextlib
import pickle
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.sog.sog_container import SogFiles
from sparklod_cli.io import PlacedFile, open_stream, open_streams, read_scene
from sparklod_cli.io import streams as idle_streams
from sparklod_cli.model import streams
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.streams import Placed, SceneStream, collected, merged
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, HasTreeError, OutputError, UnreadableError
from tests.bake.out_of_core.plain import stream_of
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
    monkeypatch.setattr(streams, "BLOCK_SPLATS", 700)
    case = WRITERS[form][way]
    splats = random_splats(COUNT, sh_degree=2)
    path = put(case.write(Scene(splats, star(COUNT) if case.lod else None)), tmp_path, form)
    if case.lod:
        with pytest.raises(HasTreeError, match="is a Level-of-Detail file already"), open_stream(path):
            pass
        return
    scene = read_scene(path)
    with open_stream(path, scratch=tmp_path, threads=threads) as stream:
        facts = {name: getattr(scene, name) for name in ("format", "antialiased", "notes")}
        assert {name: getattr(stream, name) for name in facts} == facts
        assert (stream.count, stream.sh_degree) == (COUNT, scene.splats.sh_degree)
        assert stream.header.items() <= scene.header.items()
        assert_rows(list(stream.blocks()), scene.splats)
        for start, stop in RANGES:
            assert_rows(list(stream.read(start, stop)), scene.splats.take(slice(start, stop)))


@pytest.mark.parametrize(("form", "way"), [("PLY", "binary"), ("PLY", "ascii"), ("SPZ", "3"), ("SOG", "2 folder")])
def test_reads_may_be_interleaved_pickled_and_find_what_was_unpacked(form: str, way: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    scratch = tmp_path / "scratch"
    path = put(WRITERS[form][way].write(Scene(random_splats(COUNT, sh_degree=1))), tmp_path / "in", form)
    expected = read_scene(path).splats
    with open_stream(path, scratch=scratch, keep=True) as stream:
        one, other = stream.read(0, 100), stream.read(100, 200)
        both = [next(one), next(other)]
        assert_rows(both, expected.take(slice(0, 200)))
        again: SceneStream = pickle.loads(pickle.dumps(stream))
    unpacked = {each: each.stat().st_mtime_ns for each in scratch.glob("*")}
    assert len(unpacked) == (way != "binary")
    assert_rows(list(again.read(50, 60)), expected.take(slice(50, 60)))  # the files stay
    with open_stream(path, scratch=scratch, keep=True) as stream:
        assert_rows(list(stream.blocks()), expected)
    assert {each: each.stat().st_mtime_ns for each in scratch.glob("*")} == unpacked


def test_nothing_is_left_in_the_scratch_folder(tmp_path: Path) -> None:
    path = put(WRITERS["SPZ"]["3"].write(Scene(random_splats(99))), tmp_path, "SPZ")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    with open_stream(path, scratch=scratch) as stream:
        list(stream.blocks())
    assert not list(scratch.iterdir())


def test_a_file_that_changes_is_noticed(tmp_path: Path) -> None:
    path = put(WRITERS["PLY"]["binary"].write(Scene(random_splats(99))), tmp_path, "PLY")
    with open_stream(path) as stream:
        put(WRITERS["PLY"]["binary"].write(Scene(random_splats(98))), tmp_path, "PLY")
        with pytest.raises(FormatError, match="it was changed while it was read"):
            list(stream.blocks())


def test_keeping_needs_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="keep needs a scratch folder"), open_stream(tmp_path / "x", keep=True):
        pass


def test_several_files_are_one_scene_and_one_that_is_named_twice_is_read_twice(tmp_path: Path) -> None:
    turned = Transform.from_parts(rotate=(0, 90, 0), translate=(9, 0, 0))
    paths, scenes = {}, {}
    for form, way, degree in (("PLY", "binary", 1), ("SPZ", "3", 2)):
        (tmp_path / form).mkdir()
        source = Scene(random_splats(99, sh_degree=degree))
        paths[form] = put(WRITERS[form][way].write(source), tmp_path / form, form)
        scenes[form] = read_scene(paths[form])
    order = ("PLY", "SPZ", "PLY")
    files = [PlacedFile(paths[form]) for form in order[:2]] + [PlacedFile(paths["PLY"], turned)]
    parts = [Placed(stream_of(scenes[form]), form) for form in order[:2]]
    parts += [Placed(stream_of(scenes["PLY"]), "", turned)]
    expected = collected(merged(parts)).splats
    for keep in (False, True):
        with open_streams(files, scratch=tmp_path, keep=keep) as stream:
            assert_rows([collected(stream).splats], expected)
            assert_rows(list(stream.read(150, 250)), expected.take(slice(150, 250)))
        assert len(list(tmp_path.glob("*.unpacked"))) == keep


def test_errors_on_one_of_several_files_name_it(tmp_path: Path) -> None:
    good, bad, tree = tmp_path / "good.ply", tmp_path / "bad.ply", FIXTURES / "golden/tree-v3.spz"
    good.write_bytes((FIXTURES / "sh1.ply").read_bytes())
    bad.write_bytes((FIXTURES / "sh1-ascii.ply").read_bytes()[:-300])
    for file, kind, text in (
        (tree, HasTreeError, "it is a Level-of-Detail file"),
        (bad / "x", UnreadableError, "cannot"),
    ):
        with pytest.raises(kind, match=rf"{file.name}: {text}"), open_streams([PlacedFile(good), PlacedFile(file)]):
            pass
    with open_streams([PlacedFile(good), PlacedFile(bad)]) as stream, pytest.raises(FormatError, match=r"bad\.ply: "):
        list(stream.blocks())


def test_a_scratch_folder_without_room_is_named(tmp_path: Path) -> None:
    path = put(WRITERS["SPZ"]["3"].write(Scene(random_splats(99))), tmp_path, "SPZ")
    for keep in (False, True):
        with open_stream(path, scratch=path, keep=keep) as stream, pytest.raises(OutputError, match="scratch folder"):
            list(stream.blocks())


def test_short_reads_decode_the_palette_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    pixels = SogFiles.pixels
    monkeypatch.setattr(SogFiles, "pixels", lambda *given: calls.append(given[1:3]) or pixels(*given))
    path = put(WRITERS["SOG"]["2"].write(Scene(random_splats(99, sh_degree=1))), tmp_path, "SOG")
    with open_stream(path) as stream:
        for start in range(9):
            assert len(next(stream.read(start, start + 9))) == 9
    assert calls.count(("shN", 0)) == 1


def test_files_that_wait_are_few_and_closed_at_the_end(tmp_path: Path) -> None:
    idle_streams.close_idle()
    with contextlib.ExitStack() as stack:
        for number in range(idle_streams.MOST + 3):
            path = tmp_path / f"{number}.ply"
            path.write_bytes((FIXTURES / "one.ply").read_bytes())
            next(stack.enter_context(open_stream(path)).read(0, 1))
        assert len(idle_streams._IDLE) == idle_streams.MOST
    assert not idle_streams._IDLE
