"""Charts of frames, pictures of camera paths and of trees; where none can be drawn, the error says why."""

from __future__ import annotations

import dataclasses
import io
import math
import re
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.images import charts, pyvista_scene, scene_plots
from sparklod_cli.images.pixels import BACKGROUND
from sparklod_cli.images.pyvista_scene import viewpoint
from sparklod_cli.images.scene_plots import DescribedPicture, PathScene, color_by, frustum_lines, picture_of_path
from sparklod_cli.lod import quick
from sparklod_cli.model.gaussian import covariance, spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.color_scales import MAGMA, PLASMA, VIRIDIS, ramp
from sparklod_cli.simulation.results import Extremes, add_extremes, moments_of
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.machine import install_hint
from sparklod_cli.tables.columns import Row, totals
from tests.scenes import random_splats
from tests.tables.rows import flight, row

pytestmark = pytest.mark.slow


@pytest.fixture
def charting() -> None:
    """Skips where charts cannot be drawn."""
    pytest.importorskip("matplotlib", reason="charts need the extra `render`")


@pytest.fixture
def drawing() -> None:
    """Skips where pictures cannot be drawn."""
    pytest.importorskip("pyvista", reason="pictures need the extra `render`")
    try:
        pyvista_scene.load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))


@pytest.fixture
def fresh() -> Iterator[None]:
    """Makes pyvista be looked for again."""
    pyvista_scene.load_pyvista.cache_clear()
    yield
    pyvista_scene.load_pyvista.cache_clear()


SIZE = (400, 250)

needs_charts, needs_pyvista = pytest.mark.usefixtures("charting"), pytest.mark.usefixtures("drawing")


def pixels(png: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(png))
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB")).astype(int)


def count_of(image: np.ndarray, color: str, within: int = 12) -> int:
    """How many pixels are of a colour."""
    wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=2) <= within).sum())


# Charts


def marked(rows: list[Row]) -> dict[str, int]:
    """The frames worth a look, as `traverse --plot` marks them."""
    most: Extremes = {}
    for number, total in enumerate(totals(rows)):
        add_extremes(most, total, is_first=number == 0)
    return {moment.criterion: moment.frame for moment in moments_of(most)}


def plotted(rows: list[Row], title: str = "scene.spz", path_scene: PathScene | None = None) -> tuple[bytes, str | None]:
    """The plot of `traverse --plot`."""
    return charts.plot(rows, marked(rows), title, path_scene)


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


@needs_charts
def test_a_chart_has_its_width_and_the_same_rows_give_the_same_picture() -> None:
    made = plotted(flight(60))
    assert plotted(flight(60)) == made
    image = pixels(made[0])
    assert image.shape[1] == charts.WIDTH
    assert image.shape[0] > charts.ROW * len(charts.PANELS) / 2


@needs_charts
def test_frames_to_look_at_are_marked() -> None:
    quiet = flight(60)
    for each in quiet:
        each |= dict.fromkeys(("churn", "bytes_new", "missing", "complete_in_s", "overdraw_estimate"), 0)
        each["pixel_scale_min"] = each["pixel_scale_limit"]
    assert count_of(pixels(plotted(flight(60))[0]), charts.PINK) > 500
    assert count_of(pixels(plotted(quiet)[0]), charts.PINK) == 0


@needs_charts
def test_empty_columns_leave_their_panel_out() -> None:
    rows = flight(60)
    every = charts.draw_charts(rows, marked(rows)).shape[0]
    assert every == charts.ROW * 5
    fewer = charts.draw_charts([each | dict.fromkeys(("traverse_ms", "complete_in_s"), None) for each in rows], {})
    assert fewer.shape[0] == charts.ROW * 4


@needs_charts
@pytest.mark.parametrize("panel", charts.PANELS, ids=lambda panel: panel.title)
def test_each_panel_shows_its_columns(panel: charts.Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "PANELS", (panel,))
    rows = flight(60)
    before = charts.draw_charts(rows, marked(rows))
    for name in panel.columns:
        other = [each | {name: (each[name] or 0) * (1.1 + at % 7)} for at, each in enumerate(rows)]  # type: ignore[operator]
        assert not np.array_equal(charts.draw_charts(other, marked(other)), before), name


