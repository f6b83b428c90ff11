"""Pictures show the scene, and tell what they show; where none can be drawn, that is said."""

from __future__ import annotations

import dataclasses
import io
import re
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.figures import pyvista_scene
from sparklod_cli.figures import tree_plot as plotting
from sparklod_cli.figures.tree_plot import DescribedPicture, color_by, plot
from sparklod_cli.images.pixels import BACKGROUND
from sparklod_cli.lod import quick
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.render.color_scales import MAGMA, PLASMA, VIRIDIS, ramp
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.packages import install_hint
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


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


def test_equal_splats_have_one_color() -> None:
    splats = random_splats(5).take(np.zeros(5, np.int64))
    for by in ("size", "opacity", "chunk"):
        coloring, rgb = color_by(by, splats, np.arange(5), None)
        assert len(np.unique(rgb, axis=0)) == 1
        assert coloring.marks


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


def test_few_levels_at_the_ends_do_not_take_colors_from_the_others() -> None:
    depth = np.concatenate([np.zeros(2), np.repeat([5, 6, 7], 300), np.full(3, 60)]).astype(np.int32)
    coloring, _ = color_by("level", random_splats(len(depth)), np.arange(len(depth)), depth)
    assert [text for _, text in coloring.marks] == ["5 or less", "6", "7 or more"]


def test_opacities_above_one_are_labelled_as_lod_opacity() -> None:
    splats = random_splats(1000)
    assert color_by("opacity", splats, np.arange(1000), None)[0].title == "opacity"
    splats.opacity[0] = 50
    coloring, _ = color_by("opacity", splats, np.arange(1000), None)
    assert coloring.title == "opacity (D)"
    assert coloring.marks[-1] == (1.0, "1 or more")


SIZE = (320, 200)


@pytest.fixture
def drawing() -> None:
    """Skips where pictures cannot be drawn."""
    pytest.importorskip("pyvista")
    try:
        pyvista_scene.load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def scene() -> Scene:
    splats = random_splats(3000)
    return Scene(*quick.build(splats))


def pixels(picture: DescribedPicture) -> np.ndarray:
    image = Image.open(io.BytesIO(picture.png))
    assert image.format == "PNG"
    return np.asarray(image.convert("RGB")).astype(int)


def drawn(picture: DescribedPicture) -> np.ndarray:
    """Where the middle of the picture, without title, scale and axes, is not of the colour of the ground."""
    middle = pixels(picture)[50:-30, 60:-70]
    ground = [int(BACKGROUND[at : at + 2], 16) for at in (1, 3, 5)]
    return np.abs(middle - ground).sum(axis=2) > 60


