"""Charts show what is in the rows; where none can be drawn, that is said."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest

from sparklod_cli.figures import charts
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.packages import install_hint
from sparklod_cli.tables.columns import Row
from tests.figures.flights import count_of, marked, path_scene, pixels, plotted
from tests.tables.rows import flight, row

pytestmark = pytest.mark.slow


def test_a_chart_of_no_frames_is_an_error() -> None:
    with pytest.raises(SparklodError, match="nothing to draw"):
        plotted([])


def test_a_missing_matplotlib_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(
        SparklodError, match=f"--plot needs matplotlib: {re.escape(install_hint('render', package='matplotlib'))}"
    ) as caught:
        plotted(flight(3))
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("charting", "fresh")
def test_without_pyvista_there_are_charts_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    both = plotted(flight(5), path_scene=path_scene())
    assert both[1] is not None
    assert install_hint("render", package="pyvista") in both[1]
    assert both[0] == plotted(flight(5))[0]


@pytest.mark.parametrize("most", [0, 1, 2, 3, 7, 999, 12_345, 2_500_000])
def test_ticks_of_counts_are_integers(most: int, charting: None) -> None:
    matplotlib = charts.load_matplotlib()
    figure = matplotlib.figure.Figure()
    matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_ylim(0, 1.22 * most or 1)
    charts._counted(axes, matplotlib)
    figure.canvas.draw()
    texts = [text.get_text() for text in axes.get_yticklabels()]
    assert len(texts) >= 2
    assert all("m" not in text and (text.isdigit() or text[-1] in "kM") for text in texts), texts


@pytest.mark.usefixtures("charting")
class TestCharts:
    def test_a_chart_has_its_width_and_the_same_rows_give_the_same_picture(self) -> None:
        made = plotted(flight(60))
        assert plotted(flight(60)) == made
        image = pixels(made[0])
        assert image.shape[1] == charts.WIDTH
        assert image.shape[0] > charts.ROW * len(charts.PANELS) / 2

    def test_frames_to_look_at_are_marked(self) -> None:
        quiet = flight(60)
        for each in quiet:
            each |= dict.fromkeys(("churn", "bytes_new", "missing", "complete_in_s", "overdraw_estimate"), 0)
            each["pixel_scale_min"] = each["pixel_scale_limit"]
        assert count_of(pixels(plotted(flight(60))[0]), charts.PINK) > 500
        assert count_of(pixels(plotted(quiet)[0]), charts.PINK) == 0

    def test_empty_columns_leave_their_panel_out(self) -> None:
        rows = flight(60)
        every = charts.draw_charts(rows, marked(rows)).shape[0]
        assert every == charts.ROW * 5
        fewer = charts.draw_charts([each | dict.fromkeys(("traverse_ms", "complete_in_s"), None) for each in rows], {})
        assert fewer.shape[0] == charts.ROW * 4

    @pytest.mark.parametrize("panel", charts.PANELS, ids=lambda panel: panel.title)
    def test_each_panel_shows_its_columns(self, panel: charts.Panel, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(charts, "PANELS", (panel,))
        rows = flight(60)
        before = charts.draw_charts(rows, marked(rows))
        for name in panel.columns:
            other = [each | {name: (each[name] or 0) * (1.1 + at % 7)} for at, each in enumerate(rows)]  # type: ignore[operator]
            assert not np.array_equal(charts.draw_charts(other, marked(other)), before), name

    def test_a_path_of_one_frame_has_a_chart_of_full_width(self) -> None:
        assert pixels(plotted(flight(1))[0]).shape[1] == charts.WIDTH

    @pytest.mark.parametrize(
        "cells",
        [
            {},
            {"selected": 0, "leaves": 0, "interior": 0, "budget": 0, "in_frustum": 0, "outside": 0, "behind": 0},
            {"pixel_scale_min": 0.0, "pixel_scale_limit": 0.0},
            {"pixel_scale_min": 0.0, "pixel_scale_limit": 1.0},
            {"bytes_new": 10**15, "missing": 0, "chunks_resident": 0, "churn": 0.0, "time_s": 0.0},
        ],
    )
    @pytest.mark.filterwarnings("error")
    def test_rows_of_any_cells_are_drawn(self, cells: dict[str, int | float]) -> None:
        rows: list[Row] = [row(frame, **cells) for frame in range(4)]
        assert plotted(rows)[1] is None

    @pytest.mark.parametrize("title", ["$x\n城.spz", "", "w" * 1000])
    def test_any_name_can_be_a_title(self, title: str) -> None:
        assert plotted(flight(3), title)[0]

    @pytest.mark.parametrize(("limit", "said"), [(0.001, "edges from the root"), (None, "level")])
    def test_levels_without_pixel_scales_are_detail_levels(self, limit: float | None, said: str) -> None:
        matplotlib = charts.load_matplotlib()
        (panel,) = (each for each in charts.PANELS if "level_mean" in each.columns)
        axes = matplotlib.figure.Figure().subplots()
        panel.draw(axes, charts.FrameColumns([each | {"pixel_scale_limit": limit} for each in flight(4)]), matplotlib)
        assert axes.get_ylabel() == said

    def test_a_chart_leaves_single_instances_out(self) -> None:
        rows = flight(20)
        assert plotted([*rows, *(each | {"instance": "tree"} for each in rows)], "a") == plotted(rows, "a")

    def test_a_matplotlibrc_changes_nothing(self) -> None:
        import matplotlib

        before = charts.draw_charts(flight(5), {})
        with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 30, "axes.grid": False}):
            assert np.array_equal(charts.draw_charts(flight(5), {}), before)

    def test_pyplot_is_left_alone(self) -> None:
        """It would keep every figure, and ask for a display."""
        program = (
            "import sys; from tests.tables.rows import flight; from sparklod_cli.figures import charts\n"
            "charts.draw_charts(flight(3), {}); assert 'matplotlib.pyplot' not in sys.modules"
        )
        subprocess.run([sys.executable, "-c", program], check=True)
