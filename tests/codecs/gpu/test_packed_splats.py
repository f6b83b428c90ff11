"""PackedSplats: the layout by hand, and the largest error of every field, kept and reached."""

from __future__ import annotations

import dataclasses
import re
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.gpu import packed_splats
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.codecs.cases import random_quats, rotation_degrees
from tests.scenes import random_splats

ROUNDING = 1.001  # float32's own errors, which no docstring counts
WIDE = SplatEncoding(rgb_min=-0.5, rgb_max=2, ln_scale_min=-8, ln_scale_max=1, sh1_max=0.5, sh2_max=2, sh3_max=0.25)
LOD = SplatEncoding(lod_opacity=True)


def splats_with(count: int = 1, sh_degree: int = 0, **columns: Any) -> Splats:
    splats = random_splats(count, sh_degree=sh_degree)
    for name, values in columns.items():
        getattr(splats, name)[:] = values
    return splats


def round_trip(splats: Splats, encoding: SplatEncoding = DEFAULT) -> Splats:
    return packed_splats.unpack(packed_splats.pack(splats, encoding), encoding)


def largest_error(column: str, splats: Splats, encoding: SplatEncoding = DEFAULT) -> float:
    back = getattr(round_trip(splats, encoding), column).astype(np.float64)
    return float(np.abs(back - getattr(splats, column)).max())


def ramp(low: float, high: float, width: int) -> np.ndarray:
    """(20000, width) numbers from `low` to `high`, the columns not in step."""
    count = 20_000
    return np.linspace(low, high, count * width, dtype=np.float32).reshape(width, count).T


# --- Layout -----------------------------------------------------------------------------------------------------------


def test_a_splat_is_four_words_of_these_bytes() -> None:
    splats = splats_with(
        rgb=[0, 1, 0.2],
        opacity=0.6,
        center=[1, -2, 0.5],
        quat_xyzw=[0, 0.5**0.5, 0, 0.5**0.5],
        scale=[0, 1, np.exp(9)],
    )
    packed = packed_splats.pack(splats)["packed"]
    expected = struct.pack("<4B3e2B3BB", 0, 255, 51, 153, 1, -2, 0.5, 128, 255, 0, 146, 255, 128)
    assert packed.tobytes() == expected
    assert packed.dtype == np.uint32
    assert packed.shape == (1, 4)
    assert packed[0, 0] == 153 << 24 | 51 << 16 | 255 << 8


def test_words_of_sh_are_those_worked_out_by_hand() -> None:
    splats = random_splats(1, sh_degree=3)
    numbers = np.arange(45) - 22
    splats.sh[0] = (numbers / np.repeat([63, 127, 31], [9, 15, 21])).reshape(15, 3)
    packed = packed_splats.pack(splats)
    for name, some, bits, words in (("sh1", slice(9), 7, 2), ("sh2", slice(9, 24), 8, 4), ("sh3", slice(24, 45), 6, 4)):
        bit_string = sum(int(number) % 2**bits << index * bits for index, number in enumerate(numbers[some]))
        assert packed[name].shape == (1, words)
        assert packed[name].tobytes() == bit_string.to_bytes(4 * words, "little")


@pytest.mark.parametrize("sh_degree", range(4))
def test_there_is_an_array_for_each_sh_degree(sh_degree: int) -> None:
    splats = random_splats(7, sh_degree=sh_degree)
    packed = packed_splats.pack(splats)
    assert list(packed) == ["packed", "sh1", "sh2", "sh3"][: sh_degree + 1]
    assert all(array.dtype == np.uint32 and array.flags.c_contiguous for array in packed.values())
    assert round_trip(splats).sh.shape == splats.sh.shape


# --- Largest errors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_colours_are_within_half_a_step_of_their_range(encoding: SplatEncoding) -> None:
    low, high = encoding.rgb_min, encoding.rgb_max
    bound = (high - low) / 510
    assert (
        0.99 * bound <= largest_error("rgb", splats_with(20_000, rgb=ramp(low, high, 3)), encoding) <= ROUNDING * bound
    )


def test_opacities_are_within_half_a_step() -> None:
    splats = splats_with(20_000, opacity=ramp(0, 1, 1)[:, 0])
    assert 0.99 / 510 <= largest_error("opacity", splats) <= ROUNDING / 510


@pytest.mark.parametrize(("low", "high", "bound"), [(0, 0.99999, 1 / 255), (1, 5, 4 / 255)])
def test_lod_opacities_are_within_the_stated_bound(low: float, high: float, bound: float) -> None:
    d = ramp(low, high, 1)[:, 0]
    back = lod_opacity(round_trip(splats_with(20_000, opacity=linear_opacity(d)), LOD).opacity)
    error = np.abs(back.astype(np.float64) - d).max()
    assert 0.99 * bound <= error <= ROUNDING * bound


