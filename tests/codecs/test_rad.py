"""RAD: property encodings, chunks, palettes, automatic choices, damage, and files of Spark's own tool."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fixtures import by_hand_rad
from sparklod_cli.codecs.formats import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.losses import clamps_in
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.property_codings import CODINGS
from sparklod_cli.codecs.rad.rad_header import read_header
from sparklod_cli.codecs.rad.rad_reader import RadReader
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.codecs.statistics import SMALL_QUANTILE, STEPS_A_SPLAT, Statistics
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError, PromiseError
from tests.codecs.cases import assert_same, decode, encode, linear
from tests.codecs.damage import VALUES, attempt, places_of, replaced
from tests.conftest import FIXTURES, real_scene
from tests.scenes import random_splats

pytestmark = pytest.mark.filterwarnings("error")

GOLDEN = FIXTURES / "golden"
WHOLE, CHUNKED = GOLDEN / "sh1-tree.rad", GOLDEN / "sh3-rad" / "sh3.rad"


def broad_tree(count: int) -> LodTree:
    """Tree of a root, its children in the first quarter of the nodes, and their children."""
    inner = count // 4
    child_count, child_start = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    bounds = np.linspace(inner + 1, count, inner + 1).astype(np.uint32)
    child_count[0], child_start[0] = inner, 1
    child_count[1 : inner + 1], child_start[1 : inner + 1] = np.diff(bounds), bounds[:-1]
    return LodTree(child_count, child_start)


@pytest.fixture(scope="module")
def two_chunks() -> Scene:
    splats = random_splats(CHUNK_NODES + 1000, sh_degree=1)
    splats.opacity[:1000] = linear_opacity(np.linspace(4.4, 1.1, 1000, dtype=np.float32))
    return Scene(splats, broad_tree(len(splats)))


def written(scene: Scene, threads: int = 1, **options: Any) -> bytes:
    return encode(rad, scene, WriteOptions(rad=RadOptions(**options)), threads=threads)


def written_chunked(scene: Scene, stem: str = "scene", threads: int = 1, **options: Any) -> dict[str, bytes]:
    files = rad.encode_chunked(scene, WriteOptions(rad=RadOptions(**options)), stem, threads=threads)
    return {name: b"".join(pieces) for name, pieces in files}


# --- Property encodings -----------------------------------------------------------------------------------------------

TWO = np.array([[0.0, 1.0, 2.0], [0.5, 0.25, -1.0]], np.float32)
AXIS_X = [[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]
F32 = struct.pack("<6f", 0, 0.5, 1, 0.25, 2, -1)  # number by number
F16 = struct.pack("<6e", 0, 0.5, 1, 0.25, 2, -1)
FLOAT_CODINGS = [name for name in CODINGS if name not in ("u16", "u32")]


def encoded(name: str, values: Any, low: float = 0, high: float = 1) -> bytes:
    return CODINGS[name].encode(np.asarray(values, np.float32), low, high).tobytes()


def decoded(name: str, data: bytes, count: int, numbers: int, low: float = 0, high: float = 1) -> NDArray[np.float32]:
    return CODINGS[name].decode(np.frombuffer(data, np.uint8), count, numbers, low, high)


@pytest.mark.parametrize(
    ("name", "values", "low", "high", "expected"),
    [
        ("f32", TWO, 0, 0, F32),
        ("f16", TWO, 0, 0, F16),
        ("f32_lebytes", TWO, 0, 0, F32[0::4] + F32[1::4] + F32[2::4] + F32[3::4]),
        ("f16_lebytes", TWO, 0, 0, F16[0::2] + F16[1::2]),
        ("r8", TWO, -1, 2, bytes([85, 128, 170, 106, 255, 0])),  # 127.5 rounds up
        ("r8_delta", TWO, -1, 2, bytes([85, 43, 170, 192, 255, 1])),  # modulo 256, and from 0 for each number
        ("s8", TWO, -2, 2, bytes([0, 32, 64, 16, 127, 256 - 64])),  # 31.75, 63.5, 15.875, 127, -63.5 away from 0
        ("s8", [[3e38], [-3e38], [0.0]], -1e-3, 1e-3, bytes([127, 129, 0])),  # far outside of the range
        ("s8_delta", TWO, -2, 2, bytes([0, 32, 64, 208, 127, 65])),
        ("ln_0r8", np.exp([[-31.0], [-5.0], [-1.0], [1.0], [2.0]]), -1, 1, bytes([0, 1, 1, 255, 255])),
        ("ln_0r8", [[0.0], [1.0]], -1, 1, bytes([0, 128])),
        ("ln_f16", [[0.0], [1.0], [np.e]], 0, 0, struct.pack("<3e", -np.inf, 0, 1)),
        ("oct88r8", AXIS_X, 0, 0, bytes([255, 128, 0, 255, 128, 255])),  # splat by splat: axis u v, angle of pi
    ],
)
def test_encodings_have_the_bytes_that_spark_reads(
    name: str, values: Any, low: float, high: float, expected: bytes
) -> None:
    assert encoded(name, values, low, high) == expected


@pytest.mark.parametrize("name", [name for name in FLOAT_CODINGS if name != "oct88r8"])
@pytest.mark.parametrize("numbers", [1, 3, 15])
def test_encodings_match_the_reference_writer(name: str, numbers: int) -> None:
    values = np.exp(np.random.default_rng(4).normal(-2, 0.5, (700, numbers))).astype(np.float32)
    data = encoded(name, values, -1.5, 1.5)
    assert len(data) == values.size * CODINGS[name].size
    ours, theirs = (np.frombuffer(each, np.uint8) for each in (data, by_hand_rad.encoded(values, name, -1.5, 1.5)))
    # Logarithms and quotients in float64 decide some ties in another way.
    assert np.count_nonzero(ours != theirs) <= (0 if name[0] == "f" else 0.002 * ours.size)


def test_rotations_match_the_reference_writer_for_either_sign_of_w() -> None:
    quats = random_splats(5000).quat_xyzw
    assert (quats[:, 3] < 0).any()
    expected = by_hand_rad.octahedral(quats.astype(np.float64)).tobytes()
    assert encoded("oct88r8", quats) == encoded("oct88r8", -quats) == expected


@pytest.mark.parametrize("name", FLOAT_CODINGS)
def test_any_bytes_and_any_range_are_decoded_without_a_warning(name: str) -> None:
    data = np.random.default_rng(6).bytes(3000 * CODINGS[name].size)
    for low, high in ((0, 0), (1, -1), (-3e38, 3e38), (1e-45, 2e-45)):
        with np.errstate(all="raise", under="ignore"):
            assert len(decoded(name, data, 1000, 3, low, high)) == 1000


# --- Reading chunks ---------------------------------------------------------------------------------------------------


class RecordingFile(io.BytesIO):
    """A file that records the positions of the bytes that were read."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.touched: set[int] = set()

    def read(self, size: int | None = -1) -> bytes:
        at = self.tell()
        data = super().read(size)
        self.touched.update(range(at, at + len(data)))
        return data