@pytest.mark.usefixtures("drawing")
class TestPictures:
    def test_the_figure_shows_the_scene(self, scene: Scene) -> None:
        picture = plot(scene, size=SIZE)
        assert pixels(picture).shape == (200, 320, 3)
        assert 0.02 < drawn(picture).mean() < 0.98
        assert "3,000 leaves" in picture.description
        assert "ellipsoids" in picture.description

    def test_the_same_scene_gives_the_same_picture(self, scene: Scene) -> None:
        assert plot(scene, depth=3, size=SIZE) == plot(scene, depth=3, size=SIZE)

    @pytest.mark.parametrize("size", [(161, 97), (200, 500)])
    def test_the_figure_has_the_size_asked_for(self, scene: Scene, size: tuple[int, int]) -> None:
        assert pixels(plot(scene, depth=2, size=size)).shape == (size[1], size[0], 3)

    def test_colors_and_depths_make_other_pictures(self, scene: Scene) -> None:
        pictures = [plot(scene, by=by, depth=4, size=SIZE) for by in ("level", "opacity", "size")]
        pictures += [plot(scene, depth=depth, size=SIZE) for depth in (0, 2, None)]
        assert len({picture.png for picture in pictures}) == len(pictures)
        assert len({picture.description for picture in pictures}) == len(pictures)

    def test_all_depths_have_one_viewpoint(self, scene: Scene) -> None:
        corner = (slice(-60, None), slice(0, 60))
        axes = [pixels(plot(scene, depth=level, size=SIZE))[corner] for level in (4, 5)]
        assert (axes[0] == axes[1]).mean() > 0.97

    def test_the_description_counts_what_is_drawn(self, scene: Scene) -> None:
        assert scene.tree is not None
        depth = scene.tree.depths()
        picture = plot(scene, depth=3, size=SIZE)
        nodes = np.count_nonzero(depth == 3)
        leaves = np.count_nonzero(scene.tree.is_leaf & (depth < 3))
        assert f"Depth 3 of {depth.max()}: {nodes} node" in picture.description
        assert (f"grey: {leaves} leaves" in picture.description) == (leaves > 0)
        assert "boxes: the 1 of 1 chunks of 65,536 nodes" in picture.description

    def test_a_plain_scene_is_coloured_by_size(self) -> None:
        picture = plot(Scene(random_splats(500)), size=SIZE)
        assert picture.description.startswith("500 splats; coloured by feature size")
        assert "chunks" not in picture.description
        assert drawn(picture).any()
        assert "boxes" in plot(Scene(random_splats(50)), by="chunk", size=SIZE).description

    def test_many_splats_are_points_and_more_are_a_sample(self, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(pyvista_scene, "MOST_ELLIPSOIDS", 100)
        picture = plot(scene, size=SIZE)
        assert "points" in picture.description
        assert drawn(picture).any()
        monkeypatch.setattr(plotting, "MOST_POINTS", 1000)
        sample = plot(scene, size=SIZE)
        assert "an even sample of 1,000" in sample.description
        assert sample.png == plot(scene, size=SIZE).png != picture.png

    def test_huge_splats_are_drawn_as_points(self) -> None:
        splats = random_splats(3000)
        picture = plot(Scene(dataclasses.replace(splats, scale=np.full_like(splats.scale, 1e5))), size=SIZE)
        assert "points" in picture.description

    def test_few_voxels_are_outlined_and_many_are_a_grid(self, scene: Scene) -> None:
        assert "blue: the 1 voxel of" in plot(scene, depth=0, size=SIZE).description
        assert "blue: on the walls, the grid of voxels of" in plot(scene, size=SIZE).description

    def test_a_scene_of_one_splat_is_drawn(self) -> None:
        picture = plot(Scene(random_splats(1)), size=SIZE)
        assert picture.description.startswith("1 splat;")
        assert drawn(picture).any()

    def test_values_out_of_range_do_not_spoil_the_figure(self) -> None:
        good = random_splats(2000)
        alone = drawn(plot(Scene(good), size=SIZE))
        center, scale, quat, opacity = (np.array(c) for c in (good.center, good.scale, good.quat_xyzw, good.opacity))
        center[0], center[1], center[2], center[3] = np.nan, 1e8, 3e38, -3e38
        scale[4], scale[5], scale[6] = np.inf, 3e38, 0
        quat[7], opacity[8] = np.nan, np.nan
        bad = dataclasses.replace(good, center=center, scale=scale, quat_xyzw=quat, opacity=opacity)
        picture = plot(Scene(bad), size=SIZE)
        assert picture.description.startswith("1,995 splats")
        assert abs(drawn(picture).mean() - alone.mean()) < 0.5 * alone.mean()

    def test_a_small_scene_far_from_the_origin_is_drawn(self) -> None:
        splats = random_splats(20)
        far = dataclasses.replace(
            splats, center=np.full_like(splats.center, 1e7), scale=splats.scale * np.float32(1e-9)
        )
        assert pixels(plot(Scene(far), size=SIZE)).shape == (200, 320, 3)

    def test_a_broken_tree_is_drawn_as_far_as_it_goes(self, scene: Scene) -> None:
        assert scene.tree is not None
        count, start = scene.tree.child_count.copy(), scene.tree.child_start.copy()
        start[1] = 0  # a cycle
        count[2] = 65535  # past the end
        assert drawn(plot(dataclasses.replace(scene, tree=LodTree(count, start)), size=SIZE)).any()

    def test_a_depth_that_a_tree_does_not_have_is_an_error(self, scene: Scene) -> None:
        with pytest.raises(SparklodError, match=r"there is no node of depth 99 to draw: the tree has depths 0 to \d+$"):
            plot(scene, depth=99)
        with pytest.raises(SparklodError, match="not a Level-of-Detail tree"):
            plot(Scene(scene.splats), depth=1)

    @pytest.mark.parametrize("count", [0, 3])
    def test_splats_of_no_size_are_an_error(self, count: int) -> None:
        splats = random_splats(count)
        with pytest.raises(SparklodError, match="nothing to draw"):
            plot(Scene(dataclasses.replace(splats, scale=np.zeros_like(splats.scale))))


@pytest.fixture
def fresh() -> Iterator[None]:
    """Makes pyvista be looked for again."""
    pyvista_scene.load_pyvista.cache_clear()
    yield
    pyvista_scene.load_pyvista.cache_clear()


@pytest.mark.usefixtures("fresh")
class TestWhereNoneCanBeDrawn:
    def test_a_missing_pyvista_is_named(self, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pyvista", None)
        with pytest.raises(SparklodError, match=re.escape(install_hint("render", package="pyvista"))) as caught:
            plot(scene)
        assert "\n" not in str(caught.value)

    def test_a_missing_opengl_is_an_error(self, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pyvista", subprocess)  # any module: it is not asked for anything
        monkeypatch.setattr(pyvista_scene, "PROBE", "import os; os.abort()")
        with pytest.raises(SparklodError, match="apt install libegl1 libgl1-mesa-dri"):
            plot(scene)

    def test_an_unknown_colouring_is_an_error(self, scene: Scene) -> None:
        with pytest.raises(ValueError, match="not one of level, opacity, size, chunk"):
            plot(scene, by="colour")
