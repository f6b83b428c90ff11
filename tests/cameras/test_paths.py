"""Cameras of a path: axes, worlds, lenses and times of frames; orbits, dollies and keyframes; framing of a scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.cameras import sources
from sparklod_cli.cameras.camera import Camera, Frame, Intrinsics, Settings, look_at
from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.camera_formats import Axes
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
from sparklod_cli.cameras.sources import (
    CameraPath,
    Key,
    between,
    cameras_of,
)
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.render_settings import RasterSettings
from sparklod_cli.system.errors import CameraPathError, InvalidSplatsError
from tests.cameras.known import FOCAL, HALF_TURN, KNOWN, LANDMARK, check_pose, pixel, read_fixture, read_json, text_file
from tests.simulation.conftest import UP


def own(settings: Settings | None = None, **root: Any) -> CameraPath:
    return read_json({"format": "sparklod-camera-path", "version": 1, **root}, settings)


def with_matrix(matrix: NDArray[np.float64], **root: Any) -> Camera:
    return own(frames=[{"matrix": matrix.tolist()}], **root).cameras[0]


def no_scene() -> Balls:
    raise AssertionError("the scene has no influence")


def orbited(count: int, center: Any, distance: float, degrees: float, **settings: Any) -> CameraPath:
    return sources.orbit(count, center, distance, degrees, Settings(**settings), no_scene)


@pytest.mark.parametrize("axes", Axes)
def test_a_matrix_has_the_axes_of_the_option_or_of_the_file(axes: Axes) -> None:
    """One camera, looking along z from (1, 2, 3) with y down, written in four ways."""
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    written = {
        Axes.OPENCV_C2W: pose,
        Axes.OPENGL_C2W: pose @ HALF_TURN,
        Axes.OPENCV_W2C: np.array([[1, 0, 0, -1], [0, 1, 0, -2], [0, 0, 1, -3], [0, 0, 0, 1.0]]),
        Axes.OPENGL_W2C: np.array([[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1.0]]),
    }[axes]
    frames = [{"matrix": written.tolist()}]
    for (camera,) in (own(Settings(axes=axes), frames=frames), own(frames=frames, axes=axes.value)):
        assert camera.position.tolist() == [1, 2, 3]
        assert camera.forward.tolist() == [0, 0, 1]
        assert camera.camera_to_world[:3, 1].tolist() == [0, -1, 0]


def test_a_world_is_turned_scaled_and_moved() -> None:
    world = np.array([[0, -2, 0, 10], [2, 0, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1.0]])
    before = read_fixture("inria.json").cameras[2]
    after = read_fixture("inria.json", Settings(world=world)).cameras[2]
    assert np.allclose(after.position, (world @ [*before.position, 1])[:3])
    assert np.allclose(np.linalg.norm(after.camera_to_world[:3, :3], axis=0), 1)
    moved = tuple((world @ [*LANDMARK, 1])[:3])
    assert np.allclose(pixel(after, moved), pixel(before, LANDMARK))


def test_scale_is_removed_from_a_pose_and_rounding_is_corrected() -> None:
    pose = np.eye(4)
    pose[:3, :3] = 3 * np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    pose[:3, 3] = 1, 2, 3
    camera = with_matrix(pose)
    assert np.allclose(camera.camera_to_world[:3, :3], pose[:3, :3] / 3)
    assert camera.position.tolist() == [1, 2, 3]
    rough = np.round(pose[:3, :3] / 3 + 0.002, 2)
    rotation = with_matrix(np.block([[rough, np.zeros((3, 1))], [np.zeros((1, 3)), 1]])).camera_to_world[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.allclose(rotation, rough, atol=0.01)
    inverse = np.diag([2.0, 2.0, 2.0, 1.0])
    inverse[:3, 3] = -2, -4, -6
    assert with_matrix(inverse, axes="opengl-w2c").position.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (np.diag([1.0, 1.0, 0.0, 1.0]), "determinant 0"),
        (np.zeros((4, 4)), "whose last row is not 0 0 0 1"),
        (np.diag([1.0, 1.0, 1.2, 1.0]), "not at right angles, or not of the same length"),
        (np.eye(4) + np.eye(4, k=1) * [[0.3], [0], [0], [0]], "not at right angles"),
        (np.eye(4) * 2, "last row is not"),
        (np.eye(4) + np.eye(4, k=3) * 1e300, "not finite, or too large"),
    ],
)
def test_a_matrix_that_is_not_a_pose_is_an_error_that_names_the_frame(matrix: NDArray[np.float64], said: str) -> None:
    good = {"matrix": np.eye(4).tolist()}
    with pytest.raises(CameraPathError, match=f"the camera of frame 1 \\(second\\) .*{said}"):
        own(frames=[good, {"matrix": matrix.tolist(), "name": "second"}])


def test_a_matrix_that_cannot_be_inverted_is_an_error() -> None:
    flat = np.diag([1.0, 1.0, 0.0, 1.0]).tolist()
    with pytest.raises(CameraPathError, match="frame 0 has a matrix that cannot be inverted"):
        own(frames=[{"matrix": flat}], axes="opencv-w2c")


def test_eye_and_target_quaternion_and_flat_matrix_give_the_same_pose() -> None:
    """Eye, target and up; position and quaternion; a flat matrix."""
    known = KNOWN[3]
    target = np.array(known.position) + 3 * np.array(known.ahead)
    up = (-np.array(known.down)).tolist()
    quat = {"quat_xyzw": [1, 4, -2, -2], "position": known.position}  # 1 2 2 4 times half a turn about x
    looking = {"eye": known.position, "target": target.tolist(), "up": up}
    for frame in (looking, quat):
        check_pose(own(frames=[frame]).cameras[0], known)
    flat = {"matrix": own(frames=[quat]).cameras[0].camera_to_world.ravel().tolist()}
    check_pose(own(frames=[flat]).cameras[0], known)


def test_a_file_without_a_lens_gets_the_defaults() -> None:
    inria = read(text_file('[{"position": [1, 2, 3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]'))
    assert inria.cameras[0].position.tolist() == [1, 2, 3]
    for camera in (with_matrix(np.eye(4)), inria.cameras[0]):
        assert (camera.width, camera.height, camera.principal) == (1280, 720, (640, 360))
        assert math.degrees(camera.fov_y) == pytest.approx(60)
        assert camera.focal[0] == camera.focal[1]


def test_another_size_has_the_same_vertical_field_of_view_and_another_field_of_view_the_same_pixels() -> None:
    frames = [{"matrix": np.eye(4).tolist(), "size": [640, 480], "focal": [600, 300], "principal": [330, 250]}]
    camera = own(Settings(size=(1000, 960)), frames=frames).cameras[0]
    assert camera.focal == (1200, 600)
    assert camera.principal == (500 + 2 * 10, 480 + 2 * 10)
    assert camera.fov_y == own(frames=frames).cameras[0].fov_y
    assert own(Settings(fov_y=math.radians(90)), frames=frames).cameras[0].focal == pytest.approx((480, 240))


@pytest.mark.parametrize("size", [(1000, 500), (500, 1000)])
def test_supersplat_measures_the_field_of_view_along_the_longer_side(size: tuple[int, int]) -> None:
    camera = read_fixture("supersplat-v2.json", Settings(size=size)).cameras[0]
    longer = max(camera.fov_x, camera.fov_y)
    assert longer == pytest.approx(2 * math.atan(320 / FOCAL))
    assert (longer == camera.fov_x) == (size[0] > size[1])


def test_lenses_of_transforms_are_those_of_the_frame_or_of_the_file() -> None:
    whole, short = np.eye(4).tolist(), np.eye(4)[:3].tolist()
    (camera,) = read_json({"camera_angle_x": math.radians(90), "frames": [{"transform_matrix": whole}]})
    assert math.degrees(camera.fov_x) == pytest.approx(90)
    shared = {"w": 640, "h": 480, "fl_x": 600, "cx": 300, "cy": 200, "k1": 0.1, "applied_transform": [[1, 0, 0, 0]] * 3}
    frames = [{"transform_matrix": short}, {"transform_matrix": whole, "fl_x": 700}]
    path = read_json({**shared, "frames": frames})
    assert [camera.focal for camera in path] == [(600, 600), (700, 700)]
    assert path.cameras[0].principal == (300, 200)
    assert path.notes == ("Its lens distortion was ignored.", "Its applied_transform was not undone.")


def test_a_row_of_csv_may_say_where_it_looks() -> None:
    rows = "x,y,z,target_x,target_y,target_z,up_x,up_y,up_z,shutter\n0,0,-5,0,0,0,,,,7\n0,0,-5,0,0,0,0,1,0,7\n"
    path = read(text_file(rows, "a.csv"))
    assert [camera.forward.tolist() for camera in path.cameras] == [[0, 0, 1]] * 2
    assert [camera.camera_to_world[1, 1] for camera in path.cameras] == [-1, 1]
    assert path.notes == ("Unknown columns were ignored: shutter.",)


def test_times_come_from_the_file_or_from_frames_a_second() -> None:
    frames = [{"matrix": np.eye(4).tolist(), "time": 100 + 2 * k} for k in range(5)]
    path = own(Settings(every=2), frames=frames)
    assert path.numbers == (0, 2, 4)
    assert [camera.time for camera in path] == [0, 4, 8]
    assert [camera.time for camera in own(Settings(every=2, fps=10), frames=frames)] == pytest.approx([0, 0.2, 0.4])
    assert "do not increase" in own(frames=frames[::-1]).notes[0]
    orbit = orbited(4, (0, 0, 0), 1, 0, fps=2)
    assert [camera.time for camera in orbit] == [0, 0.5, 1, 1.5]
    assert (orbit.format, orbit.notes) == ("an orbit", ())


@pytest.mark.parametrize("step", [False, True])
def test_supersplat_interpolates_between_its_keys(step: bool) -> None:
    """Keys at frames 0 and 10 of a straight line; a step holds the first until the second."""
    track = {
        "duration": 1,
        "frameRate": 20,
        "loopMode": "none",
        "interpolation": "step" if step else "spline",
        "smoothness": 1,
        "keyframes": {
            "times": [0, 10],
            "values": {"position": [0, 0, 0, 10, 0, 0], "target": [0, 0, 9, 10, 0, 9], "fov": [50, 60]},
        },
    }
    path = read_json({"version": 2, "animTracks": [track]})
    assert len(path.cameras) == 20
    assert path.cameras[5].position.tolist() == pytest.approx([0 if step else 5, 0, 0])
    assert path.cameras[15].position.tolist() == [10, 0, 0]
    half = read_json({"version": 2, "animTracks": [track]}, Settings(fps=10))
    assert [camera.time for camera in half] == pytest.approx(np.arange(10) / 10)
    assert half.cameras[1].position.tolist() == pytest.approx(path.cameras[2].position.tolist())


def test_a_loop_of_supersplat_goes_back_to_its_beginning() -> None:
    poses = [
        {"frame": frame, "position": position, "target": [0, 0, 0]}
        for frame, position in ((0, [5, 0, 0]), (30, [0, 0, 5]), (60, [-5, 0, 0]), (90, [0, 0, -5]))
    ]
    timeline = {"frames": 120, "frameRate": 30, "loop": True}
    path = read_json({"timeline": timeline, "poseSets": [{"poses": poses}]})
    assert len(path.cameras) == 120
    # A circle, almost, also from the last key to the first.
    assert min(float(np.linalg.norm(camera.position)) for camera in path) > 4.4
    assert math.degrees(path.cameras[0].fov_x) == pytest.approx(60)


def test_supersplat_without_an_animation_has_its_views() -> None:
    view = {"position": [1, 2, 3], "target": [0, 0, 0]}
    (two,) = read_json({"version": 2, "animTracks": [], "cameras": [{"initial": {**view, "fov": 40}}]})
    (one,) = read_json({"camera": view, "background": {"color": [0, 0, 0]}})
    assert [math.degrees(camera.fov_x) for camera in (two, one)] == pytest.approx([40, 75])
    assert one.position.tolist() == two.position.tolist() == [1, 2, 3]
    assert one.camera_to_world[1, 1] > 0, "y is up in SuperSplat"


@pytest.mark.parametrize(("degrees", "follows"), [(0, True), (14.9, True), (15.1, False), (180, False)])
def test_a_camera_follows_another_if_it_turns_little(degrees: float, follows: bool) -> None:
    turn = math.radians(degrees)
    ahead = [[0, 0, 1], [math.sin(turn), 0, math.cos(turn)], [math.sin(turn), 0, math.cos(turn)]]
    path = own(frames=[{"eye": [at, 0, 0], "target": [at + x, y, z]} for at, (x, y, z) in enumerate(ahead)])
    assert [path.follows(at) for at in range(3)] == [False, follows, True]


def test_rolls_other_sizes_and_cameras_without_later_times_do_not_follow() -> None:
    eye: dict[str, Any] = {"eye": [0, 0, 0], "target": [0, 0, 1]}
    for other, follows in (
        ({"up": [0.1, -1, 0]}, True),
        ({"up": [0.5, -1, 0]}, False),
        ({"size": [640, 480]}, False),
        ({"time": 0.0}, False),
        ({"time": 0.1}, True),
    ):
        assert own(frames=[eye | {"time": 0.0}, eye | {"time": 1.0} | other]).follows(1) is follows, other


# Orbits, dollies and keyframes


def moved(*how: Any) -> list[Frame]:
    """All frames between keys."""
    frames, count = between(*how)
    cameras_of(frames, Settings(), "keyframes", count=count)  # fails for too many
    return frames(np.arange(math.ceil(count)))


def positions(frames: list[Frame]) -> NDArray[np.float64]:
    return np.array([frame.matrix[:3, 3] for frame in frames])


def aheads(frames: list[Frame]) -> NDArray[np.float64]:
    return np.array([-frame.matrix[:3, 2] for frame in frames])


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0), (1, 2, 3)])
def test_an_orbit_goes_around_once_and_looks_inwards(up: tuple[float, float, float]) -> None:
    center, distance, elevation = np.array([1.0, 2.0, 3.0]), 5.0, math.radians(30)
    path = orbited(12, center, distance, 30, up=up)
    offsets = np.array([camera.position for camera in path]) - center
    axis = np.array(up) / np.linalg.norm(up)
    assert np.allclose(np.linalg.norm(offsets, axis=1), distance)
    assert np.allclose(offsets @ axis, distance * math.sin(elevation))
    assert np.allclose([camera.forward for camera in path], -offsets / distance)
    around = offsets - (offsets @ axis)[:, None] * axis
    turns = np.cross(around, np.roll(around, -1, axis=0)) @ axis
    assert np.allclose(turns, (distance * math.cos(elevation)) ** 2 * math.sin(2 * math.pi / 12)), "to the left, evenly"
    assert all(camera.camera_to_world[:3, 1] @ axis > 0 for camera in path)


@pytest.mark.parametrize(("up", "front"), [((0, -1, 0), (0, 0, -1)), ((0, 1, 0), (0, 0, 1)), ((0, 0, 1), (0, -1, 0))])
def test_a_scene_is_first_seen_from_its_front(up: tuple[float, ...], front: tuple[float, ...]) -> None:
    dolly = sources.dolly(1, (0, 0, 0), 2, 0, Settings(up=up), no_scene)
    for path in (orbited(4, (0, 0, 0), 2, 0, up=up), dolly):
        assert np.allclose(path[0].position, 2 * np.array(front))


def test_distances_of_a_dolly_have_one_ratio() -> None:
    path = sources.dolly(0.3, (1, 1, 1), 16, 20, Settings(), no_scene)
    distances = [np.linalg.norm(camera.position - 1) for camera in path]
    assert np.allclose(distances, 16 ** np.linspace(1, 0, 9))
    assert np.allclose([camera.forward for camera in path], path[0].forward)


def test_looking_along_up_still_makes_a_camera() -> None:
    for up in (UP, (0, 0, 0)):
        pose = look_at((0, 5, 0), (0, 0, 0), up)
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3))
        assert np.allclose(pose[:3, 2], (0, 1, 0))


KEYS = [
    Key((0.0, 0.0, -9.0), (0.0, 0.0, 0.0), fov=math.radians(40)),
    Key((1.0, 0.0, -9.0), (0.0, 0.0, 0.0), fov=math.radians(80)),
    Key((9.0, -3.0, 0.0), (0.0, 1.0, 0.0), fov=math.radians(80)),
    Key((0.0, -3.0, 9.0), (2.0, 0.0, 0.0), fov=math.radians(40)),
]


def test_a_path_passes_its_keyframes_without_jumps() -> None:
    frames = moved(KEYS, 200, UP)
    seen = positions(frames)
    assert len(frames) == 1 + 200 * 6
    for key in KEYS:
        nearest = int(np.argmin(np.linalg.norm(seen - key.eye, axis=1)))
        assert np.linalg.norm(seen[nearest] - key.eye) < 0.05
        ahead = np.subtract(key.target, key.eye)
        assert aheads(frames)[nearest] @ ahead / np.linalg.norm(ahead) > 0.9999
    assert np.allclose(seen[[0, -1]], [KEYS[0].eye, KEYS[-1].eye])
    speed = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    assert np.abs(np.diff(speed)).max() < 0.05 * speed.max(), "the speed has no steps"
    fovs = [frame.lens.fov for frame in frames]
    assert min(fovs) == pytest.approx(math.radians(40))
    assert max(fovs) == pytest.approx(math.radians(80)), "no overshooting"


def test_keyframes_without_a_lens_keep_the_given_one() -> None:
    lens = Intrinsics((640, 480), (600, 610), (300, 200))
    keys = [Key(key.eye, key.target) for key in KEYS]
    assert all(frame.lens == lens for frame in moved(keys, 5, UP, lens))
    mixed = moved([keys[0], KEYS[1]], 5, UP)
    assert mixed[0].lens.fov == pytest.approx(math.radians(60))


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ((0.0, None), "some have none"),
        ((1.0, 1.0), "do not increase"),
        ((0.0, 1e300), "are more than"),
        ((0.0, 1e6), "it has 30,000,001 cameras, more than 65,536; leave some out"),
    ],
)
def test_keyframe_times_that_do_not_rise_or_are_far_apart_are_refused(
    times: tuple[float | None, ...], said: str
) -> None:
    keys = [Key(key.eye, key.target, time=time) for key, time in zip(KEYS, times, strict=False)]
    with pytest.raises(CameraPathError, match=said):
        moved(keys, 30, UP)


# Framing: cameras that have a scene in view

SIZES = st.sampled_from([(1280, 720), (720, 1280), (500, 500), (2000, 100)])


@st.composite
def scenes(draw: st.DrawFn) -> Balls:
    random = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    count, size = draw(st.integers(1, 300)), draw(st.sampled_from([1e-4, 1.0, 1e6]))
    stretch = np.array(draw(st.tuples(*[st.sampled_from([0.0, 0.01, 0.3, 1.0])] * 3)))
    shift = np.array(draw(st.tuples(*[st.integers(-10, 10)] * 3)))
    center = size * (random.normal(size=(count, 3)) * stretch + shift)
    return Balls(center, size * draw(st.sampled_from([0.0, 0.01, 1.0])) * random.random(count))


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


@given(scene=scenes(), size=SIZES, azimuth=st.integers(0, 35), tilt=st.floats(-80, 80), fov=st.floats(20, 100))
def test_a_fitted_camera_sees_the_whole_scene_and_fills_its_picture(
    scene: Balls, size: tuple[int, int], azimuth: int, tilt: float, fov: float
) -> None:
    scene = covered(scene)
    camera = orbited(36, (0, 0, 0), 1, tilt, size=size, fov_y=math.radians(fov))[azimuth]
    reach = places(fitted(camera, scene), scene)
    assert reach.max() <= FILLED * (1 + 1e-4)
    # Along one of the sides it is as large as it can be: it touches both margins.
    sides = reach.max(axis=0)
    assert max(sides[:2].min(), sides[2:].min()) >= FILLED * (1 - 1e-4)


@given(scene=scenes(), size=SIZES, count=st.integers(1, 24), tilt=st.floats(-80, 80))
def test_every_camera_of_an_orbit_sees_the_whole_scene_and_one_just_so(
    scene: Balls, size: tuple[int, int], count: int, tilt: float
) -> None:
    scene = covered(scene)
    middle = middle_of(scene)
    away = distance(orbited(count, (0, 0, 0), 1, tilt, size=size).cameras, middle, scene)
    path = orbited(count, middle, away, tilt, size=size)
    assert max(places(camera, scene).max() for camera in path) == pytest.approx(FILLED, rel=1e-4)


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
    cameras = [fitted(camera, scene) for camera in orbited(5, (0, 0, 0), 1, 0)]
    default = RasterSettings()
    near, far = reach(default.near, default.far, cameras, scene)
    for camera in cameras:
        depth = (scene.center - camera.position) @ camera.forward
        assert near < depth.min()
        assert far > depth.max()
    assert near <= default.near
    assert far >= default.far
    assert np.isfinite(np.float32(far))
