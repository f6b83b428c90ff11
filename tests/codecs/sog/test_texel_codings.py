"""Number codings of SOG: each decoder's largest error, and what is written again stays the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.sog import texel_codings as codings
from sparklod_cli.codecs.sog.texel_codings import CODES, codebook, even_codebook, nearest
from sparklod_cli.model.gaussian import normalized_quat
from tests.codecs.cases import rotation_degrees, stated_degrees
from tests.references.sog_quats import decode_quat


def quats() -> np.ndarray:
    rng = np.random.default_rng(3)
    some = rng.normal(size=(20_000, 4)).astype(np.float32)
    axes = np.concatenate([np.eye(4), -np.eye(4)]).astype(np.float32)
    halves = np.array([[a, b, c, d] for a in (1, -1) for b in (1, -1) for c in (1, -1) for d in (1, -1)], np.float32)
    return np.ascontiguousarray(normalized_quat(np.concatenate([some, axes, halves])))


def test_rotations_come_back_within_the_stated_error() -> None:
    given = quats()
    back = decode_quat(codings.encode_quat(given))
    assert rotation_degrees(back, given).max() <= stated_degrees(codings.quat_components)


def test_a_rotation_and_its_opposite_have_the_same_code() -> None:
    np.testing.assert_array_equal(codings.encode_quat(quats()), codings.encode_quat(-quats()))


@pytest.mark.parametrize("ends", [(-2.0, 3.0), (0.0, 1e-30), (-3e38, 3e38), (1e6, 1e6)])
def test_coordinates_come_back_within_half_a_step(ends: tuple[float, float]) -> None:
    center = np.random.default_rng(4).uniform(-1, 1, (5000, 3))
    center = ((center + 1) / 2 * (ends[1] / 2 - ends[0] / 2) * 2 + ends[0]).astype(np.float32)
    low, high = codings.sign_log(center.min(axis=0)), codings.sign_log(center.max(axis=0))
    words = codings.encode_center(center, low, high)
    table = codings.center_table(low, high)
    back = np.stack([table[axis][words[:, axis]] for axis in range(3)], axis=1)
    off = np.abs(codings.sign_log(back) - codings.sign_log(center))
    half = (high - low) / codings.LAST_WORD / 2
    assert (off <= half * 1.001 + 1e-7 * np.abs(codings.sign_log(center))).all()
    np.testing.assert_array_equal(codings.encode_center(back, low, high), words)
    np.testing.assert_array_equal(back.min(axis=0), center.min(axis=0))
    np.testing.assert_array_equal(back.max(axis=0), center.max(axis=0))


NUMBERS = st.floats(-(2.0**50), 2.0**50, width=32)


def error(values: np.ndarray, book: np.ndarray) -> float:
    return float(((values.astype(np.float64) - book[nearest(values, book)]) ** 2).mean())


@given(arrays(np.float32, st.integers(1, 300), elements=NUMBERS))
def test_few_numbers_are_exact_and_any_book_is_ascending_and_keeps_the_range(values: np.ndarray) -> None:
    book = codebook(values)
    assert (book.dtype, book.shape) == (np.float32, (CODES,))
    assert (np.diff(book.astype(np.float64)) >= 0).all()
    assert (book[0], book[-1]) == (values.min(), values.max())
    if len(np.unique(values)) <= CODES:
        np.testing.assert_array_equal(book[nearest(values, book)], values)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 9.0]))
def test_no_other_code_is_nearer(seed: int, spread: float) -> None:
    values = np.random.default_rng(seed).lognormal(0, spread, 600).astype(np.float32)
    book = codebook(values).astype(np.float64)
    off = np.abs(values - book[nearest(values, book.astype(np.float32))])
    np.testing.assert_array_equal(off, np.abs(values[:, None] - book).min(axis=1))


@given(st.integers(0, 2**32 - 1), st.floats(1, 150), st.floats(0, 100))
def test_no_number_is_far_from_an_even_book(seed: int, extent: float, gap: float) -> None:
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.uniform(0, extent, 600), [-gap - 1]]).astype(np.float32)
    book = even_codebook(values)
    assert book[0] == values.min()
    assert (np.diff(book) >= 0).all()
    assert np.abs(values - book[nearest(values, book)]).max() <= np.ptp(values[:-1]) / 254 / 2 * 1.001 + 1e-5


def test_codes_have_the_shape_of_their_numbers() -> None:
    values = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    np.testing.assert_array_equal(nearest(values, codebook(values)), values)


DISTRIBUTIONS = {
    "even": lambda rng: rng.uniform(-3, 5, 40_000),
    "normal": lambda rng: rng.normal(-5, 1, 40_000),
    "two heaps": lambda rng: np.concatenate([rng.normal(-9, 0.1, 20_000), rng.normal(3, 0.5, 20_000)]),
    "heavy tails": lambda rng: rng.standard_t(2, 40_000),
    "few values often, others rarely": lambda rng: np.where(
        rng.random(40_000) < 0.99, np.rint(rng.normal(0, 20, 40_000)), rng.normal(0, 20, 40_000)
    ),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_a_book_is_better_than_equal_steps_and_not_far_from_the_best(name: str) -> None:
    values = DISTRIBUTIONS[name](np.random.default_rng(1)).astype(np.float32)
    found = error(values, codebook(values))
    assert found < 1.001 * error(values, np.linspace(values.min(), values.max(), CODES, dtype=np.float32))
    if name in ("even", "normal"):
        # Panter and Dite's least error of N codes: (integral of density ** (1 / 3)) ** 3 / (12 * N ** 2).
        least = 8**2 / 12 / CODES**2 if name == "even" else 3**0.5 * np.pi / 2 / CODES**2
        assert found < 1.6 * least


def test_a_number_far_away_keeps_its_value_and_spoils_no_other() -> None:
    near = np.random.default_rng(2).normal(0, 1, 40_000).astype(np.float32)
    values = np.append(near, np.float32(-110))
    book = codebook(values)
    assert book[nearest(values[-1:], book)] == -110
    assert error(near, book) < 3 * error(near, codebook(near))
