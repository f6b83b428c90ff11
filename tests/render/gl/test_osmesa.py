"""The backend osmesa draws what the reference draws."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.codecs.gpu import data_texture
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.falloff import MIN_ALPHA
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.splats import FloatArray
from sparklod_cli.render import rasterizer, settings
from sparklod_cli.render.gl import osmesa
from sparklod_cli.render.rasterizer import Image, ShadedSplats, shade
from sparklod_cli.render.settings import PROFILES, SORTS, RasterSettings
from sparklod_cli.system.errors import BackendError
from tests.conftest import FIXTURES
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: dB in which it agrees with the reference; the first is that of the reference's own early end in each tile.
FLOAT, HALF = 80, 45


@pytest.fixture(scope="module")
def opengl() -> None:
    """Skips where neither libOSMesa nor EGL draws."""
    try:
        osmesa.on_gl_thread(osmesa.open_context)
    except BackendError as error:
        pytest.skip(str(error))


needs_opengl = pytest.mark.usefixtures("opengl")


def camera(
    eye: tuple[float, ...], *, target: tuple[float, ...] = (0, 0, 0), size: tuple[int, int] = (203, 151)
) -> Camera:
    """Of another focal length on each axis, and with its optical axis off the middle of the picture."""
    width, height = size
    principal = width / 2 + 7.3, height / 2 - 4.6
    return Camera(look_at(eye, target, (0.1, 1, 0)), width, height, (190.0, 205.0), principal)


CAMERAS = {"front": camera((0, 0, 4)), "beside": camera((1.5, -2, 1)), "inside": camera((0.4, 0.2, -0.5))}


def random_shown(
    count: int,
    *,
    size: float = 0.03,
    spread: float = 0.7,
    most_opaque: float = 1.0,
    brightest: float = 1.0,
    seed: int = 0,
) -> ShadedSplats:
    """Splats around the origin; the logarithms of their scales are normal, so a spread of 2 has needles and disks."""
    rng = np.random.default_rng(seed)
    f32 = np.float32
    return ShadedSplats(
        rng.normal(0, 0.8, (count, 3)).astype(f32),
        np.exp(rng.normal(math.log(size), spread, (count, 3))).astype(f32),
        normalized_quat(rng.normal(size=(count, 4)).astype(f32)),
        rng.uniform(0, most_opaque, count).astype(f32),
        rng.uniform(0, brightest, (count, 3)).astype(f32),
    )


SPLATS = {
    "plausible": random_shown(3000),
    "tiny": random_shown(3000, size=0.002),
    "merged": random_shown(800, most_opaque=4.5, size=0.04),
    "bright": random_shown(800, most_opaque=2, brightest=2.5),
    "large": random_shown(60, size=1.0, spread=1.0),
    "huge": random_shown(30, size=8.0, spread=1.0, most_opaque=2),
    "anisotropic": random_shown(1500, spread=1.1),
    "flat": random_shown(1500, spread=1.5),
    "thin": random_shown(300, size=0.1, spread=3.0),
}

#: A float16 of the long side's variance is coarser than the whole thin side's, and opacity is made up by the area.
TOO_THIN_FOR_HALVES = {"flat", "thin"}


def psnr(image: Image, reference: Image) -> float:
    error = np.mean((image.astype(np.float64) - reference) ** 2)
    return math.inf if error == 0 else float(-10 * np.log10(error))


@needs_opengl
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("eye", CAMERAS)
@pytest.mark.parametrize("name", SPLATS)
def test_osmesa_draws_what_the_reference_draws(name: str, eye: str, profile: str) -> None:
    look = RasterSettings(profile=profile)
    reference = rasterizer.draw(SPLATS[name], CAMERAS[eye], look)
    assert reference.any()
    image = osmesa.draw(SPLATS[name], CAMERAS[eye], look)
    assert image.shape == reference.shape and image.dtype == np.float32
    assert psnr(image, reference) >= FLOAT
    if name not in TOO_THIN_FOR_HALVES:
        assert psnr(osmesa.draw(SPLATS[name], CAMERAS[eye], look, precision="half"), reference) >= HALF


@needs_opengl
@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("eye", [(0, 0, 9), (4, 3, 4), (0.5, 0.5, 0.5)])
def test_the_demo_is_drawn_as_the_reference_draws_it(eye: tuple[float, ...], sort: str) -> None:
    """The scene of the fixtures, through Backend, and with spherical harmonics of the camera's direction."""
    splats = read_scene(FIXTURES / "demo.ply", threads=2).splats
    seen = camera(eye, target=tuple(np.median(splats.center, axis=0)), size=(320, 200))
    shown = shade([(splats, np.eye(4))], seen)
    reference = rasterizer.draw(shown, seen, RasterSettings(sort=sort))
    assert psnr(osmesa.draw(shown, seen, RasterSettings(sort=sort)), reference) >= FLOAT
    assert psnr(osmesa.draw(shown, seen, RasterSettings(sort=sort), precision="half"), reference) >= HALF
    assert psnr(osmesa.draw(shown, seen, RasterSettings(sort=sort), sorting="counting16"), reference) >= HALF


