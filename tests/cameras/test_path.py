"""What becomes of frames: axes, worlds, lenses, times, and matrices that are none."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera, Settings
from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.formats.table import Axes
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.system.errors import CameraPathError
from tests.cameras.known import KNOWN, LANDMARK, check_pose, pixel, read_fixture, text_file

HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def own(**root: Any) -> CameraPath:
    return own_with(Settings(), **root)


def own_with(settings: Settings, **root: Any) -> CameraPath:
    return read(text_file(json.dumps({"format": "sparklod-camera-path", "version": 1, **root})), settings=settings)


def with_matrix(matrix: NDArray[np.float64], **root: Any) -> Camera:
    return own(frames=[{"matrix": matrix.tolist()}], **root).cameras[0]


@pytest.mark.parametrize("axes", Axes)
def test_a_matrix_means_what_the_user_says(axes: Axes) -> None:
    """One camera, looking along z from (1, 2, 3) with y down, said in four ways."""
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    written = {
        Axes.OPENCV_C2W: pose,
        Axes.OPENGL_C2W: pose @ HALF_TURN,
        Axes.OPENCV_W2C: np.array([[1, 0, 0, -1], [0, 1, 0, -2], [0, 0, 1, -3], [0, 0, 0, 1.0]]),
        Axes.OPENGL_W2C: np.array([[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1.0]]),
    }[axes]
    frames = [{"matrix": written.tolist()}]
    by_option = own_with(Settings(axes=axes), frames=frames)
    by_file = own(frames=frames, axes=axes.value)
    for camera in (by_option.cameras[0], by_file.cameras[0]):
        assert camera.position.tolist() == [1, 2, 3]
        assert camera.forward.tolist() == [0, 0, 1]
        assert camera.camera_to_world[:3, 1].tolist() == [0, -1, 0]


def test_axes_of_a_file_can_be_overridden() -> None:
    """Whoever wrote TUM lines in OpenGL's axes gets cameras that look the other way."""
    assert np.allclose(read_fixture("tum.txt").cameras[1].forward, KNOWN[1].ahead)
    turned = read_fixture("tum.txt", Settings(axes=Axes.OPENGL_C2W)).cameras[1]
    assert np.allclose(turned.forward, -np.array(KNOWN[1].ahead))
    assert np.allclose(turned.position, KNOWN[1].position)


