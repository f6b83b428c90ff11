"""Pictures that a card draws are those of the processor."""

from __future__ import annotations

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.splats import Splats
from sparklod_cli.render import rasterizer
from sparklod_cli.render.rasterizer import Image, ShadedSplats, shade
from sparklod_cli.render.settings import PROFILES, SORTS, RasterSettings
from tests.cards import MARKS

pytestmark = MARKS

#: dB that pictures agree to at least.
LEAST = 60


def draw_on_a_card(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    from sparklod_cli.render.cuda.rasterizer import draw  # loads numba's cuda

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


def agreement(image: np.ndarray, reference: np.ndarray) -> float:
    """PSNR in dB."""
    return float(-10 * np.log10(max(np.square(image.astype(np.float64) - reference).mean(), 1e-20)))


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
    assert agreement(image, reference) > LEAST


def test_near_far_and_large_splats_and_those_behind_are_drawn_likewise() -> None:
    shaded = shade([(splats_of(50, size=0.4), np.eye(4))], camera_at(0.3))
    settings = RasterSettings(near=0.2, far=1.0, max_radius=12.0)
    reference = rasterizer.draw(shaded, camera_at(0.3), settings)
    assert agreement(draw_on_a_card(shaded, camera_at(0.3), settings), reference) > LEAST


def test_no_splats_are_an_empty_picture() -> None:
    empty = ShadedSplats(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (3,), (4,), (), (3,))))
    assert not draw_on_a_card(empty, camera_at(), RasterSettings()).any()
    behind = shade([(splats_of(5), np.eye(4))], camera_at(-9.0))
    assert not draw_on_a_card(behind, camera_at(-9.0, (17, 5)), RasterSettings(far=1.0)).any()


def test_a_device_of_settings_is_where_the_reference_draws() -> None:
    scene, settings = sparklod.Scene(splats_of(20, 1)), sparklod.RenderSettings(device="cuda")
    reference = sparklod.render(scene, camera_at())
    image = sparklod.render(scene, camera_at(), settings=settings)
    assert agreement(image, reference) > LEAST
    assert not np.array_equal(image, reference)  # sums of a card are in another order


@pytest.mark.parametrize("degree", [1, 3])
def test_uploaded_splats_are_shaded_on_the_card(degree: int) -> None:
    from sparklod_cli.render.cuda.card import to_card
    from sparklod_cli.render.cuda.rasterizer import CardSplats, CardView, draw_on_card

    splats, camera, settings = splats_of(30, degree), camera_at(), RasterSettings()
    some = np.arange(5, 30, dtype=np.int32)
    reference = rasterizer.draw(shade([(splats.take(some), np.eye(4))], camera), camera, settings)
    d = lod_opacity(splats.opacity)
    uploaded = CardSplats.of(splats.center, splats.scale, splats.quat_xyzw, d, splats.rgb, splats.sh)
    drawn = draw_on_card(uploaded, to_card(some), CardView.of(camera, settings))
    assert agreement(drawn.image.copy_to_host(), reference) > LEAST
