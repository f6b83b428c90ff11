"""Levels and regions that are asked for: their texts, and numbers that mean nothing."""

from __future__ import annotations

from typing import Any

import pytest

from sparklod_cli.lod.tree_settings import MOST_LEVELS, DetailSettings, parse_levels


def test_shares_of_levels_are_read() -> None:
    assert parse_levels("auto") is None
    assert parse_levels(" 50%, 12.5% ,.5%") == (0.5, 0.125, 0.005)
    assert len(parse_levels(",".join(f"{share}%" for share in range(MOST_LEVELS, 0, -1))) or ()) == MOST_LEVELS


@pytest.mark.parametrize("text", ["", "50", "0.5", "50%,", "50%,50%", "25%,50%", "100%", "0%", "-5%", "50% 25%"])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is neither auto nor shares of full detail such as 50%,25%,12%"):
        parse_levels(text)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"levels": ()}, r"levels are \(\); give 1 to 15 shares below 1 and above 0, descending"),
        ({"levels": (0.5, float("nan"))}, "levels are"),
        ({"levels": tuple(1 / (2 + each) for each in range(16))}, "give 1 to 15 shares"),
        ({"chunk_splats": 0}, "chunk_splats is 0; give 1 or more"),
        ({"extent": float("nan")}, "extent is nan; give more than 0"),
        ({"min_splats": -1}, "min_splats is -1; give 1 or more"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(how: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DetailSettings(**how)
