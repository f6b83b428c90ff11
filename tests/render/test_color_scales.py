"""Marks of an axis are round numbers."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.render.color_scales import nice_step, ticks


@given(st.floats(1e-12, 1e12))
def test_a_nice_step_is_1_2_or_5_and_not_much_more_than_asked_for(least: float) -> None:
    step = nice_step(least)
    assert least * (1 - 1e-6) <= step <= 2.5 * least * (1 + 1e-6)
    assert f"{step:.0e}"[0] in "125"


def test_ticks_are_the_round_numbers_in_a_range() -> None:
    assert [text for _, text in ticks(-0.31, 0.52, 0.15)] == ["-0.2", "0.0", "0.2", "0.4"]
    assert [text for _, text in ticks(-3, 12, 4)] == ["0", "5", "10"]
    assert [text for _, text in ticks(0, 3e9, 1e9)] == ["0", "1e+09", "2e+09", "3e+09"]
