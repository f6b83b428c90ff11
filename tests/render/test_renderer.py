"""Pictures of splats whose look can be worked out: styles, colours that mean something, depth and overdraw."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sparklod_cli.render.rasterizer import draw, shade
from sparklod_cli.render.renderer import BILLBOARD_ALPHA, DrawnPicture, Renderer
from sparklod_cli.render.settings import COLOR_BY, STYLES, RasterSettings, RenderSettings
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.viewers.scenes import CutFinder
from tests.render.drawables import balls, camera, plain
from tests.scenes import random_splats

RED, GREEN, BLUE = np.eye(3)
MIDDLE = (24, 32)


def drawn(source: CutFinder, **how: object) -> DrawnPicture:
    return Renderer(source, RenderSettings(**how), [camera()]).draw(camera())


def test_splats_are_what_the_backend_draws() -> None:
    splats, at = random_splats(300, sh_degree=2), camera()
    image = Renderer(plain(splats), RenderSettings(), [at]).draw(at).image
    assert np.array_equal(image, draw(shade([(splats, np.eye(4))], at), at, RasterSettings()))


def test_several_threads_draw_the_same() -> None:
    at = camera()
    renderer = Renderer(plain(random_splats(2000)), RenderSettings(), [at])
    expected = renderer.draw(at).image
    with ThreadPoolExecutor(4) as pool:
        for drawn in pool.map(renderer.draw, [at] * 12):
            assert np.array_equal(drawn.image, expected)


def test_supersampling_is_the_mean_of_a_finer_picture() -> None:
    splats = plain(balls((0, 0, 0), size=0.8))
    coarse, fine = (drawn(splats, supersample=times).image for times in (1, 4))
    assert fine.shape == coarse.shape
    # A splat much larger than a pixel is hardly blurred by it.
    assert np.abs(coarse - fine).max() < 0.02


def test_a_point_is_an_opaque_pixel() -> None:
    image = drawn(plain(balls((0.001, -0.001, 0), rgb=RED, opacity=0.3)), style="points").image
    assert image[MIDDLE].tolist() == [1, 0, 0, 1]
    assert np.count_nonzero(image[..., 3]) == 1


def test_points_and_billboards_are_in_the_order_of_the_file() -> None:
    near, far = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    for first, last, top in ((near, far, GREEN), (far, near, GREEN)):
        source = plain(balls(first, last, rgb=[RED, GREEN]))
        assert np.array_equal(drawn(source, style="points").image[MIDDLE][:3], top)
        image = drawn(source, style="billboards").image
        expected = BILLBOARD_ALPHA * (1 - BILLBOARD_ALPHA) * RED + BILLBOARD_ALPHA * GREEN
        assert np.allclose(image[MIDDLE], [*expected, 1 - (1 - BILLBOARD_ALPHA) ** 2])


def test_sorted_billboards_have_the_nearest_on_top() -> None:
    near, far = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    expected = BILLBOARD_ALPHA * (1 - BILLBOARD_ALPHA) * RED + BILLBOARD_ALPHA * GREEN
    for centers, rgb in (((far, near), [RED, GREEN]), ((near, far), [GREEN, RED])):
        for sort in ("radial", "z"):
            image = drawn(
                plain(balls(*centers, rgb=rgb)), style="sorted-billboards", raster=RasterSettings(sort=sort)
            ).image
            assert np.allclose(image[MIDDLE][:3], expected)


def test_a_billboard_is_as_wide_as_its_splat() -> None:
    at = camera(640, 480)
    image = Renderer(plain(balls((0, 0, 0), size=0.5)), RenderSettings(style="billboards"), [at]).draw(at).image
    radius = 0.5 * at.focal[0] / 5
    assert np.count_nonzero(image[240, :, 3]) == pytest.approx(2 * radius, abs=2)
    assert np.count_nonzero(image[..., 3]) == pytest.approx(np.pi * radius**2, rel=0.02)
    assert set(np.unique(image[..., 3])) == {0.0, np.float32(BILLBOARD_ALPHA)}


@pytest.mark.parametrize("style", STYLES)
def test_splats_outside_near_and_far_are_not_drawn(style: str) -> None:
    source = plain(balls((0, 0, 0)))
    for raster in (RasterSettings(near=5.1), RasterSettings(far=4.9)):
        assert not drawn(source, style=style, raster=raster).image.any()
    assert drawn(source, style=style, raster=RasterSettings(near=4.9, far=5.1)).image.any()
    assert not drawn(plain(balls((0, 0, 9))), style=style).image.any()


@pytest.mark.parametrize("by", ["lod-opacity", "size", "chunk"])
def test_colours_are_those_of_the_scale(by: str) -> None:
    left, right = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    first, second = balls(left, opacity=1.0, size=0.25), balls(right, opacity=30.0, size=0.4)
    renderer = Renderer(plain(first, second), RenderSettings(color_by=by), [camera()])
    assert renderer.scale is not None
    image = renderer.draw(camera()).image
    values = {"lod-opacity": (1.0, np.sqrt(1 + np.e * np.log(30))), "chunk": (0, 1)}
    large = 2 * 0.4 * (1 + 0.7 * (values["lod-opacity"][1] - 1))
    values["size"] = (0.5, large)
    for center, value in zip((left, right), values[by], strict=True):
        column = round(32 + camera().focal[0] * center[0] / 5)
        pixel = image[24, column]
        assert pixel[3] > 0.8
        assert np.allclose(pixel[:3] / pixel[3], renderer.scale.rgb(np.array(value)) / 255, atol=0.01)


def test_color_by_ignores_spherical_harmonics() -> None:
    splats = random_splats(200, sh_degree=3)
    dark = dataclasses.replace(splats, rgb=np.zeros_like(splats.rgb), sh=np.zeros_like(splats.sh))
    images = [drawn(plain(each), color_by="size").image for each in (splats, dark)]
    assert np.array_equal(*images)


def test_color_by_level_needs_a_tree() -> None:
    with pytest.raises(SparklodError, match="no file is a Level-of-Detail tree"):
        drawn(plain(balls((0, 0, 0))), color_by="level")


@pytest.mark.parametrize("style", STYLES)
def test_depth_is_how_far_along_the_axis(style: str) -> None:
    result = drawn(plain(balls((0, 0, 2), (2.4, 0, -1), size=0.2)), color_by="depth", style=style)
    assert result.values is not None
    assert result.values[MIDDLE] == pytest.approx(3, rel=1e-4)
    assert result.values[24, int(32 + camera().focal[0] * 2.4 / 6)] == pytest.approx(6, rel=1e-4)
    assert np.isnan(result.values[0, 0])
    assert not result.image[0, 0].any()


def test_a_color_scale_spans_all_cameras() -> None:
    near, far = camera(z=3.0), camera(z=30.0)
    scale = Renderer(plain(balls((0, 0, 0), (0.1, 0, 0))), RenderSettings(color_by="depth"), [near, far]).scale
    assert scale is not None
    assert (scale.low, scale.high) == pytest.approx((3, 30))
    for by in ("overdraw", "size"):
        renderer = Renderer(plain(random_splats(500)), RenderSettings(color_by=by), [near, far])
        before = renderer.scale
        renderer.draw(near)
        assert renderer.scale is before


def test_depth_is_the_mean_by_what_is_seen() -> None:
    result = drawn(plain(balls((0, 0, 1), (0, 0, -1), opacity=0.5)), color_by="depth")
    assert result.values is not None
    # In front 0.5, behind it half of what is left.
    assert result.values[MIDDLE] == pytest.approx((0.5 * 4 + 0.25 * 6) / 0.75, rel=0.02)


def test_overdraw_counts_splats_a_pixel() -> None:
    source = plain(balls((0, 0, 1), (0, 0, 0), (0, 0, -1), (1.5, 0, 0), size=0.2))
    result = drawn(source, color_by="overdraw")
    assert result.values is not None
    assert result.values[MIDDLE] == 3
    assert result.values[24, round(32 + camera().focal[0] * 1.5 / 5)] == 1
    assert result.values[0, 0] == 0
    assert np.array_equal(result.image[..., 3], result.values > 0)


@pytest.mark.parametrize("profile", ["spark", "shifted"])
def test_overdraw_is_where_something_is_drawn(profile: str) -> None:
    splats = random_splats(40, seed=4)
    splats.opacity[::4] = 20  # merged ones, too
    at, raster = camera(200, 150), RasterSettings(profile=profile)
    counted, image = (
        Renderer(plain(splats), RenderSettings(raster=raster, color_by=by), [at]).draw(at) for by in ("overdraw", None)
    )
    assert counted.values is not None
    differ = (counted.values > 0) != (image.image[..., 3] > 0)
    # At the very edge of a splat the last bit decides.
    assert differ.mean() < 1e-3
    assert 0.02 < (counted.values > 0).mean() < 0.98


@pytest.mark.parametrize("by", [by for by in COLOR_BY if by != "level"])
def test_nothing_in_view_is_an_empty_picture(by: str) -> None:
    result = drawn(plain(balls((0, 0, 50))), color_by=by)
    assert not result.image.any()
