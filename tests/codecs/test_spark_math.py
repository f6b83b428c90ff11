"""Spark's exponential and logarithm: within a unit of the last place, and some numbers that tell them from numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.codecs import spark_math

HALVES = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)


def units_apart(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.int64]:
    """Distances in units of the last place, of numbers of equal signs."""
    np.testing.assert_array_equal(np.signbit(one), np.signbit(other))
    return np.abs(one.view(np.int32).astype(np.int64) - other.view(np.int32))


def test_exponentials_are_within_a_unit_of_the_last_place() -> None:
    finite = HALVES[np.isfinite(HALVES)]
    with np.errstate(over="ignore", under="ignore"):
        nearest = np.exp(finite.astype(np.float64)).astype(np.float32)
    apart = units_apart(spark_math.exp(finite), nearest)
    assert apart.max() == 1
    assert 0.01 < np.mean(apart[(finite > -80) & (finite < 80)]) < 0.1


def test_logarithms_are_within_a_unit_of_the_last_place() -> None:
    """Of every kind of positive number, the subnormal ones, too."""
    values = np.linspace(1, 0x7F7FFFFF, 1_000_003).astype(np.uint32).view(np.float32)
    apart = units_apart(spark_math.log(values), np.log(values.astype(np.float64)).astype(np.float32))
    assert apart.max() == 1
    assert 0.001 < apart.mean() < 0.05


@pytest.mark.parametrize(("value", "expected"), [(np.inf, np.inf), (-np.inf, 0), (100, np.inf), (-110, 0), (0, 1)])
def test_exponentials_of_the_ends(value: float, expected: float) -> None:
    assert spark_math.exp(np.array([value], np.float32)).tolist() == [expected]


@pytest.mark.parametrize(("value", "expected"), [(np.inf, np.inf), (0, -np.inf), (1, 0)])
def test_logarithms_of_the_ends(value: float, expected: float) -> None:
    assert spark_math.log(np.array([value], np.float32)).tolist() == [expected]


def test_what_is_no_number_stays_none() -> None:
    values = np.array([np.nan, -1], np.float32)
    assert np.isnan(spark_math.log(values)).all()
    assert np.isnan(spark_math.exp(values[:1])).all()


def test_exponential_and_logarithm_are_those_of_msun() -> None:
    """Of four of SPZ's scales: two exponentials are not the nearest float32, and one logarithm is not the number."""
    logs = np.array([-9.875, -6.75, -0.625, 3.75], np.float32)
    exponentials = spark_math.exp(logs)
    assert exponentials.view(np.uint32).tolist() == [945276544, 983136307, 1057556197, 1110054294]
    assert spark_math.log(exponentials).view(np.uint32).tolist() == [3239968768, 3235381248, 3206545407, 1081081856]
