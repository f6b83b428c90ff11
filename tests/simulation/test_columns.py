"""Columns are selected by name, in the order of the names."""

from __future__ import annotations

import pytest

from sparklod_cli.simulation.columns import COLUMNS, UnknownColumnError, select


class TestSelect:
    def test_no_selection_is_all_columns(self) -> None:
        assert select() == COLUMNS
        assert select(timing=False) == COLUMNS[:-1]

    def test_the_order_is_that_of_the_names(self) -> None:
        assert [column.name for column in select(["churn", "frame", "churn"])] == ["churn", "frame"]

    def test_an_unknown_column_is_an_error_with_a_suggestion(self) -> None:
        with pytest.raises(UnknownColumnError, match=r"^there is no column 'chrun', did you mean churn\?$"):
            select(["frame", "chrun"])
        with pytest.raises(UnknownColumnError, match=r"^there is no column 'zzz'$"):
            select(["zzz"])
