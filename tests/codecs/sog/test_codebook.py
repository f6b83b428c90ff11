"""Codebooks: exact where they can be, and about as good as they can be elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.codecs.sog.codebook import CODES, codebook, nearest

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
