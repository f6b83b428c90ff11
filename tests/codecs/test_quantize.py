"""Every coding keeps the largest error that it states, reaches it, and takes its own codes back unchanged."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs import quantize
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity, normalized_quat
from sparklod_cli.model.sh import SH_C0

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
def test_every_decoded_byte_is_encoded_the_same(name: str) -> None:
    encode, decode = BYTE_CODINGS[name]
    np.testing.assert_array_equal(encode(decode(CODES)), CODES)


@pytest.mark.parametrize("name", BYTE_CODINGS)
def test_codings_are_monotonic_and_float32(name: str) -> None:
    decoded = BYTE_CODINGS[name][1](CODES)
    assert decoded.dtype == np.float32
    assert (np.diff(decoded) > 0).all()


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
def test_log_scale_is_off_by_a_factor(values: np.ndarray) -> None:
    scale = np.exp(values)
    ratio = quantize.decode_log_scale(quantize.encode_log_scale(scale)) / scale
    assert np.abs(np.log(ratio)).max() <= ROUNDING / 32


def test_log_scale_reaches_its_error() -> None:
    scale = np.exp(np.linspace(-10, 5.94, 100_001)).astype(np.float32)
    error = np.abs(np.log(quantize.decode_log_scale(quantize.encode_log_scale(scale)) / scale)).max()
    assert error >= 0.98 / 32


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("log scale", 0.0, 0),
        ("log scale", 1e-45, 0),
        ("log scale", 3e38, 255),
        ("log scale", 1.0, 160),
        ("opacity", -0.1, 0),
        ("opacity", 1.5, 255),
        ("opacity", 0.5, 128),  # 127.5, a tie: to even
        ("opacity", 0.1, 26),  # 25.5 in float32, so up to even
        ("lod opacity", 0.0, 0),
        ("lod opacity", 1.0, 127),  # a tie that must not become a merged splat
        ("lod opacity", 1.0001, 128),
        ("lod opacity", 5.0, 255),
        ("lod opacity", 7.0, 255),
        ("color", -0.45, 0),
        ("color", 1.45, 255),
        ("color", -3e38, 0),  # finite, and clamped without a word on standard error
        ("color", 3e38, 255),
        ("color", 0.5, 128),  # 127.5, a tie: to even
    ],
)
def test_ends_of_ranges_and_ties_have_the_codes_stated(name: str, value: float, code: int) -> None:
    assert BYTE_CODINGS[name][0](np.array([value], np.float32)).tolist() == [code]


def test_lod_opacity_bytes_survive_being_linear() -> None:
    """An LoD file that is read and written again keeps its alphas: the way goes through linear opacity and back."""
    linear = linear_opacity(quantize.decode_lod_opacity(CODES))
    np.testing.assert_array_equal(quantize.encode_lod_opacity(lod_opacity(linear)), CODES)


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


@pytest.mark.parametrize("coefficients", [3, 8, 15])
def test_sh_beyond_their_range_are_clamped(coefficients: int) -> None:
    values = np.array([-2.0, 2.0], np.float32)
    codes = quantize.encode_sh(in_all_coefficients(values)[:, :coefficients])
    assert codes.shape == (2, coefficients, 3)
    assert (codes[0] == 0).all()
    assert (codes[1] == 255).all()


@pytest.mark.filterwarnings("error")
def test_sh_clamps_what_overflows_quietly() -> None:
    codes = quantize.encode_sh(in_all_coefficients(np.array([-3e38, 3e38], np.float32)))
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


def rotation_degrees(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) angle of the rotation between two rotations; by the chord, which is exact for small angles."""
    one, other = one.astype(np.float64), other.astype(np.float64)
    one, other = (quat / np.linalg.norm(quat, axis=1, keepdims=True) for quat in (one, other))
    sign = np.where(np.einsum("ij,ij->i", one, other) < 0, -1, 1)
    return np.degrees(4 * np.arcsin(np.linalg.norm(one - sign[:, None] * other, axis=1) / 2))


def stated_degrees(decode: Coder) -> float:
    """What the docstring promises; so it cannot be wrong for long."""
    match = re.search(r"Largest error: ([\d.]+) degrees", decode.__doc__ or "")
    assert match
    return float(match[1])


def random_quats(count: int) -> np.ndarray:
    quats = np.random.default_rng(5).normal(size=(count, 4))
    quats[: count // 4, 3] *= 0.01  # near half a turn, where w is what is left over
    return np.ascontiguousarray(normalized_quat(quats.astype(np.float32)))


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