@needs_opengl
def test_clipping_is_that_of_the_reference() -> None:
    for look in (RasterSettings(near=3.5), RasterSettings(far=4.0), RasterSettings(near=3.9, far=4.1)):
        reference = rasterizer.draw(SPLATS["large"], CAMERAS["front"], look)
        assert psnr(osmesa.draw(SPLATS["large"], CAMERAS["front"], look), reference) >= FLOAT
    # Centres on both sides of the picture's edges, and of those of the clip.
    width = np.linspace(-2, 2, 400, dtype=np.float32)
    row = dataclasses.replace(random_shown(400, size=0.05), center=np.stack([width, 0.7 * width, 0 * width], axis=1))
    reference = rasterizer.draw(row, CAMERAS["front"], RasterSettings())
    assert psnr(osmesa.draw(row, CAMERAS["front"], RasterSettings()), reference) >= FLOAT


@needs_opengl
@pytest.mark.parametrize("size", [(1, 1), (17, 300), (300, 17)])
@pytest.mark.parametrize("precision", osmesa.PRECISIONS)
def test_pictures_of_any_size_are_those_of_the_reference(size: tuple[int, int], precision: str) -> None:
    seen = camera((0, 0, 3), size=size)
    reference = rasterizer.draw(SPLATS["large"], seen, RasterSettings())
    image = osmesa.draw(SPLATS["large"], seen, RasterSettings(), precision=precision)
    assert image.shape == (size[1], size[0], 4)
    assert psnr(image, reference) >= HALF


def one(**columns: list[float]) -> ShadedSplats:
    """A round splat at the origin."""
    given: dict[str, list[float]] = {
        "center": [0, 0, 0],
        "scale": [0.1] * 3,
        "quat_xyzw": [0, 0, 0, 1],
        "rgb": [1, 0.5, 0.25],
    }
    given |= columns
    opacity = np.array(given.pop("lod_opacity", [0.5]), np.float32)
    return ShadedSplats(lod_opacity=opacity, **{name: np.array([value], np.float32) for name, value in given.items()})


@needs_opengl
@pytest.mark.parametrize("precision", osmesa.PRECISIONS)
def test_one_splat_is_the_gaussian_of_the_textbook(precision: str) -> None:
    """By the textbook: 20 pixels of standard deviation, in the middle; the first row is the uppermost."""
    straight = np.eye(4)
    straight[2, 3] = 5
    seen = Camera(straight, 200, 100, (1000.0, 1000.0), (100.5, 50.5))
    image = osmesa.draw(one(), seen, RasterSettings(), precision=precision)
    alpha = 0.5 * 400 / 400.3
    tolerance = 1e-5 if precision == "float" else 4e-3
    assert image[50, 100] == pytest.approx([alpha, alpha / 2, alpha / 4, alpha], abs=tolerance)
    assert image[50, 120, 3] == pytest.approx(alpha * math.exp(-0.5 * 400 / 400.3), abs=tolerance)
    upper = osmesa.draw(one(center=[0, 0.2, 0]), seen, RasterSettings(), precision=precision)[..., 3]
    assert np.unravel_index(upper.argmax(), upper.shape) == (10, 100)
    assert not osmesa.draw(one(lod_opacity=[MIN_ALPHA / 2]), seen, RasterSettings(), precision=precision).any()
    behind = one(center=[0, 0, 6])
    assert not osmesa.draw(behind, seen, RasterSettings(), precision=precision).any()


