"""Charts show what is in the rows, the picture shows the path; where none can be drawn, that is said."""

from __future__ import annotations

import io
import math
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.errors import SparklodError
from sparklod_cli.render import stage
from sparklod_cli.render.camera import Camera
from sparklod_cli.simulation import charts
from sparklod_cli.simulation.columns import Row
from sparklod_cli.simulation.path_picture import FRAME, _above, frustum_lines, picture_of_path
from sparklod_cli.simulation.plot import Scenery, plot
from tests.scenes import random_splats
from tests.tables.rows import flight, row

SIZE = (400, 250)


@pytest.fixture
def charting() -> None:
    """Skips where charts cannot be drawn."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")


@pytest.fixture
def drawing() -> None:
    """Skips where pictures cannot be drawn."""
    pytest.importorskip("pyvista", reason="pictures need the extra `render`")
    try:
        stage.load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))


@pytest.fixture
def fresh() -> Iterator[None]:
    """Makes pyvista be looked for again."""
    stage.load_pyvista.cache_clear()
    yield
    stage.load_pyvista.cache_clear()


def looking(position: tuple[float, float, float], up: tuple[float, float, float] = (0, -1, 0)) -> Camera:
    """A camera that looks at the origin."""
    forward = -np.array(position) / np.linalg.norm(position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, forward), -forward], 1)
    pose[:3, 3] = position
    focal = 450 / math.tan(math.radians(25))
    return Camera(pose, 1600, 900, (focal, focal), (800, 450))


def circle(count: int = 20, radius: float = 6) -> list[Camera]:
    angles = np.linspace(0, 4, count)
    return [looking((radius * math.cos(angle), -2, radius * math.sin(angle))) for angle in angles]


def scenery(frame: int | None = 3) -> Scenery:
    splats = random_splats(500)
    return Scenery(circle(), splats, np.arange(500) // 100, frame)


@pytest.mark.parametrize("most", [0, 1, 2, 3, 7, 999, 12_345, 2_500_000])
def test_axes_count_in_whole_numbers(most: int, charting: None) -> None:
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


def pixels(png: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(png))
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB")).astype(int)


def count_of(image: np.ndarray, color: str, within: int = 12) -> int:
    """How many pixels are of a colour."""
    wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=2) <= within).sum())


@pytest.mark.usefixtures("charting")
class TestCharts:
    def test_the_same_rows_give_the_same_picture(self) -> None:
        assert plot(flight(60), "scene.spz") == plot(flight(60), "scene.spz")

    def test_it_is_as_wide_as_it_should_be(self) -> None:
        image = pixels(plot(flight(60), "scene.spz").png)
        assert image.shape[1] == charts.WIDTH
        assert image.shape[0] > charts.ROW * len(charts.PANELS) / 2

    def test_frames_to_look_at_are_marked(self) -> None:
        quiet = flight(60)
        for each in quiet:
            each |= dict.fromkeys(("churn", "bytes_new", "missing", "complete_in_s", "overdraw_estimate"), 0)
            each["pixel_scale_min"] = each["pixel_scale_limit"]
        assert count_of(pixels(plot(flight(60), "scene.spz").png), charts.PINK) > 500
        assert count_of(pixels(plot(quiet, "scene.spz").png), charts.PINK) == 0

    def test_empty_columns_leave_their_panel_out(self) -> None:
        rows = flight(60)
        every = charts.draw(rows).shape[0]
        assert every == charts.ROW * 5
        fewer = charts.draw([each | dict.fromkeys(("traverse_ms", "complete_in_s"), None) for each in rows])
        assert fewer.shape[0] == charts.ROW * 4

    @pytest.mark.parametrize("panel", charts.PANELS, ids=lambda panel: panel.title)
    def test_each_panel_shows_its_columns(self, panel: charts.Panel, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(charts, "PANELS", (panel,))
        rows = flight(60)
        before = charts.draw(rows)
        for name in panel.columns:
            other = [each | {name: (each[name] or 0) * (1.1 + at % 7)} for at, each in enumerate(rows)]  # type: ignore[operator]
            assert not np.array_equal(charts.draw(other), before), name

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_a_path_of_few_frames_has_a_chart_of_full_width(self, count: int) -> None:
        assert pixels(plot(flight(count), "scene.spz").png).shape[1] == charts.WIDTH

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
    def test_rows_with_nothing_in_them(self, cells: dict[str, int | float]) -> None:
        rows: list[Row] = [row(frame, **cells) for frame in range(4)]
        assert plot(rows, "scene.spz").note is None

    @pytest.mark.parametrize("title", ["$x", "a\nb", "", "城.spz", "w" * 1000])
    def test_any_name_is_a_title(self, title: str) -> None:
        assert plot(flight(3), title).png

    def test_a_chart_leaves_single_instances_out(self) -> None:
        rows = flight(20)
        assert plot([*rows, *(each | {"instance": "tree"} for each in rows)], "a") == plot(rows, "a")

    def test_a_matplotlibrc_changes_nothing(self) -> None:
        import matplotlib

        before = charts.draw(flight(5))
        with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 30, "axes.grid": False}):
            assert np.array_equal(charts.draw(flight(5)), before)

    def test_pyplot_is_left_alone(self) -> None:
        """It would keep every figure, and ask for a display."""
        program = (
            "import sys; from tests.tables.rows import flight; from sparklod_cli.simulation import charts\n"
            "charts.draw(flight(3)); assert 'matplotlib.pyplot' not in sys.modules"
        )
        subprocess.run([sys.executable, "-c", program], check=True)


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


@pytest.mark.usefixtures("drawing")
class TestPictureOfPath:
    def test_it_shows_the_scene_and_the_path(self) -> None:
        of = scenery()
        with_frame = pixels(picture_of_path(of.cameras, of.splats, of.level, frame=3, size=SIZE))
        without = pixels(picture_of_path(of.cameras, of.splats, of.level, size=SIZE))
        assert with_frame.shape == without.shape == (250, 400, 3)
        body = (slice(50, None), slice(0, 320))
        assert count_of(without[body], "#ffffff", 60) > 100
        assert count_of(with_frame[body], "#ff5c8a", 40) > 10
        assert count_of(without[body], "#ff5c8a", 40) == 0

    def test_it_is_the_same_again(self) -> None:
        of = scenery()
        assert len({picture_of_path(of.cameras, of.splats, of.level, size=SIZE) for _ in range(2)}) == 1

    def test_one_camera_and_one_splat(self) -> None:
        splats = random_splats(1)
        assert picture_of_path(circle(1), splats, np.array([4]), frame=0, size=SIZE)

    def test_hidden_lines_are_seen_faintly(self) -> None:
        """The path goes through a ball."""
        splats = random_splats(200).take(np.zeros(1, np.int64))
        splats.center[:], splats.scale[:] = 0, 3
        path = [looking((x, 0.01, 0.3)) for x in np.linspace(-1, 1, 9)]
        image = picture_of_path(path, splats, np.array([0]), size=SIZE)
        plain = picture_of_path([looking((0, 0, 0.001))], splats, np.array([0]), size=SIZE)
        middle = (slice(100, 190), slice(120, 240))
        assert (np.abs(pixels(image)[middle] - pixels(plain)[middle]).max(axis=2) > 40).sum() > 50

    def test_splats_that_are_not_finite_are_left_out(self) -> None:
        of = scenery()
        of.splats.center[0], of.splats.scale[1] = np.nan, np.inf
        assert picture_of_path(of.cameras, of.splats, of.level, size=SIZE)
        of.splats.scale[:] = 0
        with pytest.raises(SparklodError, match="nothing to draw"):
            picture_of_path(of.cameras, of.splats, of.level, size=SIZE)

    @pytest.mark.usefixtures("charting")
    def test_it_stands_below_the_charts(self) -> None:
        plotted = plot(flight(5), "scene.spz", scenery())
        alone = pixels(plot(flight(5), "scene.spz").png)
        both = pixels(plotted.png)
        assert plotted.note is None
        assert both.shape == (len(alone) + 1000, charts.WIDTH, 3)
        assert (both[: len(alone)] == alone).all()


def test_frusta_are_what_the_camera_sees() -> None:
    camera = looking((3, -2, 5))
    points = frustum_lines(camera, 2.0).reshape(-1, 2, 3)
    local = (points - camera.position) @ camera.camera_to_world[:3, :3]
    corners = local[:4, 1]
    assert np.allclose(points[:4, 0], camera.position)
    assert np.allclose(corners[:, 2], -2)
    at = corners[:, :2] / -corners[:, 2:] * camera.focal * (1, -1) + camera.principal
    assert np.allclose(at, [(0, 0), (1600, 0), (1600, 900), (0, 900)], atol=1e-6)
    assert local[-1, 0, 1] > local[:4, 1, 1].max()  # the mark is on the upper side


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0, 0, 1)])
def test_above_is_what_it_is_for_the_cameras(up: tuple[float, float, float]) -> None:
    positions = [(4, 0.5, 0.7), (0.3, 4, 3), (2, 0.4, 4)]
    low, high = np.array([-3.0, -2, -1]), np.array([3.0, 2, 1])
    eye = _above([looking(position, up) for position in positions], low, high, (1600, 1000))
    assert eye.axes[1] @ up > 0.5
    assert (eye.position - (low + high) / 2) @ up > 0
    corners = np.array([[x, y, z] for x in (-3, 3) for y in (-2, 2) for z in (-1, 1)])
    seen = eye.project(corners)
    assert (seen >= np.array(FRAME[:2]) - 1e-6).all()
    assert (seen <= np.array(FRAME[2:]) + 1e-6).all()
