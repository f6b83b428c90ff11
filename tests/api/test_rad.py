"""RAD through the public interface: written, read as a whole, and read in parts, which touch no other bytes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.splats import COLUMNS
from tests.api.runs import DEMO, command
from tests.scenes import random_splats


@pytest.fixture(scope="module")
def large() -> sparklod.Tree:
    """A tree of more nodes than a chunk has."""
    return sparklod.Tree(*quick.build(random_splats(60_000, sh_degree=1, extent=50)))


@pytest.fixture(scope="module", params=[False, True], ids=["whole", "chunked"])
def rad(request: pytest.FixtureRequest, large: sparklod.Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rad") / "large.rad"
    sparklod.write(path, large, chunked=request.param, compression_level=1)
    return path


def copied(rad: Path, folder: Path) -> Path:
    for path in rad.parent.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder / rad.name


def test_a_written_tree_is_read_back(rad: Path, large: sparklod.Tree) -> None:
    again = sparklod.read(rad)
    assert isinstance(again, sparklod.Tree)
    np.testing.assert_array_equal(again.tree.child_start, large.tree.child_start)
    # Rounded to a 16th of small splats, which are 0.2 here.
    np.testing.assert_allclose(again.splats.center, large.splats.center, atol=0.01)
    np.testing.assert_allclose(again.splats.rgb, large.splats.rgb, atol=0.01)


def test_what_was_written_counts_all_files(large: sparklod.Tree, tmp_path: Path) -> None:
    written = sparklod.write(tmp_path / "x.rad", large, chunked=True)
    assert written.bytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    assert written.format == "RAD"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x-0.radc", "x-1.radc", "x.rad"]
    with pytest.raises(sparklod.OutputError, match=r"x\.rad exists"):
        sparklod.write(tmp_path / "x.rad", large)


def test_the_header_is_read_without_its_chunks(rad: Path, large: sparklod.Tree, tmp_path: Path) -> None:
    header = sparklod.read_rad_header(rad)
    assert (header.count, header.max_sh, header.lod_tree) == (len(large), 1, True)
    assert header.chunk_size == CHUNK_NODES
    assert [entry.bytes for entry in header.chunks] == list(sparklod.read(rad).chunk_bytes or ())
    alone = tmp_path / "alone.rad"
    alone.write_bytes(rad.read_bytes()[: header.bytes])
    assert sparklod.read_rad_header(alone) == header


@pytest.mark.parametrize("number", [0, 1])
def test_a_chunk_is_read_from_its_own_bytes(number: int, rad: Path, tmp_path: Path) -> None:
    whole = sparklod.read(rad)
    path = copied(rad, tmp_path)
    header = sparklod.read_rad_header(path)
    # Every byte but those of the header and of the chunk is another one.
    for file in tmp_path.iterdir():
        data = bytearray(b ^ 0xFF for b in file.read_bytes())
        if file == path:
            data[: header.bytes] = file.read_bytes()[: header.bytes]
        entry = header.chunks[number]
        begin = entry.offset + (header.bytes if entry.filename is None else 0)
        if (entry.filename or path.name) == file.name:
            data[begin : begin + entry.bytes] = file.read_bytes()[begin : begin + entry.bytes]
        file.write_bytes(data)
    with pytest.raises(sparklod.FormatError):
        sparklod.read(path)
    chunk = sparklod.read_rad_chunk(path, number)
    assert chunk.header.base == number * CHUNK_NODES
    part = slice(chunk.header.base, chunk.header.base + chunk.header.count)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(chunk.splats, name), getattr(whole.splats, name)[part], name)
    assert chunk.tree is not None and whole.tree is not None
    np.testing.assert_array_equal(chunk.tree.child_start, whole.tree.child_start[part])


def test_options_of_rad_reach_the_file(large: sparklod.Tree, tmp_path: Path) -> None:
    options = sparklod.RadOptions(center="f32", rgb="f32", ranges=sparklod.SplatEncoding(lod_opacity=True))
    sparklod.write(tmp_path / "x.rad", large, rad=options)
    again = sparklod.read(tmp_path / "x.rad")
    np.testing.assert_array_equal(again.splats.center, large.splats.center)
    np.testing.assert_array_equal(again.splats.rgb, large.splats.rgb)
    assert sparklod.read_rad_header(tmp_path / "x.rad").encoding == options.ranges
    sparklod.write(tmp_path / "y.rad", large, rad=sparklod.RadOptions(chunked=True))
    assert sparklod.read_rad_header(tmp_path / "y.rad").chunked


def test_what_does_not_suit_is_refused(large: sparklod.Tree, scene: sparklod.Scene, rad: Path, tmp_path: Path) -> None:
    for options in ({"chunked": True}, {"rad": sparklod.RadOptions()}):
        with pytest.raises(ValueError, match="chunked and rad are of RAD; leave them out"):
            sparklod.write(tmp_path / "x.spz", large, **options)
        with pytest.raises(ValueError, match="chunked and rad are of RAD; leave them out"):
            sparklod.write(tmp_path / "x.rad", large, encoding="ext", **options)
    with pytest.raises(ValueError, match="spz_version and fractional_bits are of SPZ"):
        sparklod.write(tmp_path / "x.rad", large, spz_version=2)
    with pytest.raises(ValueError, match="no rad center 'r8'; give one of auto, f32"):
        sparklod.RadOptions(center="r8")
    with pytest.raises(sparklod.FormatError, match=r"a tree is written as \.spz, \.rad, which"):
        sparklod.write(tmp_path / "x.ply", large)
    for number in (-1, 2):
        with pytest.raises(ValueError, match=f"number is {number}; its chunks are 0 to 1"):
            sparklod.read_rad_chunk(rad, number)
    with pytest.raises(sparklod.FormatError, match=r"demo\.ply: no RAD header"):
        sparklod.read_rad_header(DEMO)
    for missing in (tmp_path / "missing.rad", tmp_path):
        with pytest.raises(sparklod.FormatError, match="cannot be read"):
            sparklod.read_rad_header(missing)
    assert list(tmp_path.iterdir()) == []


def test_a_chunk_that_is_cut_short_is_refused(rad: Path, tmp_path: Path) -> None:
    path = copied(rad, tmp_path)
    last = sparklod.read_rad_header(path).chunks[-1]
    file = path if last.filename is None else path.with_name(last.filename)
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(sparklod.FormatError, match="cut short"):
        sparklod.read_rad_chunk(path, 1)
    assert sparklod.read_rad_chunk(path, 0).header.count == CHUNK_NODES
    if last.filename is not None:
        file.unlink()
        with pytest.raises(sparklod.FormatError, match="which it names, cannot be read"):
            sparklod.read_rad_chunk(path, 1)


def test_plain_splats_are_written_and_read(scene: sparklod.Scene, tmp_path: Path) -> None:
    sparklod.write(tmp_path / "plain.rad", scene)
    again = sparklod.read(tmp_path / "plain.rad")
    assert again.tree is None
    np.testing.assert_allclose(again.splats.center, scene.splats.center, atol=1e-3)


def test_a_file_is_what_the_command_writes(tmp_path: Path) -> None:
    command("build-lod", DEMO, "-o", tmp_path / "theirs.rad", "-q")
    tree = sparklod.build_lod(sparklod.read(DEMO))
    sparklod.write(tmp_path / "ours.rad", sparklod.arrange_chunks(tree))
    assert (tmp_path / "ours.rad").read_bytes() == (tmp_path / "theirs.rad").read_bytes()


def test_the_order_for_streaming_keeps_the_tree(large: sparklod.Tree, scene: sparklod.Scene) -> None:
    streamed = sparklod.arrange_chunks(large)
    streamed.tree.validate()
    assert not np.array_equal(streamed.splats.center, large.splats.center)
    for name in ("center", "opacity"):
        ours, theirs = getattr(streamed.splats, name), getattr(large.splats, name)
        np.testing.assert_array_equal(np.sort(ours, axis=0), np.sort(theirs, axis=0))
    one = sparklod.arrange_chunks(large, threads=1)
    np.testing.assert_array_equal(one.splats.center, streamed.splats.center)
    with pytest.raises(sparklod.FormatError, match="no Level-of-Detail tree; build_lod makes one"):
        sparklod.arrange_chunks(scene)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"rad": {"center": "f32"}}, TypeError, "rad is {'center': 'f32'}; give RadOptions"),
        ({"rad": sparklod.RadOptions(ranges=3)}, TypeError, "ranges is 3; give a SplatEncoding"),  # type: ignore[arg-type]
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(
    scene: sparklod.Scene, tmp_path: Path, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=f"^{re.escape(message)}"):
        sparklod.write(tmp_path / "new.rad", scene, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("ranges", "error", "message"),
    [
        ({"rgb_min": 1, "rgb_max": 0}, ValueError, "rgb_min is 1, which is not below rgb_max, 0"),
        ({"ln_scale_min": 9}, ValueError, "ln_scale_min is 9, which is not below ln_scale_max, 9"),
        ({"sh2_max": 0}, ValueError, "sh2_max is 0; give a number above 0"),
        ({"rgb_max": float("nan")}, ValueError, "rgb_max is nan; give a number"),
        ({"ln_scale_max": 1e39}, ValueError, "ln_scale_max is 1e+39; give a number"),
        ({"rgb_min": "a"}, TypeError, "rgb_min is 'a'; give a number"),
    ],
)
def test_impossible_ranges_are_refused(ranges: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{re.escape(message)}"):
        sparklod.SplatEncoding(**ranges)


@pytest.mark.parametrize("number", [1.0, "1", None, True])
def test_the_number_of_a_chunk_is_a_whole_one(rad: Path, number: Any) -> None:
    with pytest.raises(TypeError, match="give a whole number, which counts chunks from 0"):
        sparklod.read_rad_chunk(rad, number)
    assert sparklod.read_rad_chunk(rad, np.int64(1)).header.base == CHUNK_NODES  # type: ignore[arg-type]


def test_a_palette_of_another_degree_is_refused(rad: Path) -> None:
    with pytest.raises(ValueError, match=r"shape \(7, 8, 3\); that of this file has \(codes, 3, 3\)$"):
        sparklod.read_rad_chunk(rad, 1, palette=np.zeros((7, 8, 3), np.float32))


def test_the_header_of_a_chunk_file_is_not_that_of_the_rad(rad: Path) -> None:
    name = sparklod.read_rad_header(rad).chunks[0].filename
    if name is not None:
        with pytest.raises(sparklod.FormatError, match=r"it is one chunk of a RAD file; give the \.rad file"):
            sparklod.read_rad_header(rad.with_name(name))
