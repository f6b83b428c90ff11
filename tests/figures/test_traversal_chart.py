"""Charts and the picture of the path in one; what cannot be drawn is said or left out."""

from __future__ import annotations

import re
import sys

import pytest

from sparklod_cli.support.errors import SparklodError
from sparklod_cli.support.optional import install_hint
from tests.figures.flights import path_scene, plotted
from tests.tables.rows import flight

pytestmark = pytest.mark.slow


def test_a_chart_of_no_frames_is_an_error() -> None:
    with pytest.raises(SparklodError, match="nothing to draw"):
        plotted([])


def test_a_missing_matplotlib_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SparklodError, match=re.escape(install_hint("render"))) as caught:
        plotted(flight(3))
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("charting", "fresh")
def test_without_pyvista_there_are_charts_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    both = plotted(flight(5), path_scene=path_scene())
    assert both.note is not None
    assert install_hint("render") in both.note
    assert both.png == plotted(flight(5)).png
