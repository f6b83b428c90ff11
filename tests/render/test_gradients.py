"""Gradients are the finite differences of the slow twin's pictures, and keep laws that need no twin."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.splats import Splats
from sparklod_cli.render import rasterizer
from sparklod_cli.render.gradients import SplatGradients, by_sh, draw
from sparklod_cli.render.rasterizer import ShadedSplats, shade
from sparklod_cli.render.render_settings import SORTS, RasterSettings
from sparklod_cli.system.threads import on_threads
from tests.references import spark_pictures
from tests.render.drawables import camera_at, joined, one, rows, shown
from tests.scenes import random_splats

LOOK = RasterSettings()
PROPERTIES = [field.name for field in dataclasses.fields(SplatGradients)]

#: Steps of finite differences, in float64.
STEP = 1e-5

#: Largest difference to the twin's, as a share of the sum of what could cancel.
MOST = 2e-3

#: A camera of a small picture, as each of its gradients takes many pictures of the twin.
SMALL = camera_at(size=(29, 19), focal=(30.0, 26.0))


def random_weights(camera: Camera, seed: int = 0) -> np.ndarray:
    """Derivatives of a loss by a picture."""
    return np.random.default_rng(seed).normal(size=(camera.height, camera.width, 4)).astype(np.float32)


def gradients(of: ShadedSplats, camera: Camera, look: RasterSettings = LOOK) -> SplatGradients:
    return draw(of, camera, look).gradients(random_weights(camera))


def assert_equal(found: SplatGradients, expected: SplatGradients, index: np.ndarray | slice = slice(None)) -> None:
    for name in PROPERTIES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name)[index])


def assert_finite(found: SplatGradients) -> None:
    assert all(np.isfinite(getattr(found, name)).all() for name in PROPERTIES)


def changed(of: ShadedSplats, by: Mapping[str, np.ndarray]) -> ShadedSplats:
    """Splats in float64 after a small change of each property, as `SplatGradients` defines it."""
    turn = by["turn"] / 2
    (x, y, z), (a, b, c, d) = turn.T, of.quat_xyzw.T
    quat = np.stack([a - c * y + b * z, b - a * z + c * x, c - b * x + a * y, d - a * x - b * y - c * z], axis=1)
    quat[:, :3] += of.quat_xyzw[:, 3:] * turn
    return ShadedSplats(
        center=of.center + by["center"],
        scale=of.scale * np.exp(by["log_scale"]),
        quat_xyzw=quat / np.linalg.norm(quat, axis=1, keepdims=True),
        lod_opacity=of.lod_opacity + by["lod_opacity"],
        rgb=of.rgb + by["rgb"],
    )


def weights_of(twin: spark_pictures.Drawn, seed: int = 0) -> np.ndarray:
    """Derivatives of a loss by a picture; 0 where float32 cannot tell what is drawn."""
    weights = np.random.default_rng(seed).normal(size=twin.rgba.shape)
    weights[twin.unsure] = 0
    return weights.astype(np.float32)


def difference(of: ShadedSplats, camera: Camera, look: RasterSettings, by: Mapping[str, np.ndarray]) -> np.ndarray:
    """How the twin's picture changes with a small change of some properties; where splats end is held."""
    exact = ShadedSplats(**{name: column.astype(np.float64) for name, column in vars(of).items()})
    held = spark_pictures.picture(exact, camera, look)
    none = {name: np.zeros((len(of), 3)) for name in PROPERTIES} | {"lod_opacity": np.zeros(len(of))}
    more, less = (
        spark_pictures.picture(
            changed(exact, none | {name: sign * STEP * value for name, value in by.items()}), camera, look, held
        ).rgba
        for sign in (1, -1)
    )
    return (more - less) / (2 * STEP)


def check(of: ShadedSplats, camera: Camera, look: RasterSettings = LOOK, *, seed: int = 0) -> None:
    """Compare the gradient of one property at a time, in a random direction, with the twin's."""
    rng = np.random.default_rng(seed)
    weights = weights_of(spark_pictures.picture(of, camera, look), seed)
    found = draw(of, camera, look).gradients(weights)
    for name in PROPERTIES:
        direction = rng.normal(size=getattr(found, name).shape)
        if name == "center":
            direction *= of.scale.min()
        terms = getattr(found, name) * direction
        expected = float((difference(of, camera, look, {name: direction}) * weights).sum())
        assert terms.sum() == pytest.approx(expected, abs=MOST * np.abs(terms).sum() + 1e-6), name


