"""Cells of tables."""

from __future__ import annotations

import math

import pytest

from sparklod_cli.tables.columns import Column


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_number_that_is_not_finite_is_an_empty_cell(value: float) -> None:
    column = Column("size", float, ".3f", "px", "a size")
    assert column.rounded(value) is None
