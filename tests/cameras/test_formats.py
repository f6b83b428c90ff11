"""Files of camera paths: every format, faults and damage in them, and the programs that write them."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.camera_files import Files, read, read_path
from sparklod_cli.cameras.camera_formats import FORMATS
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.system.errors import CameraPathError
from tests.cameras.known import (
    FOCAL,
    FOLDER,
    FOV_Y,
    HALF_TURN,
    KNOWN,
    LANDMARK,
    OUT_OF_PLAYCANVAS,
    SIZE,
    check_pose,
    files_at,
    pixel,
    read_fixture,
    read_json,
    text_file,
)
from tests.interop.node import ENGINES, folder_with

#: What has to be said about a format that leaves things open.
NO_LENS = Settings(size=SIZE, fov_y=FOV_Y)
TURNED = Settings(size=SIZE, world=OUT_OF_PLAYCANVAS)

#: File, its format, how many of the cameras it has, the settings that it needs, the time of its second camera.
CASES = {
    "sparklod.json": ("sparklod", 4, None, 1 / 25),
    "sparklod.csv": ("csv", 4, None, 1 / 25),
    "nerfstudio.json": ("nerfstudio", 4, None, 1 / 25),
    "transforms.json": ("transforms", 4, None, 1 / 30),
    "inria.json": ("inria", 4, None, 1 / 30),
    "colmap-text": ("colmap", 4, None, 1 / 30),
    "colmap-binary": ("colmap", 4, None, 1 / 30),
    "open3d.json": ("open3d", 4, None, 1 / 30),
    "open3d.log": ("open3d", 4, NO_LENS, 1 / 30),
    "supersplat-v2.json": ("supersplat", 3, TURNED, 1 / 25),
    "supersplat-v1.json": ("supersplat", 3, TURNED, 1 / 30),
    "supersplat-document.json": ("supersplat", 3, TURNED, 1 / 25),
    "splat-transform.json": ("camera-track", 4, TURNED, 1 / 25),
    "tum.txt": ("tum", 4, NO_LENS, 1 / 25),
}


@pytest.mark.parametrize("named", [False, True], ids=["by-content", "by-name"])
@pytest.mark.parametrize("name", CASES)
def test_every_format_gives_the_known_cameras(name: str, named: bool) -> None:
    form, count, settings, second = CASES[name]
    path = read_fixture(name, settings, format=form if named else None)
    assert path.format == next(row.title for row in FORMATS if row.name == form)
    assert len(path.cameras) == count
    assert path.numbers == tuple(range(count))
    for camera, known in zip(path.cameras, KNOWN, strict=False):
        check_pose(camera, known)
        assert (camera.width, camera.height) == SIZE
        assert np.allclose(camera.focal, FOCAL)
        assert np.allclose(camera.principal, (320, 240))
        assert np.allclose(pixel(camera, LANDMARK), known.landmark, atol=1e-4)
    assert path.cameras[0].time == 0
    assert path.cameras[1].time == pytest.approx(second, abs=1e-6)


@pytest.mark.parametrize("form", [form.name for form in FORMATS])
def test_every_format_has_a_fixture_and_refuses_those_of_others(form: str) -> None:
    assert form in {own for own, *_ in CASES.values()}
    for name, (other, *_) in CASES.items():
        if other != form:
            with pytest.raises(CameraPathError):
                read_fixture(name, format=form)


@pytest.mark.parametrize("form", [None, *(form.name for form in FORMATS)])
def test_every_format_refuses_an_empty_file(form: str | None) -> None:
    for content in ("", "\n", "#", "\ufeff"):
        for name in ("path.json", "path.csv", "images.txt"):
            with pytest.raises(CameraPathError):
                read(text_file(content, name), format=form)


def test_formats_whose_world_may_differ_have_a_note() -> None:
    for name in ("supersplat-v1.json", "splat-transform.json", "nerfstudio.json"):
        assert "--world-transform" in read_fixture(name).notes[-1]
        assert read_fixture(name, Settings(world=np.eye(4))).notes == ()
    assert read_fixture("inria.json").notes == ()


# Labels, distortion, and other fields without an influence on the picture

EYE = np.eye(4).tolist()


def inria(**fields: Any) -> CameraPath:
    return read_json([{"position": [0, 0, -3], "rotation": np.eye(3).tolist(), **fields}])


def transforms(**fields: Any) -> CameraPath:
    return read_json({"frames": [{"transform_matrix": EYE, **fields}]})


def own(**fields: Any) -> CameraPath:
    return read_json({"format": "sparklod-camera-path", "frames": [{"matrix": EYE, **fields}]})


NAMED = {"img_name": inria, "file_path": transforms, "name": own}


@pytest.mark.parametrize("key", NAMED)
def test_a_name_is_a_label_of_any_type(key: str) -> None:
    labels = [(0, "0"), (1.5, "1.5"), (10**30, "1e+30"), (True, "True"), (None, ""), ("", ""), ("a b", "a b")]
    for value, name in (*labels, (["a"], "['a']"), ({"a": 1}, "{'a': 1}")):
        assert [camera.name for camera in NAMED[key](**{key: value})] == [name]


@pytest.mark.parametrize("value", ["unknown", None, [], "0", 0, 0.0])
def test_distortion_that_is_ignored_need_not_be_a_number(value: Any) -> None:
    distorts = value in ("unknown", [])
    for path in (transforms(k1=value), read_json({"k1": value, "frames": [{"transform_matrix": EYE}]})):
        assert path.notes == (("Its lens distortion was ignored.",) if distorts else ())


def test_a_camera_model_that_is_no_text_is_no_panorama() -> None:
    assert len(read_json({"camera_model": 3, "frames": [{"transform_matrix": EYE}]})) == 1


def test_blank_lines_of_a_log_are_skipped() -> None:
    log = (FOLDER / "open3d.log").read_text()
    blank = read(text_file("\n\n".join(log.splitlines()) + "\n\n", "x.log"), format="open3d")
    assert len(blank) == len(read(text_file(log, "x.log")))


def test_animations_and_poses_that_are_not_read_are_noted() -> None:
    viewer = json.loads((FOLDER / "supersplat-v2.json").read_text())
    assert read_json(viewer).notes[:-1] == ()
    viewer["animTracks"] *= 3
    assert read_json(viewer).notes[0] == "Only the first of its 3 animations was read."
    project = json.loads((FOLDER / "supersplat-document.json").read_text())
    assert read_json(project).notes[:-1] == ()
    project["poseSets"][0]["poses"].append({**project["poseSets"][0]["poses"][0], "frame": 99})
    project["poseSets"] *= 2
    assert read_json(project).notes[:2] == (
        "Only the first of its 2 pose sets was read.",
        "Poses beyond the end of its time line were ignored (1).",
    )


# Faults


def own_text(fields: str) -> str:
    return f'{{"format": "sparklod-camera-path", {fields}}}'


def own_frame(fields: str) -> str:
    return own_text(f'"frames": [{{{fields}}}]')


def seen(fields: str) -> str:
    """A file of sparklod's own format with a valid frame."""
    return own_text(f'{fields}, "frames": [{{"eye": [1, 0, 0], "target": [0, 0, 0]}}]')