@given(
    seed=st.integers(0, 10_000),
    most=st.sampled_from([1.0, 5.0]),
    scale=st.sampled_from([0.005, 0.08, 0.3]),
    sort=st.sampled_from(SORTS),
)
def test_gradients_are_finite_differences_of_the_twin(seed: int, most: float, scale: float, sort: str) -> None:
    check(shown(12, seed=seed, scale=scale, most=most), SMALL, RasterSettings(sort=sort), seed=seed)


@pytest.mark.parametrize("seed", range(4))
def test_needles_and_splats_below_a_pixel_have_the_gradients_of_the_twin(seed: int) -> None:
    """The former are a thousand times longer than thick; the latter become fainter as they shrink."""
    needles = shown(10, seed=5, most=3.0)
    needles.scale[:] = np.float32([0.5, 0.0005, 0.0005])
    check(needles, camera_at(size=(40, 30), focal=(45.0, 45.0)), seed=seed)
    check(shown(20, scale=0.003, seed=seed), camera_at(size=(29, 19), focal=(120.0, 120.0)), seed=seed)


def test_colours_that_are_clamped_to_one_have_no_gradients() -> None:
    scene, camera = one((0, 0, 0), 0.4, 0.9, (4.0, 0.5, 0.0)), camera_at((0, 0, 4))
    weights = np.zeros((camera.height, camera.width, 4), np.float32)
    weights[20, 28] = 1  # at the centre, where alpha is about 0.9
    [by_rgb] = draw(scene, camera, LOOK).gradients(weights).rgb
    assert by_rgb[0] == 0
    np.testing.assert_allclose(by_rgb[1:], 0.9, atol=0.03)
    for brightest in (1.3, 3.9):
        check(shown(12, scale=0.2, most=3.0, brightest=brightest), SMALL)


def test_an_lod_opacity_above_five_has_no_gradient() -> None:
    weights = weights_of(spark_pictures.picture(one((0, 0, 0), 0.3, 7.5, (1, 0.5, 0.2)), SMALL, LOOK))
    five, more = (draw(one((0, 0, 0), 0.3, d, (1, 0.5, 0.2)), SMALL, LOOK).gradients(weights) for d in (5.0, 7.5))
    assert five.lod_opacity[0] != 0 and more.lod_opacity[0] == 0
    np.testing.assert_array_equal(five.center, more.center)


def test_splats_shortened_to_the_largest_radius_have_gradients_of_opacity_and_colour() -> None:
    camera, look = camera_at(size=(57, 41)), replace(LOOK, max_radius=15.0)
    scene = shown(5, seed=3, scale=0.6, most=0.9)
    scene.center[:, :2] *= np.float32(0.3)
    weights = weights_of(spark_pictures.picture(scene, camera, LOOK))
    found = draw(scene, camera, look).gradients(weights)
    assert_finite(found)
    drawn = rasterizer.draw(scene, camera, look)
    for name in ("lod_opacity", "rgb"):
        step = np.float32(1e-2) * np.random.default_rng(0).normal(size=getattr(scene, name).shape).astype(np.float32)
        after = rasterizer.draw(replace(scene, **{name: getattr(scene, name) + step}), camera, look)
        expected = float(((after - drawn).astype(np.float64) * weights).sum())
        assert (getattr(found, name) * step).sum() == pytest.approx(expected, rel=0.1)


def test_splats_that_are_not_drawn_have_no_gradients() -> None:
    scene, camera = shown(100, seed=2, most=3.0), camera_at()
    hidden = joined(
        one((0, 0, 50), 0.3, 0.9, (1, 1, 1)),  # behind the camera
        one((40, 0, 0), 0.3, 0.9, (1, 1, 1)),  # beside the picture
        one((0, 0, 0), 0.3, 0.001, (1, 1, 1)),  # fainter than half a step
        one((0, 0, 0), 1e-6, 0.9, (1, 1, 1)),  # smaller than can be seen
        one((0, 0, 0), np.nan, 0.9, (1, 1, 1)),
    )
    alone, found = gradients(scene, camera), gradients(joined(hidden, scene), camera)
    for name in PROPERTIES:
        values = getattr(found, name)
        assert not values[: len(hidden)].any()
        np.testing.assert_array_equal(values[len(hidden) :], getattr(alone, name))
    assert gradients(shown(0), camera).center.shape == (0, 3)


