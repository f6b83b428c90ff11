"""Charts and the picture of the path in one; what cannot be drawn is said or left out."""

from __future__ import annotations

import sys

import pytest

from sparklod_cli.figures.traversal_chart import plot
from sparklod_cli.support.errors import SparklodError
from tests.figures.flights import scenery
from tests.tables.rows import flight


def test_a_chart_of_no_frames_is_an_error() -> None:
    with pytest.raises(SparklodError, match="nothing to draw"):
        plot([], "scene.spz")


def test_matplotlib_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SparklodError, match=r"pip install 'sparklod\[render\]'") as caught:
        plot(flight(3), "scene.spz")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("charting", "fresh")
def test_without_pyvista_there_are_charts_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    plotted = plot(flight(5), "scene.spz", scenery())
    assert plotted.note is not None
    assert "sparklod[render]" in plotted.note
    assert plotted.png == plot(flight(5), "scene.spz").png
