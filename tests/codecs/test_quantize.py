"""Every coding keeps the largest error that it states, reaches it, and takes its own codes back unchanged.

Opacities make up for what rounding does to the size of a splat, and to nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs import quantize, spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.lod import quick
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from tests.codecs.cases import assert_same, decode, encode, random_quats, rotation_degrees, stated_degrees
from tests.scenes import random_splats

CODES = np.arange(256, dtype=np.uint8)
ROUNDING = 1.001  # float32's own errors, which no docstring counts


def floats(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    numbers = st.floats(np.float32(low).item(), np.float32(high).item(), width=32)
    return arrays(np.float32, 16, elements=numbers)


# --- 24-bit fixed point -----------------------------------------------------------------------------------------------


@given(values=floats(-(2.0**23) + 1, 2.0**23 - 1), bits=st.integers(0, 24))
def test_fixed24_is_off_by_half_a_step(values: np.ndarray, bits: int) -> None:
    values = np.ldexp(values, -bits)
    back = quantize.decode_fixed24(quantize.encode_fixed24(values, bits), bits)
    assert np.abs(back.astype(np.float64) - values).max() <= 0.5 * 2.0**-bits


@given(codes=arrays(np.uint8, (20, 3)), bits=st.integers(0, 24))
def test_every_code_of_fixed24_comes_back(codes: np.ndarray, bits: int) -> None:
    back = quantize.encode_fixed24(quantize.decode_fixed24(codes, bits), bits)
    np.testing.assert_array_equal(back, codes)


def test_fixed24_is_little_endian_twos_complement() -> None:
    codes = quantize.encode_fixed24(np.array([[1.0, -1.0, 1 / 256]], np.float32), 8)
    assert codes.tolist() == [[[0, 1, 0], [0, 255, 255], [1, 0, 0]]]


def test_fixed24_clamps_and_rounds_ties_to_even() -> None:
    values = np.array([1e9, -1e9, 8388607.0, -8388608.0, 0.5, 1.5, -0.5, -2.5], np.float32)
    back = quantize.decode_fixed24(quantize.encode_fixed24(values, 0), 0)
    assert back.tolist() == [8388607, -8388608, 8388607, -8388608, 0, 2, 0, -2]


# --- Bytes ------------------------------------------------------------------------------------------------------------

BYTE_CODINGS = {
    "log scale": (quantize.encode_log_scale, quantize.decode_log_scale),
    "opacity": (quantize.encode_unorm8, quantize.decode_unorm8),
    "lod opacity": (quantize.encode_lod_opacity, quantize.decode_lod_opacity),
    "color": (quantize.encode_color, quantize.decode_color),
}


@pytest.mark.parametrize("name", BYTE_CODINGS)
def test_bytes_come_back_and_their_values_rise(name: str) -> None:
    encode, decode = BYTE_CODINGS[name]
    np.testing.assert_array_equal(encode(decode(CODES)), CODES)
    assert decode(CODES).dtype == np.float32
    assert (np.diff(decode(CODES)) > 0).all()


def largest_error(name: str, values: np.ndarray) -> float:
    encode, decode = BYTE_CODINGS[name]
    return float(np.abs(decode(encode(values)).astype(np.float64) - values).max())


@pytest.mark.parametrize(
    ("name", "low", "high", "bound"),
    [
        ("opacity", 0, 1, 1 / 510),
        ("lod opacity", 0, 1, 1 / 255),
        ("lod opacity", 1, 5, 4 / 255),
        ("color", -0.44, 1.44, SH_C0 / (2 * 0.15 * 255)),
    ],
)
def test_linear_bytes_keep_and_reach_their_error(name: str, low: float, high: float, bound: float) -> None:
    error = largest_error(name, np.linspace(low, high, 100_001, dtype=np.float32))
    assert 0.98 * bound <= error <= ROUNDING * bound


@given(values=floats(-10, 5.94))
@example(values=np.linspace(-10, 5.94, 100_001, dtype=np.float32))
def test_log_scale_keeps_and_reaches_its_factor(values: np.ndarray) -> None:
    scale = np.exp(values)
    error = np.abs(np.log(quantize.decode_log_scale(quantize.encode_log_scale(scale)) / scale)).max()
    assert error <= ROUNDING / 32
    assert error >= 0.98 / 32 or len(values) == 16


#: Codes of values at the ends of ranges, beyond them, and of ties, which go to even; but D = 1 must not become a merged
#: splat.
ENDS = {
    "log scale": {0.0: 0, 1e-45: 0, 1.0: 160, 3e38: 255},
    "opacity": {-0.1: 0, 0.1: 26, 0.5: 128, 1.5: 255},
    "lod opacity": {0.0: 0, 1.0: 127, 1.0001: 128, 5.0: 255, 7.0: 255},
    "color": {-3e38: 0, -0.45: 0, 0.5: 128, 1.45: 255, 3e38: 255},
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ENDS)
def test_ends_of_ranges_and_ties_have_the_codes_stated(name: str) -> None:
    values, codes = zip(*ENDS[name].items(), strict=True)
    assert BYTE_CODINGS[name][0](np.array(values, np.float32)).tolist() == [*codes]


# --- Spherical harmonics ----------------------------------------------------------------------------------------------


def in_all_coefficients(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(values[:, None, None], (len(values), 15, 3)))


@pytest.mark.parametrize("bits", range(4, 9))
def test_sh_keeps_and_reaches_its_error(bits: int) -> None:
    values = in_all_coefficients(np.linspace(-0.9375, 0.9375, 50_001, dtype=np.float32))
    error = quantize.decode_sh(quantize.encode_sh(values, bits)) - values
    bound = np.repeat([0.5 ** max(bits, 5), 0.5**bits], [3, 12])[:, None]
    assert (np.abs(error).max(axis=0) <= ROUNDING * bound).all()
    assert (np.abs(error).max(axis=0) >= 0.98 * bound).all()
    assert (np.abs(error.mean(axis=0)) <= 0.01 * bound).all()  # as often up as down


@pytest.mark.parametrize("bits", range(4, 9))
def test_sh_codes_of_fewer_bits_are_among_those_of_more(bits: int) -> None:
    codes = quantize.encode_sh(in_all_coefficients(quantize.decode_sh(CODES)), bits)
    step = np.repeat([2 ** (8 - max(bits, 5)), 2 ** (8 - bits)], [3, 12])[None, :, None]
    assert ((codes % step == 0) | (codes == 255)).all()
    for more in range(bits, 9):
        np.testing.assert_array_equal(quantize.encode_sh(quantize.decode_sh(codes), more), codes)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("coefficients", [3, 8, 15])
@pytest.mark.parametrize("size", [2.0, 3e38])
def test_sh_beyond_their_range_are_clamped(size: float, coefficients: int) -> None:
    codes = quantize.encode_sh(in_all_coefficients(np.array([-size, size], np.float32))[:, :coefficients])
    assert codes.shape == (2, coefficients, 3)
    assert (codes[0] == 0).all()
    assert (codes[1] == 255).all()


# --- Rotations --------------------------------------------------------------------------------------------------------

Coder = Callable[[np.ndarray], np.ndarray]
QUATERNIONS: dict[str, tuple[Coder, Coder, list[float]]] = {
    # With rotations that come out badly, as a search found them.
    "first three": (
        quantize.encode_quat_first_three,
        quantize.decode_quat_first_three,
        [0.36077943, -0.69008201, 0.62739539, -1.5e-08],
    ),
    "smallest three": (
        quantize.encode_quat_smallest_three,
        quantize.decode_quat_smallest_three,
        [0.5259297, -0.48224637, 0.49331897, -0.4974664],
    ),
}


@pytest.mark.parametrize("name", QUATERNIONS)
def test_rotations_keep_and_nearly_reach_their_error(name: str) -> None:
    encode, decode, worst = QUATERNIONS[name]
    quats = np.concatenate([random_quats(100_000), normalized_quat(np.array([worst], np.float32))])
    error = rotation_degrees(quats, decode(encode(quats))).max()
    assert 0.7 * stated_degrees(decode) <= error <= stated_degrees(decode)


@pytest.mark.parametrize("name", QUATERNIONS)
def test_rotations_come_back_as_unit_and_as_either_sign(name: str) -> None:
    encode, decode, _ = QUATERNIONS[name]
    quats = random_quats(1000)
    back = decode(encode(quats))
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(back, decode(encode(-quats)))


@given(codes=arrays(np.uint8, (50, 3)))
def test_codes_of_first_three_come_back(codes: np.ndarray) -> None:
    xyz = codes / 127.5 - 1
    possible = codes[(xyz**2).sum(axis=1) < 1]  # longer ones are made unit, so they move
    back = quantize.encode_quat_first_three(quantize.decode_quat_first_three(possible))
    np.testing.assert_array_equal(back, possible)


def test_codes_of_smallest_three_come_back() -> None:
    rng = np.random.default_rng(6)
    parts, largest = rng.integers(-511, 512, (20_000, 3)), rng.integers(0, 4, 20_000)
    others = parts / 511 * 0.5**0.5
    rest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    possible = rest > np.abs(others).max(axis=1) + 1e-4  # else what is left over would not be the largest
    assert possible.sum() > 5000
    fields = ((parts < 0) << 9 | np.abs(parts)) << np.array([20, 10, 0])
    code = (largest << 30 | fields.sum(axis=1))[possible]
    codes = code.astype("<u4").view(np.uint8).reshape(-1, 4)
    back = quantize.encode_quat_smallest_three(quantize.decode_quat_smallest_three(codes))
    np.testing.assert_array_equal(back, codes)


def test_smallest_three_is_as_worked_out_by_hand() -> None:
    half = 0.5**0.5
    quats = np.array([[0, 0, 0, 1], [0, half, 0, -half], [-0.3, 0.9, 0.1, 0.3]], np.float32)
    codes = quantize.encode_quat_smallest_three(normalized_quat(quats)).view("<u4")[:, 0]
    assert codes[0] == 3 << 30
    assert codes[1] == (1 << 30 | 512 + 511)  # y, the first of two equals; w is negative beside it
    assert [codes[2] >> 30, codes[2] >> 29 & 1, codes[2] >> 19 & 1, codes[2] >> 9 & 1] == [1, 1, 0, 0]
    assert [codes[2] >> 20 & 511, codes[2] >> 10 & 511, codes[2] & 511] == [217, 72, 217]


# --- Opacities that make up for the rounding of scales ----------------------------------------------------------------

SEEDS = st.integers(0, 2**32 - 1)


def rounded(scale: np.ndarray) -> np.ndarray:
    return quantize.decode_log_scale(quantize.encode_log_scale(scale))


def integral(opacity: np.ndarray) -> np.ndarray:
    """Of the falloff over the plane, per area of 2 * pi: opacity up to 1, else of 1 - (1 - exp(-z * z / 2)) ** A."""
    u = np.linspace(0, 40, 40_001)[:, None]
    beyond = (-np.expm1(opacity * np.log1p(-np.exp(-u.clip(1e-12))))).sum(axis=0) * (u[1] - u[0])
    return np.where(opacity <= 1, opacity, beyond)


@given(SEEDS)
@settings(max_examples=20)
def test_a_splat_covers_what_it_did(seed: int) -> None:
    splats = random_splats(300, seed=seed)
    held = rounded(splats.scale)
    before = splats.opacity * quantize.faces(splats.scale, 0)
    area = quantize.faces(held, 0)
    kept = quantize.compensated(splats.opacity, splats.scale, held, 0.0)
    off = np.abs(kept * area / before - 1)
    assert (off[kept < 1] < 1e-5).all()
    assert (off <= np.abs(splats.opacity * area / before - 1) + 1e-6).all()  # saturated ones gain as much as they can
    assert kept.max() <= 1


@given(SEEDS)
@settings(max_examples=20)
def test_a_file_is_nearer_to_what_splats_cover(seed: int) -> None:
    """Through the codes of opacities, too, whose steps are what is left."""
    splats = random_splats(300, seed=seed)
    splats.opacity[:] = splats.opacity.clip(0.2, 0.93)
    back = decode(spz, encode(spz, splats))
    blur = 2.0 ** -back.header["fractional_bits"]
    expected, area = splats.opacity * quantize.faces(splats.scale, blur), quantize.faces(back.splats.scale, blur)
    left = np.abs(back.splats.opacity * area / expected - 1)
    before = np.abs(splats.opacity * area / expected - 1)
    assert (left <= 0.51 / 255 / splats.opacity * 1.08 + 1e-4).all()
    assert np.square(left).mean() < np.square(before).mean() / 4


def test_merged_splats_cover_what_they_did() -> None:
    splats = random_splats(400, seed=3)
    opacity = np.geomspace(1.2, 1000, 400).astype(np.float32)
    held = rounded(splats.scale)
    kept = quantize.compensated(opacity, splats.scale, held, 0.0)
    expected, area = integral(opacity) * quantize.faces(splats.scale, 0), quantize.faces(held, 0)
    off = np.abs(integral(kept) * area / expected - 1)
    assert off.max() < 0.012  # of 0.06
    assert (np.abs(kept - opacity) > 0).all()
    barely = np.full(400, 1.001, np.float32)
    assert (quantize.compensated(barely, splats.scale, held, 0.0) > 1).all()  # they keep their falloff


@pytest.mark.parametrize("opacity", [0.0, 0.5, 1.0, 1.5, 1000.0])
@pytest.mark.parametrize("blur", [0.0, 1e-3])
def test_what_is_not_rounded_stays_bit_for_bit(opacity: float, blur: float) -> None:
    scale = np.concatenate([random_splats(50).scale, np.zeros((1, 3), np.float32)])
    column = np.full(len(scale), opacity, np.float32)
    assert quantize.compensated(column, scale, scale.copy(), blur).tobytes() == column.tobytes()


def test_what_is_thinner_than_a_step_of_positions_makes_no_splat_fainter() -> None:
    """A speck or a wire, of which a pixel shows as much however thin it is."""
    opacity, least = np.full(2, 0.8, np.float32), np.float32(np.exp(-10))
    scale = np.array([[1e-9, 1e-9, 1e-9], [0.5, 1e-8, 1e-7]], np.float32)
    held = np.maximum(scale, least)
    assert (quantize.compensated(opacity, scale, held, 1e-3) > 0.79).all()
    # In a scene of such splats a pixel is as small, up to what cannot be told from a speck.
    np.testing.assert_allclose(quantize.compensated(opacity, scale, held, 0.0), [0.8 * quantize.LEAST_GROWTH] * 2)


@pytest.mark.filterwarnings("error")
def test_what_shrinks_to_the_largest_code_does_not_get_dense() -> None:
    opacity = np.array([0.5, 2, 1000], np.float32)
    scale = np.full((3, 3), 1e9, np.float32)
    kept = quantize.compensated(opacity, scale, rounded(scale), 1.0)
    assert kept[0] == pytest.approx(0.5 * quantize.MOST_GROWTH)
    assert np.isfinite(kept).all()
    assert np.isfinite(quantize.compensated(opacity, np.zeros_like(scale), np.zeros_like(scale), 0.0)).all()


@pytest.mark.parametrize("lod", [False, True])
@pytest.mark.parametrize("codec", [spz, rad])
@given(SEEDS, st.integers(0, 3))
@settings(max_examples=15)
def test_what_was_read_is_written_as_it_is(codec: ModuleType, lod: bool, seed: int, degree: int) -> None:
    """SPZ with the same fractional bits: its other choices follow the values, which are where they were put. RAD with
    the same choices."""
    splats = random_splats(60, sh_degree=degree, seed=seed, extent=0.02)
    splats.sh[:] *= np.random.default_rng(seed).choice([0.1, 1, 4])
    scene = Scene(*quick.build(splats)) if lod else Scene(splats)
    options = codec.settled(scene, WriteOptions())
    if codec is spz:
        options = WriteOptions(fractional_bits=options.fractional_bits)
    once = decode(codec, encode(codec, scene, options))
    assert_same(decode(codec, encode(codec, once, options)).splats, once.splats, but="quat_xyzw")
