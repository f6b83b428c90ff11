"""ExtSplats: the layout by hand, and the largest error of every field, kept and reached."""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.gpu import ext_splats
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.threads import BLOCK_ROWS
from tests.codecs.cases import random_quats, rotation_degrees
from tests.scenes import random_splats

HALF = 2.0**-11  # relative rounding error of a float16
TINY = 2.0**-25  # and the absolute one of its smallest numbers
ROUNDING = 1.001  # float32's own errors, which no docstring counts


def splats_with(count: int = 1, sh_degree: int = 0, **columns: Any) -> Splats:
    splats = random_splats(count, sh_degree=sh_degree)
    for name, values in columns.items():
        getattr(splats, name)[:] = values
    return splats


def round_trip(splats: Splats) -> Splats:
    return ext_splats.unpack(ext_splats.pack(splats))


def ramp(low: float, high: float, width: int) -> np.ndarray:
    """(20000, width) numbers from `low` to `high`, the columns not in step."""
    return np.linspace(low, high, 20_000 * width, dtype=np.float32).reshape(width, 20_000).T


# --- Layout -----------------------------------------------------------------------------------------------------------


def test_a_splat_is_eight_words_of_these_bytes() -> None:
    splats = splats_with(
        center=[1.1, -2e30, 3e-20],
        opacity=linear_opacity(np.float32(3)),
        rgb=[0.5, -0.25, 1.5],
        scale=[1, 0, np.exp(-4.5)],
        quat_xyzw=[0, 0.5**0.5, 0, 0.5**0.5],
    )
    packed = ext_splats.pack(splats)
    assert packed["ext0"].tobytes() == struct.pack("<3f2e", 1.1, -2e30, 3e-20, 1.5, 0)
    rotation = 512 | 1023 << 10 | 2048 << 20
    assert packed["ext1"].tobytes() == struct.pack("<6eI", 0.5, -0.25, 1.5, 0, -np.inf, -4.5, rotation)
    assert all(array.dtype == np.uint32 and array.shape == (1, 4) for array in packed.values())


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
def test_a_word_of_sh_is_that_worked_out_by_hand(rgb: list[float], expected: int) -> None:
    assert ext_splats.encode_sh(np.array([[rgb]], np.float32)).tolist() == [[expected]]


@pytest.mark.parametrize(
    ("sh_degree", "names"), [(0, []), (1, ["sh1"]), (2, ["sh1", "sh2"]), (3, ["sh1", "sh2", "sh3a", "sh3b"])]
)
def test_sh_fill_as_many_arrays_as_their_degree_needs(sh_degree: int, names: list[str]) -> None:
    """The coefficients follow each other through the arrays, and what they do not fill is 0."""
    splats = random_splats(7, sh_degree=sh_degree)
    packed = ext_splats.pack(splats)
    assert list(packed) == ["ext0", "ext1", *names]
    words = np.concatenate([np.zeros((7, 0), np.uint32), *(packed[name] for name in names)], axis=1)
    coefficients = splats.sh.shape[1]
    np.testing.assert_array_equal(words[:, :coefficients], ext_splats.encode_sh(splats.sh))
    assert not words[:, coefficients:].any()
    np.testing.assert_array_equal(round_trip(splats).sh, ext_splats.decode_sh(words[:, :coefficients]))


# --- Largest errors ---------------------------------------------------------------------------------------------------


@given(center=arrays(np.float32, (8, 3), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)))
def test_center_is_exact(center: np.ndarray) -> None:
    np.testing.assert_array_equal(round_trip(splats_with(8, center=center)).center, center)


def test_colours_keep_the_precision_of_float16() -> None:
    rgb = np.exp(ramp(-20, np.log(65504), 3))
    rgb[::2] *= -1
    error = np.abs(round_trip(splats_with(20_000, rgb=rgb)).rgb.astype(np.float64) - rgb)
    assert 0.99 <= (error / np.maximum(HALF * np.abs(rgb), TINY)).max() <= 1


def test_opacities_keep_the_precision_of_float16() -> None:
    opacity = np.exp(ramp(-20, 0, 1))[:, 0]
    error = np.abs(round_trip(splats_with(20_000, opacity=opacity)).opacity.astype(np.float64) - opacity)
    assert 0.99 <= (error / np.maximum(HALF * opacity, TINY)).max() <= 1


def test_lod_opacities_from_1_to_5_are_within_a_step_of_float16() -> None:
    d = ramp(1, 5, 1)[:, 0]
    back = lod_opacity(round_trip(splats_with(20_000, opacity=linear_opacity(d))).opacity)
    assert 0.99 <= np.abs(back.astype(np.float64) - d).max() / 2.0**-9 <= ROUNDING


@pytest.mark.parametrize(("low", "high", "stated"), [(-16, 16, 0.004), (-87, 88, 0.034)])
def test_logarithms_of_scales_keep_the_precision_of_float16(low: float, high: float, stated: float) -> None:
    log = ramp(low, high, 3)
    scale = np.exp(log.astype(np.float64)).astype(np.float32)
    log = np.log(scale.astype(np.float64))
    error = np.abs(np.log(round_trip(splats_with(20_000, scale=scale)).scale.astype(np.float64)) - log)
    assert 0.99 <= (error / np.maximum(HALF * np.abs(log), 1e-6)).max() <= ROUNDING
    assert 0.9 * stated <= error.max() <= stated


def test_rotations_are_off_by_less_than_half_a_degree() -> None:
    quats = random_quats(100_000)
    error = rotation_degrees(quats, round_trip(splats_with(len(quats), quat_xyzw=quats)).quat_xyzw).max()
    assert 0.95 * 0.476 <= error <= 0.476