@needs_opengl
@pytest.mark.parametrize("precision", osmesa.PRECISIONS)
@pytest.mark.parametrize("sorting", settings.SORTINGS)
@pytest.mark.parametrize("throttle", [0.0, 0.01])
def test_a_picture_of_no_splats_is_empty(precision: str, sorting: str, throttle: float) -> None:
    image = osmesa.draw(
        random_shown(0), CAMERAS["front"], RasterSettings(), precision=precision, sorting=sorting, throttle=throttle
    )
    assert image.shape == (151, 203, 4) and not image.any()


@needs_opengl
def test_broken_splats_are_not_drawn() -> None:
    shown = random_shown(100)
    broken = dataclasses.replace(shown, center=shown.center.copy(), scale=shown.scale.copy())
    broken.center[:20] = np.nan
    broken.center[20:30] = np.inf
    broken.center[30:40] = 3e38
    broken.scale[40:50] = np.nan
    kept = ShadedSplats(**{field.name: getattr(shown, field.name)[50:] for field in dataclasses.fields(ShadedSplats)})
    for throttle in (0.0, 0.01):
        image = osmesa.draw(broken, CAMERAS["front"], RasterSettings(), throttle=throttle)
        assert np.array_equal(image, osmesa.draw(kept, CAMERAS["front"], RasterSettings()))


@needs_opengl
def test_of_equally_distant_splats_the_last_is_in_front() -> None:
    both = ShadedSplats(
        *(
            np.concatenate(pair)
            for pair in zip(_columns(one(lod_opacity=[1])), _columns(one(rgb=[0, 1, 0])), strict=True)
        )
    )
    for sorting in settings.SORTINGS:
        image = osmesa.draw(both, CAMERAS["front"], RasterSettings(), sorting=sorting)
        assert psnr(image, rasterizer.draw(both, CAMERAS["front"], RasterSettings())) >= FLOAT


def _columns(shown: ShadedSplats) -> list[FloatArray]:
    return [getattr(shown, field.name) for field in dataclasses.fields(ShadedSplats)]


@needs_opengl
def test_frames_of_the_same_splats_share_an_upload() -> None:
    shown, other = SPLATS["plausible"], SPLATS["merged"]
    renderer = osmesa.OpenGLRenderer()
    first = renderer.draw(shown, CAMERAS["front"], RasterSettings())
    again = ShadedSplats(*(column.copy() for column in _columns(shown)))
    renderer.draw(again, CAMERAS["beside"], RasterSettings())
    assert (renderer.uploads, renderer.sorts) == (1, 2)
    recolored = dataclasses.replace(shown, rgb=shown.rgb[::-1].copy())
    assert np.array_equal(
        renderer.draw(recolored, CAMERAS["front"], RasterSettings()),
        osmesa.draw(recolored, CAMERAS["front"], RasterSettings()),
    )
    assert renderer.uploads == 2
    renderer.draw(other, CAMERAS["front"], RasterSettings())
    assert renderer.uploads == 3
    renderer.draw(other, camera((0, 0, 4), size=(64, 48)), RasterSettings())
    assert renderer.uploads == 3
    assert np.array_equal(renderer.draw(shown, CAMERAS["front"], RasterSettings()), first)


def turned(degrees: float, *, away: float = 0.0) -> Camera:
    """At (0, 0, 4 + away), looking so far to the side of the origin."""
    eye = np.array([0, 0, 4 + away])
    ahead = np.array([math.sin(math.radians(degrees)), 0, -math.cos(math.radians(degrees))])
    return camera(tuple(eye), target=tuple(eye + ahead))