def test_cameras_with_a_target_take_no_axes() -> None:
    with pytest.raises(CameraPathError, match="--camera-axes cannot be used with it"):
        read_fixture("supersplat-v2.json", Settings(axes=Axes.OPENCV_C2W))
    frames = [{"eye": [0, 0, -5], "target": [0, 0, 0]}]
    assert own_with(Settings(axes=Axes.OPENCV_W2C), frames=frames).cameras[0].forward.tolist() == [0, 0, 1]


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
    camera = with_matrix(np.block([[rough, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]))
    rotation = camera.camera_to_world[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.allclose(rotation, rough, atol=0.01)


def test_a_scaled_world_to_camera_matrix_keeps_the_position() -> None:
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    matrix[:3, 3] = -2, -4, -6
    assert with_matrix(matrix, axes="opengl-w2c").position.tolist() == [1, 2, 3]


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


def test_a_file_without_settings_gets_the_defaults() -> None:
    camera = with_matrix(np.eye(4))
    assert (camera.width, camera.height, camera.principal) == (1280, 720, (640, 360))
    assert math.degrees(camera.fov_y) == pytest.approx(60)
    assert camera.focal[0] == camera.focal[1]


def test_another_size_keeps_the_vertical_field_of_view() -> None:
    lens = {"size": [640, 480], "focal": [600, 300], "principal": [330, 250]}
    frames = [{"matrix": np.eye(4).tolist(), **lens}]
    camera = own_with(Settings(size=(1000, 960)), frames=frames).cameras[0]
    assert camera.focal == (1200, 600)
    assert camera.principal == (500 + 2 * 10, 480 + 2 * 10)
    assert camera.fov_y == own(frames=frames).cameras[0].fov_y


def test_another_field_of_view_keeps_the_shape_of_pixels() -> None:
    frames = [{"matrix": np.eye(4).tolist(), "size": [640, 480], "focal": [600, 300]}]
    camera = own_with(Settings(fov_y=math.radians(90)), frames=frames).cameras[0]
    assert camera.focal == pytest.approx((480, 240))


@pytest.mark.parametrize("size", [(1000, 500), (500, 1000)])
def test_supersplat_measures_along_the_longer_side(size: tuple[int, int]) -> None:
    camera = read_fixture("supersplat-v2.json", Settings(size=size)).cameras[0]
    longer = max(camera.fov_x, camera.fov_y)
    assert longer == pytest.approx(2 * math.atan(320 / 600))
    assert (longer == camera.fov_x) == (size[0] > size[1])


def test_camera_angle_x_is_along_x() -> None:
    frame = {"transform_matrix": np.eye(4).tolist(), "file_path": "./r_0"}
    path = read(text_file(json.dumps({"camera_angle_x": math.radians(90), "frames": [frame]})), settings=Settings())
    assert math.degrees(path.cameras[0].fov_x) == pytest.approx(90)
    assert path.cameras[0].name == "./r_0"


def test_a_frame_of_transforms_overrides_the_file() -> None:
    shared = {"w": 640, "h": 480, "fl_x": 600, "cx": 300, "cy": 200, "k1": 0.1, "applied_transform": [[1, 0, 0, 0]] * 3}
    frames = [{"transform_matrix": np.eye(4)[:3].tolist()}, {"transform_matrix": np.eye(4).tolist(), "fl_x": 700}]
    path = read(text_file(json.dumps({**shared, "frames": frames})))
    assert [camera.focal for camera in path.cameras] == [(600, 600), (700, 700)]
    assert path.cameras[0].principal == (300, 200)
    assert path.notes == ("Its lens distortion was ignored.", "Its applied_transform was not undone.")


def test_a_row_of_csv_may_say_where_it_looks() -> None:
    rows = "x,y,z,target_x,target_y,target_z,up_x,up_y,up_z,shutter\n0,0,-5,0,0,0,,,,7\n0,0,-5,0,0,0,0,1,0,7\n"
    path = read(text_file(rows, "a.csv"))
    assert [camera.forward.tolist() for camera in path.cameras] == [[0, 0, 1]] * 2
    assert [camera.camera_to_world[1, 1] for camera in path.cameras] == [-1, 1]
    assert path.notes == ("Unknown columns were ignored: shutter.",)


def test_cameras_of_inria_without_a_lens() -> None:
    path = read(text_file('[{"position": [1, 2, 3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]'))
    assert (path.cameras[0].width, path.cameras[0].position.tolist()) == (1280, [1, 2, 3])


def test_times_come_from_the_file_or_from_frames_a_second() -> None:
    frames = [{"matrix": np.eye(4).tolist(), "time": 100 + 2 * k} for k in range(5)]
    path = own_with(Settings(every=2), frames=frames)
    assert path.numbers == (0, 2, 4)
    assert [camera.time for camera in path.cameras] == [0, 4, 8]
    path = own_with(Settings(every=2, fps=10), frames=frames)
    assert [camera.time for camera in path.cameras] == pytest.approx([0, 0.2, 0.4])
    assert "do not increase" in own(frames=frames[::-1]).notes[0]


def test_a_path_of_millions_is_an_error() -> None:
    with pytest.raises(CameraPathError, match=r"it has 30,000,001 cameras, more than 65,536; leave some out"):
        keys = [{"eye": [k, 0, 0], "target": [0, 0, 9], "time": k * 1e6} for k in range(2)]
        own(keyframes=keys)


@pytest.mark.parametrize("step", [False, True])
def test_supersplat_interpolates_between_its_keys(step: bool) -> None:
    """Keys at frames 0 and 10 of a straight line; a step holds the first until the second."""
    values = {"position": [0, 0, 0, 10, 0, 0], "target": [0, 0, 9, 10, 0, 9], "fov": [50, 60]}
    track = {
        "duration": 1,
        "frameRate": 20,
        "loopMode": "none",
        "interpolation": "step" if step else "spline",
        "smoothness": 1,
        "keyframes": {"times": [0, 10], "values": values},
    }
    path = read(text_file(json.dumps({"version": 2, "animTracks": [track]})))
    assert len(path.cameras) == 20
    assert path.cameras[5].position.tolist() == pytest.approx([0 if step else 5, 0, 0])
    assert path.cameras[15].position.tolist() == [10, 0, 0]
    half = read(text_file(json.dumps({"version": 2, "animTracks": [track]})), settings=Settings(fps=10))
    assert [camera.time for camera in half.cameras] == pytest.approx(np.arange(10) / 10)
    assert half.cameras[1].position.tolist() == pytest.approx(path.cameras[2].position.tolist())


def test_a_loop_of_supersplat_goes_back_to_its_beginning() -> None:
    poses = [
        {"frame": frame, "position": position, "target": [0, 0, 0]}
        for frame, position in ((0, [5, 0, 0]), (30, [0, 0, 5]), (60, [-5, 0, 0]), (90, [0, 0, -5]))
    ]
    document = {"timeline": {"frames": 120, "frameRate": 30, "loop": True}, "poseSets": [{"poses": poses}]}
    path = read(text_file(json.dumps(document)))
    assert len(path.cameras) == 120
    distances = [float(np.linalg.norm(camera.position)) for camera in path.cameras]
    assert min(distances) > 4.4  # a circle, almost, also from the last key to the first
    assert math.degrees(path.cameras[0].fov_x) == pytest.approx(60)


def test_views_of_supersplat_where_there_is_no_animation() -> None:
    view = {"position": [1, 2, 3], "target": [0, 0, 0]}
    two = read(text_file(json.dumps({"version": 2, "animTracks": [], "cameras": [{"initial": {**view, "fov": 40}}]})))
    one = read(text_file(json.dumps({"camera": view, "background": {"color": [0, 0, 0]}})))
    assert math.degrees(two.cameras[0].fov_x) == pytest.approx(40)
    assert math.degrees(one.cameras[0].fov_x) == pytest.approx(75)
    assert one.cameras[0].position.tolist() == two.cameras[0].position.tolist() == [1, 2, 3]
    assert one.cameras[0].camera_to_world[1, 1] > 0, "y is up in SuperSplat"


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