def sh_bound(sh: np.ndarray) -> np.ndarray:
    """(N, K, 3) what the docstring allows: p / 510 up to p, above it what is beyond p."""
    magnitude = np.abs(sh).astype(np.float64)
    power = np.clip(
        2.0 ** np.floor(np.log2(np.maximum(magnitude.max(axis=2, keepdims=True), 1e-30))), 2.0**-15, 2.0**16
    )
    return np.where(magnitude <= power, power / 510, magnitude - power)


def test_sh_are_within_their_shared_exponent_and_reach_its_bound() -> None:
    sh = np.exp(ramp(-10, 11.7, 45)).reshape(-1, 15, 3)
    sh *= np.array([1, -0.9, 0.3], np.float32)
    back = round_trip(splats_with(20_000, 3, sh=sh)).sh
    ratio = np.abs(back.astype(np.float64) - sh) / sh_bound(sh)
    assert (ratio.max(axis=(0, 1)) <= ROUNDING).all()
    assert (ratio.max(axis=(0, 1)) >= 0.99).all()
    lost = np.abs(back - sh).max(axis=2) / np.abs(sh).max(axis=2)
    assert 0.499 <= lost.max() < 0.5


@given(sh=arrays(np.float32, (4, 15, 3), elements=st.floats(-(2**17), 2**17, width=32)))
def test_any_sh_are_within_their_shared_exponent_and_keep_their_sign(sh: np.ndarray) -> None:
    back = round_trip(splats_with(4, 3, sh=sh)).sh
    # float32's logarithm lifts what lies within its last bit below a power of two onto it.
    allowed = ROUNDING * np.maximum(sh_bound(sh), sh_bound(sh * np.float32(1.000001)))
    assert (np.abs(back.astype(np.float64) - sh) <= allowed + 1e-6 * np.abs(sh)).all()
    assert (back * sh >= 0).all()


# --- Edges, chunks and threads, and what is refused -------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_extreme_values_are_clamped_without_a_warning() -> None:
    extreme = splats_with(
        sh_degree=3, scale=[0, 1e-45, 3e38], opacity=1e3, rgb=[3e38, -3e38, 65519], center=3e38, sh=[-3e38, 0, 3e38]
    )
    back = round_trip(extreme)
    assert back.scale[0, 0] == 0
    assert back.scale[0, 1] == pytest.approx(1e-45, abs=2e-45)
    assert back.scale[0, 2] == pytest.approx(3e38, rel=0.04)
    assert back.rgb.tolist() == [[np.inf, -np.inf, 65504]]
    assert back.opacity[0] == pytest.approx(1e3, rel=0.02)
    assert np.abs(back.sh).max() == 65536


@pytest.mark.filterwarnings("error")
@given(words=arrays(np.uint32, (6, 5, 4)))
def test_any_words_of_ext_splats_are_read_quietly(words: np.ndarray) -> None:
    names = ("ext0", "ext1", *ext_splats.SH_ARRAYS)
    splats = ext_splats.unpack(dict(zip(names, words, strict=True)))
    assert np.isfinite(splats.quat_xyzw).all()
    assert np.isfinite(splats.sh).all()


def test_packing_again_changes_nothing() -> None:
    """But codes that mean the same: an axis on the rim of the octahedron's square, the sign of an SH of 0."""
    once = round_trip(random_splats(5000, sh_degree=3))
    again = round_trip(once)
    for column in COLUMNS:
        atol = 1e-6 if column == "quat_xyzw" else 0
        np.testing.assert_allclose(getattr(again, column), getattr(once, column), rtol=0, atol=atol)


def test_threads_and_chunks_do_not_change_a_word_of_ext_splats() -> None:
    splats = random_splats(BLOCK_ROWS + 1000, sh_degree=3)
    one, two = (ext_splats.pack(splats, threads=threads) for threads in (1, 2))
    last = ext_splats.pack(splats.take(slice(BLOCK_ROWS, None)))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
        np.testing.assert_array_equal(one[name][BLOCK_ROWS:], last[name])
    back = (ext_splats.unpack(one, threads=threads) for threads in (1, 2))
    for ours, theirs in zip(*map(dataclasses.astuple, back), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_ext_splats_of_no_splats_are_empty_arrays() -> None:
    packed = ext_splats.pack(Splats.empty(0, 3))
    assert {array.shape for array in packed.values()} == {(0, 4)}
    assert len(ext_splats.unpack(packed)) == 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"ext0": np.zeros((3, 3), np.uint32)}, "ext0 is"),
        ({"ext1": np.zeros((3, 4), np.float32)}, "ext1 is float32"),
        ({"ext1": np.zeros((4, 4), np.uint32)}, r"ext1 is .*expected uint32\[3, 4\]"),
        ({"sh3b": np.zeros((3, 2), np.uint32)}, r"sh3b is .*expected uint32\[3, 4\]"),
    ],
)
def test_ext_splats_of_wrong_shapes_or_types_are_refused(change: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        ext_splats.unpack(ext_splats.pack(random_splats(3, sh_degree=3)) | change)


@pytest.mark.parametrize("name", ["ext0", "ext1", "sh1", "sh2", "sh3a", "sh3b"])
def test_an_array_of_ext_splats_that_is_missing_is_named(name: str) -> None:
    packed = ext_splats.pack(random_splats(3, sh_degree=3))
    del packed[name]
    with pytest.raises(FormatError, match=f"no array {name}, only "):
        ext_splats.unpack(packed)