def test_centres_on_a_grid_keep_and_reach_the_error_of_float16() -> None:
    center = np.exp(ramp(-20, np.log(65504), 3))
    center[::2] *= -1
    error = np.abs(round_trip(splats_with(20_000, center=center)).center.astype(np.float64) - center)
    bound = np.maximum(2.0**-11 * np.abs(center), 2.0**-25)
    assert 0.99 <= (error / bound).max() <= 1
    small = np.abs(center) < 2.0**-14
    assert (error / bound)[small].max() >= 0.99


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_logarithms_of_scales_are_within_half_a_step_of_their_range(encoding: SplatEncoding) -> None:
    log = ramp(encoding.ln_scale_min, encoding.ln_scale_max, 3).astype(np.float64)
    splats = splats_with(20_000, scale=np.exp(log))
    error = np.abs(np.log(round_trip(splats, encoding).scale) - log).max()
    bound = (encoding.ln_scale_max - encoding.ln_scale_min) / 508
    assert 0.99 * bound <= error <= ROUNDING * bound


def test_rotations_are_off_by_less_than_two_degrees() -> None:
    quats = random_quats(100_000)
    error = rotation_degrees(quats, round_trip(splats_with(len(quats), quat_xyzw=quats)).quat_xyzw).max()
    assert 0.95 * 1.94 <= error <= 1.94


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_sh_are_within_half_a_step_of_the_range_of_their_degree(encoding: SplatEncoding) -> None:
    splats = random_splats(20_000, sh_degree=3)
    tops = {1: (encoding.sh1_max, 126), 2: (encoding.sh2_max, 254), 3: (encoding.sh3_max, 62)}
    for degree, (most, _) in tops.items():
        some = slice(COEFFICIENTS[degree - 1], COEFFICIENTS[degree])
        width = 3 * (2 * degree + 1)
        splats.sh[:, some] = ramp(-most, most, width).reshape(len(splats), -1, 3)
    error = np.abs(round_trip(splats, encoding).sh.astype(np.float64) - splats.sh).max(axis=(0, 2))
    for degree, (most, steps) in tops.items():
        some = error[COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
        assert (some >= 0.98 * most / steps).all()
        assert (some <= ROUNDING * most / steps).all()


@given(data=st.data(), encoding=st.sampled_from([DEFAULT, WIDE, LOD]))
def test_all_columns_of_any_splats_are_within_their_bounds(data: st.DataObject, encoding: SplatEncoding) -> None:
    def numbers(low: float, high: float, *shape: int) -> np.ndarray:
        return data.draw(arrays(np.float32, shape, elements=st.floats(np.float32(low), np.float32(high), width=32)))

    low, high = encoding.ln_scale_min, encoding.ln_scale_max
    log_scale = numbers(low, high, 4, 3)
    splats = splats_with(
        4,
        rgb=numbers(encoding.rgb_min, encoding.rgb_max, 4, 3),
        opacity=numbers(0, 0.99, 4),
        scale=np.exp(log_scale),
    )
    back = round_trip(splats, encoding)
    assert np.abs(back.rgb - splats.rgb).max() <= ROUNDING * (encoding.rgb_max - encoding.rgb_min) / 510
    assert np.abs(back.opacity - splats.opacity).max() <= ROUNDING * encoding.alpha_max / 510
    assert np.abs(np.log(back.scale) - log_scale).max() <= ROUNDING * (high - low) / 508 + 1e-6


# --- Clamping and edges -----------------------------------------------------------------------------------------------


def code(field: str, encoding: SplatEncoding = DEFAULT, **columns: Any) -> Any:
    packed = packed_splats.pack(splats_with(**columns), encoding)["packed"]
    return packed.view(packed_splats.SPLAT)[0, 0][field].tolist()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("scale", "expected"),
    [
        (0, 0),
        (np.exp(-30.001), 0),
        (np.exp(-29.999), 1),  # not zero, so the smallest that there is
        (np.exp(-12), 1),
        (np.exp(-12 + 21 / 254), 2),
        (1, 146),
        (np.exp(9), 255),
        (3e38, 255),
    ],
)
def test_scales_are_coded_from_1_to_255_and_zero_as_0(scale: float, expected: int) -> None:
    assert code("log_scale", scale=scale) == [expected] * 3


@pytest.mark.filterwarnings("error")
def test_values_out_of_range_are_clamped_without_a_warning() -> None:
    assert code("rgb", rgb=[-0.1, 1.1, 3e38]) == [0, 255, 255]
    assert code("rgb", WIDE, rgb=[-3e38, -0.5, 2]) == [0, 0, 255]
    assert code("alpha", opacity=1000) == 255
    assert code("alpha", LOD, opacity=linear_opacity(np.float32(6))) == 255
    assert code("center", center=[65519, 65520, -3e38]) == [65504, np.inf, -np.inf]
    splats = splats_with(sh_degree=3)
    splats.sh[:] = 3e38
    np.testing.assert_allclose(round_trip(splats).sh, 1)
    splats.sh[:] = -3e38
    np.testing.assert_allclose(round_trip(splats, WIDE).sh[0, [0, 3, 8]], [[-0.5] * 3, [-2] * 3, [-0.25] * 3])


