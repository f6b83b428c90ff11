"""Laws of every format, scene and SH degree: a scene comes back within the precision that the codings state.

The blocks of a stream, of whatever range, are the rows of the decoded scene; beside these there is little in memory.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import os
import pickle
import tempfile
import tracemalloc
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sparklod_cli.codecs import ply, quantize, splat, spz
from sparklod_cli.codecs.formats import FORMATS, WRITABLE, WriteOptions
from sparklod_cli.codecs.merging import Placed, merged
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.reader import Reader, decode_file
from sparklod_cli.io.reading import MOST, Merged, open_reader, read_scene
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, HasTreeError, OutputError, UnreadableError
from sparklod_cli.system.threads import BLOCK_ROWS, ordered_map
from tests.bake.jobs import reader_of
from tests.codecs.cases import Precision, assert_same, decode, encode, put, rotation_degrees, star
from tests.codecs.writers import WRITERS
from tests.conftest import FIXTURES
from tests.scenes import random_splats

SCENES = ("sh0", "sh1", "sh2", "sh3", "flat", "needle", "coincident", "huge", "one")
CASES = [pytest.param(form, way, id=f"{form}-{way}") for form, ways in WRITERS.items() for way in ways]
EVERY_WAY = pytest.mark.parametrize(("form", "way"), CASES)


def test_every_format_has_a_writer() -> None:
    assert {form.name for form in FORMATS} == WRITERS.keys()


# --- Round trips ------------------------------------------------------------------------------------------------------


@functools.cache
def scene(name: str, *, lod: bool = False) -> Scene:
    """A fixture; as a tree it has splats of every opacity up to 1000, which is where the encoder stops."""
    splats = read_scene(FIXTURES / f"{name}.ply").splats
    if not lod:
        return Scene(splats)
    opacity = linear_opacity(np.linspace(4.4, 0.01, len(splats), dtype=np.float32))
    return Scene(dataclasses.replace(splats, opacity=opacity), star(len(splats)))


@pytest.mark.parametrize("name", SCENES)
@EVERY_WAY
def test_a_scene_comes_back_within_the_precision_of_its_format(form: str, way: str, name: str, tmp_path: Path) -> None:
    case = WRITERS[form][way]
    source = scene(name, lod=case.lod)
    if np.abs(source.splats.center).max() > case.reach:
        with pytest.raises(FormatError, match="coordinates reach"):
            case.write(source)
        return
    back = read_scene(put(case.write(source), tmp_path, form))
    assert (back.format, back.antialiased, back.notes) == (case.format, False, ())
    held = case.held(source.splats)
    assert_close(back.splats, held, case.precision(Scene(held, source.tree)))
    assert (back.tree is None) == (source.tree is None)
    if back.tree and source.tree:
        np.testing.assert_array_equal(back.tree.child_count, source.tree.child_count)
        np.testing.assert_array_equal(back.tree.child_start, source.tree.child_start)


def assert_close(back: Splats, source: Splats, allowed: Precision) -> None:
    assert back.sh.shape == source.sh.shape
    slack = 1e-6  # float32
    assert (np.abs(back.center.astype(np.float64) - source.center) <= allowed.center).all()
    expected = np.clip(source.scale, *allowed.scale_range)
    assert (np.abs(np.log(back.scale / expected)) <= allowed.log_scale).all()
    assert rotation_degrees(back.quat_xyzw, source.quat_xyzw).max() <= allowed.degrees
    opacity = source.opacity
    if allowed.blur is not None:
        opacity = quantize.compensated(opacity, source.scale, back.scale, allowed.blur)
    off = np.abs(lod_opacity(back.opacity) - lod_opacity(opacity))
    assert (off <= np.where(opacity > 1, allowed.merged, allowed.opacity)).all()
    assert (np.abs(back.rgb - np.clip(source.rgb, *allowed.rgb_range)) <= allowed.rgb).all()
    sh = np.abs(back.sh - np.clip(source.sh, *allowed.sh_range))
    assert sh[:, :3].max(initial=0) <= allowed.sh[0] * (1 + slack)
    assert sh[:, 3:].max(initial=0) <= allowed.sh[1] * (1 + slack)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("lod", [False, True])
def test_writing_a_decoded_scene_again_changes_nothing(name: str, version: int, lod: bool) -> None:
    """SPZ of SPZ: whatever was rounded once stays where it is (rotations beyond half a turn excepted)."""
    options = spz.settled(scene(name), WriteOptions(spz_version=version))
    once = decode(spz, encode(spz, scene(name, lod=lod), options))
    assert_same(decode(spz, encode(spz, once, options)).splats, once.splats, but="quat_xyzw")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("codec", [spz, rad, ply])
def test_whether_a_scene_is_antialiased_is_kept(codec: ModuleType, antialiased: bool) -> None:
    assert decode(codec, encode(codec, Scene(scene("sh0").splats, antialiased=antialiased))).antialiased is antialiased


@EVERY_WAY
@pytest.mark.slow
def test_threads_do_not_change_what_is_read(form: str, way: str, tmp_path: Path) -> None:
    case = WRITERS[form][way]
    splats = random_splats(17_000, sh_degree=1)  # more than one chunk of rows
    source = Scene(splats, star(len(splats)) if case.lod else None)
    path = put(case.write(source), tmp_path, form)
    expected = read_scene(path).splats
    assert_close(expected, case.held(splats), case.precision(Scene(case.held(splats), source.tree)))
    assert_same(read_scene(path, threads=5).splats, expected)


#: Ways to write: a codec, and its options.
OWN = {
    "ply": (ply, WriteOptions()),
    "splat": (splat, WriteOptions()),
    **{f"spz {version}": (spz, WriteOptions(spz_version=version)) for version in (2, 3, 4)},
    "sog": (WRITABLE[".sog"].codec(), WriteOptions()),
}


@pytest.mark.parametrize("way", OWN)
def test_threads_do_not_change_a_byte(way: str) -> None:
    codec, options = OWN[way]
    source = Scene(random_splats(3_000 if way == "sog" else 40_000, sh_degree=1))  # more than two blocks of rows
    one = encode(codec, source, options)
    for threads in (2, 5):
        assert encode(codec, source, options, threads=threads) == one


@pytest.mark.parametrize("way", sorted(OWN.keys() - {"sog"}))
def test_a_scene_without_splats_comes_back(way: str) -> None:
    codec, options = OWN[way]
    assert len(decode(codec, encode(codec, Splats.empty(0, 0), options)).splats) == 0


# --- Streams ----------------------------------------------------------------------------------------------------------

COUNT = 2600  # no multiple of a block, a chunk of compressed PLY, or a chunk of the RAD by hand
RANGES = ((0, COUNT), (0, 1), (COUNT - 1, COUNT), (255, 257), (300, 300), (999, 2001), (700, 1400), (123, 2345))


def assert_rows(blocks: Sequence[Splats], expected: Splats, start: int = 0, stop: int | None = None) -> None:
    """Assert that blocks are a range of rows."""
    found = Splats.concat(blocks) if blocks else Splats.empty(0, expected.sh_degree)
    assert_same(found, expected.take(slice(start, stop)))


def written(form: str, way: str, folder: Path, count: int = COUNT, sh_degree: int = 1) -> Path:
    folder.mkdir(exist_ok=True)
    return put(WRITERS[form][way].write(Scene(random_splats(count, sh_degree=sh_degree))), folder, form)


@pytest.mark.parametrize("threads", [1, 2])
@EVERY_WAY
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
            assert_rows(list(stream.blocks(start, stop)), scene.splats, start, stop)


@EVERY_WAY
def test_several_threads_read_one_reader(form: str, way: str, tmp_path: Path) -> None:
    if WRITERS[form][way].lod:
        return
    path = written(form, way, tmp_path)
    expected = read_scene(path).splats
    starts = range(0, COUNT - 100, 50)
    with open_reader(path) as reader, ThreadPoolExecutor(4) as pool:
        for start, splats in zip(starts, pool.map(lambda at: reader.read(at, at + 100)[0], starts), strict=True):
            assert_rows([splats], expected, start, start + 100)


@pytest.mark.parametrize(("form", "way"), [("PLY", "binary"), ("PLY", "ascii"), ("SPZ", "3"), ("SOG", "2 folder")])
def test_reads_may_be_interleaved_pickled_and_find_what_was_unpacked(form: str, way: str, tmp_path: Path) -> None:
    scratch, path = tmp_path / "scratch", written(form, way, tmp_path / "in")
    expected = read_scene(path).splats
    with open_reader(path, scratch=scratch) as stream:
        one, other = stream.blocks(0, 100), stream.blocks(100, 200)
        assert_rows([next(one), next(other)], expected, 0, 200)
        again: Reader = pickle.loads(pickle.dumps(stream))
    unpacked = {each: each.stat().st_mtime_ns for each in scratch.glob("*")}
    assert len(unpacked) == (way != "binary")
    assert_rows(list(again.blocks(50, 60)), expected, 50, 60)  # the files stay
    with open_reader(path, scratch=scratch) as stream:
        assert_rows(list(stream.blocks()), expected)
    assert {each: each.stat().st_mtime_ns for each in scratch.glob("*")} == unpacked


def test_nothing_is_left_among_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, scratch = written("SPZ", "3", tmp_path), tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    with open_reader(path) as stream:
        list(stream.blocks())
    assert not list(scratch.iterdir())


def test_a_file_that_changes_is_noticed(tmp_path: Path) -> None:
    with open_reader(written("PLY", "binary", tmp_path)) as stream:
        written("PLY", "binary", tmp_path, COUNT - 1)
        with pytest.raises(FormatError, match="it was changed while it was read"):
            list(stream.blocks())


def test_a_scratch_folder_without_room_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written("SPZ", "3", tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(path))
    for scratch in (None, path):
        with open_reader(path, scratch=scratch) as stream, pytest.raises(OutputError, match="scratch folder"):
            list(stream.blocks())


@pytest.mark.parametrize("way", ["ply", "splat", "spz 3", "spz 4"])
def test_decoding_takes_little_memory_beside_the_splats(way: str) -> None:
    """The files are, or unfold to, 49, 6, 13 and 13 MB, so whoever reads them whole needs more."""
    extra = {"ply": 12e6, "splat": 3e6, "spz 3": 9e6, "spz 4": 9e6}[way]
    codec, options = OWN[way]
    count = 12 * BLOCK_ROWS
    file = io.BytesIO(encode(codec, random_splats(count, sh_degree=3), options))
    tracemalloc.start()
    splats = decode_file(codec, file).splats
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    decoded = sum(getattr(splats, name).nbytes for name in COLUMNS)
    assert len(splats) == count
    assert decoded < peak < decoded + extra


# --- Several files ----------------------------------------------------------------------------------------------------


def test_several_files_are_one_scene_and_one_that_is_named_twice_is_read_twice(tmp_path: Path) -> None:
    turned = Transform.from_parts(rotate=(0, 90, 0), translate=(9, 0, 0))
    one, two = written("PLY", "binary", tmp_path / "a", 99, 1), written("SPZ", "3", tmp_path / "b", 99, 2)
    files = ((one, Transform()), (two, Transform()), (one, turned))
    parts = [Placed(reader_of(read_scene(path)), path.name, place) for path, place in files]
    expected = merged(parts).scene().splats
    for scratch in (None, tmp_path):
        with open_reader(Merged(files), scratch=scratch) as stream:
            assert_rows([stream.scene().splats], expected)
            assert_rows(list(stream.blocks(150, 250)), expected, 150, 250)
        assert len(list(tmp_path.glob("*.unpacked"))) == (scratch is not None)


def test_errors_on_one_of_several_files_name_it(tmp_path: Path) -> None:
    good, bad, tree = FIXTURES / "sh1.ply", tmp_path / "bad.ply", FIXTURES / "golden/tree-v3.spz"
    bad.write_bytes((FIXTURES / "sh1-ascii.ply").read_bytes()[:-300])
    for file, kind, text in (
        (tree, HasTreeError, "it is a Level-of-Detail file"),
        (bad / "x", UnreadableError, "cannot"),
    ):
        with pytest.raises(kind, match=rf"{file.name}: {text}"), open_reader(Merged.of([good, file])):
            pass
    with open_reader(Merged.of([good, bad])) as stream, pytest.raises(FormatError, match=r"bad\.ply: "):
        list(stream.blocks())


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files")
def test_few_of_many_files_are_open_at_a_time(tmp_path: Path) -> None:
    for number in range(3 * MOST):
        (tmp_path / f"{number}.ply").write_bytes((FIXTURES / "one.ply").read_bytes())
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    with open_reader(Merged.of(sorted(tmp_path.glob("*.ply")))) as reader:
        assert len(reader.scene()) == 3 * MOST
        assert len(os.listdir("/proc/self/fd")) <= before + 2 * MOST  # noqa: PTH208
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208


# --- Blocks on several threads ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_items_are_taken_as_they_are_needed(threads: int) -> None:
    taken = []

    def items() -> Iterator[int]:
        for item in range(1000):
            taken.append(item)
            yield item

    for expected, result in enumerate(ordered_map(lambda item: 2 * item, items(), threads)):
        assert result == 2 * expected
        assert len(taken) <= expected + 2 * threads + 2
    assert len(taken) == 1000


@pytest.mark.parametrize("threads", [1, 3])
def test_a_failure_is_passed_on_and_ends_the_work(threads: int) -> None:
    done = []

    def work(item: int) -> None:
        done.append(item)
        if item == 5:
            raise FormatError("five")

    with pytest.raises(FormatError, match="five"):
        list(ordered_map(work, range(1000), threads))
    assert len(done) < 20