def track(*times: int, **fields: float) -> str:
    """Settings of SuperSplat's viewer."""
    count = len(times)
    values = {"position": [0, 0, 0] * count, "target": [1, 0, 0] * count, "fov": [60] * count}
    animation = {**fields, "frameRate": 30, "keyframes": {"times": times, "values": values}}
    return json.dumps({"version": 2, "animTracks": [animation]})


TRAJECTORY = '{"class_name": "PinholeCameraTrajectory", "parameters": [%s]}'

#: Content, and a part of the error.
FAULTS: list[tuple[str | bytes, str]] = [
    ("", "it is empty"),
    (bytes(range(256)) * 9, "of no known format"),
    ("<!DOCTYPE html><html></html>", "of no known format"),
    ('{"a": 1}', "of no known format"),
    ("[" * 100_000, "of no known format"),
    (own_text('"frames": []'), "it has no cameras"),
    (own_text('"frames": 7'), "frames: expected a list"),
    (own_text('"frames": [], "keyframes": []'), "it has frames and keyframes; give one of them"),
    ('{"format": "sparklod-camera-path"}', "frames: expected a list, but it is missing"),
    (own_text('"version": 2, "frames": []'), "version 2 is unknown"),
    (own_text('"version": "a\\nb"'), "version 'a"),
    (own_text('"version": [[1]]'), "version .* is unknown"),
    (own_text('"axes": "up", "frames": []'), "axes 'up' are unknown"),
    (own_text('"frames": ["x"]'), "frames.0.: expected an object"),
    (own_frame('"matrix": [1, 2]'), "frames.0..matrix: expected a list of 16 numbers"),
    (own_frame('"eye": [NaN, 0, 0], "target": [0, 0, 0]'), "frames.0..eye.0.: expected a finite number, not nan"),
    (own_frame('"eye": [' + "9" * 4000 + ', 0, 0], "target": [0, 0, 0]'), "expected a finite number"),
    (own_text('"fps": true, "frames": []'), "fps: expected a finite number, not True"),
    (own_text('"fps": 0, "frames": []'), "fps: expected a number above 0"),
    (own_frame('"eye": [1, 2, 3], "target": [1, 2, 3]'), "the camera at 1, 2, 3 looks at its own position"),
    (own_frame('"quat_xyzw": [0, 0, 0, 0], "position": [0, 0, 0]'), "frames.0.: it has a quaternion of length 0"),
    (own_frame('"focal": [9, 9], "eye": [1, 0, 0], "target": [0, 0, 0]'), "frames.0.: a focal length .* needs a size"),
    (seen('"size": [9, 9], "focal": [0, 9]'), "frame 0 has a focal length .* not positive or too large"),
    (seen('"size": [9, 9], "focal": [9, 1e200]'), "frame 0 has a focal length .* not positive or too large"),
    (own_text('"size": [9], "frames": []'), "size: expected a list of 2 numbers"),
    (own_text('"size": [9.5, 9], "frames": []'), "size.0.: expected a number of pixels, not 9.5"),
    (seen('"fov": 180'), "frame 0 has a field of view of 180 degrees"),
    (
        own_frame('"fov": 0, "name": "a\\nb", "eye": [1, 0, 0], "target": [0, 0, 0]'),
        r"frame 0 \(a b\) has a field of view of 0 degrees",
    ),
    (
        own_text(
            '"frames": [{"eye": [1, 0, 0], "target": [0, 0, 0], "time": -1.7e308},'
            ' {"eye": [1, 0, 0], "target": [0, 0, 0], "time": 1.7e308}]'
        ),
        "times are too far apart",
    ),
    (own_text('"keyframes": [{"eye": [1, 0, 0], "target": [0, 0, 0]}]'), "needs at least two keyframes"),
    ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,one\n", "qw of line 2: expected a finite number, not 'one'"),
    ("x,y,z,qx,qy,qz,qw\n1,2,3\n", "line 2 has 3 values, not 7"),
    ("x,y,z,qx,qy,qz,qw,x\n", "names a column twice"),
    ("x,y,z,qx,qy,qz,qw\n", "it has no cameras"),
    ('x,y,z,qx,qy,qz,qw,name\n1,2,3,0,0,0,1,"' + "a" * 200_000 + '"\n', "it is not CSV"),
    ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 one\n", "qw of line 2: expected a finite number, not 'one'"),
    ("1 0 0 0 0 0 0 1\n2 0 0\n", "line 2 has 3 values"),
    ("1 0 0 0 0 0 0 1\n2 inf 0 0 0 0 0 1\n", "tx of line 2: expected a finite number, not 'inf'"),
    ("1 0 0 0 0 0 0 0\n", "line 1: it has a quaternion of length 0"),
    (
        '{"frameRate": 0, "frames": [{"position": [0, 0, 0], "target": [1, 0, 0]}]}',
        "frameRate: expected a number above 0",
    ),
    (
        '{"w": 9, "h": 9, "camera_angle_x": 0, "camera_angle_y": 0, "frames": [{"transform_matrix":'
        " [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}]}",
        "frame 0 has a field of view of 0 degrees",
    ),
    ('{"frames": [{"transform_matrix": [[1, 0, 0, 0]]}]}', "expected a list of 12 or 16 numbers"),
    (
        '{"camera_model": "EQUIRECTANGULAR", "frames": [{"transform_matrix": []}]}',
        "camera_model 'EQUIRECTANGULAR' is not that of a pinhole",
    ),
    ('{"camera_path": [], "camera_type": "equirectangular"}', "not that of a pinhole camera"),
    ('[{"position": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0]]}]', "rotation: expected a list of 9 numbers"),
    ('{"version": 3, "animTracks": []}', "version 3 of SuperSplat's settings"),
    (track(0), "duration: expected a finite number, but it is missing"),
    (track(duration=1), "it has no keyframes"),
    (track(3, 2, duration=1), "do not increase"),
    (track(0, duration=1e9), "it has 30,000,000,000 cameras, more than 65,536; leave some out with --every"),
    ("# Image list with two lines of data per image\n1 1 0 0\n", "line 2 of images.txt has 4"),
]