def test_splats_hidden_by_an_opaque_one_have_no_gradients() -> None:
    """Tiles end where nothing is to be seen any more, as those of the picture do."""
    camera = camera_at((0, 0, 4), size=(32, 32))
    walls = joined(*(one((0, 0, 2.5 + k / 100), 2.0, 5.0, (0.2, 0.4, 0.6)) for k in range(20)))
    behind = shown(200, seed=4, spread=0.3)
    drawing = draw(joined(behind, walls), camera, LOOK)
    assert (drawing.drawn.stop < drawing.drawn.start[1:]).all()
    found = drawing.gradients(random_weights(camera))
    assert not any(getattr(found, name)[: len(behind)].any() for name in PROPERTIES)
    assert_finite(found)
    assert found.rgb[-1].any()


@given(seed=st.integers(0, 1000), most=st.sampled_from([1.0, 5.0]), scale=st.sampled_from([1e-9, 0.01, 0.3, 8.0]))
def test_gradients_are_finite(seed: int, most: float, scale: float) -> None:
    assert_finite(gradients(shown(60, seed=seed, scale=scale, most=most), camera_at(size=(24, 20))))


@pytest.mark.parametrize("sort", SORTS)
def test_the_picture_is_the_rasterizer_s(sort: str) -> None:
    scene, camera, look = shown(3000, most=3.0), camera_at(size=(70, 50)), RasterSettings(sort=sort)
    np.testing.assert_array_equal(draw(scene, camera, look).image, rasterizer.draw(scene, camera, look))


def test_a_drawing_outlives_the_next_picture() -> None:
    scene, camera = shown(300, most=3.0), camera_at()
    expected, drawing = gradients(scene, camera), draw(scene, camera, LOOK)
    gradients(shown(400, seed=1), camera_at((1, 2, 3)))
    assert_equal(drawing.gradients(random_weights(camera)), expected)


def test_threads_and_the_order_of_splats_do_not_change_a_bit_of_a_gradient() -> None:
    scene, camera = shown(5000, most=3.0, seed=11), camera_at(size=(200, 150), focal=(200.0, 200.0))
    with on_threads(1):
        expected = gradients(scene, camera)
    with on_threads(2):
        assert_equal(gradients(scene, camera), expected)
    scene, camera = shown(300, most=3.0, seed=12), camera_at()
    order = np.random.default_rng(0).permutation(len(scene))
    assert_equal(gradients(rows(scene, order), camera), gradients(scene, camera), order)


def test_the_profile_shifted_is_refused() -> None:
    with pytest.raises(ValueError, match="profile shifted"):
        draw(shown(3), camera_at(), RasterSettings(profile="shifted"))


@pytest.mark.parametrize("sh_degree", range(4))
def test_gradients_of_spherical_harmonics_are_differences_of_the_twin_s_colours(sh_degree: int) -> None:
    """Colours are linear in the coefficients, up to where they are clamped."""
    splats, eye = random_splats(60, sh_degree=sh_degree), np.array([1.0, -2.0, 3.0])
    splats.rgb[:6] = -1
    rng = np.random.default_rng(0)
    by_rgb = rng.normal(size=(60, 3)).astype(np.float32)
    rgb = shade([(splats, np.eye(4))], camera_at(tuple(eye))).rgb
    by_color, by_coefficient = by_sh(splats.center, eye, splats.sh.shape[1], rgb, by_rgb)
    assert (rgb == 0).any() and not by_color[rgb == 0].any() and by_coefficient.shape == splats.sh.shape
    names = ("rgb", "sh")
    steps = {name: 1e-5 * rng.normal(size=getattr(splats, name).shape) for name in names}
    columns = {"center": splats.center, "rgb": splats.rgb.astype(np.float64), "sh": splats.sh.astype(np.float64)}
    plain, more = SimpleNamespace(**columns), SimpleNamespace(**columns)
    for name in names:
        setattr(more, name, columns[name] + steps[name])
    before, after = (spark_pictures.seen_rgb(cast(Splats, some), eye) for some in (plain, more))
    expected = ((after - before) * by_rgb).sum(axis=1)
    found = (by_color * steps["rgb"]).sum(axis=1) + (by_coefficient * steps["sh"]).sum(axis=(1, 2))
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