def test_reading_a_chunk_reads_only_its_own_bytes() -> None:
    file, scene = RecordingFile(WHOLE.read_bytes()), read_scene(WHOLE)
    header = read_header(file)
    assert (header.bytes, len(header.chunks), header.comment) == (min(set(range(9999)) - file.touched), 3, "by hand")
    for number, entry in enumerate(header.chunks):
        file.touched.clear()
        chunk = RadReader(header, file).read_chunk(number)
        start = header.bytes + entry.offset
        assert file.touched == set(range(start, start + entry.bytes))
        rows = slice(24 * number, 24 * number + chunk.header.count)
        assert_same(chunk.splats, scene.splats.take(rows))
        assert chunk.tree is not None and scene.tree is not None and chunk.labels is None
        np.testing.assert_array_equal(chunk.tree.child_start, scene.tree.child_start[rows])


def test_a_chunk_with_labels_needs_the_palette_of_the_first_chunk() -> None:
    scene = read_scene(CHUNKED)
    with CHUNKED.open("rb") as file:
        header = read_header(file)
        reader = RadReader(header, file, lambda name: (CHUNKED.parent / name).open("rb"))
        first, second = (reader.read_chunk(number) for number in (0, 1))
        again = dataclasses.replace(reader, palette=first.palette).read_chunk(1)
    assert first.palette is not None and first.labels is None and second.palette is None
    assert_same(first.splats, scene.splats.take(slice(24)))
    assert second.labels is not None and not second.splats.sh.any()
    rows = scene.splats.take(slice(24, 48))
    np.testing.assert_array_equal(first.palette[second.labels], rows.sh)
    assert_same(again.splats, rows)
    assert scene.header["sh_codes"] == 24 and scene.header["chunked"] == 1


