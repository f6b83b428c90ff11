"""Budgets, levels and regions as people write them, and numbers that are refused or questioned."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest

from sparklod_cli.lod.budget import LARGEST, Budget, doubt, parse_budget, parse_budgets
from sparklod_cli.lod.tree_settings import MOST_LEVELS, DetailSettings, parse_levels
from sparklod_cli.system.units import parse_count, parse_size


def test_budgets_are_shares_or_counts() -> None:
    some = parse_budgets("2%, 12.5 %,500k,1000,.5%")
    assert [budget.text for budget in some] == ["2%", "12.5 %", "500k", "1000", ".5%"]
    assert [budget.of(8000) for budget in some] == [160, 1000, 500_000, 1000, 40]
    assert parse_budget("0.001%").of(10) == 1  # there is always something to draw
    assert parse_budget("29%").share == Fraction(29, 100)  # and not 28.999 %
    assert parse_budget(str(LARGEST)).of(1) == LARGEST == int(float(LARGEST))  # whole numbers in every table
    assert [budget.count for budget in parse_budgets("250,500")] == [250, 500]
    assert [budget.text for budget in parse_budgets("2.125%,0.5k,1.500k")] == ["2.125%", "0.5k", "1.500k"]


@pytest.mark.parametrize("text", ["", ",", "0%", "0", "-5%", "5 percent", "1%5%", "nan%", "2.5", "5%,lots", "1e60"])
def test_other_texts_are_no_budgets(text: str) -> None:
    with pytest.raises(ValueError, match=r"budget|neither"):
        parse_budgets(text)
    with pytest.raises(ValueError, match=r"from 1 to 2\^53"):
        parse_budget(str(LARGEST + 1))


@pytest.mark.parametrize("scale", [1e-9, 0.3, 1.0, 2.5])
def test_a_scale_multiplies_counts_and_shares(scale: float) -> None:
    for leaves in (1, 999, 10**7):
        assert replace(Budget.of_count(5000), scale=scale).of(leaves) == max(1, int(5000 * scale))
        assert replace(parse_budget("25%"), scale=scale).of(leaves) == max(1, int(leaves / 4 * scale))


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
    parsers = [parse_budget, parse_count, parse_size]
    for parse in [*parsers, parse_budgets] if ",0" in text else parsers:
        with pytest.raises(ValueError, match=rf"has digits in groups; did you mean {meant}\?$"):
            parse(text)


@pytest.mark.parametrize(
    ("text", "question"),
    [
        ("1", "1 means 1 splat; did you mean 1k or 1%?"),
        ("5", "5 means 5 splats; did you mean 5k or 5%?"),
        ("99", "99 means 99 splats; did you mean 99k or 99%?"),
        ("100", ""),
        ("500k", ""),
        ("0.001%", ""),
    ],
)
def test_a_count_that_is_probably_a_mistake_is_questioned(text: str, question: str) -> None:
    assert doubt(parse_budget(text).count) == question


def test_levels_are_shares_of_full_detail() -> None:
    assert parse_levels("auto") is None
    assert parse_levels(" 50%, 12.5% ,.5%") == (0.5, 0.125, 0.005)
    assert len(parse_levels(",".join(f"{share}%" for share in range(MOST_LEVELS, 0, -1))) or ()) == MOST_LEVELS


@pytest.mark.parametrize("text", ["", "50", "0.5", "50%,", "50%,50%", "25%,50%", "100%", "0%", "-5%", "50% 25%"])
def test_other_texts_are_no_levels(text: str) -> None:
    with pytest.raises(ValueError, match="is neither auto nor shares of full detail such as 50%,25%,12%"):
        parse_levels(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"levels": ()}, r"levels are \(\); give 1 to 15 shares below 1 and above 0, descending"),
        ({"levels": (0.5, float("nan"))}, "levels are"),
        ({"levels": tuple(1 / (2 + each) for each in range(16))}, "give 1 to 15 shares"),
        ({"chunk_splats": 0}, "chunk_splats is 0; give 1 or more"),
        ({"extent": float("nan")}, "extent is nan; give more than 0"),
        ({"min_splats": -1}, "min_splats is -1; give 1 or more"),
    ],
)
def test_settings_of_regions_out_of_range_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DetailSettings(**arguments)