@needs_charts
@pytest.mark.parametrize(
    ("cells", "title"),
    [
        ({}, "$x\n城.spz"),
        ({"selected": 0, "leaves": 0, "interior": 0, "budget": 0, "in_frustum": 0, "outside": 0, "behind": 0}, ""),
        ({"pixel_scale_min": 0.0, "pixel_scale_limit": 0.0}, "w" * 1000),
        ({"pixel_scale_min": 0.0, "pixel_scale_limit": 1.0}, "a"),
        ({"bytes_new": 10**15, "missing": 0, "chunks_resident": 0, "churn": 0.0, "time_s": 0.0}, "a"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_rows_of_any_cells_and_any_title_are_drawn(cells: dict[str, int | float], title: str) -> None:
    for count in (1, 4):
        png, problem = plotted([row(frame, **cells) for frame in range(count)], title if count > 1 else "a")
        assert problem is None
        assert pixels(png).shape[1] == charts.WIDTH


@needs_charts
@pytest.mark.parametrize(("limit", "said"), [(0.001, "edges from the root"), (None, "level")])
def test_levels_without_pixel_scales_are_detail_levels(limit: float | None, said: str) -> None:
    matplotlib = charts.load_matplotlib()
    (panel,) = (each for each in charts.PANELS if "level_mean" in each.columns)
    axes = matplotlib.figure.Figure().subplots()
    panel.draw(axes, charts.FrameColumns([each | {"pixel_scale_limit": limit} for each in flight(4)]), matplotlib)
    assert axes.get_ylabel() == said


@needs_charts
def test_a_matplotlibrc_changes_nothing() -> None:
    import matplotlib

    before = charts.draw_charts(flight(5), {})
    with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 30, "axes.grid": False}):
        assert np.array_equal(charts.draw_charts(flight(5), {}), before)


@needs_charts
def test_pyplot_is_left_alone() -> None:
    """It would keep every figure, and ask for a display."""
    program = (
        "import sys; from tests.tables.rows import flight; from sparklod_cli.images import charts\n"
        "charts.draw_charts(flight(3), {}); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


# Pictures of a path


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


def path_scene(frame: int | None = 3) -> PathScene:
    splats = random_splats(500)
    return PathScene(circle(), splats, np.arange(500) // 100, frame)


@needs_pyvista
def test_the_figure_shows_the_scene_and_the_path() -> None:
    of = path_scene()
    with_frame = pixels(picture_of_path(of, size=SIZE))
    without = pixels(picture_of_path(dataclasses.replace(of, frame=None), size=SIZE))
    assert with_frame.shape == without.shape == (250, 400, 3)
    body = (slice(50, None), slice(0, 320))
    assert count_of(without[body], "#ffffff", 60) > 100
    assert count_of(with_frame[body], "#ff5c8a", 40) > 10
    assert count_of(without[body], "#ff5c8a", 40) == 0
    assert picture_of_path(of, size=SIZE) == picture_of_path(of, size=SIZE)


@needs_pyvista
def test_hidden_lines_are_seen_faintly() -> None:
    """The path goes through a ball."""
    splats = random_splats(200).take(np.zeros(1, np.int64))
    splats.center[:], splats.scale[:] = 0, 3
    path = [looking((x, 0.01, 0.3)) for x in np.linspace(-1, 1, 9)]
    image = picture_of_path(PathScene(path, splats, np.array([0])), size=SIZE)
    plain = picture_of_path(PathScene([looking((0, 0, 0.001))], splats, np.array([0])), size=SIZE)
    middle = (slice(100, 190), slice(120, 240))
    assert (np.abs(pixels(image)[middle] - pixels(plain)[middle]).max(axis=2) > 40).sum() > 50


@needs_pyvista
def test_one_splat_and_splats_that_are_not_finite_are_no_problem() -> None:
    assert picture_of_path(PathScene(circle(1), random_splats(1), np.array([4]), 0), size=SIZE)
    of = path_scene()
    of.splats.center[0], of.splats.scale[1] = np.nan, np.inf
    assert picture_of_path(of, size=SIZE)
    of.splats.scale[:] = 0
    with pytest.raises(SparklodError, match="nothing to draw"):
        picture_of_path(of, size=SIZE)


@needs_charts
@needs_pyvista
def test_the_figure_is_below_the_charts() -> None:
    whole = plotted(flight(5), path_scene=path_scene())
    alone = pixels(plotted(flight(5))[0])
    both = pixels(whole[0])
    assert whole[1] is None
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


# Geometry of scenes in PyVista


def test_ellipsoids_are_where_the_gaussian_says_and_not_thinner_than_a_pixel() -> None:
    splats = random_splats(30)
    ball = pyvista_scene.sphere(1)
    surface, normals, triangles = pyvista_scene.ellipsoids(splats, 2, ball, thinnest=0)
    points = (surface.reshape(30, len(ball[0]), 3) - splats.center[:, None]).astype(np.float64)
    matrices = covariance(splats.scale, splats.quat_xyzw)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(30, 3, 3)
    gradient = np.linalg.solve(matrices[:, None], points[..., None])[..., 0]
    assert np.allclose(np.einsum("nij,nij->ni", points, gradient), 4, rtol=1e-3)
    assert np.allclose(
        normals.reshape(points.shape), gradient / np.linalg.norm(gradient, axis=2, keepdims=True), atol=2e-3
    )
    assert triangles.max() == len(surface) - 1
    away = pyvista_scene.ellipsoids(splats, 1, ball, thinnest=1e4)[0].reshape(points.shape) - splats.center[:, None]
    assert np.allclose(np.linalg.norm(away, axis=2), 1e4, rtol=1e-5)


@given(st.integers(0, 10**9), st.integers(1, 1000))
def test_a_sample_is_even_and_has_the_requested_size(count: int, most: int) -> None:
    if count > most:
        index = pyvista_scene.evenly(count, most)
        assert len(index) == most
        assert index[0] == 0
        assert set(np.diff(index)) <= {count // most, count // most + 1}
        assert index[-1] < count
    assert pyvista_scene.evenly(most, most).tolist() == list(range(most))


@given(st.floats(1e-30, 1e30))
def test_the_level_of_a_step_is_the_smallest_not_below_it(size: float) -> None:
    level = pyvista_scene.level_of_step(size)
    assert 1.5 ** (level - 1) * (1 - 1e-6) <= size <= 1.5**level * (1 + 1e-6)


@pytest.mark.parametrize("aspect", [0.5, 1.6, 3])
@pytest.mark.parametrize("extent", [(1.0, 1, 1), (100, 1, 1), (1, 50, 0.1), (1e-6, 1e-6, 1e-6)])
def test_a_viewpoint_sees_all_within_its_frame(aspect: float, extent: tuple[float, float, float]) -> None:
    corners = pyvista_scene.CORNERS * extent + 7
    frame = (0.1, 0.2, 0.8, 0.9)
    eye = viewpoint(corners, np.array([-0.6, 0.5, -1]), np.array([0, -1.0, 0]), aspect=aspect, frame=frame)
    seen = eye.project(corners)
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert (low >= np.array(frame[:2]) - 1e-6).all()
    assert (high <= np.array(frame[2:]) + 1e-6).all()
    assert np.isclose((high - low) / (0.7, 0.7), 1, atol=1e-6).any()  # and fills it in one way
    assert np.allclose((low + high) / 2, (0.45, 0.55), atol=1e-6)
    assert np.allclose(eye.axes @ eye.axes.T, np.eye(3))
    below, above = eye.project(np.array([[7.0, 7, 7], [7, 7 - 0.1 * extent[1], 7]]))
    assert above[1] < below[1]  # y is down in the picture, and in the world


# Pictures of trees


def brightness(colors: np.ndarray) -> np.ndarray:
    linear = (colors / 255) ** 2.2
    return np.asarray(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("stops", [VIRIDIS, PLASMA, MAGMA])
def test_ramps_get_brighter_all_the_way(stops: tuple[str, ...]) -> None:
    assert (np.diff(brightness(ramp(stops, 50))) > 0).all()
    assert ramp(stops, 1).shape == (1, 3)


def test_colors_tell_sizes_apart() -> None:
    splats = random_splats(500)
    index = np.arange(100, 300)
    coloring, rgb = color_by("size", splats, index, None)
    assert coloring.title == "feature size"
    assert rgb.shape == (200, 3)
    order = np.argsort(spark_size(splats)[index])
    assert (np.diff(brightness(rgb[order])) >= 0).all()
    places = [place for place, _ in coloring.marks]
    assert len(places) > 3
    assert 0 <= min(places) <= max(places) <= 1


def test_every_level_has_a_colour_and_a_mark() -> None:
    splats = random_splats(1000)
    depth = np.repeat(np.arange(10, dtype=np.int32), 100)
    depth[-1] = -1
    many, rgb = color_by("level", splats, np.arange(0, 900), depth)
    assert [text for _, text in many.marks] == [str(level) for level in range(9)]
    assert len(np.unique(rgb, axis=0)) == 9
    one, rgb = color_by("level", splats, np.arange(300, 400), depth)
    assert [text for _, text in one.marks] == [str(level) for level in range(10)]
    assert len(np.unique(rgb, axis=0)) == 1


def test_outliers_take_no_colors_from_other_values_and_opacities_above_one_are_lod_opacities() -> None:
    depth = np.concatenate([np.zeros(2), np.repeat([5, 6, 7], 300), np.full(3, 60)]).astype(np.int32)
    splats, every = random_splats(len(depth)), np.arange(len(depth))
    levels = color_by("level", splats, every, depth)[0]
    assert [text for _, text in levels.marks] == ["5 or less", "6", "7 or more"]
    assert color_by("opacity", splats, every, None)[0].title == "opacity"
    splats.opacity[0] = 50
    opacities = color_by("opacity", splats, every, None)[0]
    assert (opacities.title, opacities.marks[-1]) == ("opacity (D)", (1.0, "1 or more"))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(*quick.build(random_splats(3000)))


def plot(scene: Scene, *, size: tuple[int, int] = (320, 200), **options: object) -> DescribedPicture:
    return scene_plots.plot(scene, size=size, **options)  # type: ignore[arg-type]


def drawn(picture: DescribedPicture) -> np.ndarray:
    """Where the middle of the picture, without title, scale and axes, is not of the colour of the ground."""
    middle = pixels(picture.png)[50:-30, 60:-70]
    ground = [int(BACKGROUND[at : at + 2], 16) for at in (1, 3, 5)]
    return np.abs(middle - ground).sum(axis=2) > 60


@needs_pyvista
def test_the_figure_shows_the_scene_in_the_requested_size(scene: Scene) -> None:
    picture = plot(scene)
    assert 0.02 < drawn(picture).mean() < 0.98
    assert "3,000 leaves" in picture.description
    assert "ellipsoids" in picture.description
    for width, height in ((320, 200), (161, 97), (200, 500)):
        assert pixels(plot(scene, depth=2, size=(width, height)).png).shape == (height, width, 3)


@needs_pyvista
def test_colors_and_depths_make_other_pictures_of_one_viewpoint(scene: Scene) -> None:
    looks = [("level", 4), ("opacity", 4), ("size", 4), ("level", 0), ("level", 2), ("level", None)]
    pictures = [plot(scene, by=by, depth=depth) for by, depth in looks]
    assert len({picture.png for picture in pictures}) == len(pictures)
    assert len({picture.description for picture in pictures}) == len(pictures)
    assert pictures[0] == plot(scene, depth=4)
    axes = [pixels(picture.png)[-60:, :60] for picture in (pictures[0], plot(scene, depth=5))]
    assert (axes[0] == axes[1]).mean() > 0.97


@needs_pyvista
def test_the_description_counts_what_is_drawn(scene: Scene) -> None:
    assert scene.tree is not None
    depth = scene.tree.depths()
    picture = plot(scene, depth=3)
    nodes = np.count_nonzero(depth == 3)
    leaves = np.count_nonzero(scene.tree.is_leaf & (depth < 3))
    assert f"Depth 3 of {depth.max()}: {nodes} node" in picture.description
    assert (f"grey: {leaves} leaves" in picture.description) == (leaves > 0)
    assert "boxes: the 1 of 1 chunks of 65,536 nodes" in picture.description
    assert "blue: on the walls, the grid of voxels of" in plot(scene).description
    assert "blue: the 1 voxel of" in plot(scene, depth=0).description


@needs_pyvista
def test_a_plain_scene_is_coloured_by_size() -> None:
    picture = plot(Scene(random_splats(500)))
    assert picture.description.startswith("500 splats; coloured by feature size")
    assert "chunks" not in picture.description
    assert drawn(picture).any()
    assert "boxes" in plot(Scene(random_splats(50)), by="chunk").description
    single = plot(Scene(random_splats(1)))
    assert single.description.startswith("1 splat;")
    assert drawn(single).any()


@needs_pyvista
def test_many_splats_are_points_and_more_are_a_sample(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyvista_scene, "MOST_ELLIPSOIDS", 100)
    picture = plot(scene)
    assert "points" in picture.description
    assert drawn(picture).any()
    monkeypatch.setattr(scene_plots, "MOST_POINTS", 1000)
    sample = plot(scene)
    assert "an even sample of 1,000" in sample.description
    assert sample.png == plot(scene).png != picture.png


@needs_pyvista
def test_values_out_of_range_do_not_spoil_the_figure() -> None:
    good = random_splats(2000)
    alone = drawn(plot(Scene(good)))
    center, scale, quat, opacity = (np.array(c) for c in (good.center, good.scale, good.quat_xyzw, good.opacity))
    center[0], center[1], center[2], center[3] = np.nan, 1e8, 3e38, -3e38
    scale[4], scale[5], scale[6] = np.inf, 3e38, 0
    quat[7], opacity[8] = np.nan, np.nan
    bad = dataclasses.replace(good, center=center, scale=scale, quat_xyzw=quat, opacity=opacity)
    picture = plot(Scene(bad))
    assert picture.description.startswith("1,995 splats")
    assert abs(drawn(picture).mean() - alone.mean()) < 0.5 * alone.mean()
    assert "points" in plot(Scene(dataclasses.replace(good, scale=np.full_like(scale, 1e5)))).description
    far = dataclasses.replace(good, center=np.full_like(center, 1e7), scale=good.scale * np.float32(1e-9))
    assert plot(Scene(far)).png


@needs_pyvista
def test_a_broken_tree_is_drawn_as_far_as_it_goes(scene: Scene) -> None:
    assert scene.tree is not None
    count, start = scene.tree.child_count.copy(), scene.tree.child_start.copy()
    start[1] = 0  # a cycle
    count[2] = 65535  # past the end
    assert drawn(plot(dataclasses.replace(scene, tree=LodTree(count, start)))).any()


@needs_pyvista
def test_a_picture_without_anything_to_draw_is_an_error(scene: Scene) -> None:
    with pytest.raises(SparklodError, match=r"there is no node of depth 99 to draw: the tree has depths 0 to \d+$"):
        plot(scene, depth=99)
    with pytest.raises(SparklodError, match="not a Level-of-Detail tree"):
        plot(Scene(scene.splats), depth=1)
    for splats in (Splats.zeros(0, 0), Splats.zeros(3, 0)):
        with pytest.raises(SparklodError, match="nothing to draw"):
            plot(Scene(splats))
    with pytest.raises(ValueError, match="not one of level, opacity, size, chunk"):
        plot(scene, by="colour")


@pytest.mark.usefixtures("fresh")
def test_a_missing_pyvista_or_opengl_is_named(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(SparklodError, match=re.escape(install_hint("render", package="pyvista"))) as caught:
        plot(scene)
    assert "\n" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "pyvista", subprocess)  # any module: it is not used
    monkeypatch.setattr(pyvista_scene, "PROBE", "import os; os.abort()")
    with pytest.raises(SparklodError, match="apt install libegl1 libgl1-mesa-dri"):
        plot(scene)
