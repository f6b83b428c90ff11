"""Where cameras stand that are to see a scene: laws over any scene, size of picture and direction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras import sources
from sparklod_cli.cameras.camera import DEFAULT_UP, Camera, Frame, Settings, camera_of
from sparklod_cli.cameras.framing import (
    FILLED,
    OUTSIDE,
    Balls,
    balls_of,
    covered,
    distance,
    fitted,
    framing,
    middle_of,
    reach,
)
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.system.errors import InvalidSplatsError

SIZES = st.sampled_from([(1280, 720), (720, 1280), (500, 500), (2000, 100)])


@st.composite
def scenes(draw: st.DrawFn) -> Balls:
    random = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    count, size = draw(st.integers(1, 300)), draw(st.sampled_from([1e-4, 1.0, 1e6]))
    stretch = np.array(draw(st.tuples(*[st.sampled_from([0.0, 0.01, 0.3, 1.0])] * 3)))
    shift = np.array(draw(st.tuples(*[st.integers(-10, 10)] * 3)))
    center = size * (random.normal(size=(count, 3)) * stretch + shift)
    return Balls(center, size * draw(st.sampled_from([0.0, 0.01, 1.0])) * random.random(count))


def orbited(count: int, center: object, distance: float, elevation: float, up: object) -> list[Frame]:
    return sources.orbit_frames(np.arange(count), count, center, distance, elevation, up)  # type: ignore[arg-type]


def places(camera: Camera, scene: Balls) -> np.ndarray:
    """(N, 4) how far each ball reaches to the right, left, top and bottom: 1 is the edge of the picture."""
    local = (scene.center - camera.position) @ camera.camera_to_world[:3, :3]
    half = np.array([camera.width, camera.height]) / (2 * np.asarray(camera.focal))
    assert (local[:, 2] < 0).all(), "in front of the camera"
    reach = []
    for axis in (0, 1):
        for sign in (1, -1):
            # A sphere is seen between its two tangents from the eye, which are so far to either side of its centre.
            away = np.hypot(local[:, axis], local[:, 2])
            angle = np.arctan2(sign * local[:, axis], -local[:, 2]) + np.arcsin(np.minimum(1, scene.radius / away))
            assert (angle < math.pi / 2).all()
            reach.append(np.tan(angle) / half[axis])
    return np.stack(reach, axis=1)


@given(scene=scenes(), size=SIZES, azimuth=st.floats(0, 360), tilt=st.floats(-80, 80), fov=st.floats(20, 100))
def test_a_fitted_camera_sees_the_whole_scene_and_fills_its_picture(
    scene: Balls, size: tuple[int, int], azimuth: float, tilt: float, fov: float
) -> None:
    scene = covered(scene)
    start = orbited(360, (0, 0, 0), 1, math.radians(tilt), DEFAULT_UP)[int(azimuth) % 360]
    settings = Settings(size=size, fov_y=math.radians(fov))
    camera = fitted(camera_of(start.matrix, start.lens, 0, "", settings), scene)
    reach = places(camera, scene)
    assert reach.max() <= FILLED * (1 + 1e-4)
    # Along one of the sides it is as large as it can be: it touches both margins.
    sides = reach.max(axis=0)
    assert max(sides[:2].min(), sides[2:].min()) >= FILLED * (1 - 1e-4)


@given(scene=scenes(), size=SIZES, count=st.integers(1, 24), tilt=st.floats(-80, 80))
def test_every_camera_of_an_orbit_sees_the_whole_scene(
    scene: Balls, size: tuple[int, int], count: int, tilt: float
) -> None:
    scene = covered(scene)
    middle = middle_of(scene)
    settings = Settings(size=size)

    def around(away: float, at: np.ndarray) -> list[Camera]:
        frames = orbited(count, at, away, math.radians(tilt), DEFAULT_UP)
        return [camera_of(frame.matrix, frame.lens, 0, "", settings) for frame in frames]

    away = distance(around(1, np.zeros(3)), middle, scene)
    reach = [places(camera, scene).max() for camera in around(away, middle)]
    assert max(reach) == pytest.approx(FILLED, rel=1e-4), "and one of them as large as it can be"


def test_the_largest_thousandth_of_the_balls_is_left_out() -> None:
    random = np.random.default_rng(0)
    scene = Balls(random.uniform(-1, 1, (20_000, 3)), np.full(20_000, 0.1))
    scene.radius[:10] = 2.2  # few, and large
    kept = covered(scene)
    assert 0.999 * 20_000 <= len(kept.center) <= 0.999 * 20_000 + 1
    assert kept.radius.max() == 0.1
    assert np.allclose(middle_of(kept), 0, atol=0.1)
    one = covered(Balls(np.zeros((1, 3)), np.array([50.0])))
    assert one.radius.tolist() == [50], "all that there is counts, however large it is"
    assert covered(Balls(np.full((3, 3), 2.0), np.zeros(3))).radius.min() > 0, "a point has some size"
    assert covered(Balls(np.zeros((3, 3)), np.zeros(3))).radius.min() > 0


def test_a_backdrop_is_not_framed() -> None:
    random = np.random.default_rng(0)
    center = random.uniform(-1, 1, (20_000, 3)) + np.array([5, 6, 7])
    center[:1000] = 1e6 * random.normal(size=(1000, 3))
    kept = covered(Balls(center, np.zeros(20_000)))
    middle, radius = framing(center)
    assert np.linalg.norm(kept.center - middle, axis=1).max() <= OUTSIDE * radius
    assert len(kept.center) == pytest.approx(19_000, rel=0.01)


def test_stray_splats_and_haze_are_not_framed() -> None:
    """Around a ground whose splats touch each other are small ones with room between them, and faint ones."""
    random = np.random.default_rng(0)
    splats = Splats.zeros(22_000, 0)
    splats.center[:20_000, ::2] = random.uniform(-1, 1, (20_000, 2))
    splats.center[20_000:] = random.uniform(-2.5, 2.5, (2_000, 3))
    splats.scale[:20_000], splats.scale[20_000:] = 0.01, 0.005
    splats.opacity[:] = 1
    splats.scale[21_000:], splats.opacity[21_000:] = 0.3, 0.1
    kept = covered(balls_of(splats, slice(None), np.eye(4)))
    assert np.abs(kept.center).max() <= 1.2
    assert np.count_nonzero(np.abs(kept.center).max(axis=1) <= 1) > 0.99 * 20_000


@pytest.mark.parametrize(("opacity", "radius"), [(1, 2), (50, 2), (math.exp(-1.5), 1), (math.exp(-2), 0), (0, 0)])
def test_a_fainter_splat_covers_less(opacity: float, radius: float) -> None:
    splats = Splats.zeros(1, 0)
    splats.scale[:], splats.opacity[:] = 1, opacity
    assert balls_of(splats, slice(None), np.eye(4)).radius == pytest.approx(radius, abs=1e-3)


def test_framing_ignores_splats_far_away() -> None:
    random = np.random.default_rng(0)
    center = random.normal(size=(20_000, 3)).astype(np.float32) + np.array([5, 6, 7])
    center[:500] = 1e6
    center[500:600] = np.nan
    middle, radius = framing(center)
    assert np.allclose(middle, (5, 6, 7), atol=0.1)
    assert 2 < radius < 3.5
    assert framing(np.full((3, 3), 2.0))[1] == 1, "a scene of one point has some size"
    assert framing(np.repeat(center, 20, axis=0))[1] == pytest.approx(radius, rel=0.02)
    with pytest.raises(InvalidSplatsError, match="no finite centres"):
        framing(np.full((3, 3), np.nan))


@pytest.mark.filterwarnings("error")
def test_balls_have_the_places_of_finite_splats() -> None:
    splats = Splats.zeros(5, 0)
    splats.opacity[:] = 1
    splats.scale[:] = (0.1, 0.5, 0.2)
    splats.center[:, 0] = (1, 2, np.nan, 3e38, 4)
    splats.scale[4] = np.inf
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[:3, 3] = (0, 0, 7)
    found = balls_of(splats, slice(None), matrix)
    assert np.allclose(found.center, [(2, 0, 7), (4, 0, 7), (2 * float(np.float32(3e38)), 0, 7)])
    assert np.allclose(found.radius, 2.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-6, 1e-4, 1.0, 1e5, 1e30])
def test_the_clip_planes_reach_around_a_scene_of_any_size(size: float) -> None:
    scene = covered(Balls(np.random.default_rng(0).normal(size=(500, 3)) * size, np.zeros(500)))
    frames = orbited(5, (0, 0, 0), 1, 0, DEFAULT_UP)
    cameras = [fitted(camera_of(frame.matrix, frame.lens, 0, "", Settings()), scene) for frame in frames]
    default = RasterSettings()
    near, far = reach(default.near, default.far, cameras, scene)
    for camera in cameras:
        depth = (scene.center - camera.position) @ camera.forward
        assert near < depth.min()
        assert far > depth.max()
    assert near <= default.near
    assert far >= default.far
    assert np.isfinite(np.float32(far))
