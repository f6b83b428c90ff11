"""Budgets as people write them."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest

from sparklod_cli.lod.budget import LARGEST, Budget, doubt, parse_budget, parse_budgets
from sparklod_cli.system.units import parse_count, parse_size


def test_budgets_are_shares_or_counts() -> None:
    some = parse_budgets("2%, 12.5 %,500k,1000,.5%")
    assert [budget.text for budget in some] == ["2%", "12.5 %", "500k", "1000", ".5%"]
    assert [budget.of(8000) for budget in some] == [160, 1000, 500_000, 1000, 40]
    assert parse_budget("0.001%").of(10) == 1  # there is always something to draw
    assert parse_budget("29%").share == Fraction(29, 100)  # and not 28.999 %


@pytest.mark.parametrize("text", ["", ",", "0%", "0", "-5%", "5 percent", "1%5%", "nan%", "2.5", "5%,lots", "1e60"])
def test_what_is_no_budget_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"budget|neither"):
        parse_budgets(text)


def test_the_largest_count_is_a_whole_number_in_every_table() -> None:
    assert parse_budget(str(LARGEST)).of(1) == LARGEST == int(float(LARGEST))
    with pytest.raises(ValueError, match=r"from 1 to 2\^53"):
        parse_budget(str(LARGEST + 1))


@pytest.mark.parametrize("scale", [1e-9, 0.3, 1.0, 2.5])
def test_a_scale_multiplies_counts_and_shares(scale: float) -> None:
    for leaves in (1, 999, 10**7):
        assert replace(Budget.of_count(5000), scale=scale).of(leaves) == max(1, int(5000 * scale))
        assert replace(parse_budget("25%"), scale=scale).of(leaves) == max(1, int(leaves / 4 * scale))
    assert replace(parse_budget("40%"), scale=0.25).of(1000) == 100


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("500.000", "500000 or 500k"),
        ("500,000", "500000 or 500k"),
        ("500 000", "500000 or 500k"),
        ("500'000", "500000 or 500k"),
        ("500_000", "500000 or 500k"),
        ("1.000.000", "1000000 or 1000k"),
        ("1,000,000", "1000000 or 1000k"),
        ("1.500", "1500"),
        ("1\u202f000", "1000 or 1k"),
    ],
)
def test_digits_in_groups_are_refused_with_the_number_that_is_probably_meant(text: str, meant: str) -> None:
    for parse in (parse_budget, parse_count, parse_size):
        with pytest.raises(ValueError, match=rf"has digits in groups; did you mean {meant}\?$"):
            parse(text)


def test_lists_of_budgets_and_decimals_are_no_groups() -> None:
    assert [budget.count for budget in parse_budgets("250,500")] == [250, 500]
    for text in ("500,000", "1,000,000"):
        with pytest.raises(ValueError, match="has digits in groups"):
            parse_budgets(text)
    assert [budget.text for budget in parse_budgets("2.125%,0.5k,1.500k")] == ["2.125%", "0.5k", "1.500k"]


@pytest.mark.parametrize(
    ("text", "question"),
    [
        ("1", "1 means 1 splat; did you mean 1k or 1%?"),
        ("5", "5 means 5 splats; did you mean 5k or 5%?"),
        ("99", "99 means 99 splats; did you mean 99k or 99%?"),
        ("100", ""),
        ("500k", ""),
        ("5%", ""),
        ("0.001%", ""),
    ],
)
def test_a_count_that_cannot_be_meant_is_questioned(text: str, question: str) -> None:
    assert doubt(parse_budget(text).count) == question