def test_columns_that_are_not_read_are_0_and_their_damage_is_still_reported() -> None:
    scene, whole = read_scene(WHOLE, columns=("center", "scale"), validate=False), read_scene(WHOLE)
    np.testing.assert_array_equal(scene.splats.center, whole.splats.center)
    np.testing.assert_array_equal(scene.splats.scale, whole.splats.scale)
    assert not (scene.splats.sh.any() or scene.splats.rgb.any())
    assert scene.tree is not None and whole.tree is not None
    np.testing.assert_array_equal(scene.tree.child_count, whole.tree.child_count)
    data = bytearray(WHOLE.read_bytes())
    data[data.index(b'"r8_delta"') + 1] = ord("s")
    with pytest.raises(FormatError, match="rgb"):
        decode(rad, bytes(data), columns=("center",))


def test_chunk_files_need_the_header_beside_them_and_the_header_needs_a_folder() -> None:
    with pytest.raises(FormatError, match=r"one chunk of a RAD file; give the \.rad file"):
        read_scene(CHUNKED.parent / "sh3-0.radc")
    with pytest.raises(FormatError, match="chunks are in files beside it"):
        decode(rad, CHUNKED.read_bytes())


@pytest.mark.parametrize("name", ["../sh3-0.radc", "/sh3-0.radc", "folder/sh3-0.radc", "missing.radc", ".."])
def test_a_chunk_file_outside_the_folder_or_missing_is_refused(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for path in CHUNKED.parent.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (folder / "sh3.rad").write_bytes(
        with_header(CHUNKED.read_bytes(), lambda fields: fields["chunks"][0].update(filename=name))
    )
    with pytest.raises(FormatError, match=name.replace(".", r"\.") if name != ".." else "not a file beside it"):
        read_scene(folder / "sh3.rad")


def with_header(data: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """A file with changed fields of its header."""
    fields = json.loads(data[8 : 8 + int.from_bytes(data[4:8], "little")])
    change(fields)
    return by_hand_rad.headed(b"RAD0", fields) + data[read_header(io.BytesIO(data)).bytes :]


@pytest.mark.parametrize(
    ("name", "column"),
    [("center", "center"), ("alpha", "opacity"), ("rgb", "rgb"), ("scales", "scale"), ("orientation", "quat_xyzw")],
)
def test_a_missing_property_is_read_as_0_and_properties_may_be_uncompressed(name: str, column: str) -> None:
    columns = linear(Scene(random_splats(30, sh_degree=2)))
    whole = decode(rad, by_hand_rad.rad(**columns, chunk_size=20)["scene.rad"]).splats
    lacking = decode(rad, by_hand_rad.rad(**columns, chunk_size=20, without=[name, "sh2"])["scene.rad"]).splats
    np.testing.assert_array_equal(getattr(lacking, column), [[0, 0, 0, 1]] * 30 if name == "orientation" else 0)
    for other in set(COLUMNS) - {column, "sh"}:
        np.testing.assert_array_equal(getattr(lacking, other), getattr(whole, other))
    np.testing.assert_array_equal(lacking.sh[:, :3], whole.sh[:, :3])
    assert not lacking.sh[:, 3:].any()
    assert_same(decode(rad, by_hand_rad.rad(**columns, chunk_size=20, pack=None)["scene.rad"]).splats, whole)


# --- Writing ----------------------------------------------------------------------------------------------------------


def test_chunk_files_hold_the_bytes_of_one_file_for_any_number_of_threads(two_chunks: Scene) -> None:
    whole, files = written(two_chunks), written_chunked(two_chunks, "a b")
    for threads in (2, 5):
        assert (written(two_chunks, threads), written_chunked(two_chunks, "a b", threads)) == (whole, files)
    assert list(files) == ["a b-0.radc", "a b-1.radc", "a b.rad"]
    header, chunked = (read_header(io.BytesIO(data)) for data in (whole, files["a b.rad"]))
    assert whole[header.bytes :] == files["a b-0.radc"] + files["a b-1.radc"]
    assert chunked.bytes == len(files["a b.rad"])
    sizes = [entry.bytes for entry in header.chunks]
    assert [(entry.filename, entry.bytes) for entry in chunked.chunks] == list(zip(files, sizes, strict=False))
    assert [entry.offset for entry in header.chunks] == list(itertools.accumulate(sizes, initial=0))[:-1]
    assert len(whole) == header.bytes + header.all_chunk_bytes


def test_an_opaque_leaf_does_not_become_a_merged_splat() -> None:
    splats = random_splats(200)
    splats.opacity[:] = np.linspace(0, 1, 200)
    splats.opacity[0] = 1000
    tree, plain = Scene(splats, broad_tree(200)), Scene(splats.take(slice(1, None)))
    back = decode(rad, written(tree, alpha="r8", scales="f32")).splats.opacity  # exact scales need no compensation
    assert back[1:].max() <= 1 < back[0]
    assert np.abs(back[1:] - splats.opacity[1:]).max() <= 1 / 255 + 1e-6
    assert decode(rad, written(plain, alpha="r8", scales="f32")).splats.opacity.max() == 1
    assert decode(rad, written(tree, alpha="r8")).splats.opacity[1:].max() <= 1


# --- Palettes ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def few_sh() -> Scene:
    """A tree of 500 nodes with 40 different SH of degree 3."""
    splats = random_splats(500, sh_degree=3)
    splats.sh[:] = splats.sh[np.random.default_rng(2).permutation(500) % 40]
    return Scene(splats, broad_tree(500))


def test_a_palette_is_padded_to_the_splats_of_the_first_chunk(few_sh: Scene) -> None:
    """Spark reads no other number of codes, see docs/formats/rad.md."""
    file = io.BytesIO(written(few_sh, sh_codes=64))
    header = read_header(file)
    palette = RadReader(header, file).read_chunk(0).palette
    assert palette is not None
    assert header.sh_code_count == len(palette) == 500
    assert palette[:40].any(axis=(1, 2)).all() and not palette[40:].any()
    header = read_header(io.BytesIO(written(Scene(random_splats(9)), sh_codes=4)))
    assert (header.sh_code_count, header.max_sh) == (None, 0)  # without SH there is no palette


def test_a_small_palette_approximates_sh_with_any_threads_and_in_chunk_files(few_sh: Scene) -> None:
    exact = few_sh.splats.sh
    near = decode(rad, written(few_sh, sh_codes=20, sh="f32")).splats.sh
    assert len(np.unique(near, axis=0)) <= 20
    assert np.mean((near - exact) ** 2) < 0.7 * np.mean((exact - exact.mean(axis=0)) ** 2)
    whole = written(few_sh, sh_codes=20)
    assert written(few_sh, threads=2, sh_codes=20) == whole
    files = written_chunked(few_sh, sh_codes=20)
    back = decode(rad, files["scene.rad"], open_companion=lambda name: io.BytesIO(files[name]))
    assert_same(back.splats, decode(rad, whole).splats)


# --- Automatic choices ------------------------------------------------------------------------------------------------


def chosen(splats: Splats, **options: Any) -> RadOptions:
    return rad.settled(Scene(splats), WriteOptions(rad=RadOptions(**options))).rad


def test_centers_are_rounded_to_a_fraction_of_a_small_splat_unless_their_encoding_is_given() -> None:
    splats = random_splats(3000)
    bits = chosen(splats).center_bits
    assert bits is not None
    small = np.quantile(splats.scale.max(axis=1), SMALL_QUANTILE)
    assert small / STEPS_A_SPLAT / 2 < 2.0**-bits <= small / STEPS_A_SPLAT
    rounded, exact = written(Scene(splats)), written(Scene(splats), center="f32_lebytes")
    off = np.abs(decode(rad, rounded).splats.center - splats.center).max()
    assert 0 < off <= 2.0 ** -(bits + 1)
    assert chosen(splats, center="f32_lebytes").center_bits is None
    np.testing.assert_array_equal(decode(rad, exact).splats.center, splats.center)
    assert len(rounded) < 0.9 * len(exact)


def test_centers_near_the_largest_float_stay_finite() -> None:
    splats = random_splats(3)
    splats.center[:], splats.scale[:] = -3.4e38, 1e37
    center = decode(rad, written(Scene(splats))).splats.center
    assert np.isfinite(center).all() and (center <= -3.3e38).all()


def test_ranges_hold_all_scales_and_most_colors_and_sh() -> None:
    splats = random_splats(5000, sh_degree=3)
    splats.rgb[:5000:7] = 2.25
    splats.sh[0] = 40  # an outlier that must not spoil the precision of all others
    options = rad.settled(Scene(splats), DEFAULTS)
    ranges = options.rad.ranges
    assert ranges is not None
    logs = np.log(splats.scale)
    assert ranges.ln_scale_min <= logs.min() < ranges.ln_scale_min + 0.03
    assert ranges.ln_scale_max - 0.03 < logs.max() <= ranges.ln_scale_max
    assert (ranges.rgb_min, ranges.rgb_max) == (0, 2.25)
    assert 0.3 < ranges.sh1_max < 4 and not ranges.lod_opacity
    counts, ends = clamps_in(splats, ranges=rad.held(options, 3))
    assert counts == {"sh": 1}
    assert [(each.column, each.degree, each.both, each.splats) for each in ends] == [
        ("sh", degree, True, 1) for degree in (1, 2, 3)
    ]


def test_ranges_do_not_depend_on_the_order_of_splats_and_few_splats_have_some(two_chunks: Scene) -> None:
    splats = dataclasses.replace(two_chunks.splats, rgb=two_chunks.splats.rgb.copy())
    splats.rgb[::64] *= 3
    shuffled = splats.take(np.random.default_rng(1).permutation(len(splats)))
    one, other = (rad.fitted(Statistics.of_scene(Scene(each))) for each in (shuffled, splats))
    assert one == other
    for count in (0, 1):
        few = random_splats(count)
        for scale in (few.scale, np.full_like(few.scale, 0.5)):
            scene = Scene(dataclasses.replace(few, scale=scale))
            assert isinstance(rad.fitted(Statistics.of_scene(scene)), SplatEncoding)


def test_colors_and_scales_of_a_wide_range_are_float16() -> None:
    splats = random_splats(300)
    splats.rgb[:150] = 9
    assert chosen(splats).rgb == "f16"
    splats.scale[:, 2] = np.exp(np.linspace(-29, 3, 300))
    assert chosen(splats).scales == "ln_f16"
    assert chosen(splats, scales="ln_0r8", rgb="r8") == dataclasses.replace(chosen(splats), scales="ln_0r8", rgb="r8")


@pytest.mark.parametrize(("long", "encoding"), [(400, "oct88r8"), (600, "f16")])
def test_rotations_are_float16_if_half_of_the_leaves_are_long(long: int, encoding: str) -> None:
    splats = random_splats(1_000)
    splats.scale[:] = [0.01, 0.002, 1e-5]
    splats.scale[:long] = [0.0001, 0.02, 0.002]
    assert chosen(splats).orientation == encoding
    assert chosen(splats, orientation="oct88r8").orientation == "oct88r8"
    splats.scale[long:, :2] = 0  # lines have no width, and do not count
    assert chosen(splats).orientation == encoding


def test_clamped_values_are_counted_and_scales_of_0_are_kept() -> None:
    splats = random_splats(1000)
    splats.scale[:4, 0] = np.exp(-20)
    splats.scale[4, 1] = 0
    options = rad.settled(Scene(splats), DEFAULTS)
    back = decode(rad, written(Scene(splats))).splats.scale
    assert back[4, 1] == 0
    counts, ends = clamps_in(splats, 2, rad.held(options, 0))
    assert counts == {"scale": 4}
    (end,) = ends
    assert (end.above, end.splats, end.farthest) == (False, 4, pytest.approx(np.exp(-20)))
    assert back[:4, 0] == pytest.approx(end.end, rel=0.03)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        *(
            ({"center": name}, FormatError, f"coordinates reach 65500, and {name} holds less than 65504")
            for name in ("f16", "f16_lebytes")
        ),
        ({"rgb": "r9"}, ValueError, "no rad rgb 'r9'; give one of auto, r8_delta, r8, f16, f32"),
        *(({"sh_codes": codes}, ValueError, f"sh_codes is {codes}; give 2 to 65536") for codes in (0, -1, 65537)),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    splats = random_splats(10)
    splats.center[3, 1] = -65500
    with pytest.raises(error, match=message):
        chosen(splats, **options)


# --- Damage -----------------------------------------------------------------------------------------------------------

PARTS = by_hand_rad.split(WHOLE.read_bytes())
CHUNK_FILES = {path.name: path.read_bytes() for path in CHUNKED.parent.iterdir()}


def attempt_chunked(files: dict[str, bytes], threads: int = 1) -> str:
    return attempt("golden/sh3-rad/sh3.rad", files["sh3.rad"], files=files, threads=threads)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["file.json", "0.json"])
def test_a_changed_header_gives_a_scene_or_a_format_error(name: str) -> None:
    assert attempt("", by_hand_rad.joined(PARTS)) == "scene"
    fields = json.loads(by_hand_rad.split(by_hand_rad.joined(PARTS))[name])
    refused = total = 0
    for path in places_of(fields)[1:]:
        for value in (..., *VALUES):
            text = json.dumps(replaced(fields, path, value)).encode()
            refused += attempt("", by_hand_rad.joined(PARTS | {name: text}, PARTS), threads=1 + total % 2) != "scene"
            total += 1
    assert refused > 0.4 * total


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CHUNK_FILES))
def test_a_truncated_or_flipped_chunk_file_gives_a_scene_or_a_format_error(name: str) -> None:
    data, rng = CHUNK_FILES[name], np.random.default_rng(3)
    assert attempt_chunked(CHUNK_FILES, 2) == "scene"
    for end in {*range(0, len(data), 41), len(data) - 1}:
        assert attempt_chunked(CHUNK_FILES | {name: data[:end]}) != "scene"
    for bit in {*rng.integers(0, 8 * len(data), 200), *range(64)}:
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        attempt_chunked(CHUNK_FILES | {name: bytes(changed)}, 1 + int(bit) % 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PARTS if name.startswith("0 ")])
def test_any_bytes_of_a_property_give_a_scene_or_a_format_error(name: str) -> None:
    rng, size = np.random.default_rng(8), len(PARTS[name])
    for data in (b"", b"\xff" * size, bytes(size), rng.bytes(size), PARTS[name][:-1], PARTS[name] + b"\0"):
        result = attempt("", by_hand_rad.joined(PARTS | {name: data}, PARTS))
        assert (result == "scene") <= (len(data) == size)
        if data == PARTS[name][:-1]:
            assert result.startswith(f"{name[2:]} of chunk 0 has {size - 1:,} bytes")


