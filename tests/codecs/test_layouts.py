"""Layouts in a viewer's memory: their bytes by hand, and the largest error of every field, kept and reached.

`tests/interop/test_spark_files.py` holds those of Spark to Spark's own words.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs import layouts
from sparklod_cli.codecs.formats import ENCODINGS
from sparklod_cli.codecs.losses import SAMPLE, LayoutLoss, sample_loss
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity, normalized_quat
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.codecs.cases import assert_same, half_float, random_quats, rotation_degrees, splats_with
from tests.references import gaussians
from tests.scenes import random_splats

ROUNDING = 1.001  # float32's own errors, which no docstring counts
WIDE = SplatEncoding(rgb_min=-0.5, rgb_max=2, ln_scale_min=-8, ln_scale_max=1, sh1_max=0.5, sh2_max=2, sh3_max=0.25)
LOD = SplatEncoding(lod_opacity=True)
HALF_TURN = [0, 0.5**0.5, 0, 0.5**0.5]

#: Layouts of splats: PackedSplats in an encoding, or ExtSplats.
Layout = SplatEncoding | None
EXT: Layout = None


def pack(splats: Splats, layout: Layout = DEFAULT, threads: int = 1) -> dict[str, np.ndarray]:
    if layout is EXT:
        return layouts.pack_ext(splats, threads=threads)
    return layouts.pack_packed(splats, layout, threads=threads)


def unpack(words: dict[str, np.ndarray], layout: Layout = DEFAULT, threads: int = 1) -> Splats:
    if layout is EXT:
        return layouts.unpack_ext(words, threads=threads)
    return layouts.unpack_packed(words, layout, threads=threads)


def round_trip(splats: Splats, layout: Layout = DEFAULT) -> Splats:
    return unpack(pack(splats, layout), layout)


# --- Bytes ------------------------------------------------------------------------------------------------------------


def test_a_splat_of_packed_splats_is_four_words_of_these_bytes() -> None:
    columns = {"rgb": [0, 1, 0.2], "opacity": 0.6, "center": [1, -2, 0.5], "scale": [0, 1, np.exp(9)]}
    packed = pack(splats_with(**columns, quat_xyzw=HALF_TURN))["packed"]
    assert packed.tobytes() == struct.pack("<4B3e2B3BB", 0, 255, 51, 153, 1, -2, 0.5, 128, 255, 0, 146, 255, 128)
    assert (packed.dtype, packed.shape) == (np.uint32, (1, 4))


def test_a_splat_of_ext_splats_is_eight_words_of_these_bytes() -> None:
    columns = {"center": [1.1, -2e30, 3e-20], "opacity": linear_opacity(np.float32(3)), "rgb": [0.5, -0.25, 1.5]}
    packed = pack(splats_with(**columns, scale=[1, 0, np.exp(-4.5)], quat_xyzw=HALF_TURN), EXT)
    assert packed["ext0"].tobytes() == struct.pack("<3f2e", 1.1, -2e30, 3e-20, 1.5, 0)
    rotation = 512 | 1023 << 10 | 2048 << 20
    assert packed["ext1"].tobytes() == struct.pack("<6eI", 0.5, -0.25, 1.5, 0, -np.inf, -4.5, rotation)
    assert all(array.dtype == np.uint32 and array.shape == (1, 4) for array in packed.values())


def test_words_of_sh_in_packed_splats_are_those_worked_out_by_hand() -> None:
    splats = random_splats(1, sh_degree=3)
    numbers = np.arange(45) - 22
    splats.sh[0] = (numbers / np.repeat([63, 127, 31], [9, 15, 21])).reshape(15, 3)
    packed = pack(splats)
    for name, part, bits, words in (("sh1", slice(9), 7, 2), ("sh2", slice(9, 24), 8, 4), ("sh3", slice(24, 45), 6, 4)):
        bit_string = sum(int(number) % 2**bits << index * bits for index, number in enumerate(numbers[part]))
        assert packed[name].shape == (1, words)
        assert packed[name].tobytes() == bit_string.to_bytes(4 * words, "little")


def word(r: int, g: int, b: int, signs: int, exponent: int) -> int:
    return r | g << 8 | b << 16 | signs << 24 | (exponent + 15) << 27


@pytest.mark.parametrize(
    ("rgb", "expected"),
    [
        ([0.5, -0.125, 0], word(255, 64, 0, 2, -1)),
        ([0.375, -0.625, -0.6875], word(191, 255, 255, 6, -1)),  # cut off at 1 / 2: see docs/formats/memory.md
        ([0, 0, 0], word(0, 0, 0, 0, -15)),
        ([-0.0, 0, 1], word(0, 0, 255, 0, 0)),
        ([-1e-9, 0, 1], word(0, 0, 255, 1, 0)),
        ([2.0**-15, -(2.0**-17), 2.0**-18], word(255, 64, 32, 2, -15)),
        ([1e-6, 0, 0], word(8, 0, 0, 0, -15)),
        ([3e38, -65536, 256], word(255, 255, 1, 2, 16)),
        ([0.12499999, 0, 0], word(255, 0, 0, 0, -3)),  # its logarithm is -3 in float32
    ],
)
def test_a_word_of_sh_in_ext_splats_is_that_worked_out_by_hand(rgb: list[float], expected: int) -> None:
    assert layouts.encode_ext_sh(np.array([[rgb]], np.float32)).tolist() == [[expected]]


@pytest.mark.parametrize("sh_degree", range(4))
def test_there_are_arrays_for_each_sh_degree(sh_degree: int) -> None:
    """Those of ExtSplats are filled with one coefficient after the other, and 0 at the end."""
    splats = random_splats(7, sh_degree=sh_degree)
    assert list(pack(splats)) == ["packed", "sh1", "sh2", "sh3"][: sh_degree + 1]
    packed = pack(splats, EXT)
    assert list(packed) == ["ext0", "ext1", *["sh1", "sh2", "sh3a", "sh3b"][: (0, 1, 2, 4)[sh_degree]]]
    words = np.concatenate([np.zeros((7, 0), np.uint32), *list(packed.values())[2:]], axis=1)
    coefficients = splats.sh.shape[1]
    np.testing.assert_array_equal(words[:, :coefficients], layouts.encode_ext_sh(splats.sh))
    assert not words[:, coefficients:].any()
    for layout in (DEFAULT, EXT):
        assert round_trip(splats, layout).sh.shape == splats.sh.shape


# --- Largest errors ---------------------------------------------------------------------------------------------------


def ramp(low: float, high: float, width: int = 1) -> np.ndarray:
    """(20000, width) numbers from `low` to `high`, the columns not in step; (20000,) of one."""
    return np.linspace(low, high, 20_000 * width, dtype=np.float32).reshape(width, 20_000).T.squeeze()


def exponentials(low: float, high: float) -> np.ndarray:
    """(20000, 3) numbers of which every second row is negative."""
    values = np.exp(ramp(low, high, 3))
    values[::2] *= -1
    return values


def log_scale(splats: Splats) -> np.ndarray:
    return np.log(splats.scale.astype(np.float64))


def d(splats: Splats) -> np.ndarray:
    return lod_opacity(splats.opacity).astype(np.float64)


#: Layout, columns, what is measured (a column, or a function of splats), and half a step.
Bound = float | Callable[[np.ndarray], np.ndarray]
ERRORS: dict[str, tuple[Layout, dict[str, np.ndarray], str | Callable[[Splats], np.ndarray], Bound]] = {
    "packed centres": (DEFAULT, {"center": exponentials(-20, np.log(65504))}, "center", half_float),
    "packed colours": (DEFAULT, {"rgb": ramp(0, 1, 3)}, "rgb", 1 / 510),
    "packed colours of a range": (WIDE, {"rgb": ramp(-0.5, 2, 3)}, "rgb", 2.5 / 510),
    "packed opacities": (DEFAULT, {"opacity": ramp(0, 1)}, "opacity", 1 / 510),
    "packed D up to 1": (LOD, {"opacity": linear_opacity(ramp(0, 0.99999))}, d, 1 / 255),
    "packed D from 1": (LOD, {"opacity": linear_opacity(ramp(1, 5))}, d, 4 / 255),
    "packed scales": (DEFAULT, {"scale": np.exp(ramp(-12, 9, 3))}, log_scale, 21 / 508),
    "packed scales of a range": (WIDE, {"scale": np.exp(ramp(-8, 1, 3))}, log_scale, 9 / 508),
    "ext colours": (EXT, {"rgb": exponentials(-20, np.log(65504))}, "rgb", half_float),
    "ext opacities": (EXT, {"opacity": np.exp(ramp(-20, 0))}, "opacity", half_float),
    "ext D from 1": (EXT, {"opacity": linear_opacity(ramp(1, 5))}, d, 2.0**-9),
    "ext scales": (EXT, {"scale": np.exp(ramp(-16, 16, 3))}, log_scale, lambda log: half_float(log) + 1e-6),
    "any ext scales": (EXT, {"scale": np.exp(ramp(-87, 88, 3))}, log_scale, lambda log: half_float(log) + 1e-6),
}


@pytest.mark.parametrize("name", ERRORS)
def test_values_keep_and_reach_their_error(name: str) -> None:
    layout, columns, measured, bound = ERRORS[name]
    splats = splats_with(20_000, **columns)
    one, other = (
        getattr(each, measured).astype(np.float64) if isinstance(measured, str) else measured(each)
        for each in (splats, round_trip(splats, layout))
    )
    ratio = np.abs(other - one) / (bound if isinstance(bound, float) else bound(one))
    assert 0.99 <= ratio.max() <= ROUNDING


@pytest.mark.parametrize(("layout", "degrees"), [(DEFAULT, 1.94), (EXT, 0.476)])
def test_rotations_keep_and_nearly_reach_their_error(layout: Layout, degrees: float) -> None:
    quats = random_quats(100_000)
    back = round_trip(splats_with(len(quats), quat_xyzw=quats), layout).quat_xyzw
    assert 0.95 * degrees <= rotation_degrees(back, quats).max() <= degrees


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_sh_of_packed_splats_are_within_half_a_step_of_the_range_of_their_degree(encoding: SplatEncoding) -> None:
    splats = random_splats(20_000, sh_degree=3)
    degrees = {1: 126, 2: 254, 3: 62}
    for degree in degrees:
        most, part = float(encoding.sh_max(degree)), slice(COEFFICIENTS[degree - 1], COEFFICIENTS[degree])
        splats.sh[:, part] = ramp(-most, most, 3 * (2 * degree + 1)).reshape(len(splats), -1, 3)
    error = np.abs(round_trip(splats, encoding).sh.astype(np.float64) - splats.sh).max(axis=(0, 2))
    for degree, steps in degrees.items():
        ratio = error[COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]] / encoding.sh_max(degree) * steps
        assert 0.98 <= ratio.min() <= ratio.max() <= ROUNDING


def sh_bound(sh: np.ndarray) -> np.ndarray:
    """(N, K, 3) what the docstring allows: p / 510 up to p, above it what is beyond p."""
    magnitude = np.abs(sh).astype(np.float64)
    largest = np.maximum(magnitude.max(axis=2, keepdims=True), 1e-30)
    power = np.clip(2.0 ** np.floor(np.log2(largest)), 2.0**-15, 2.0**16)
    return np.where(magnitude <= power, power / 510, magnitude - power)


def test_sh_of_ext_splats_are_within_their_shared_exponent_and_reach_its_bound() -> None:
    sh = np.exp(ramp(-10, 11.7, 45)).reshape(-1, 15, 3)
    sh *= np.array([1, -0.9, 0.3], np.float32)
    back = round_trip(splats_with(20_000, 3, sh=sh), EXT).sh
    ratio = (np.abs(back.astype(np.float64) - sh) / sh_bound(sh)).max(axis=(0, 1))
    assert (ratio <= ROUNDING).all() and (ratio >= 0.99).all()
    lost = np.abs(back - sh).max(axis=2) / np.abs(sh).max(axis=2)
    assert 0.499 <= lost.max() < 0.5


@given(sh=arrays(np.float32, (4, 15, 3), elements=st.floats(-(2**17), 2**17, width=32)))
def test_any_sh_of_ext_splats_are_within_their_shared_exponent_and_keep_their_sign(sh: np.ndarray) -> None:
    back = round_trip(splats_with(4, 3, sh=sh), EXT).sh
    # float32's logarithm lifts what lies within its last bit below a power of two onto it.
    allowed = ROUNDING * np.maximum(sh_bound(sh), sh_bound(sh * np.float32(1.000001)))
    assert (np.abs(back.astype(np.float64) - sh) <= allowed + 1e-6 * np.abs(sh)).all()
    assert (back * sh >= 0).all()


@given(center=arrays(np.float32, (8, 3), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)))
def test_centres_of_ext_splats_are_exact(center: np.ndarray) -> None:
    np.testing.assert_array_equal(round_trip(splats_with(8, center=center), EXT).center, center)


@given(data=st.data(), encoding=st.sampled_from([DEFAULT, WIDE, LOD]))
def test_all_columns_of_any_splats_are_within_their_bounds(data: st.DataObject, encoding: SplatEncoding) -> None:
    def numbers(low: float, high: float, *shape: int) -> np.ndarray:
        return data.draw(arrays(np.float32, shape, elements=st.floats(np.float32(low), np.float32(high), width=32)))

    low, high = encoding.ln_scale_min, encoding.ln_scale_max
    logs, rgb = numbers(low, high, 4, 3), numbers(encoding.rgb_min, encoding.rgb_max, 4, 3)
    splats = splats_with(4, rgb=rgb, opacity=numbers(0, 0.99, 4), scale=np.exp(logs))
    back = round_trip(splats, encoding)
    assert np.abs(back.rgb - splats.rgb).max() <= ROUNDING * (encoding.rgb_max - encoding.rgb_min) / 510
    assert np.abs(back.opacity - splats.opacity).max() <= ROUNDING * encoding.alpha_max / 510
    assert np.abs(np.log(back.scale) - logs).max() <= ROUNDING * (high - low) / 508 + 1e-6


# --- Ends of ranges ---------------------------------------------------------------------------------------------------


def code(field: str, encoding: SplatEncoding = DEFAULT, **columns: Any) -> Any:
    return pack(splats_with(**columns), encoding)["packed"].view(layouts.PACKED)[0, 0][field].tolist()


#: Codes of scales, of which 0 is that of a scale of 0, or below e ** -30, alone.
SCALES = {0: 0, np.exp(-30.001): 0, np.exp(-29.999): 1, np.exp(-12): 1, np.exp(-12 + 21 / 254): 2}
SCALES |= {1: 146, np.exp(9): 255, 3e38: 255}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("field", "encoding", "columns", "expected"),
    [
        *(("log_scale", DEFAULT, {"scale": value}, [code] * 3) for value, code in SCALES.items()),
        *(("alpha", DEFAULT, {"opacity": value}, code) for value, code in [(0, 0), (0.5, 128), (1, 255), (1000, 255)]),
        # 1 is half-way between two codes of an LoD tree and goes up, to D = 1.016.
        *(("alpha", LOD, {"opacity": value}, code) for value, code in [(0, 0), (0.5, 64), (1, 128), (7.5, 177)]),
        ("alpha", LOD, {"opacity": linear_opacity(np.float32(6))}, 255),
        ("rgb", DEFAULT, {"rgb": [-0.1, 1.1, 3e38]}, [0, 255, 255]),
        ("rgb", WIDE, {"rgb": [-3e38, -0.5, 2]}, [0, 0, 255]),
        ("center", DEFAULT, {"center": [65519, 65520, -3e38]}, [65504, np.inf, -np.inf]),
    ],
)
def test_ends_of_ranges_have_these_codes(field: str, encoding: SplatEncoding, columns: Any, expected: Any) -> None:
    assert code(field, encoding, **columns) == expected


@pytest.mark.filterwarnings("error")
def test_extreme_values_are_clamped_without_a_warning() -> None:
    for size, sh in ((3e38, [[1] * 3] * 3), (-3e38, [[-0.5] * 3, [-2] * 3, [-0.25] * 3])):
        splats = splats_with(sh_degree=3, sh=size)
        np.testing.assert_allclose(round_trip(splats, DEFAULT if size > 0 else WIDE).sh[0, [0, 3, 8]], sh)
    extreme = {"scale": [0, 1e-45, 3e38], "opacity": 1e3, "rgb": [3e38, -3e38, 65519], "center": 3e38}
    back = round_trip(splats_with(sh_degree=3, **extreme, sh=[-3e38, 0, 3e38]), EXT)
    assert back.scale[0].tolist() == [0, pytest.approx(1e-45, abs=2e-45), pytest.approx(3e38, rel=0.04)]
    assert back.rgb.tolist() == [[np.inf, -np.inf, 65504]]
    assert back.opacity[0] == pytest.approx(1e3, rel=0.02)
    assert np.abs(back.sh).max() == 65536


def test_ties_of_sh_go_away_from_zero() -> None:
    back = round_trip(splats_with(sh_degree=3, sh=-0.5)).sh  # 31.5, 63.5 and 15.5 steps
    np.testing.assert_array_equal(back[0, [0, 3, 8], 0], np.array([-32 / 63, -64 / 127, -16 / 31], np.float32))


def test_unpacked_words_are_packed_to_the_same_words() -> None:
    rng = np.random.default_rng(3)
    packed = rng.integers(0, 2**32, (1000, 4), np.uint32)
    rows = packed.view(layouts.PACKED)[:, 0]
    rows["center"] = rng.normal(size=(1000, 3))
    rows["axis"] = rng.integers(1, 255, (1000, 2))
    rows["angle"] = rng.integers(10, 256, 1000)
    for encoding in (DEFAULT, WIDE, LOD):
        np.testing.assert_array_equal(pack(unpack({"packed": packed}, encoding), encoding)["packed"], packed)
    # ExtSplats, but codes that mean the same: an axis on the rim of the octahedron's square, the sign of an SH of 0.
    once = round_trip(random_splats(5000, sh_degree=3), EXT)
    assert_same(round_trip(once, EXT), once, but="quat_xyzw")
    np.testing.assert_allclose(round_trip(once, EXT).quat_xyzw, once.quat_xyzw, rtol=0, atol=1e-6)


@pytest.mark.filterwarnings("error")
@given(words=arrays(np.uint32, (6, 9, 4)), sh1=arrays(np.uint32, (9, 2)))
def test_any_words_are_read_without_a_warning(words: np.ndarray, sh1: np.ndarray) -> None:
    splats = unpack({"packed": words[0], "sh1": sh1, "sh2": words[1], "sh3": words[2]}, LOD)
    assert all(np.isfinite(getattr(splats, column)).all() for column in COLUMNS[1:])
    splats = unpack(dict(zip(("ext0", "ext1", *layouts.SH_ARRAYS), words, strict=True)), EXT)
    assert np.isfinite(splats.quat_xyzw).all()
    assert np.isfinite(splats.sh).all()


# --- Blocks, threads, and what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ENCODINGS)
def test_threads_and_blocks_do_not_change_a_word(layout: str) -> None:
    splats = random_splats(BLOCK_ROWS + 1024, sh_degree=3)
    count = np.zeros(len(splats), np.uint16)
    tree = LodTree(count, count.astype(np.uint32))
    one, two = (layouts.pack_layout(Scene(splats, tree), layout, threads) for threads in (1, 2))
    rows = slice(BLOCK_ROWS, None)
    last = {**one} if layout == "packed" else layouts.pack_layout(Scene(splats.take(rows), tree.rows(rows)), layout)
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
        if layout != "packed":  # whose ranges follow all splats
            np.testing.assert_array_equal(one[name][-len(last[name]) :], last[name])


@pytest.mark.parametrize("layout", [DEFAULT, EXT])
def test_threads_do_not_change_what_is_unpacked(layout: Layout) -> None:
    splats = random_splats(BLOCK_ROWS + 1000, sh_degree=3)
    words = pack(splats, layout)
    last = pack(splats.take(slice(BLOCK_ROWS, None)), layout)
    assert all(np.array_equal(words[name][BLOCK_ROWS:], last[name]) for name in words)
    assert_same(unpack(words, layout, threads=2), unpack(words, layout))
    empty = pack(Splats.empty(0, 3), layout)
    assert {len(array) for array in empty.values()} == {0} and len(unpack(empty, layout)) == 0


PACKED, EXTENDED = (pack(random_splats(3, sh_degree=3), layout) for layout in (DEFAULT, EXT))


def without(words: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {other: array for other, array in words.items() if other != name}


def zeros(*shape: int, dtype: Any = np.uint32) -> np.ndarray:
    return np.zeros(shape, dtype)


@pytest.mark.parametrize(
    ("unpack", "words", "text"),
    [
        (layouts.unpack_packed, PACKED | {"packed": zeros(3, 4, dtype=np.uint8)}, "packed is uint8"),
        (layouts.unpack_packed, PACKED | {"sh1": zeros(3, 4)}, r"sh1 is .*expected uint32\[3, 2\]"),
        (layouts.unpack_packed, PACKED | {"sh3": zeros(2, 4)}, r"sh3 is .*expected uint32\[3, 4\]"),
        (layouts.unpack_packed, without(PACKED, "sh1"), r"SH arrays of degree \(2, 3\)"),
        (layouts.unpack_ext, EXTENDED | {"ext0": zeros(3, 3)}, "ext0 is"),
        (layouts.unpack_ext, EXTENDED | {"ext1": zeros(4, 4)}, r"ext1 is .*expected uint32\[3, 4\]"),
        *((layouts.unpack_ext, without(EXTENDED, name), f"no array {name}, only ") for name in EXTENDED),
        (layouts.unpack_nodes, {}, "no array lod_tree"),
        (layouts.unpack_nodes, {"lod_tree": zeros(3, 3)}, "lod_tree is"),
        (layouts.unpack_nodes, {"lod_tree": np.uint32(0)}, r"lod_tree is uint32\[\], expected uint32\[N, 4\]"),
        (
            layouts.unpack_nodes,
            {"lod_tree": np.uint32([[0, 0, 1, 1], [0, 0, 65536, 2]])},
            "node 1 has 65,536 children",
        ),
        (layouts.texture_capacity, {}, "no array texture, only none"),
        (layouts.texture_capacity, {"texture": zeros(1, 2048, 4, dtype=np.uint8)}, "texture is uint8"),
        (layouts.texture_capacity, {"texture": zeros(1, 1024, 4)}, r"expected uint32\[1, 2048, 4\]"),
        (layouts.texture_capacity, {"texture": zeros(2048, 4)}, r"texture is uint32\[2048, 4\]"),
        (layouts.texture_capacity, {"texture": np.array(3)}, r"texture is int64\[\]"),
    ],
)
def test_arrays_of_wrong_shapes_or_types_are_refused(unpack: Callable, words: Any, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        unpack(words)


@pytest.mark.parametrize(
    ("ranges", "text"),
    [
        ({"rgb_min": 1}, "rgb_min is 1, which is not below rgb_max, 1"),
        ({"ln_scale_max": -12}, "ln_scale_min is -12, which is not below ln_scale_max, -12"),
        ({"sh2_max": 0}, "sh2_max is 0; give a number above 0"),
        ({"rgb_max": float("nan")}, "rgb_max is nan; give a number whose magnitude is at most"),
    ],
)
def test_an_encoding_with_an_empty_range_is_refused(ranges: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        SplatEncoding(**ranges)


# --- The data texture, against a twin that follows the viewer splat by splat ------------------------------------------

AXES, OTHER_AXES = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def texels_of(splats: Splats) -> np.ndarray:
    """Rows of `layouts.TEXELS`."""
    return layouts.pack_texture(splats)["texture"].reshape(-1, 8).view(layouts.TEXELS)[: len(splats), 0]


def covariance_of(splats: Splats) -> np.ndarray:
    """(N, 6) covariances, as the texture has them."""
    return texels_of(splats)["covariance"].astype(np.float32) / 4


def true_covariance(splats: Splats) -> np.ndarray:
    return gaussians.covariance(splats.scale, splats.quat_xyzw)[:, AXES, OTHER_AXES]


def viewers_texels(splats: Splats, index: int) -> bytes:
    """The 32 bytes that the viewer's formulas make of one splat: a matrix of 3 x 3 by rows, each times its scale."""
    x, y, z, w = (float(number) for number in splats.quat_xyzw[index])
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]
    m = [[float(scale) * number for number in row] for scale, row in zip(splats.scale[index], turn, strict=True)]
    sigma = [sum(m[k][i] * m[k][j] for k in range(3)) for i, j in zip(AXES, OTHER_AXES, strict=True)]
    colour = [*splats.rgb[index], splats.opacity[index]]
    rgba = [round(min(max(float(number), 0), 1) * 255) for number in colour]
    return struct.pack("<3fI6e4B", *splats.center[index], 0, *(4 * number for number in sigma), *rgba)


