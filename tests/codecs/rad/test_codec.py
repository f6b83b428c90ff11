"""RAD: its chunks, what is written, what "auto" chooses, and files that Spark's own tool wrote."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fixtures import by_hand_rad
from sparklod_cli import __version__
from sparklod_cli.codecs.clamps import clamps_in
from sparklod_cli.codecs.options import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad import rad_writer as rad_options
from sparklod_cli.codecs.rad.rad_header import RadHeader, read_header
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.codecs.statistics import SMALL_QUANTILE, STEPS_A_SPLAT, Statistics
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import linear
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden"
WHOLE, CHUNKED = GOLDEN / "sh1-tree.rad", GOLDEN / "sh3-rad" / "sh3.rad"


def broad_tree(count: int) -> LodTree:
    """A root, its children in the first quarter, and theirs."""
    inner = count // 4
    child_count, child_start = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    bounds = np.linspace(inner + 1, count, inner + 1).astype(np.uint32)
    child_count[0], child_start[0] = inner, 1
    child_count[1 : inner + 1], child_start[1 : inner + 1] = np.diff(bounds), bounds[:-1]
    return LodTree(child_count, child_start)


@pytest.fixture(scope="module")
def large() -> Scene:
    """A tree of two chunks."""
    splats = random_splats(CHUNK_NODES + 1000, sh_degree=1)
    splats.opacity[:1000] = linear_opacity(np.linspace(4.4, 1.1, 1000, dtype=np.float32))
    return Scene(splats, broad_tree(len(splats)))


def written(scene: Scene, threads: int = 1, **options: object) -> bytes:
    chosen = WriteOptions(rad=RadOptions(**options))  # type: ignore[arg-type]
    return b"".join(rad.encode(scene, chosen, threads=threads))


def read(data: bytes) -> Scene:
    return decode_file(rad, io.BytesIO(data))


def assert_same(one: Splats, other: Splats, names: tuple[str, ...] = COLUMNS) -> None:
    for name in names:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)


# --- Chunks -----------------------------------------------------------------------------------------------------------


class Watched(io.BytesIO):
    """A file that remembers which bytes were read."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.touched: set[int] = set()

    def read(self, size: int | None = -1) -> bytes:
        at = self.tell()
        data = super().read(size)
        self.touched.update(range(at, at + len(data)))
        return data


def test_a_chunk_is_read_of_its_own_bytes_alone() -> None:
    file, scene = Watched(WHOLE.read_bytes()), read_scene(WHOLE)
    header = read_header(file)
    assert (header.bytes, len(header.chunks), header.comment) == (min(set(range(9999)) - file.touched), 3, "by hand")
    for number, entry in enumerate(header.chunks):
        file.touched.clear()
        chunk = rad.read_chunk(file, entry, header)
        start = header.bytes + entry.offset
        assert file.touched == set(range(start, start + entry.bytes))
        rows = slice(24 * number, 24 * number + chunk.header.count)
        assert_same(chunk.splats, scene.splats.take(rows))
        assert chunk.tree is not None and scene.tree is not None and chunk.labels is None
        np.testing.assert_array_equal(chunk.tree.child_start, scene.tree.child_start[rows])


def test_labels_of_a_chunk_wait_for_the_palette_of_the_first() -> None:
    scene = read_scene(CHUNKED)
    with CHUNKED.open("rb") as file:
        header = read_header(file)
    files = [io.BytesIO((CHUNKED.parent / str(entry.filename)).read_bytes()) for entry in header.chunks]
    first, second = (rad.read_chunk(file, entry, header) for file, entry in zip(files[:2], header.chunks, strict=False))
    assert first.palette is not None and first.labels is None and second.palette is None
    assert_same(first.splats, scene.splats.take(slice(24)))
    assert second.labels is not None and not second.splats.sh.any()
    rows = scene.splats.take(slice(24, 48))
    np.testing.assert_array_equal(first.palette[second.labels], rows.sh)
    assert_same(rad.read_chunk(files[1], header.chunks[1], header, first.palette).splats, rows)
    assert scene.header["sh_codes"] == 24 and scene.header["chunked"] == 1