def with_property(name: str, piece: bytes) -> bytes:
    """The file with other stored bytes of a property of its first chunk."""
    fields = json.loads(PARTS["0.json"])
    payload = b""
    for each in fields["properties"]:
        own = each["property"]
        data = piece if own == name else by_hand_rad.stored(PARTS[f"0 {own}"])
        each |= {"offset": len(payload), "bytes": len(data)}
        payload += by_hand_rad.padded(data)
    chunk = by_hand_rad.headed(b"RADC", fields | {"payloadBytes": len(payload)})
    chunk += len(payload).to_bytes(8, "little") + payload
    header = json.loads(PARTS["file.json"])
    header |= {"count": 24, "chunks": [{"offset": 0, "bytes": len(chunk)}], "allChunkBytes": len(chunk)}
    return by_hand_rad.headed(b"RAD0", header) + chunk


def deflate_bomb() -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(bytes(1 << 28)) + packer.flush()


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        (b"\xff\xff", "corrupt data in rgb of chunk 0"),
        (by_hand_rad.stored(bytes(72))[:-1], "rgb of chunk 0 has 71 bytes"),
        (by_hand_rad.stored(bytes(72)).replace(b"\1", b"\0", 1), "its compressed data do not end"),
        (by_hand_rad.stored(bytes(73)), "more than the 72 bytes of 24 splats in r8_delta"),
        (b"", "rgb of chunk 0 has 0 bytes; 24 splats in r8_delta take 72"),
        pytest.param(deflate_bomb, "more than the 72 bytes", id="bomb", marks=pytest.mark.slow),
    ],
)
def test_compressed_data_of_a_wrong_size_are_refused_within_little_memory(piece: Any, message: str) -> None:
    data = with_property("rgb", piece if isinstance(piece, bytes) else piece())
    tracemalloc.start()
    with pytest.raises(FormatError, match=message):
        decode(rad, data, validate=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


@pytest.mark.parametrize("count", [10**9, 4 * 10**9, 2**63, 10**18])
def test_a_header_that_promises_too_much_is_refused_before_memory_is_allocated(count: int) -> None:
    fields = json.loads(PARTS["0.json"]) | {"count": count, "properties": [], "payloadBytes": 0}
    chunk = by_hand_rad.headed(b"RADC", fields) + bytes(8)
    header = json.loads(PARTS["file.json"]) | {"count": count, "chunkSize": count}
    header |= {"chunks": [{"offset": 0, "bytes": len(chunk)}], "allChunkBytes": len(chunk)}
    data = by_hand_rad.headed(b"RAD0", header) + chunk
    tracemalloc.start()
    with pytest.raises(PromiseError, match="more than a file of"):
        decode(rad, data)
    file = io.BytesIO(data)
    known = read_header(file)
    with pytest.raises(PromiseError, match="more than a file of"):
        RadReader(known, file).read_chunk(0)
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()


def test_a_chunk_that_ends_beyond_its_file_is_refused() -> None:
    header = json.loads(PARTS["file.json"])
    header["chunks"][0]["bytes"] = 10**15
    data = by_hand_rad.headed(b"RAD0", header)
    file = io.BytesIO(data)
    known = read_header(file)
    with pytest.raises(FormatError, match="cut short"):
        RadReader(known, file).read_chunk(0)
    with pytest.raises(FormatError, match=r"cut short|inside"):
        decode(rad, data)


def test_a_label_beyond_the_palette_is_named() -> None:
    chunk = by_hand_rad.split(CHUNK_FILES["sh3-1.radc"])
    data = by_hand_rad.joined(chunk | {"0 sh_label": np.full(24, 24, "<u2").tobytes()}, chunk)
    header = json.loads(by_hand_rad.split(CHUNK_FILES["sh3.rad"])["file.json"])
    header["chunks"][1]["bytes"] = len(data)
    result = attempt_chunked(CHUNK_FILES | {"sh3-1.radc": data, "sh3.rad": by_hand_rad.headed(b"RAD0", header)})
    assert result == "SH label 24 of chunk 1 is beyond the 24 codes of the palette"


# --- Files of Spark's own tool ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "source", "nodes"),
    [("rad/biker-spark.rad", "biker.ply", 179_850), ("rad/playbot-125k-spark/p-lod.rad", "playbot-125k.ply", 166_695)],
)
def test_the_leaves_of_a_file_of_spark_are_the_splats_of_its_source(name: str, source: str, nodes: int) -> None:
    scene, splats = read_scene(real_scene(name), threads=2), read_scene(real_scene(source), threads=2).splats
    assert (len(scene), scene.format, scene.header["chunks"]) == (nodes, "RAD LoD", 3)
    assert scene.tree is not None and scene.chunk_bytes is not None and len(scene.chunk_bytes) == 3
    leaves = scene.splats.take(scene.tree.is_leaf)
    assert len(leaves) == len(splats)
    ours, theirs = (each.take(np.lexsort((lod_opacity(each.opacity), *each.center.T))) for each in (splats, leaves))
    np.testing.assert_array_equal(ours.center, theirs.center)
    assert np.abs(ours.opacity - theirs.opacity).max() <= 2**-11
