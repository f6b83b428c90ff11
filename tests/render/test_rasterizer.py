"""The rasterizer draws what its slow twin draws, and keeps laws that need no twin."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import Image, ShadedSplats, draw, shade
from sparklod_cli.render.settings import PROFILES, SORTS, RasterSettings
from sparklod_cli.system.threads import on_threads
from tests.references import spark_pictures
from tests.scenes import random_splats

#: Largest difference to the twin, which computes in float64, at pixels of which float32 can tell what they are in.
MOST = 1e-3
LEAST_PSNR = 70.0

#: How much light may be left where the rasterizer stops: what is behind adds no more than this times its colour.
EARLY = 1e-4


def camera_at(
    eye: tuple[float, float, float] = (0.3, -0.5, 4.0),
    *,
    size: tuple[int, int] = (57, 41),
    focal: tuple[float, float] = (60.0, 52.0),
    principal: tuple[float, float] | None = None,
) -> Camera:
    """Looks at the origin; y is down in the world."""
    middle = (size[0] / 2, size[1] / 2)
    return Camera(look_at(eye, (0, 0, 0), (0, -1, 0)), *size, focal, principal or middle)


def shown(count: int, *, seed: int = 0, scale: float = 0.08, spread: float = 0.7, most: float = 1.0) -> ShadedSplats:
    """Splats around the origin: scales over a decade, D up to `most`, colours up to 1.3."""
    rng = np.random.default_rng(seed)
    f32 = np.float32
    return ShadedSplats(
        center=rng.normal(0, spread, (count, 3)).astype(f32),
        scale=(scale * np.exp(rng.normal(0, 0.8, (count, 3)))).astype(f32),
        quat_xyzw=normalized_quat(rng.normal(size=(count, 4)).astype(f32)),
        lod_opacity=rng.uniform(0, most, count).astype(f32),
        rgb=rng.uniform(0, 1.3, (count, 3)).astype(f32),
    )


def joined(*parts: ShadedSplats) -> ShadedSplats:
    names = [field.name for field in dataclasses.fields(ShadedSplats)]
    return ShadedSplats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def rows(of: ShadedSplats, index: np.ndarray | slice) -> ShadedSplats:
    return ShadedSplats(**{field.name: getattr(of, field.name)[index] for field in dataclasses.fields(ShadedSplats)})


def one(center: tuple[float, float, float], scale: float, d: float, rgb: tuple[float, float, float]) -> ShadedSplats:
    columns = [center, (scale, scale, scale), (0, 0, 0, 1), d, rgb]
    return ShadedSplats(*(np.array([column], np.float32) for column in columns))


def check(
    of: ShadedSplats, camera: Camera, look: RasterSettings | None = None, *, most: float = MOST, unsure: float = 0.1
) -> Image:
    """Holds a picture against the twin's.

    Args:
        of, camera, look: what is drawn.
        most: the largest difference.
        unsure: the share of pixels that may be left out, because a splat ends there.
    """
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


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (16, 16), (64, 3), (2, 70)])
def test_pictures_of_any_size_are_those_of_the_twin(size: tuple[int, int]) -> None:
    count = 10 if size == (1, 1) else 100  # so that no splat ends at that one pixel
    check(shown(count, most=3.0), camera_at(size=size, focal=(0.8 * size[0], 0.8 * size[1])), unsure=0.3)


@pytest.mark.parametrize("principal", [(0.0, 0.0), (57.0, 10.0), (-20.0, 20.0), (28.0, 70.0)])
def test_an_off_centre_principal_point_shifts_the_picture(principal: tuple[float, float]) -> None:
    """What is dropped is told by where it is on the picture, not by its angle to the optical axis."""
    image = check(shown(400, spread=1.5), camera_at(principal=principal))
    assert image[..., 3].mean() > 0.02


@pytest.mark.parametrize("most", [1.0, 5.0])
def test_the_longest_needles_are_exact(most: float) -> None:
    """As long as a splat may be; in float32 the terms of a quadratic form would cancel to 1e-2."""
    needles = shown(12, seed=5, spread=0.4, most=most)
    needles.scale[:] = np.float32([2.0, 0.001, 0.001])
    image = check(needles, camera_at(size=(960, 540), focal=(1500.0, 1500.0)), most=2e-4)
    assert (image[..., 3] > 0.01).sum() > 300


@pytest.mark.parametrize("most", [1.0, 5.0])
@pytest.mark.parametrize("thin", [1.0, 0.01])
def test_no_splat_is_larger_than_512_pixels(thin: float, most: float) -> None:
    huge = shown(6, seed=6, scale=6.0, spread=0.5, most=most)
    huge.scale[:, 1:] *= np.float32(thin)
    image = check(huge, camera_at(size=(1300, 40), focal=(600.0, 600.0)), unsure=0.3)
    assert (image[:, :30, 3] == 0).any() and image[..., 3].max() > 0


def test_the_edge_of_a_huge_splat_is_512_pixels_from_its_centre() -> None:
    camera = camera_at((0, 0, 5), size=(1201, 9), focal=(1000.0, 1000.0))
    image = draw(one((0, 0, 0), 4.0, 1.0, (1, 1, 1)), camera, RasterSettings())
    [seen] = np.nonzero(image[4, :, 3])
    assert 511 <= 600 - seen.min() <= 512 and 511 <= seen.max() - 600 <= 512


def test_splats_below_a_pixel_are_drawn_as_the_twin_draws_them() -> None:
    """Blur makes them half a pixel large, and opacity as much lower."""
    check(shown(500, scale=0.003, seed=7), camera_at())
    check(shown(500, scale=1e-9, seed=8), camera_at())


def test_splats_before_near_and_beyond_far_are_not_drawn() -> None:
    look = RasterSettings(near=3.7, far=4.3)
    near_and_far = shown(300, seed=9)
    image = check(near_and_far, camera_at(), look)
    assert not np.array_equal(image, draw(near_and_far, camera_at(), RasterSettings()))
    inside = camera_at((0.01, 0.02, 0.1))  # splats are behind it, and all around it
    check(near_and_far, inside, RasterSettings(near=0.2))
    nothing = draw(near_and_far, camera_at(), RasterSettings(near=100.0, far=200.0))
    assert not nothing.any()


def test_a_splat_is_dropped_when_its_center_is_beyond_the_clip() -> None:
    """A splat is drawn as long as its centre is within 1.4 times the picture's half width, and then not at all."""
    camera = camera_at((0, 0, 5), size=(40, 30), focal=(50.0, 50.0))
    for pixels, drawn in ((1.39 * 20, True), (1.41 * 20, False)):
        for sign in (-1, 1):
            image = draw(one((sign * pixels / 50 * 5, 0, 0), 1.0, 1.0, (1, 1, 1)), camera, RasterSettings())
            assert image.any() == drawn
    for pixels, drawn in ((1.39 * 15, True), (1.41 * 15, False)):
        image = draw(one((0, pixels / 50 * 5, 0), 1.0, 1.0, (1, 1, 1)), camera, RasterSettings())
        assert image.any() == drawn