def test_every_byte_is_that_of_the_slow_twin() -> None:
    splats = random_splats(3000)
    texture = layouts.pack_texture(splats)["texture"]
    assert texture.shape == (3, 2048, 4)
    assert texture.dtype == np.uint32
    for index in range(len(splats)):
        row, column = divmod(index, 1024)  # as the viewer's shader finds them
        texels = texture[row, 2 * column : 2 * column + 2]
        assert texels.tobytes() == viewers_texels(splats, index), index
    assert not texture.reshape(-1, 8)[len(splats) :].any()


@pytest.mark.parametrize(("count", "height"), [(0, 1), (1, 1), (1024, 1), (1025, 2), (2048, 2)])
def test_a_texture_has_as_many_rows_as_its_splats_need(count: int, height: int) -> None:
    packed = layouts.pack_texture(random_splats(2048).take(slice(count)))
    assert packed["texture"].shape == (height, 2048, 4)
    assert layouts.texture_capacity(packed) == 1024 * height


@given(
    scale=arrays(np.float32, (8, 3), elements=st.floats(2.0**-20, 127, width=32)),
    quats=arrays(np.float32, (8, 4), elements=st.floats(-1, 1, width=32)),
)
def test_covariance_keeps_its_error(scale: np.ndarray, quats: np.ndarray) -> None:
    quats[np.abs(quats).max(axis=1) == 0] = [0, 0, 0, 1]
    splats = splats_with(8, scale=scale, quat_xyzw=normalized_quat(quats))
    expected = true_covariance(splats)
    error = np.abs(covariance_of(splats) - expected)
    # The twin makes its matrix in another way, which float32 quaternions of nearly unit length tell apart.
    noise = 2e-6 * (splats.scale.astype(np.float64) ** 2).max(axis=1, keepdims=True)
    assert (error <= np.maximum(2.0**-11 * np.abs(expected), 2.0**-27) + noise).all()