def test_columns_that_are_not_asked_for_are_0_but_damage_to_them_is_found() -> None:
    scene = read_scene(WHOLE, columns=("center", "scale"), validate=False)
    whole = read_scene(WHOLE)
    assert_same(scene.splats, whole.splats, ("center", "scale"))
    assert not (scene.splats.sh.any() or scene.splats.rgb.any())
    assert scene.tree is not None and whole.tree is not None
    np.testing.assert_array_equal(scene.tree.child_count, whole.tree.child_count)
    data = bytearray(WHOLE.read_bytes())
    data[data.index(b'"r8_delta"') + 1] = ord("s")
    with pytest.raises(FormatError, match="rgb"):
        decode_file(rad, io.BytesIO(bytes(data)), columns=("center",))


def test_a_chunk_alone_says_what_to_give_instead() -> None:
    with pytest.raises(FormatError, match=r"one chunk of a RAD file; give the \.rad file"):
        read_scene(CHUNKED.parent / "sh3-0.radc")


def test_chunks_in_files_are_not_read_from_standard_input() -> None:
    with pytest.raises(FormatError, match="chunks are in files beside it"):
        decode_file(rad, io.BytesIO(CHUNKED.read_bytes()))


@pytest.mark.parametrize("name", ["../sh3-0.radc", "/sh3-0.radc", "folder/sh3-0.radc", "missing.radc", ".."])
def test_a_chunk_file_that_is_elsewhere_or_missing_is_refused(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for path in CHUNKED.parent.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
        (tmp_path / path.name).write_bytes(path.read_bytes())
    header = rewritten(CHUNKED.read_bytes(), lambda fields: fields["chunks"][0].update(filename=name))
    (folder / "sh3.rad").write_bytes(header)
    with pytest.raises(FormatError, match=name.replace(".", r"\.") if name != ".." else "not a file beside it"):
        read_scene(folder / "sh3.rad")


def rewritten(data: bytes, change: Callable[[dict[str, object]], object]) -> bytes:
    """A file whose header says something else."""
    header = read_header(io.BytesIO(data))
    length = int.from_bytes(data[4:8], "little")
    fields = json.loads(data[8 : 8 + length])
    change(fields)
    return by_hand_rad.headed(b"RAD0", fields) + data[header.bytes :]


@pytest.mark.parametrize(
    ("name", "column"),
    [("center", "center"), ("alpha", "opacity"), ("rgb", "rgb"), ("scales", "scale"), ("orientation", "quat_xyzw")],
)
def test_a_column_of_which_a_chunk_has_no_property_is_0_or_no_rotation(name: str, column: str) -> None:
    scene = Scene(random_splats(30, sh_degree=2))
    whole = read(by_hand_rad.rad(**linear(scene), chunk_size=20)["scene.rad"]).splats
    lacking = read(by_hand_rad.rad(**linear(scene), chunk_size=20, without=[name, "sh2"])["scene.rad"]).splats
    np.testing.assert_array_equal(getattr(lacking, column), [[0, 0, 0, 1]] * 30 if name == "orientation" else 0)
    assert_same(lacking, whole, tuple(set(COLUMNS) - {column, "sh"}))
    np.testing.assert_array_equal(lacking.sh[:, :3], whole.sh[:, :3])
    assert not lacking.sh[:, 3:].any()


def test_properties_need_not_be_compressed() -> None:
    splats = random_splats(30)
    assert_same(read(by_hand_rad.rad(**linear(Scene(splats)), pack=None)["scene.rad"]).splats, splats, ("center",))


# --- Writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunked", [False, True])
def test_threads_do_not_change_a_byte(large: Scene, chunked: bool) -> None:
    def files(threads: int) -> dict[str, bytes]:
        if not chunked:
            return {"": written(large, threads)}
        pairs = rad.encode_chunked(large, DEFAULTS, "scene", threads=threads)
        return {name: b"".join(pieces) for name, pieces in pairs}

    assert files(1) == files(2) == files(5)


def test_chunks_in_files_are_those_of_one_file(large: Scene) -> None:
    whole = written(large)
    files = {name: b"".join(pieces) for name, pieces in rad.encode_chunked(large, DEFAULTS, "a b")}
    assert list(files) == ["a b-0.radc", "a b-1.radc", "a b.rad"]
    header = read_header(io.BytesIO(whole))
    assert whole[header.bytes :] == files["a b-0.radc"] + files["a b-1.radc"]
    other = read_header(io.BytesIO(files["a b.rad"]))
    assert other.bytes == len(files["a b.rad"])
    assert [entry.filename for entry in other.chunks] == list(files)[:2]
    assert [entry.bytes for entry in other.chunks] == [len(data) for data in list(files.values())[:2]]
    assert offsets_are_sums(header) and len(whole) == header.bytes + header.all_chunk_bytes


def offsets_are_sums(header: RadHeader) -> bool:
    sizes = [entry.bytes for entry in header.chunks]
    return [entry.offset for entry in header.chunks] == list(itertools.accumulate(sizes, initial=0))[:-1]


def test_a_tree_of_several_chunks_comes_back(large: Scene) -> None:
    data = written(large)
    back = read(data)
    assert back.tree is not None and large.tree is not None
    np.testing.assert_array_equal(back.tree.child_start, large.tree.child_start)
    np.testing.assert_array_equal(back.tree.child_count, large.tree.child_count)
    header = read_header(io.BytesIO(data))
    assert back.chunk_bytes == tuple(entry.bytes for entry in header.chunks)
    assert (header.chunk_size, header.lod_tree, header.max_sh) == (CHUNK_NODES, True, 1)
    assert header.comment is not None
    assert json.loads(header.comment) == {"generator": f"sparklod {__version__}"}
    assert header.encoding is not None and header.encoding.lod_opacity


def test_an_opaque_leaf_does_not_become_a_merged_splat() -> None:
    splats = random_splats(200)
    splats.opacity[:] = np.linspace(0, 1, 200)
    splats.opacity[0] = 1000
    tree = Scene(splats, broad_tree(200))
    back = read(written(tree, alpha="r8", scales="f32")).splats.opacity  # which need not make up for scales
    assert back[1:].max() <= 1 < back[0]
    assert np.abs(back[1:] - splats.opacity[1:]).max() <= 1 / 255 + 1e-6
    assert read(written(Scene(splats.take(slice(1, None))), alpha="r8", scales="f32")).splats.opacity.max() == 1
    assert read(written(tree, alpha="r8")).splats.opacity[1:].max() <= 1


def test_a_scene_without_splats_is_a_file_without_chunks() -> None:
    back = read(written(Scene(random_splats(0, sh_degree=2))))
    assert (len(back), back.tree, back.splats.sh_degree, back.chunk_bytes) == (0, None, 2, ())


# --- Palettes ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared() -> Scene:
    """A tree whose 500 nodes have 40 different SH of degree 3."""
    splats = random_splats(500, sh_degree=3)
    splats.sh[:] = splats.sh[np.random.default_rng(2).permutation(500) % 40]
    return Scene(splats, broad_tree(500))


def test_few_different_sh_are_all_in_the_palette(shared: Scene) -> None:
    data = written(shared, sh_codes=64, sh="f32")
    back = read(data)
    np.testing.assert_array_equal(back.splats.sh, shared.splats.sh)
    plain = read(written(shared, sh="f32")).splats
    assert_same(back.splats, plain)
    assert len(data) < 0.7 * len(written(shared, sh="f32"))


def test_a_palette_has_as_many_codes_as_the_first_chunk_has_splats_with_zeros_at_its_end(shared: Scene) -> None:
    """Spark reads no other number, see docs/formats/rad.md."""
    file = io.BytesIO(written(shared, sh_codes=64))
    header = read_header(file)
    palette = rad.read_chunk(file, header.chunks[0], header).palette
    assert palette is not None
    assert header.sh_code_count == len(palette) == 500
    assert palette[:40].any(axis=(1, 2)).all() and not palette[40:].any()


def test_fewer_codes_than_different_sh_come_near(shared: Scene) -> None:
    exact, near = (read(written(shared, sh_codes=codes, sh="f32")).splats.sh for codes in (64, 20))
    assert len(np.unique(near, axis=0)) <= 20 < len(np.unique(exact, axis=0)) == 40
    middle = shared.splats.sh.mean(axis=0)
    assert np.mean((near - exact) ** 2) < 0.7 * np.mean((exact - middle) ** 2)


def test_threads_do_not_change_a_palette_and_chunk_files_have_it_in_the_first(shared: Scene) -> None:
    assert written(shared, 1, sh_codes=20) == written(shared, 2, sh_codes=20)
    options = WriteOptions(rad=RadOptions(sh_codes=20))
    files = {name: b"".join(pieces) for name, pieces in rad.encode_chunked(shared, options, "scene")}
    back = decode_file(rad, io.BytesIO(files["scene.rad"]), open_companion=lambda name: io.BytesIO(files[name]))
    assert_same(back.splats, read(written(shared, sh_codes=20)).splats)


def test_without_sh_there_is_no_palette() -> None:
    header = read_header(io.BytesIO(written(Scene(random_splats(9)), sh_codes=4)))
    assert (header.sh_code_count, header.max_sh) == (None, 0)


@pytest.mark.parametrize("codes", [0, -1, 65537])
def test_a_palette_of_an_impossible_size_is_refused(codes: int) -> None:
    with pytest.raises(ValueError, match=f"sh_codes is {codes}; give 2 to 65536"):
        chosen(random_splats(1), sh_codes=codes)


# --- What "auto" chooses ----------------------------------------------------------------------------------------------


def chosen(splats: Splats, **options: object) -> RadOptions:
    return rad.settled(Scene(splats), WriteOptions(rad=RadOptions(**options))).rad  # type: ignore[arg-type]


def test_settled_options_leave_nothing_open_and_stay() -> None:
    scene = Scene(random_splats(500, sh_degree=2))
    once = rad.settled(scene, DEFAULTS)
    assert "auto" not in dataclasses.asdict(once.rad).values()
    assert once.rad.ranges is not None
    assert rad.settled(scene, once) == once
    assert written(scene) == b"".join(rad.encode(scene, once))


def test_centres_are_rounded_to_a_fraction_of_a_small_splat_unless_their_encoding_is_given() -> None:
    splats = random_splats(3000)
    bits = chosen(splats).center_bits
    assert bits is not None
    small = np.quantile(splats.scale.max(axis=1), SMALL_QUANTILE)
    assert small / STEPS_A_SPLAT / 2 < 2.0**-bits <= small / STEPS_A_SPLAT
    off = np.abs(read(written(Scene(splats))).splats.center - splats.center).max()
    assert 0 < off <= 2.0 ** -(bits + 1)
    assert chosen(splats, center="f32_lebytes").center_bits is None
    assert_same(read(written(Scene(splats), center="f32_lebytes")).splats, splats, ("center",))
    assert len(written(Scene(splats))) < 0.9 * len(written(Scene(splats), center="f32_lebytes"))


def test_centres_near_the_largest_number_stay_finite_when_their_splats_are_as_large() -> None:
    splats = dataclasses.replace(
        random_splats(3), center=np.full((3, 3), -3.4e38, np.float32), scale=np.full((3, 3), 1e37, np.float32)
    )
    center = read(written(Scene(splats))).splats.center
    assert np.isfinite(center).all() and (center <= -3.3e38).all()


def test_ranges_hold_all_scales_and_most_of_the_rest() -> None:
    splats = random_splats(5000, sh_degree=3)
    splats.rgb[:5000:7] = 2.25
    splats.sh[0] = 40  # one that would spoil all others
    options = rad.settled(Scene(splats), DEFAULTS)
    ranges = options.rad.ranges
    assert ranges is not None
    logs = np.log(splats.scale)
    assert ranges.ln_scale_min <= logs.min() < ranges.ln_scale_min + 0.03
    assert ranges.ln_scale_max - 0.03 < logs.max() <= ranges.ln_scale_max
    assert (ranges.rgb_min, ranges.rgb_max) == (0, 2.25)
    assert 0.3 < ranges.sh1_max < 4 and not ranges.lod_opacity
    counts, ends = clamps_in(splats, ranges=rad_options.held(options, 3))
    assert counts == {"sh": 1}
    assert [(each.column, each.degree, each.both, each.splats) for each in ends] == [
        ("sh", degree, True, 1) for degree in (1, 2, 3)
    ]


def test_the_order_of_splats_does_not_change_a_range(large: Scene) -> None:
    rgb = large.splats.rgb.copy()
    rgb[::64] *= 3
    splats = dataclasses.replace(large.splats, rgb=rgb)
    shuffled = splats.take(np.random.default_rng(1).permutation(len(splats)))
    one, other = (rad_options.fitted(Statistics.of_scene(Scene(some))) for some in (shuffled, splats))
    assert one == other


def test_colours_and_scales_of_a_wide_range_are_float16() -> None:
    splats = random_splats(300)
    splats.rgb[:150] = 9
    assert chosen(splats).rgb == "f16"
    splats.scale[:, 2] = np.exp(np.linspace(-29, 3, 300))
    assert chosen(splats).scales == "ln_f16"
    assert chosen(splats, scales="ln_0r8", rgb="r8") == dataclasses.replace(chosen(splats), scales="ln_0r8", rgb="r8")


@pytest.mark.parametrize(("long", "encoding"), [(400, "oct88r8"), (600, "f16")])
def test_rotations_of_long_splats_are_float16(long: int, encoding: str) -> None:
    """Where at least half of the leaves are: the merged splats of a tree do not matter, nor how thin splats are."""
    splats = random_splats(1_000)
    splats.scale[:] = [0.01, 0.002, 1e-5]
    splats.scale[:long] = [0.0001, 0.02, 0.002]
    assert chosen(splats).orientation == encoding
    assert chosen(splats, orientation="oct88r8").orientation == "oct88r8"
    splats.scale[long:, :2] = 0  # a line, which has no width, is none
    assert chosen(splats).orientation == encoding


def test_scales_of_0_are_held_and_thin_ones_clamped_and_counted() -> None:
    splats = random_splats(1000)
    splats.scale[:4, 0] = np.exp(-20)
    splats.scale[4, 1] = 0
    options = rad.settled(Scene(splats), DEFAULTS)
    back = read(written(Scene(splats))).splats.scale
    assert back[4, 1] == 0
    counts, ends = clamps_in(splats, 2, rad_options.held(options, 0))
    assert counts == {"scale": 4}
    (end,) = ends
    assert (end.above, end.splats, end.farthest) == (False, 4, pytest.approx(np.exp(-20)))
    assert back[:4, 0] == pytest.approx(end.end, rel=0.03)


def test_what_float16_clamps_is_counted() -> None:
    splats = random_splats(10)
    splats.center[3, 1] = -60000
    splats.rgb[5] = 1e6
    options = rad.settled(Scene(splats), WriteOptions(rad=RadOptions(center="f16_lebytes", rgb="f16")))
    counts, _ = clamps_in(splats, ranges=rad_options.held(options, 0))
    assert counts == {"rgb": 1}
    back = read(b"".join(rad.encode(Scene(splats), options))).splats
    assert (back.center[3, 1], back.rgb[5, 0]) == (-60000, 65504)


@pytest.mark.parametrize("encoding", ["f16", "f16_lebytes"])
def test_centres_beyond_float16_are_refused(encoding: str) -> None:
    splats = random_splats(10)
    splats.center[3, 1] = -65500
    with pytest.raises(FormatError, match=f"coordinates reach 65500, and {encoding} holds less than 65504"):
        rad.settled(Scene(splats), WriteOptions(rad=RadOptions(center=encoding)))


def test_an_unknown_encoding_is_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="no rad rgb 'r9'; give one of auto, r8_delta, r8, f16, f32"):
        chosen(random_splats(1), rgb="r9")