def test_an_lod_opacity_above_five_is_five() -> None:
    camera = camera_at()
    five, more = (draw(one((0, 0, 0), 0.3, d, (1, 0.5, 0)), camera, RasterSettings()) for d in (5.0, 7.5))
    np.testing.assert_array_equal(five, more)


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


def test_several_objects_are_drawn_as_one() -> None:
    splats, camera = random_splats(300, sh_degree=2), camera_at()
    parts = [(splats.take(slice(0, 100)), np.eye(4)), (splats.take(slice(100, 300)), np.eye(4))]
    whole = draw(shade([(splats, np.eye(4))], camera), camera, RasterSettings())
    np.testing.assert_array_equal(draw(shade(parts, camera), camera, RasterSettings()), whole)


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


@pytest.mark.parametrize("profile", PROFILES)
def test_an_opaque_near_splat_hides_all_behind_it(profile: str) -> None:
    camera = camera_at((0, 0, 4))
    wall = one((0, 0, 2.5), 2.0, 5.0, (0.2, 0.4, 0.6))
    image = draw(joined(shown(200, spread=0.4), wall), camera, RasterSettings(profile=profile))
    np.testing.assert_allclose(image, np.broadcast_to(np.float32([0.2, 0.4, 0.6, 1]), image.shape), atol=2 * EARLY)


def test_the_two_sorts_differ() -> None:
    """Off the axis, what is deeper may be nearer."""
    camera = camera_at((0, 0, 4), size=(60, 40))
    deep, wide = one((0.0, 0, 0.0), 0.3, 5.0, (1, 0, 0)), one((1.4, 0, 0.2), 0.5, 5.0, (0, 0, 1))
    radial, along = (draw(joined(deep, wide), camera, RasterSettings(sort=sort)) for sort in ("radial", "z"))
    assert (radial - along)[..., 0].max() > 0.3  # red is in front by distance, blue by depth


@given(seed=st.integers(0, 1000), most=st.sampled_from([1.0, 5.0]), profile=st.sampled_from(PROFILES))
def test_alpha_is_no_more_than_one(seed: int, most: float, profile: str) -> None:
    image = draw(shown(60, seed=seed, scale=0.3, most=most), camera_at(size=(24, 20)), RasterSettings(profile=profile))
    assert np.isfinite(image).all() and image.min() >= 0 and image[..., 3].max() <= 1


def test_an_empty_scene_is_transparent() -> None:
    assert not draw(shown(0), camera_at(), RasterSettings()).any()
    no_splats = Splats(*(column[:0] for column in dataclasses.astuple(random_splats(1))))
    assert not draw(shade([(no_splats, np.eye(4))], camera_at()), camera_at(), RasterSettings()).any()


def test_splats_without_opacity_are_not_drawn() -> None:
    scene = shown(200)
    faint = dataclasses.replace(scene, lod_opacity=np.zeros(200, np.float32))
    assert not draw(faint, camera_at(), RasterSettings()).any()
    np.testing.assert_array_equal(
        draw(joined(scene, faint), camera_at(), RasterSettings()), draw(scene, camera_at(), RasterSettings())
    )


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, -3e38])
@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(ShadedSplats)])
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


def test_stopping_early_costs_no_more_than_it_may() -> None:
    """Hundreds of splats behind each other, of which the last are never looked at."""
    rng = np.random.default_rng(14)
    stack = shown(600, seed=14, scale=0.4, spread=0.3)
    stack.lod_opacity[:] = rng.uniform(0.05, 0.6, 600)
    check(stack, camera_at(size=(24, 20)), most=2 * EARLY, unsure=0.5)
