"""The rasterizer draws what its slow twin draws, and keeps laws that need no twin."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.model.splats import Splats
from sparklod_cli.render import rasterizer
from sparklod_cli.render.kernels.project import GROUP, index_of
from sparklod_cli.render.rasterizer import (
    Image,
    ShadedSplats,
    draw,
    project_splats,
    shade,
    sort_into_tiles,
    tiles_across,
)
from sparklod_cli.render.render_settings import PROFILES, SORTS, RasterSettings
from sparklod_cli.system.threads import on_threads
from tests.references import spark_pictures
from tests.render.drawables import COLUMNS, camera_at, joined, one, rows, shown
from tests.scenes import random_splats

#: Largest difference to the twin, which computes in float64, at pixels of which float32 can tell what they are in.
MOST = 1e-3
LEAST_PSNR = 70.0

#: How much light may be left where the rasterizer stops: what is behind adds no more than this times its colour.
EARLY = 1e-4


def check(
    of: ShadedSplats, camera: Camera, look: RasterSettings | None = None, *, most: float = MOST, unsure: float = 0.1
) -> Image:
    """Compare a picture with that of the twin; `unsure` is the share of pixels in which a splat may end."""
    look = look or RasterSettings()
    image, twin = draw(of, camera, look), spark_pictures.picture(of, camera, look)
    assert image.shape == (camera.height, camera.width, 4) and image.dtype == np.float32
    assert twin.unsure.mean() <= unsure
    difference = (image - twin.rgba)[~twin.unsure]
    assert np.abs(difference).max(initial=0) <= most
    assert np.square(difference).mean() <= 10 ** (-LEAST_PSNR / 10)
    return image


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("most", [1.0, 5.0])
def test_pictures_are_those_of_the_twin(most: float, profile: str, sort: str) -> None:
    for seed in range(3):
        image = check(shown(150, seed=seed, most=most), camera_at(), RasterSettings(profile=profile, sort=sort))
        assert image[..., 3].mean() > 0.1


def squeezed(of: ShadedSplats, *factors: float) -> ShadedSplats:
    of.scale[:] *= np.float32(factors)
    return of


def needles(most: float) -> ShadedSplats:
    """As long as a splat may be; in float32 the terms of a quadratic form would cancel to 1e-2."""
    of = shown(12, seed=5, spread=0.4, most=most)
    of.scale[:] = np.float32([2.0, 0.001, 0.001])
    return of


def stack() -> ShadedSplats:
    """Hundreds of splats behind each other, of which the last are never drawn."""
    of = shown(600, seed=14, scale=0.4, spread=0.3)
    of.lod_opacity[:] = np.random.default_rng(14).uniform(0.05, 0.6, 600)
    return of


LONG, WIDE = camera_at(size=(960, 540), focal=(1500.0, 1500.0)), camera_at(size=(1300, 40), focal=(600.0, 600.0))


def small(width: int, height: int) -> Camera:
    return camera_at(size=(width, height), focal=(0.8 * width, 0.8 * height))


#: Splats, camera, arguments of `check`, and the least share of the picture that they cover.
PICTURES: dict[str, tuple[ShadedSplats, Camera, dict[str, Any], float]] = {
    "a pixel": (shown(10, most=3.0), small(1, 1), {"unsure": 0.3}, 0),  # few, so that no splat ends at the pixel
    "tiles and a bit": (shown(100, most=3.0), small(17, 33), {"unsure": 0.3}, 0),
    "a tile": (shown(100, most=3.0), small(16, 16), {"unsure": 0.3}, 0),
    "low": (shown(100, most=3.0), small(64, 3), {"unsure": 0.3}, 0),
    "narrow": (shown(100, most=3.0), small(2, 70), {"unsure": 0.3}, 0),
    "axis at a corner": (shown(400, spread=1.5), camera_at(principal=(0.0, 0.0)), {}, 0.02),
    "axis at a side": (shown(400, spread=1.5), camera_at(principal=(57.0, 10.0)), {}, 0.02),
    "axis to the left": (shown(400, spread=1.5), camera_at(principal=(-20.0, 20.0)), {}, 0.02),
    "axis below": (shown(400, spread=1.5), camera_at(principal=(28.0, 70.0)), {}, 0.02),
    "needles": (needles(1.0), LONG, {"most": 2e-4}, 1e-5),
    "needles, merged": (needles(5.0), LONG, {"most": 2e-4}, 1e-5),
    "below a pixel": (shown(500, scale=0.003, seed=7), camera_at(), {}, 0),
    "far below a pixel": (shown(500, scale=1e-9, seed=8), camera_at(), {}, 0),
    "between near and far": (shown(300, seed=9), camera_at(), {"look": RasterSettings(near=3.7, far=4.3)}, 0),
    "all around": (shown(300, seed=9), camera_at((0.01, 0.02, 0.1)), {"look": RasterSettings(near=0.2)}, 0),
    "behind each other": (stack(), camera_at(size=(24, 20)), {"most": 2 * EARLY, "unsure": 0.5}, 0),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_special_splats_and_cameras_are_those_of_the_twin(name: str) -> None:
    splats, camera, how, least = PICTURES[name]
    assert check(splats, camera, **how)[..., 3].mean() >= least


@pytest.mark.parametrize("most", [1.0, 5.0])
@pytest.mark.parametrize("thin", [1.0, 0.01])
def test_no_splat_is_larger_than_512_pixels(thin: float, most: float) -> None:
    huge = squeezed(shown(6, seed=6, scale=6.0, spread=0.5, most=most), 1, thin, thin)
    image = check(huge, WIDE, unsure=0.3)
    assert (image[:, :30, 3] == 0).any() and image[..., 3].max() > 0


@pytest.mark.parametrize("sh_degree", range(4))
def test_colours_follow_the_direction_by_spherical_harmonics(sh_degree: int) -> None:
    splats = random_splats(200, sh_degree=sh_degree)
    eye = (1.0, -2.0, 3.0)
    seen = shade([(splats, np.eye(4))], camera_at(eye))
    np.testing.assert_allclose(seen.rgb, spark_pictures.seen_rgb(splats, np.array(eye)), atol=2e-6)
    check(seen, camera_at(eye))


@pytest.mark.parametrize("size", [1.0, 1.7])
def test_moving_splats_is_moving_the_camera_the_other_way(size: float) -> None:
    splats, camera = random_splats(300, sh_degree=3), camera_at()
    matrix = np.linalg.inv(look_at((0.4, 0.9, -0.3), (1.0, 0.2, 0.5), (0.1, -1.0, 0.3)))
    matrix[:3, :3] *= size
    moved = matrix @ camera.camera_to_world
    moved[:3, :3] /= size
    there = dataclasses.replace(camera, camera_to_world=moved)
    placed = draw(shade([(splats, matrix)], there), there, RasterSettings())
    plain = draw(shade([(splats, np.eye(4))], camera), camera, RasterSettings())
    close = np.abs(placed - plain).max(axis=-1) < MOST
    assert close.mean() > 0.99 and plain[..., 3].mean() > 0.02


@pytest.mark.parametrize("profile", PROFILES)
def test_threads_do_not_change_a_bit_of_a_picture(profile: str) -> None:
    camera = camera_at(size=(200, 150), focal=(200.0, 200.0))
    scene = shown(5000, most=3.0, seed=11)
    pictures = []
    for count in (1, 2, 3):
        with on_threads(count):
            pictures.append(draw(scene, camera, RasterSettings(profile=profile)).tobytes())
    assert pictures[0] == pictures[1] == pictures[2]


@pytest.mark.parametrize("sort", SORTS)
def test_the_order_of_splats_does_not_matter(sort: str) -> None:
    scene, camera = shown(300, most=3.0, seed=12), camera_at()
    mixed = rows(scene, np.random.default_rng(0).permutation(len(scene)))
    np.testing.assert_array_equal(
        draw(mixed, camera, RasterSettings(sort=sort)), draw(scene, camera, RasterSettings(sort=sort))
    )


def test_of_splats_in_one_place_the_last_is_in_front() -> None:
    """As Spark's sort has it."""
    red, blue = one((0, 0, 0), 0.5, 5.0, (1, 0, 0)), one((0, 0, 0), 0.5, 5.0, (0, 0, 1))
    for scene, seen in (((red, blue), 2), ((blue, red), 0)):
        middle = draw(joined(*scene), camera_at(), RasterSettings())[20, 28]
        np.testing.assert_allclose(middle[:3], np.eye(3)[seen], atol=1e-3)


