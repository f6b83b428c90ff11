"""What Spark's in-memory layouts share keeps the largest errors that it states, and reaches them."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from sparklod_cli.codecs import spark_codings, spark_nodes
from sparklod_cli.codecs.spark_codings import STEPS_8_8_8, STEPS_10_10_12
from sparklod_cli.model.gaussian import normalized_quat
from tests.codecs.cases import random_quats, rotation_degrees

Steps = tuple[int, int]
BOTH = pytest.mark.parametrize("steps", [STEPS_8_8_8, STEPS_10_10_12])
HALF_TURN = np.float32(0.5**0.5)


def stated_degrees(steps: Steps) -> float:
    """What the docstring promises; so it cannot be wrong for long."""
    name = {STEPS_8_8_8: "STEPS_8_8_8", STEPS_10_10_12: "STEPS_10_10_12"}[steps]
    match = re.search(rf"([\d.]+)(?: degrees of rotation)? for `{name}`", spark_codings.decode_axis_angle.__doc__ or "")
    assert match
    return float(match[1])


def round_trip(quats: np.ndarray, steps: Steps) -> np.ndarray:
    return spark_codings.decode_axis_angle(*spark_codings.encode_axis_angle(quats, steps), steps)


# --- Rotations --------------------------------------------------------------------------------------------------------


@BOTH
def test_rotations_keep_and_reach_their_error(steps: Steps) -> None:
    # Half-way between codes, all over the octahedron, for nearly half a turn.
    middles = np.arange(steps[0]) + 0.5
    u, v = (grid.ravel() for grid in np.meshgrid(middles, middles))
    between = spark_codings.decode_axis_angle(u, v, np.full(u.size, steps[1] - 0.5), steps)
    error = rotation_degrees(between, round_trip(between, steps)).max()
    assert 0.99 * stated_degrees(steps) <= error <= stated_degrees(steps)
    quats = random_quats(200_000)
    assert rotation_degrees(quats, round_trip(quats, steps)).max() <= stated_degrees(steps)


@BOTH
@given(quats=arrays(np.float32, (20, 4), elements=st.floats(-1, 1, width=32)))
def test_any_rotation_keeps_its_error(steps: Steps, quats: np.ndarray) -> None:
    quats = np.ascontiguousarray(normalized_quat(quats[np.abs(quats).max(axis=1) > 0]))
    assert rotation_degrees(quats, round_trip(quats, steps)).max(initial=0) <= stated_degrees(steps)


@BOTH
def test_both_signs_are_one_rotation_and_what_comes_back_is_unit(steps: Steps) -> None:
    quats = random_quats(1000)
    back = round_trip(quats, steps)
    np.testing.assert_array_equal(back, round_trip(-quats, steps))
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)
    assert back.dtype == np.float32
    assert (back[:, 3] >= -1e-7).all()


@pytest.mark.parametrize(
    ("quat", "u", "v", "angle"),
    [
        ([0, 0, 0, 1], 255, 128, 0),  # no rotation: the x axis; y = 0 is a tie, 127.5, and goes up
        ([0, 0, 0, -1], 255, 128, 0),
        ([1e-8, 2e-8, -3e-8, 1], 255, 128, 0),
        ([1, 0, 0, 0], 255, 128, 255),
        ([-1, 0, 0, 0], 0, 128, 255),
        ([0, 1, 0, 0], 128, 255, 255),
        ([0, 0, 1, 0], 128, 128, 255),
        ([0, 0, -1, 0], 255, 255, 255),  # the lower tip is all four corners
        ([0, 0, HALF_TURN, HALF_TURN], 128, 128, 128),
        ([0, 0, -HALF_TURN, -HALF_TURN], 128, 128, 128),
        ([-HALF_TURN, 0, -HALF_TURN, 0], 0, 191, 255),  # folded: x = -1, y = 1 / 2
    ],
)
def test_rotations_have_the_codes_worked_out_by_hand(quat: list[float], u: int, v: int, angle: int) -> None:
    codes = spark_codings.encode_axis_angle(np.array([quat], np.float32), STEPS_8_8_8)
    assert [int(code[0]) for code in codes] == [u, v, angle]


def test_small_turns_keep_their_axis() -> None:
    """By as little as float32 tells of w: 3.5e-4 is half the angle."""
    quats = np.array([[0, -4e-4, 0, 1 - 8e-8], [0, 3.5e-4, 0, 1 - 6e-8]], np.float32)
    u, v, angle = spark_codings.encode_axis_angle(quats, STEPS_10_10_12)
    assert (u.tolist(), v.tolist(), angle.tolist()) == ([512, 512], [0, 1023], [1, 1])


# --- Rounding and alpha -----------------------------------------------------------------------------------------------


def test_ties_go_up() -> None:
    values = np.array([0, 0.49999997, 0.5, 0.50000006, 1.5, 2.4999998, 2.5, 126.5, 254.49998, 254.5], np.float32)
    expected = [0, 0, 1, 1, 2, 2, 3, 127, 254, 255]
    np.testing.assert_array_equal(spark_codings.to_code(values, 255), expected)


def test_values_beyond_the_codes_become_the_first_or_last() -> None:
    values = np.array([-np.inf, -1e30, -0.6, 255.4, 1e30, np.inf], np.float32)
    assert spark_codings.to_code(values, 255).tolist() == [0, 0, 0, 255, 255, 255]


@pytest.mark.parametrize(("opacity", "alpha"), [(0, 0), (0.3, 0.3), (1, 1), (np.exp(3 / np.e), 1.25), (1000, 1.8618)])
def test_lod_alpha_is_opacity_up_to_1_and_d_above(opacity: float, alpha: float) -> None:
    """D is itself up to 1, 2 for exp(3 / e), 4.447 for 1000."""
    assert spark_codings.encode_lod_alpha(np.array([opacity], np.float32))[0] == pytest.approx(alpha, abs=1e-4)


@given(opacity=arrays(np.float32, 16, elements=st.floats(0, 1000, width=32)))
def test_decoding_lod_alpha_gives_the_opacity_back(opacity: np.ndarray) -> None:
    back = spark_codings.decode_lod_alpha(spark_codings.encode_lod_alpha(opacity))
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, opacity, rtol=2e-5)
    np.testing.assert_array_equal(back[opacity <= 1], opacity[opacity <= 1])


def test_the_alpha_that_an_opacity_was_decoded_from_is_found() -> None:
    """To the last bit, for every alpha of a merged splat that half floats, bytes or chance may give."""
    halves = np.arange(0x3C00, 0x4001, dtype=np.uint16).view(np.float16).astype(np.float32)
    alphas = [halves, np.arange(256, dtype=np.float32) / np.float32(255) * 2]
    alphas += [np.random.default_rng(0).uniform(0, 2, 200_000).astype(np.float32)]
    alphas += [np.linspace(0x3F800000, 0x3F800400, 1025).astype(np.int32).view(np.float32)]  # just above 1
    alpha = np.concatenate(alphas)
    opacity = spark_codings.decode_lod_alpha(alpha)
    found = spark_nodes.stored_lod_alpha(opacity)
    assert np.array_equal(spark_codings.decode_lod_alpha(found), opacity)
    assert np.array_equal(found, alpha)
    assert not np.array_equal(spark_codings.encode_lod_alpha(opacity), alpha)


def test_an_opacity_that_no_alpha_has_gets_the_nearest() -> None:
    opacity = np.random.default_rng(1).uniform(1, 900, 10_000).astype(np.float32)
    found = spark_nodes.stored_lod_alpha(opacity)
    assert np.abs(found - spark_codings.encode_lod_alpha(opacity)).max() < 1e-6


HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)


def units_apart(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.int64]:
    """Distances in units of the last place, of numbers of equal signs."""
    np.testing.assert_array_equal(np.signbit(one), np.signbit(other))
    return np.abs(one.view(np.int32).astype(np.int64) - other.view(np.int32))


def test_exponentials_are_within_a_unit_of_the_last_place() -> None:
    finite = HALVES[np.isfinite(HALVES)]
    with np.errstate(over="ignore", under="ignore"):
        nearest = np.exp(finite.astype(np.float64)).astype(np.float32)
    apart = units_apart(spark_nodes.exp(finite), nearest)
    assert apart.max() == 1
    assert 0.01 < np.mean(apart[(finite > -80) & (finite < 80)]) < 0.1


def test_logarithms_are_within_a_unit_of_the_last_place() -> None:
    """Of every kind of positive number, the subnormal ones, too."""
    values = np.linspace(1, 0x7F7FFFFF, 1_000_003).astype(np.uint32).view(np.float32)
    apart = units_apart(spark_nodes.log(values), np.log(values.astype(np.float64)).astype(np.float32))
    assert apart.max() == 1
    assert 0.001 < apart.mean() < 0.05


EXP, LOG = spark_nodes.exp, spark_nodes.log


@pytest.mark.parametrize(
    ("function", "values", "expected"),
    [
        (EXP, [np.inf, -np.inf, 100, -110, 0, np.nan], [np.inf, 0, np.inf, 0, 1, np.nan]),
        (LOG, [np.inf, 0, 1, np.nan, -1], [np.inf, -np.inf, 0, np.nan, np.nan]),
    ],
)
def test_ends_of_exponentials_and_logarithms(function: Callable, values: list[float], expected: list[float]) -> None:
    np.testing.assert_array_equal(function(np.array(values, np.float32)), expected)


def test_exponential_and_logarithm_are_those_of_msun() -> None:
    """Of four of SPZ's scales: two exponentials are not the nearest float32, and one logarithm is not the number."""
    logs = np.array([-9.875, -6.75, -0.625, 3.75], np.float32)
    exponentials = spark_nodes.exp(logs)
    assert exponentials.view(np.uint32).tolist() == [945276544, 983136307, 1057556197, 1110054294]
    assert spark_nodes.log(exponentials).view(np.uint32).tolist() == [3239968768, 3235381248, 3206545407, 1081081856]