@pytest.mark.parametrize(("content", "said"), FAULTS, ids=[said for _, said in FAULTS])
def test_a_planted_fault_is_an_error_of_one_line(content: str | bytes, said: str) -> None:
    with pytest.raises(CameraPathError, match=said) as caught:
        read(text_file(content, "broken.json"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("x.json", TRAJECTORY % '{"extrinsic": [1, 2]}', "extrinsic: expected a list of 16 numbers"),
        (
            "x.json",
            TRAJECTORY % '{"extrinsic": [%s]}' % ", ".join("1" * 16),
            "intrinsic: expected an object, but it is missing",
        ),
        ("x.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "line 4: expected a list of 4 numbers"),
        ("x.log", "0 0 1\n1 0 0 0\n0 1 0 0\n", "it ends inside a pose"),
        ("x.log", "0 0 1\n1 0 0 nan\n0 1 0 0\n", "line 2: expected a finite number, not 'nan'"),
        ("x.log", "0 0 1\n" + 4 * "1 0 0 0\n", "it has a matrix that cannot be inverted"),
        ("x.json", "0 0 1\n", "it is not JSON"),
        ("x.trajectory", TRAJECTORY % "", "it has no cameras"),
    ],
)
def test_a_broken_trajectory_of_open3d_is_refused(name: str, content: str, said: str) -> None:
    with pytest.raises(CameraPathError, match=said):
        read(text_file(content, name), format="open3d")


# Damage


def check_any(files: Files, form: str | None) -> None:
    """They are cameras that can be used, or an error of one line; nothing is said by numpy."""
    for settings in (Settings(every=50), Settings(fov_y=1.0, size=(64, 48), fps=3.0, every=50)):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                path = read(files, format=form, settings=settings)
        except CameraPathError as error:
            assert "\n" not in str(error)
            continue
        assert path.cameras
        for camera in path.cameras:
            assert np.isfinite(camera.camera_to_world).all()
            assert min(camera.focal) > 0
            assert np.isfinite(camera.time)


@pytest.mark.parametrize("name", CASES)
@given(data=st.data())
def test_truncated_or_changed_files_give_cameras_or_an_error(name: str, data: st.DataObject) -> None:
    whole = files_at(FOLDER / name)
    contents = dict(whole.contents)
    file = data.draw(st.sampled_from(sorted(contents)))
    content = bytearray(contents[file])
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    for _ in range(data.draw(st.integers(0, 3))):
        if content:
            place = data.draw(st.integers(0, len(content) - 1))
            content[place] = data.draw(st.integers(0, 255))
    contents[file] = bytes(content)
    for form in (None, CASES[name][0]):
        check_any(Files(whole.path, contents), form)


#: Numbers that are finite, and of which few sums and products are.
HUGE = [0.0, -0.0, 5e-324, 1e-300, -1e308, 1e308, 1.7e308, 9223372036854775808, 1.5]


@pytest.mark.parametrize("name", [name for name in CASES if "binary" not in name])
def test_a_number_of_any_size_gives_cameras_or_an_error(name: str) -> None:
    """Each number of a file by turns becomes each of `HUGE`."""
    whole = files_at(FOLDER / name)
    for file, content in whole.contents.items():
        text = content.decode()
        numbers = list(re.finditer(r"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?", text))
        for number in numbers[:: -(-len(numbers) // 60)]:
            for value in HUGE:
                changed = f"{text[: number.start()]}{value!r}{text[number.end() :]}"
                check_any(Files(whole.path, {**whole.contents, file: changed.encode()}), CASES[name][0])


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from(["", "x", "opencv-c2w", "repeat", "1e400"]),
    lambda inner: st.lists(inner, max_size=4) | st.lists(st.integers(-3, 3), min_size=3, max_size=3),
    max_leaves=6,
)


def mutilated(value: Any, data: st.DataObject) -> Any:
    """The value, with one of those in it replaced by anything."""
    if isinstance(value, (dict, list)) and value and data.draw(st.integers(0, 4)):
        keys = sorted(value) if isinstance(value, dict) else range(len(value))
        key = data.draw(st.sampled_from(keys))
        copy = value.copy()
        copy[key] = mutilated(value[key], data)
        return copy
    return data.draw(VALUES)


@pytest.mark.parametrize("name", [name for name in CASES if name.endswith(".json")])
@given(data=st.data())
def test_any_value_replaced_by_another_gives_cameras_or_an_error(name: str, data: st.DataObject) -> None:
    root = mutilated(json.loads((FOLDER / name).read_text(encoding="utf-8")), data)
    for form in (None, CASES[name][0]):
        check_any(text_file(json.dumps(root)), form)


# COLMAP's models, as COLMAP, other programs and hands write them

HEAD = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
COUNTED = HEAD + "# Number of images: 4, mean observations per image: 0\n"

CAMERAS = "1 PINHOLE 640 480 500 500 320 240\n"

POINTS = "10.5 20.5 -1 7 8 12 0 1 0 1 1 1"


def image(number: int, name: str | None = None) -> str:
    return f"{number} 1 0 0 0 0 0 {5 + number} 1 {name or f'i{number}.jpg'}"


def model(images: str, cameras: str | bytes = CAMERAS) -> Files:
    cameras = cameras if isinstance(cameras, bytes) else cameras.encode()
    return Files(Path("sparse"), {"images.txt": images.encode(), "cameras.txt": cameras})


def names(files: Files) -> list[str]:
    return [camera.name for camera in read(files)]


#: What follows each of four images.
LAYOUTS = {
    "lines of points": [f"\n{POINTS}\n"] * 4,
    "empty lines of points": ["\n\n"] * 4,
    "no lines of points": ["\n"] * 4,
    "no empty lines of points": ["\n", f"\n{POINTS}\n", "\n", f"\n{POINTS}\n"],
    "no newline at the end": ["\n", "\n", "\n", ""],
    "blank lines between all lines": [f"\n\n{POINTS}\n\n"] * 4,
    "blanks for points": ["\n  \t\n"] * 4,
    "comments between": ["\n# more\n", f"\n# points\n{POINTS}\n", "\n", "\n"],
    "Windows' ends of lines": [f"\r\n{POINTS}\r\n", "\r\n\r\n", "\r\n", "\r\n"],
    "whole numbers for points": ["\n1 1 0 0 0 0\n", "\n512 256 9\n", "\n3 1 0 0 0 0 0 5 1\n", "\n"],
    "numbers of points as floats": ["\n1.5 2.5 -1.0\n"] * 4,
}


@pytest.mark.parametrize("head", ["", HEAD, COUNTED, "# by another program\n", "\ufeff", "\ufeff" + COUNTED])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_image_is_read_whatever_lines_of_points_follow(layout: str, head: str) -> None:
    images = head + "".join(image(number) + end for number, end in enumerate(LAYOUTS[layout]))
    for files in (model(images), text_file(images, "renamed.dat")):
        assert names(files) == ["i0.jpg", "i1.jpg", "i2.jpg", "i3.jpg"]


@pytest.mark.parametrize("between", ["\n", "\n\n", f"\n{POINTS}\n"])
@pytest.mark.parametrize("name", ["7", "0012", "3.5", "a b.jpg", "1 2.jpg", "-1", "2024 10 3"])
def test_a_name_may_be_a_number_or_have_blanks(name: str, between: str) -> None:
    assert names(model("".join(image(number, name) + between for number in range(4)))) == [name] * 4


def test_colmap_sorts_by_name_as_people_do() -> None:
    assert names(files_at(FOLDER / "colmap-binary")) == ["image8.jpg", "image9.jpg", "image10.jpg", "image11.jpg"]


def test_colmap_without_its_cameras_has_poses() -> None:
    path = read(text_file((FOLDER / "colmap-text" / "images.txt").read_bytes(), "renamed.dat"))
    check_pose(path.cameras[3], KNOWN[3])
    assert path.cameras[0].width == 1280
    assert "its lenses are unknown" in path.notes[0]


CAMERA_LINES = {
    "SIMPLE_PINHOLE 640 480 600 320 240": (600, 600, ""),
    "PINHOLE 640 480 600 610 320 240": (600, 610, ""),
    "SIMPLE_RADIAL 640 480 600 320 240 0.1": (600, 600, "SIMPLE_RADIAL"),
    "RADIAL 640 480 600 320 240 0.1 0.2": (600, 600, "RADIAL"),
    "OPENCV 640 480 600 610 320 240 0.1 0.2 0 0": (600, 610, "OPENCV"),
    "OPENCV_FISHEYE 640 480 600 610 320 240 0 0 0 0": (600, 610, "OPENCV_FISHEYE"),
    "FULL_OPENCV 640 480 600 610 320 240 0 0 0 0 0 0 0 0": (600, 610, "FULL_OPENCV"),
    "FOV 640 480 600 610 320 240 0.5": (600, 610, "FOV"),
    "THIN_PRISM_FISHEYE 640 480 600 610 320 240 0 0 0 0 0 0 0 0": (600, 610, "THIN_PRISM_FISHEYE"),
    "SIMPLE_FISHEYE 640 480 600 320 240": (600, 600, "SIMPLE_FISHEYE"),
    "EUCM 640 480 600 610 320 240 0.5 1": (600, 610, "EUCM"),
}


@pytest.mark.parametrize("line", CAMERA_LINES)
def test_colmap_distortion_is_dropped_with_a_note(line: str) -> None:
    fx, fy, said = CAMERA_LINES[line]
    path = read(model(image(0) + "\n\n" + image(1), f"1 {line}\n"), format="colmap")
    assert [camera.focal for camera in path] == [(fx, fy)] * 2
    assert path.notes == ((f"The lens distortion of {said} was ignored.",) if said else ())


@pytest.mark.parametrize(
    ("images", "cameras", "said"),
    [
        (COUNTED + "\n".join(map(image, range(3))), CAMERAS, "images.txt has 3 images, but its comment announces 4"),
        (COUNTED + "\n\n".join(map(image, range(5))), CAMERAS, "images.txt has 5 images, but its comment announces 4"),
        (
            image(0) + "\n1 1 0 0 0 0 0 x 1 i1.jpg\n",
            CAMERAS,
            "TZ of line 2 of images.txt: expected a finite number, not 'x'",
        ),
        (image(0) + "\n1 1 0 0 0 0 0 5 i1.jpg\n", CAMERAS, "line 2 of images.txt has 9 values, not 10"),
        (
            image(0) + f"\n{POINTS}\n{POINTS}\n",
            CAMERAS,
            "IMAGE_ID of line 3 of images.txt: expected a whole number, not '10.5'",
        ),
        (f"{POINTS}\n" + image(0), CAMERAS, "IMAGE_ID of line 1 of images.txt: expected a whole number, not '10.5'"),
        (image(0) + "\n1 2\n", CAMERAS, "line 2 of images.txt has 2 values"),
        (
            image(0) + "\n1 1 0 0 0 0 0 5 1.5 i1.jpg\n",
            CAMERAS,
            "CAMERA_ID of line 2 of images.txt: expected a whole number",
        ),
        ("1 2 3\n", CAMERAS, "line 1 of images.txt has 3 values, not 10"),
        (image(0), "# Number of cameras: 2\n" + CAMERAS, "cameras.txt has 1 cameras, but its comment announces 2"),
        (image(0), "# nothing\n", "line 1 of images.txt: it has camera 1, which does not exist"),
        (
            image(0),
            "1 LENSBABY 640 480 600 600 320 240\n",
            "MODEL of line 1 of cameras.txt: expected a pinhole camera of COLMAP, not 'LENSBABY'",
        ),
        (image(0), "1 PINHOLE 640 480 600 600 320\n", "PARAMS of line 1 of cameras.txt: expected a list of 4 numbers"),
        (image(0), "1 EQUIRECTANGULAR 640 480 640 480\n", "expected a pinhole camera of COLMAP, not 'EQUIRECTANGULAR'"),
        (
            image(0),
            "1 PINHOLE 0 480 600 600 320 240\n",
            "WIDTH of line 1 of cameras.txt: expected a number of pixels, not '0'",
        ),
        (image(0), "1 PINHOLE\n", "PARAMS of line 1 of cameras.txt: expected a list of 4 numbers"),
        (image(0), b"\xff\xfa", "cameras.txt is not text"),
    ],
)
def test_a_broken_model_of_colmap_is_refused(images: str, cameras: str | bytes, said: str) -> None:
    with pytest.raises(CameraPathError, match=said):
        read(model(images, cameras))


def test_a_model_of_colmap_is_found_by_any_of_its_files_and_by_its_lines(tmp_path: Path) -> None:
    for file in ("images.bin", "cameras.bin"):
        check_pose(read_fixture(f"colmap-binary/{file}").cameras[2], KNOWN[2])
    (tmp_path / "images.txt").write_text(image(0) + "\n\n" + image(1) + "\n\n")
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    for path in (tmp_path, tmp_path / "images.txt", tmp_path / "cameras.txt"):
        found = read_path(path)
        assert (found.format, len(found), found.cameras[0].focal) == ("COLMAP", 2, (500, 500))
    (tmp_path / "cameras.txt").unlink()
    (tmp_path / "images.txt").rename(tmp_path / "poses")
    assert len(read_path(tmp_path / "poses")) == 2


@pytest.mark.parametrize("content", ["1 0 0 0 0 0 0 1\n", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "1 3 0 0 0 0 0 5 1 a.jpg\n"])
def test_other_lines_of_numbers_are_not_taken_for_images(content: str) -> None:
    try:
        assert read(text_file(content, "x.txt")).format != "COLMAP"
    except CameraPathError as error:
        assert "of no known format" in str(error)


def test_a_binary_model_of_colmap_has_all_that_it_announces_and_no_more() -> None:
    whole = files_at(FOLDER / "colmap-binary")
    images, cameras = whole.contents["images.bin"], whole.contents["cameras.bin"]
    many, name = struct.pack("<Q", 10**12), images.index(b"image")
    end = images.index(b"\0", name) + 1
    points = images[:end] + struct.pack("<Q", 2**63) + images[end + 8 :]
    for file, content, said in (
        ("images.bin", many + images[8:], "images.bin announces 1,000,000,000,000 items, more than it can hold"),
        ("cameras.bin", many + cameras[8:], "cameras.bin announces 1,000,000,000,000"),
        ("images.bin", points, "images.bin ends before all of its data"),
        ("images.bin", images + b"spare", "images.bin has 5 bytes after the 4 items that it announces"),
        ("cameras.bin", cameras + b"spare", "cameras.bin has 5 bytes after the 1 items that it announces"),
    ):
        with pytest.raises(CameraPathError, match=said):
            read(Files(whole.path, {**whole.contents, file: content}), format="colmap")


@pytest.mark.parametrize("focal", [0.0, 5e-324, -1.0, 1e308])
def test_a_colmap_focal_length_that_is_not_positive_and_finite_is_refused(focal: float) -> None:
    whole = files_at(FOLDER / "colmap-binary")
    cameras = bytearray(whole.contents["cameras.bin"])
    cameras[8 + 24 : 8 + 24 + 8] = struct.pack("<d", focal)
    files = Files(whole.path, {**whole.contents, "cameras.bin": bytes(cameras)})
    check_any(files, "colmap")
    if focal <= 0:
        with pytest.raises(CameraPathError, match=r"focal length .* not positive or too large"):
            read(files, settings=Settings(fov_y=1.0))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize(
    "name", ["inria.json", "sparklod.json", "sparklod.csv", "tum.txt", "open3d.log", "transforms.json", "colmap-text"]
)
def test_a_byte_order_mark_changes_nothing(name: str, encoding: str) -> None:
    whole = files_at(FOLDER / name)
    mark = "" if encoding in ("utf-8-sig", "utf-16") else "\ufeff"
    path = read(
        Files(whole.path, {file: (mark + data.decode()).encode(encoding) for file, data in whole.contents.items()})
    )
    assert path.format == read(whole).format
    for camera, known in zip(path, KNOWN, strict=True):
        check_pose(camera, known)


# The programs themselves


def random_poses(count: int) -> list[NDArray[np.float64]]:
    """(4, 4) each: from the world to a camera in OpenCV's axes, which has the landmark before it."""
    random = np.random.default_rng(7)
    poses = []
    while len(poses) < count:
        rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
        pose[:3, 3] = random.normal(size=3) * 3
        if (pose @ [*LANDMARK, 1])[2] > 0.5:
            poses.append(pose)
    return poses


@pytest.fixture(scope="module")
def packages(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_with(ENGINES, variable="ENGINES_DIR", request=request, tmp_path_factory=tmp_path_factory)


def viewer(**changes: Any) -> dict[str, Any]:
    """Settings of SuperSplat's viewer, with five keys that are not evenly apart."""
    random = np.random.default_rng(3)
    values = {
        "position": random.normal(size=15).round(3).tolist(),
        "target": (random.normal(size=15) + 9).round(3).tolist(),
        "fov": [50, 70, 60, 40, 55],
    }
    frames = {"times": [0, 7, 12, 30, 44], "values": values}
    usual = {"name": "x", "duration": 1.5, "frameRate": 30, "loopMode": "none", "interpolation": "spline"}
    return {"version": 2, "animTracks": [{**usual, "smoothness": 1, "keyframes": frames, **changes}]}


def document(**changes: Any) -> dict[str, Any]:
    """A project of SuperSplat; its last pose is past the end."""
    random = np.random.default_rng(4)
    poses = [
        {"frame": frame, "position": random.normal(size=3).tolist(), "target": [9, k, 9], "fov": 40 + k}
        for k, frame in enumerate((20, 3, 31, 50, 70))
    ]
    timeline = {"frames": 60, "frameRate": 24, "smoothness": 0.8, "loop": True, **changes}
    return {"version": 0, "camera": {"fov": 50}, "timeline": timeline, "poseSets": [{"name": "set0", "poses": poses}]}


TRACKS = {
    "viewer": viewer(),
    "viewer that repeats": viewer(loopMode="repeat"),
    "viewer that repeats to its last key": viewer(loopMode="repeat", duration=44 / 30),
    "viewer, straight": viewer(smoothness=0),
    "viewer, in steps": viewer(interpolation="step"),
    "project": document(),
    "project that ends": document(loop=False, smoothness=0.3),
    "frames": json.loads((FOLDER / "splat-transform.json").read_text(encoding="utf-8")),
}


@pytest.mark.slow
def test_splat_transform_has_the_same_cameras_on_every_frame(packages: Path, tmp_path: Path) -> None:
    paths = [tmp_path / f"{index}.json" for index in range(len(TRACKS))]
    for path, content in zip(paths, TRACKS.values(), strict=True):
        path.write_text(json.dumps(content), encoding="utf-8")
    script = Path(__file__).with_name("camera_track.mjs")
    done = subprocess.run(
        ["node", str(script), str(packages), *map(str, paths)], capture_output=True, encoding="utf-8", timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    for name, path, line in zip(TRACKS, paths, done.stdout.splitlines(), strict=True):
        theirs = json.loads(line)
        ours = read(files_at(path), settings=Settings(size=(500, 500))).cameras
        assert len(ours) == len(theirs["frames"]), name
        for index, (camera, frame) in enumerate(zip(ours, theirs["frames"], strict=True)):
            eye, target, up = ([frame[key][axis] for axis in "xyz"] for key in ("position", "target", "up"))
            ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
            right = np.cross(ahead, up)
            assert np.allclose(camera.position, eye, atol=1e-9), (name, index)
            assert np.allclose(camera.forward, ahead, atol=1e-9), (name, index)
            assert np.allclose(camera.camera_to_world[:3, 0], right / np.linalg.norm(right), atol=1e-9), (name, index)
            assert np.degrees(camera.fov_y) == pytest.approx(frame["fov"]), (name, index)
            assert camera.time == pytest.approx(index / theirs["frameRate"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL"])
def test_colmap_projects_a_point_to_the_same_pixel(kind: str, model: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    numbers = [600, 610, 330, 250] if model == "PINHOLE" else [600, 330, 250, 0]
    lens = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=numbers)
    model_of_scene = pycolmap.Reconstruction()
    model_of_scene.add_camera_with_trivial_rig(lens)
    poses = random_poses(5)
    for index, pose in enumerate(poses):
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=9 - index)
        model_of_scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    getattr(model_of_scene, f"write_{kind}")(str(tmp_path))
    path = read(files_at(tmp_path))
    assert [camera.name for camera in path.cameras] == [f"{index}.jpg" for index in range(5)]
    for camera, pose in zip(path.cameras, poses, strict=True):
        assert np.allclose(np.linalg.inv(camera.camera_to_world @ HALF_TURN), pose)
        theirs = lens.img_from_cam((pose @ [*LANDMARK, 1])[:3])
        assert np.allclose(pixel(camera, LANDMARK), theirs)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".json", ".log"])
def test_a_trajectory_that_open3d_wrote_is_read(suffix: str, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed")
    poses = random_poses(4)
    trajectory = open3d.camera.PinholeCameraTrajectory()
    parameters = []
    for pose in poses:
        camera = open3d.camera.PinholeCameraParameters()
        camera.intrinsic = open3d.camera.PinholeCameraIntrinsic(640, 480, 600.0, 610.0, 329.5, 249.5)
        camera.extrinsic = pose
        parameters.append(camera)
    trajectory.parameters = parameters
    file = tmp_path / f"path{suffix}"
    assert open3d.io.write_pinhole_camera_trajectory(str(file), trajectory)
    path = read(files_at(file))
    for camera, pose in zip(path.cameras, poses, strict=True):
        assert np.allclose(np.linalg.inv(camera.camera_to_world @ HALF_TURN), pose, atol=1e-6)
        if suffix == ".json":
            assert (camera.focal, camera.principal) == ((600, 610), (330, 250))
