"""What the pages about `traverse` promise of columns, assertions and the summary."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from sparklod_cli.simulation.results import COLUMNS, LOADING, MOMENTS, QUANTITIES
from sparklod_cli.tables.assertions import check, parse
from tests.conftest import ROOT
from tests.docs.traverse_picture import example
from tests.tables.rows import flight

PAGE, TABLE = ROOT / "docs" / "traverse.md", ROOT / "docs" / "traverse-table.md"


def test_the_page_about_the_table_lists_the_columns() -> None:
    """Made by `python -m tests.docs.test_traverse_page`."""
    text = TABLE.read_text()
    assert with_columns(text) == text


def with_columns(text: str) -> str:
    """The page with all columns in the table of its section of that name."""
    pattern = re.compile(r"(?<=\n\| column \| type \| unit \| meaning \|\n\| --- \| --- \| --- \| --- \|\n)(?:\|.*\n)*")
    assert pattern.search(text)
    kinds = {int: "whole", float: "number", str: "text"}
    rows = (f"| `{each.name}` | {kinds[each.kind]} | {each.unit} | {each.meaning} |\n" for each in COLUMNS)
    table = "".join(rows)
    return pattern.sub(lambda _: table, text, count=1)


@pytest.mark.parametrize("text", re.findall(r"--assert '(.*?)'", PAGE.read_text()))
def test_assertions_on_the_page_are_understood(text: str) -> None:
    rows = [row | {column.name: 1 for column in LOADING} for row in flight(20)]
    assert check([parse(text, (*COLUMNS, *LOADING))], rows)


def test_the_page_names_what_is_in_the_summary() -> None:
    names = set(re.findall(r"`(\w+)`", PAGE.read_text().partition("\n## Summary\n")[2].partition("\n## ")[0]))
    assert set(QUANTITIES) | set(MOMENTS) | {column.name for column in LOADING} <= names


def test_the_biker_of_the_picture_stands_upright() -> None:
    """Its file has y up, unlike the others: half a turn about x takes that to -y, and a turn about y keeps it."""
    instances, arguments = example()
    assert "city.json" in arguments
    bikers = [each for each in json.loads(instances)["instances"] if each["file"].startswith("biker")]
    assert len(bikers) == 2
    for biker in bikers:
        x, y, z, w = biker["rotation"]
        assert np.allclose([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], [0, -1, 0], atol=1e-6)


if __name__ == "__main__":
    TABLE.write_text(with_columns(TABLE.read_text()))