@needs_opengl
def test_a_throttle_sorts_anew_only_after_a_large_turn() -> None:
    shown = SPLATS["plausible"]
    lazy = osmesa.OpenGLRenderer(throttle=0.01)
    for degrees, sorts in ((0, 1), (5, 1), (8, 1), (8.2, 2), (3, 2), (0, 3)):
        image = lazy.draw(shown, turned(degrees), RasterSettings(sort="z"))
        assert lazy.sorts == sorts, degrees
        # Nothing is missing, though it was out of sight when the splats were sorted.
        assert psnr(image, rasterizer.draw(shown, turned(degrees), RasterSettings(sort="z"))) >= 25
    # Along its axis as beside it, every depth changes alike.
    assert (
        psnr(
            lazy.draw(shown, turned(0, away=-2), RasterSettings(sort="z")),
            rasterizer.draw(shown, turned(0, away=-2), RasterSettings()),
        )
        >= 25
    )
    assert lazy.sorts == 3
    lazy.draw(shown, turned(0), RasterSettings(sort="radial"))
    assert lazy.sorts == 4
    lazy.draw(shown, turned(0, away=0.2), RasterSettings(sort="radial"))
    assert lazy.sorts == 4
    lazy.draw(
        shown, turned(0, away=1), RasterSettings(sort="radial")
    )  # the middle splat is about 4 away; 0.14 of that is 0.57
    assert lazy.sorts == 5
    lazy.draw(SPLATS["merged"], turned(0, away=1), RasterSettings(sort="radial"))
    assert lazy.sorts == 6
    eager = osmesa.OpenGLRenderer()
    for _ in range(3):
        eager.draw(shown, turned(0), RasterSettings())
    assert eager.sorts == 3


def test_keys_are_sorted_upwards_and_equal_ones_backwards() -> None:
    rng = np.random.default_rng(0)
    key = np.concatenate([rng.normal(0, 100, 5000), np.repeat(rng.normal(0, 100, 50), 20)]).astype(np.float32)
    rng.shuffle(key)
    assert np.array_equal(osmesa.sort_exact(key), len(key) - 1 - np.argsort(key[::-1], kind="stable"))
    by_steps = osmesa.sort_counting16(key)
    assert np.array_equal(np.sort(by_steps), np.arange(len(key)))
    step = (float(key.max()) - float(key.min())) / 65535
    assert (np.diff(key[by_steps]) > -1.001 * step).all()
    assert (np.diff(key[by_steps]) < 0).any(), "16 bits cannot tell all of these apart"
    for few in ([], [3.0], [2.0, 2.0], [-0.0, 0.0]):
        for sort in osmesa.SORT.values():
            assert sort(np.array(few, np.float32)).tolist() == list(range(len(few)))[::-1]


def test_half_precision_has_the_texture_of_the_viewer() -> None:
    splats = random_splats(1500)
    shown = shade([(splats, np.eye(4))], CAMERAS["front"])
    words = osmesa.DATA_TEXTURES["half"]()
    assert words.update(shown) == (True, True)
    theirs = data_texture.pack(splats)["texture"]
    assert words.texture.shape == theirs.shape == (2, 2048, 4)
    used = np.ones((2, 2048, 4), bool)
    used[:, ::2, 3] = False  # the viewer looks at all others
    assert np.array_equal(words.texture[used], theirs[used])
    assert words.update(shown) == (False, False)


@needs_opengl
def test_sizes_beyond_opengls_limits_are_refused() -> None:
    wide = dataclasses.replace(CAMERAS["front"], width=1 << 20)
    with pytest.raises(BackendError, match="1048576 x 151 pixels exceed the limit of this OpenGL"):
        osmesa.draw(SPLATS["plausible"], wide, RasterSettings())
    image = osmesa.draw(SPLATS["plausible"], CAMERAS["front"], RasterSettings())
    assert psnr(image, rasterizer.draw(SPLATS["plausible"], CAMERAS["front"], RasterSettings())) >= FLOAT


@needs_opengl
@pytest.mark.parametrize("precision", osmesa.PRECISIONS)
def test_the_order_of_the_input_does_not_matter(precision: str) -> None:
    shown = SPLATS["plausible"]
    shuffle = np.random.default_rng(1).permutation(len(shown))
    shuffled = ShadedSplats(
        **{field.name: getattr(shown, field.name)[shuffle] for field in dataclasses.fields(ShadedSplats)}
    )
    images = [osmesa.draw(each, CAMERAS["beside"], RasterSettings(), precision=precision) for each in (shown, shuffled)]
    assert psnr(*images) >= FLOAT


@needs_opengl
def test_sorting_by_16_bits_hardly_changes_a_picture() -> None:
    for name in ("plausible", "merged"):
        images = [
            osmesa.draw(SPLATS[name], CAMERAS["beside"], RasterSettings(), sorting=sorting)
            for sorting in settings.SORTINGS
        ]
        assert psnr(*images) >= 60