@pytest.mark.parametrize("scene", [Scene(random_splats(1)), Scene(random_splats(0))])
def test_ranges_of_hardly_any_splats_are_not_empty(scene: Scene) -> None:
    assert isinstance(rad_options.fitted(Statistics.of_scene(scene)), SplatEncoding)
    flat = dataclasses.replace(scene.splats, scale=np.full_like(scene.splats.scale, 0.5))
    assert isinstance(rad_options.fitted(Statistics.of_scene(Scene(flat))), SplatEncoding)


# --- Spark's own files ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "source", "nodes"),
    [("rad/biker-spark.rad", "biker.ply", 179_850), ("rad/playbot-125k-spark/p-lod.rad", "playbot-125k.ply", 166_695)],
)
def test_a_file_that_sparks_own_tool_wrote_has_the_splats_of_its_source(name: str, source: str, nodes: int) -> None:
    scene, splats = read_scene(real_scene(name), threads=2), read_scene(real_scene(source), threads=2).splats
    assert (len(scene), scene.format, scene.header["chunks"]) == (nodes, "RAD LoD", 3)
    assert scene.tree is not None and scene.chunk_bytes is not None and len(scene.chunk_bytes) == 3
    leaves = scene.splats.take(scene.tree.is_leaf)
    assert len(leaves) == len(splats)

    def ordered(some: Splats) -> Splats:
        return some.take(np.lexsort((lod_opacity(some.opacity), *some.center.T)))

    ours, theirs = ordered(splats), ordered(leaves)
    assert_same(ours, theirs, ("center",))
    assert np.abs(ours.opacity - theirs.opacity).max() <= 2**-11
