"""Pictures and gradients of a card are those of the processor."""

from __future__ import annotations

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.splats import Splats
from sparklod_cli.render import gradients as on_processor
from sparklod_cli.render import rasterizer
from sparklod_cli.render.kernels.backward import CENTER, LOD_OPACITY, LOG_SCALE, RGB, TURN
from sparklod_cli.render.rasterizer import Image, ShadedSplats, shade
from sparklod_cli.render.render_settings import PROFILES, SORTS, RasterSettings
from tests.cards import MARKS
from tests.render.drawables import psnr, shown

pytestmark = MARKS

#: dB that pictures agree to at least.
LEAST = 60


def draw_on_a_card(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    from sparklod_cli.render.cuda.card_rasterizer import draw  # loads numba's cuda

    return draw(splats, camera, settings)


def splats_of(count: int, sh_degree: int = 0, *, size: float = 0.12, seed: int = 0) -> Splats:
    """Splats around the origin, some of them merged ones."""
    rng = np.random.default_rng(seed)
    splats = Splats.zeros(count, sh_degree)
    splats.center[:] = rng.normal(0, 0.6, (count, 3))
    splats.scale[:] = size * np.exp(rng.normal(0, 0.6, (count, 3)))
    quat = rng.normal(size=(count, 4))
    splats.quat_xyzw[:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    splats.opacity[:] = rng.choice([0.05, 0.4, 0.9, 1.0, 3.0, 20.0], count)
    splats.rgb[:] = rng.uniform(-0.1, 1.1, (count, 3))
    splats.sh[:] = rng.normal(0, 0.2, splats.sh.shape)
    return splats


def camera_at(distance: float = 3.0, size: tuple[int, int] = (20, 12)) -> Camera:
    return Camera.look_at([0.3, 0.2, -distance], [0, 0, 0], up=[0, -1, 0], fov_y=50, size=size)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("sort", SORTS)
def test_a_picture_is_that_of_the_processor(profile: str, sort: str) -> None:
    camera = camera_at(size=(12, 20) if sort == "z" else (20, 12))  # two tiles, one above the other or side by side
    shaded = shade([(splats_of(60), np.eye(4))], camera)
    settings = RasterSettings(profile=profile, sort=sort)
    reference = rasterizer.draw(shaded, camera, settings)
    image = draw_on_a_card(shaded, camera, settings)
    assert image.dtype == np.float32
    assert 0.1 < reference[..., 3].mean() < 0.99
    assert psnr(image, reference) > LEAST


def test_near_far_and_large_splats_and_those_behind_are_drawn_likewise() -> None:
    shaded = shade([(splats_of(50, size=0.4), np.eye(4))], camera_at(0.3))
    settings = RasterSettings(near=0.2, far=1.0, max_radius=12.0)
    reference = rasterizer.draw(shaded, camera_at(0.3), settings)
    assert psnr(draw_on_a_card(shaded, camera_at(0.3), settings), reference) > LEAST


def test_no_splats_are_an_empty_picture() -> None:
    assert not draw_on_a_card(shown(0), camera_at(), RasterSettings()).any()
    behind = shade([(splats_of(5), np.eye(4))], camera_at(-9.0))
    assert not draw_on_a_card(behind, camera_at(-9.0, (17, 5)), RasterSettings(far=1.0)).any()


def test_a_device_of_settings_is_where_the_reference_draws() -> None:
    scene, settings = sparklod.Scene(splats_of(20, 1)), sparklod.RenderSettings(device="cuda")
    reference = sparklod.render(scene, camera_at())
    image = sparklod.render(scene, camera_at(), settings=settings)
    assert psnr(image, reference) > LEAST
    assert not np.array_equal(image, reference)  # sums of a card are in another order


@pytest.mark.parametrize("degree", [1, 3])
def test_uploaded_splats_are_shaded_on_the_card(degree: int) -> None:
    from sparklod_cli.render.cuda.card import to_card
    from sparklod_cli.render.cuda.card_rasterizer import CardSplats, CardView, draw_on_card

    splats, camera, settings = splats_of(30, degree), camera_at(), RasterSettings()
    some = np.arange(5, 30, dtype=np.int32)
    reference = rasterizer.draw(shade([(splats.take(some), np.eye(4))], camera), camera, settings)
    d = lod_opacity(splats.opacity)
    uploaded = CardSplats.of(splats.center, splats.scale, splats.quat_xyzw, d, splats.rgb, splats.sh)
    drawn = draw_on_card(uploaded, to_card(some), CardView.of(camera, settings))
    assert psnr(drawn.image.copy_to_host(), reference) > LEAST


COLUMNS = {
    "center": slice(CENTER, CENTER + 3),
    "log_scale": slice(LOG_SCALE, LOG_SCALE + 3),
    "turn": slice(TURN, TURN + 3),
    "lod_opacity": LOD_OPACITY,
    "rgb": slice(RGB, RGB + 3),
}


#: Largest difference to the processor's, over the largest derivative of the property. Chosen: sums are of float32.
MOST = 1e-3


def test_gradients_are_those_of_the_processor() -> None:
    from sparklod_cli.render.cuda.card import to_card
    from sparklod_cli.render.cuda.card_gradients import BATCH, gradients_on_card
    from sparklod_cli.render.cuda.card_rasterizer import CardSplats, CardView, draw_on_card

    splats, camera, settings = splats_of(40), camera_at(size=(18, 10)), RasterSettings(max_radius=25.0)
    by_image = np.random.default_rng(1).normal(size=(camera.height, camera.width, 4)).astype(np.float32)
    drawing = on_processor.draw(shade([(splats, np.eye(4))], camera), camera, settings)
    reference = drawing.gradients(by_image)
    d = lod_opacity(splats.opacity)
    uploaded = CardSplats.of(splats.center, splats.scale, splats.quat_xyzw, d, splats.rgb, splats.sh)
    view = CardView.of(camera, settings)
    drawn = draw_on_card(uploaded, to_card(np.arange(len(splats), dtype=np.int32)), view)
    assert np.diff(drawn.start.copy_to_host()).max() > BATCH
    found = gradients_on_card(uploaded, drawn, view, to_card(by_image)).copy_to_host()
    for name, columns in COLUMNS.items():
        expected = getattr(reference, name)
        assert np.abs(expected).max() > 0
        assert np.abs(found[:, columns] - expected).max() < MOST * np.abs(expected).max(), name
