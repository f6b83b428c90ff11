"""docs/cameras.md: its examples are read, its table has all formats."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.formats.colmap import MODELS
from sparklod_cli.cameras.formats.table import FORMATS, PLAYCANVAS
from tests.cameras.known import text_file
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "cameras.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```(json|csv)\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize(("kind", "example"), EXAMPLES)
def test_the_examples_can_be_read(kind: str, example: str) -> None:
    path = read(text_file(example, f"example.{kind}"))
    assert path.format == ("sparklod's CSV" if kind == "csv" else "sparklod's JSON")
    assert path.notes == ()
    first = path.cameras[0]
    assert np.allclose(first.position, (0, 0, -5))
    assert np.allclose(first.forward, (0, 0, 1))
    if len(path.cameras) == 3:
        assert np.allclose(path.cameras[1].camera_to_world, first.camera_to_world)


def test_there_are_three_examples() -> None:
    assert len(EXAMPLES) == 3


def test_the_table_has_all_formats_and_their_axes() -> None:
    rows = dict(re.findall(r"^\| `([a-z0-9-]+)` \|[^|]*\| ([^|]*) \|", PAGE, re.MULTILINE))
    for form in FORMATS:
        said = rows[form.name]
        assert said.startswith(f"`{form.axes.value}`" if form.axes else "eye and target"), form.name


def test_the_page_agrees_with_the_program() -> None:
    assert re.search(r"--world-transform [-01,]+", PLAYCANVAS).group() in PAGE  # type: ignore[union-attr]
    assert f"all {sum(focals > 0 for focals, _ in MODELS.values())} camera models" in PAGE