@given(seed=st.integers(0, 1000), most=st.sampled_from([1.0, 5.0]), profile=st.sampled_from(PROFILES))
def test_alpha_is_no_more_than_one(seed: int, most: float, profile: str) -> None:
    image = draw(shown(60, seed=seed, scale=0.3, most=most), camera_at(size=(24, 20)), RasterSettings(profile=profile))
    assert np.isfinite(image).all() and image.min() >= 0 and image[..., 3].max() <= 1


def test_splats_without_opacity_are_not_drawn_and_no_splats_are_a_transparent_picture() -> None:
    camera, look, scene = camera_at(), RasterSettings(), shown(200)
    faint = dataclasses.replace(scene, lod_opacity=np.zeros(200, np.float32))
    no_splats = shade([(Splats.zeros(0, 0), np.eye(4))], camera)
    for nothing in (faint, shown(0), no_splats):
        assert not draw(nothing, camera, look).any()
    np.testing.assert_array_equal(draw(joined(scene, faint), camera, look), draw(scene, camera, look))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, -3e38])
@pytest.mark.parametrize("name", COLUMNS)
def test_a_broken_splat_harms_no_other(name: str, value: float) -> None:
    """It is a small one; if it is drawn, then where it is."""
    scene, camera = shown(60, seed=13), camera_at()
    unharmed = draw(scene, camera, RasterSettings())
    for at in range(getattr(scene, name)[0].size):
        broken = one((0, 0, 1), 0.05, 0.9, (1, 1, 1))
        getattr(broken, name).reshape(-1)[at] = value
        image = draw(joined(scene, broken), camera, RasterSettings())
        assert np.isfinite(image).all() and image.min() >= 0 and image[..., 3].max() <= 1
        assert (np.abs(image - unharmed).max(axis=-1) > 1e-6).mean() < 0.1