@pytest.mark.filterwarnings("error")
def test_splats_too_wide_are_shrunk_in_their_shape() -> None:
    splats = random_splats(500)
    splats.scale[:] *= np.exp(np.linspace(0, 85, 500)).astype(np.float32)[:, None]
    true = true_covariance(splats)
    factor = np.minimum(1, 65504 / 4 / true[:, [0, 3, 5]].max(axis=1, keepdims=True))
    assert np.count_nonzero(factor < 1) > 100
    got = covariance_of(splats)
    np.testing.assert_allclose(got, true * factor, rtol=2.0**-11, atol=2e-6 * 65504 / 4)
    np.testing.assert_allclose(got[:, [0, 3, 5]].max(axis=1)[factor[:, 0] < 1], 65504 / 4)


@pytest.mark.filterwarnings("error")
def test_colours_of_the_texture_are_clamped_and_centres_exact() -> None:
    splats = splats_with(1, rgb=[-0.5, 3e38, 0.5], opacity=1000, center=[3e38, -1e-40, 0.1])
    got = texels_of(splats)
    np.testing.assert_array_equal(got["rgba"], [[0, 255, 128, 255]])
    np.testing.assert_array_equal(got["center"], splats.center)


# --- Choice of Spark's layouts: one loses strong SH, the other far places and colours beyond 0 to 1 -------------------


