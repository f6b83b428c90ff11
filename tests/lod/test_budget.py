"""Budgets as people write them."""

from __future__ import annotations

from fractions import Fraction

import pytest

from sparklod_cli.lod.budget import LARGEST, Budget, parse_budget, parse_budgets


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
        assert Budget.of_count(5000).scaled(scale).of(leaves) == max(1, int(5000 * scale))
        assert parse_budget("25%").scaled(scale).of(leaves) == max(1, int(leaves / 4 * scale))
    assert parse_budget("40%").scaled(0.5).scaled(0.5).of(1000) == 100