# Tiles


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_tile_lists_the_splats_whose_boxes_overlap_it_from_near_to_far(blocks: int) -> None:
    """Those that are not drawn have empty boxes, and no key."""
    camera = camera_at(size=(200, 150), focal=(100.0, 100.0))
    _, boxes, keys = project_splats(shown(500, spread=2.0, most=3.0), camera, RasterSettings())
    across, down = tiles_across(camera)
    start, splats = sort_into_tiles(boxes, keys, across, down, blocks)
    order = [index_of(key) for key in keys]
    assert 0 < len(order) < 500
    for tile in range(across * down):
        y, x = divmod(tile, across)
        left, right, top, bottom = boxes[order].T
        overlap = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        assert splats[start[tile] : start[tile + 1]].tolist() == np.array(order)[overlap].tolist()
    hidden = np.setdiff1d(np.arange(500), order)
    assert (boxes[hidden, 1] < boxes[hidden, 0]).all()


def test_a_picture_with_more_tiles_than_their_numbers_hold_is_refused() -> None:
    camera = camera_at(size=(rasterizer.MAX_SIDE + 1, 1))
    with pytest.raises(ValueError, match="524,272 along a side"):
        draw(shown(1), camera, RasterSettings())
    widest = camera_at((0, 0, 5), size=(rasterizer.MAX_SIDE, 1), focal=(1e5, 1e5))
    ends = joined(*(one((x, 0, 0), 0.01, 1.0, (1, 1, 1)) for x in (-13.1, 13.1)))
    image = draw(ends, widest, RasterSettings())
    assert image[0, :700].any() and image[0, -700:].any() and not image[0, 700:-700].any()


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("scale", [0.08, 8.0])
def test_a_splat_is_projected_alike_among_any_others(scale: float, sort: str) -> None:
    """Small ones, and ones whose axes are shortened; D from 0 to 5; some beside the picture."""
    camera, look, count = camera_at(), RasterSettings(sort=sort), 2 * GROUP + 7
    scene = shown(count, scale=scale, spread=2.0, most=5.0)
    screen, boxes, keys = project_splats(scene, camera, look)
    drawn = sorted(index_of(key) for key in keys)
    found = screen[drawn].copy(), boxes.copy()
    assert 0 < len(drawn) < count
    for size in (1, GROUP - 1, GROUP, GROUP + 1):
        first = count - size
        screen, boxes, keys = project_splats(rows(scene, slice(first, None)), camera, look)
        kept = sorted(index_of(key) for key in keys)
        assert [first + i for i in kept] == [i for i in drawn if i >= first]
        np.testing.assert_array_equal(screen[kept], found[0][len(drawn) - len(kept) :])
        np.testing.assert_array_equal(boxes, found[1][first:])