def changed(sh_degree: int, *, sh: float = 1, moved: float = 0, rgb: float = 0) -> Splats:
    """Random splats with weaker SH, farther from the origin, brighter."""
    splats = random_splats(500, sh_degree=sh_degree)
    columns = {"sh": splats.sh * np.float32(sh), "center": splats.center + np.float32(moved)}
    return dataclasses.replace(splats, **columns, rgb=splats.rgb + np.float32(rgb))


@pytest.mark.parametrize("sh_degree", [1, 2, 3])
@pytest.mark.parametrize(
    ("change", "layout"),
    [({}, "packed"), ({"sh": 0.05}, "ext"), ({"sh": 0}, "ext"), ({"moved": 2000}, "ext"), ({"rgb": 0.5}, "ext")],
)
def test_sh_decide_unless_places_or_colours_do(sh_degree: int, change: dict[str, float], layout: str) -> None:
    assert sample_loss(changed(sh_degree, **change)).better == layout


def test_a_sample_stands_for_all() -> None:
    splats = random_splats(3 * SAMPLE + 1, sh_degree=1)
    parts = [LayoutLoss.of(splats.take(slice(start, start + SAMPLE))) for start in range(0, len(splats), SAMPLE)]
    for layout in ("ext", "packed"):
        assert sample_loss(splats).psnr(layout) == pytest.approx(LayoutLoss.total(parts).psnr(layout), abs=0.2)


def test_invalid_and_invisible_splats_have_no_weight() -> None:
    splats = changed(1)
    splats.center[0], splats.opacity[1], splats.scale[2] = np.nan, 0, 0
    assert np.isfinite(sample_loss(splats).psnr("ext"))
    assert sample_loss(splats.take(slice(0, 1))).better == "ext"
    assert sample_loss(Splats.empty(0, 2)).better == "ext"