def test_ties_of_sh_go_away_from_zero() -> None:
    splats = splats_with(sh_degree=3)
    splats.sh[:] = -0.5  # 31.5, 63.5 and 15.5 steps
    np.testing.assert_array_equal(
        np.unique(round_trip(splats).sh), np.array([-32 / 63, -64 / 127, -16 / 31], np.float32)[[2, 0, 1]]
    )


@pytest.mark.parametrize(("opacity", "plain", "lod"), [(0, 0, 0), (0.5, 128, 64), (1, 255, 128), (7.5, 255, 177)])
def test_opacities_are_coded_by_whether_they_are_of_a_tree(opacity: float, plain: int, lod: int) -> None:
    """1 is half-way between two codes of an LoD tree and goes up, to D = 1.016."""
    assert code("alpha", opacity=opacity) == plain
    assert code("alpha", LOD, opacity=opacity) == lod


def test_unpacked_words_are_packed_to_the_same_words() -> None:
    rng = np.random.default_rng(3)
    packed = rng.integers(0, 2**32, (1000, 4), np.uint32)
    rows = packed.view(packed_splats.SPLAT)[:, 0]
    rows["center"] = rng.normal(size=(1000, 3))
    rows["axis"] = rng.integers(1, 255, (1000, 2))
    rows["angle"] = rng.integers(10, 256, 1000)
    for encoding in (DEFAULT, WIDE, LOD):
        back = packed_splats.pack(packed_splats.unpack({"packed": packed}, encoding), encoding)["packed"]
        np.testing.assert_array_equal(back, packed)


@pytest.mark.filterwarnings("error")
@given(packed=arrays(np.uint32, (9, 4)), sh1=arrays(np.uint32, (9, 2)), sh=arrays(np.uint32, (2, 9, 4)))
def test_any_words_of_packed_splats_are_read_without_a_warning(
    packed: np.ndarray, sh1: np.ndarray, sh: np.ndarray
) -> None:
    splats = packed_splats.unpack({"packed": packed, "sh1": sh1, "sh2": sh[0], "sh3": sh[1]}, LOD)
    for column in ("scale", "quat_xyzw", "opacity", "rgb", "sh"):
        assert np.isfinite(getattr(splats, column)).all()


# --- Chunks, threads, and what is refused -----------------------------------------------------------------------------


def test_threads_and_chunks_do_not_change_a_word_of_packed_splats() -> None:
    splats = random_splats(BLOCK_ROWS + 1000, sh_degree=3)
    one, two = (packed_splats.pack(splats, threads=threads) for threads in (1, 2))
    last = packed_splats.pack(splats.take(slice(BLOCK_ROWS, None)))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
        np.testing.assert_array_equal(one[name][BLOCK_ROWS:], last[name])
    back = (packed_splats.unpack(one, threads=threads) for threads in (1, 2))
    for ours, theirs in zip(*map(dataclasses.astuple, back), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_packed_splats_of_no_splats_are_empty_arrays() -> None:
    packed = packed_splats.pack(Splats.empty(0, 3))
    assert [array.shape for array in packed.values()] == [(0, 4), (0, 2), (0, 4), (0, 4)]
    assert len(packed_splats.unpack(packed)) == 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"packed": np.zeros((3, 3), np.uint32)}, "packed is"),
        ({"packed": np.zeros((3, 4), np.uint8)}, "packed is uint8"),
        ({"sh1": np.zeros((3, 4), np.uint32)}, r"sh1 is .*expected uint32\[3, 2\]"),
        ({"sh3": np.zeros((2, 4), np.uint32)}, r"sh3 is .*expected uint32\[3, 4\]"),
    ],
)
def test_packed_splats_of_wrong_shapes_or_types_are_refused(change: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        packed_splats.unpack(packed_splats.pack(random_splats(3, sh_degree=3)) | change)


def test_sh_of_a_degree_that_is_missing_are_refused() -> None:
    packed = packed_splats.pack(random_splats(3, sh_degree=3))
    del packed["sh1"]
    with pytest.raises(FormatError, match=r"SH arrays of degree \(2, 3\)"):
        packed_splats.unpack(packed)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rgb_min": 1}, "rgb_min is 1, which is not below rgb_max, 1"),
        ({"ln_scale_max": -12}, "ln_scale_min is -12, which is not below ln_scale_max, -12"),
        ({"sh2_max": 0}, "sh2_max is 0; give a number above 0"),
        ({"rgb_max": float("nan")}, "rgb_max is nan; give a number whose magnitude is at most"),
    ],
)
def test_an_encoding_with_an_empty_range_is_refused(options: dict[str, float], told: str) -> None:
    with pytest.raises(ValueError, match=re.escape(told)):
        SplatEncoding(**options)
