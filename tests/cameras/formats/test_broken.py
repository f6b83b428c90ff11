"""Broken camera paths are errors of one line, never a traceback, a hang or gigabytes."""

from __future__ import annotations

import json
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.formats.parsing import Files
from sparklod_cli.cameras.formats.table import FORMATS
from sparklod_cli.system.errors import CameraPathError
from tests.cameras.formats.test_same_cameras import CASES
from tests.cameras.known import FOLDER, files_at, text_file

EYE = np.eye(4).tolist()

NAMES = list(CASES)


def own(fields: str) -> str:
    """A file of sparklod's own format with these fields, as JSON."""
    return f'{{"format": "sparklod-camera-path", {fields}}}'


#: Content, and what is said of it.
FAULTS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "it is empty"),
    "binary garbage": (bytes(range(256)) * 9, "of no known format"),
    "a web page": ("<!DOCTYPE html><html></html>", "of no known format"),
    "other JSON": ('{"a": 1}', "of no known format"),
    "JSON of lists all the way down": ("[" * 100_000, "of no known format"),
    "no frames": (own('"frames": []'), "it has no cameras"),
    "no list": (own('"frames": 7'), "frames: expected a list"),
    "neither": ('{"format": "sparklod-camera-path"}', "frames: expected a list, but it is missing"),
    "another version": (own('"version": 2, "frames": []'), "version 2 is unknown"),
    "axes": (own('"axes": "up", "frames": []'), "axes 'up' are unknown"),
    "a frame of text": (own('"frames": ["x"]'), "frames.0.: expected an object"),
    "a short matrix": (own('"frames": [{"matrix": [1, 2]}]'), "frames.0..matrix: expected a list of 16 numbers"),
    "NaN": (
        own('"frames": [{"eye": [NaN, 0, 0], "target": [0, 0, 0]}]'),
        "frames.0..eye.0.: expected a finite number, not nan",
    ),
    "a number of 5,000 digits": (
        '{"format": "sparklod-camera-path", "frames": [{"eye": [' + "9" * 4000 + ', 0, 0], "target": [0, 0, 0]}]}',
        "expected a finite number",
    ),
    "true is no number": (own('"fps": true, "frames": []'), "fps: expected a finite number, not True"),
    "looks at itself": (
        own('"frames": [{"eye": [1, 2, 3], "target": [1, 2, 3]}]'),
        "the camera at 1, 2, 3 looks at its own position",
    ),
    "zero quaternion": (
        own('"frames": [{"quat_xyzw": [0, 0, 0, 0], "position": [0, 0, 0]}]'),
        "frames.0. has a quaternion of length 0",
    ),
    "focal without size": (
        own('"frames": [{"focal": [9, 9], "eye": [1, 0, 0], "target": [0, 0, 0]}]'),
        "frames.0.: a focal length .* needs a size",
    ),
    "no focal length": (
        own('"size": [9, 9], "focal": [0, 9], "frames": [{"eye": [1, 0, 0], "target": [0, 0, 0]}]'),
        "frame 0 has a focal length .* not positive or too large",
    ),
    "a focal length beyond all measure": (
        own('"size": [9, 9], "focal": [9, 1e200], "frames": [{"eye": [1, 0, 0], "target": [0, 0, 0]}]'),
        "frame 0 has a focal length .* not positive or too large",
    ),
    "a size of one side": (own('"size": [9], "frames": []'), "size: expected a list of 2 numbers"),
    "half a pixel": (own('"size": [9.5, 9], "frames": []'), "size.0.: expected a number of pixels, not 9.5"),
    "a fov of 180": (
        own('"fov": 180, "frames": [{"eye": [1, 0, 0], "target": [0, 0, 0]}]'),
        "frame 0 has a field of view of 180 degrees",
    ),
    "a name of two lines": (
        own('"fov": 0, "frames": [{"name": "a\\nb", "eye": [1, 0, 0], "target": [0, 0, 0]}]'),
        r"frame 0 \(a b\) has a field of view of 0 degrees",
    ),
    "a version of two lines": (own('"version": "a\\nb"'), "version 'a"),
    "a version of lists": (own('"version": [[1]]'), "version .* is unknown"),
    "angles of 0": (
        '{"w": 9, "h": 9, "camera_angle_x": 0, "camera_angle_y": 0, "frames": [{"transform_matrix":'
        " [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}]}",
        "frame 0 has a field of view of 0 degrees",
    ),
    "TUM of other words": ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 one\n", "qw of line 2 has 'one'"),
    "CSV in which nothing ends": ('x,y,z,qx,qy,qz,qw,name\n1,2,3,0,0,0,1,"' + "a" * 200_000 + '"\n', "it is not CSV"),
    "frames at no rate": (
        '{"frameRate": 0, "frames": [{"position": [0, 0, 0], "target": [1, 0, 0]}]}',
        "frameRate: expected a number above 0",
    ),
    "own frames at no rate": (own('"fps": 0, "frames": []'), "fps: expected a number above 0"),
    "times beyond all measure": (
        '{"format": "sparklod-camera-path", "frames": [{"eye": [1, 0, 0], "target": [0, 0, 0], "time": -1.7e308},'
        ' {"eye": [1, 0, 0], "target": [0, 0, 0], "time": 1.7e308}]}',
        "times are too far apart",
    ),
    "SuperSplat of no duration": (
        '{"version": 2, "animTracks": [{"frameRate": 30, "keyframes": {"times": [0], "values":'
        ' {"position": [0, 0, 0], "target": [1, 0, 0], "fov": [60]}}}]}',
        "duration: expected a finite number, but it is missing",
    ),
    "one key": (own('"keyframes": [{"eye": [1, 0, 0], "target": [0, 0, 0]}]'), "needs at least two keyframes"),
    "CSV without numbers": ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,one\n", "qw of line 2 has 'one'"),
    "CSV without an end": ("x,y,z,qx,qy,qz,qw\n1,2,3\n", "line 2 has 3 values, not 7"),
    "CSV of twins": ("x,y,z,qx,qy,qz,qw,x\n", "names a column twice"),
    "CSV of nothing": ("x,y,z,qx,qy,qz,qw\n", "it has no cameras"),
    "TUM without an end": ("1 0 0 0 0 0 0 1\n2 0 0\n", "line 2 has 3 values"),
    "TUM of infinity": ("1 0 0 0 0 0 0 1\n2 inf 0 0 0 0 0 1\n", "tx of line 2 has 'inf'"),
    "TUM without a rotation": ("1 0 0 0 0 0 0 0\n", "line 1 has a quaternion of length 0"),
    "panoramas": (
        '{"camera_model": "EQUIRECTANGULAR", "frames": [{"transform_matrix": []}]}',
        "camera_model 'EQUIRECTANGULAR' is not that of a pinhole",
    ),
    "panorama": ('{"camera_path": [], "camera_type": "equirectangular"}', "not that of a pinhole camera"),
    "rotation of Inria": (
        '[{"position": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0]]}]',
        "rotation: expected a list of 9 numbers",
    ),
    "SuperSplat of the future": ('{"version": 3, "animTracks": []}', "version 3 of SuperSplat's settings"),
    "SuperSplat without keys": (
        '{"version": 2, "animTracks": [{"duration": 1, "keyframes": {"times": [], "values": {"position": [],'
        ' "target": [], "fov": []}}}]}',
        "it has no keyframes",
    ),
    "SuperSplat back in time": (
        '{"version": 2, "animTracks": [{"duration": 1, "frameRate": 30, "keyframes": {"times": [3, 2], "values":'
        ' {"position": [0, 0, 0, 0, 0, 0], "target": [1, 0, 0, 1, 0, 0], "fov": [60, 60]}}}]}',
        "do not increase",
    ),
    "SuperSplat for years": (
        '{"version": 2, "animTracks": [{"duration": 1e9, "frameRate": 30, "keyframes": {"times": [0], "values":'
        ' {"position": [0, 0, 0], "target": [1, 0, 0], "fov": [60]}}}]}',
        "it has 30,000,000,000 cameras, more than 65,536; leave some out with --every",
    ),
    "COLMAP without words": ("# Image list with two lines of data per image\n1 1 0 0\n", "line 2 of images.txt has 4"),
    "frames of frames": ('{"frames": [{"transform_matrix": [[1, 0, 0, 0]]}]}', "expected a list of 12 or 16 numbers"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_told_in_one_line(fault: str) -> None:
    content, said = FAULTS[fault]
    with pytest.raises(CameraPathError, match=said) as caught:
        read(text_file(content, "broken.json"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", NAMES)
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


#: Numbers that are finite, and of which few sums and products are.
HUGE = [0.0, -0.0, 5e-324, 1e-300, -1e308, 1e308, 1.7e308, 9223372036854775808, 1.5]


@pytest.mark.parametrize("name", [name for name in NAMES if "binary" not in name])
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


@pytest.mark.parametrize(
    "model", [struct.pack("<d", 0.0), struct.pack("<d", 5e-324), struct.pack("<d", -1.0), struct.pack("<d", 1e308)]
)
def test_a_colmap_focal_length_that_is_not_positive_and_finite_is_refused(model: bytes) -> None:
    whole = files_at(FOLDER / "colmap-binary")
    cameras = bytearray(whole.contents["cameras.bin"])
    cameras[8 + 24 : 8 + 24 + 8] = model
    check_any(Files(whole.path, {**whole.contents, "cameras.bin": bytes(cameras)}), "colmap")
    if struct.unpack("<d", model)[0] <= 0:
        with pytest.raises(CameraPathError, match=r"focal length .* not positive or too large"):
            read(Files(whole.path, {**whole.contents, "cameras.bin": bytes(cameras)}), settings=Settings(fov_y=1.0))


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


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith(".json")])
@given(data=st.data())
def test_any_value_replaced_by_another_gives_cameras_or_an_error(name: str, data: st.DataObject) -> None:
    root = mutilated(json.loads((FOLDER / name).read_text(encoding="utf-8")), data)
    for form in (None, CASES[name][0]):
        check_any(text_file(json.dumps(root)), form)


@pytest.mark.parametrize("form", [form.name for form in FORMATS])
def test_every_parser_refuses_files_of_other_formats(form: str) -> None:
    for name, (other, *_) in CASES.items():
        if other != form:
            with pytest.raises(CameraPathError):
                read(files_at(FOLDER / name), format=form)


@pytest.mark.parametrize("form", [None, *(form.name for form in FORMATS)])
@pytest.mark.parametrize("content", ["", "\n", "#", "\ufeff"])
def test_every_parser_refuses_an_empty_file(form: str | None, content: str) -> None:
    for name in ("path.json", "path.csv", "images.txt"):
        with pytest.raises(CameraPathError):
            read(text_file(content, name), format=form)


def colmap(images: bytes = b"", cameras: bytes = b"") -> Files:
    return Files(Path("sparse"), {"images.bin": images, "cameras.bin": cameras})


def test_a_colmap_file_that_promises_billions_is_refused() -> None:
    whole = files_at(FOLDER / "colmap-binary").contents
    many = struct.pack("<Q", 10**12)
    with pytest.raises(CameraPathError, match=r"images.bin announces 1,000,000,000,000 items, more than it can hold"):
        read(colmap(many + whole["images.bin"][8:], whole["cameras.bin"]), format="colmap")
    with pytest.raises(CameraPathError, match=r"cameras.bin announces 1,000,000,000,000"):
        read(colmap(whole["images.bin"], many + whole["cameras.bin"][8:]), format="colmap")
    name = whole["images.bin"].index(b"image")
    end = whole["images.bin"].index(b"\0", name) + 1
    points = whole["images.bin"][:end] + struct.pack("<Q", 2**63) + whole["images.bin"][end + 8 :]
    with pytest.raises(CameraPathError, match=r"images.bin ends before all of its data"):
        read(colmap(points, whole["cameras.bin"]), format="colmap")


def test_a_colmap_image_of_a_missing_camera_is_refused() -> None:
    images = b"1 1 0 0 0 0 0 5 9 a.jpg\n\n"
    for cameras, said in {
        b"8 PINHOLE 640 480 600 600 320 240\n": "image 1 has camera 9, which does not exist",
        b"9 LENSBABY 640 480 600 600 320 240\n": "line 1 of cameras.txt has a camera model 'LENSBABY'",
        b"9 PINHOLE 640 480 600 600 320\n": "line 1 of cameras.txt has 3 parameters, not the 4 of PINHOLE",
        b"9 EQUIRECTANGULAR 640 480 640 480\n": "which is not a pinhole camera",
        b"9 PINHOLE 0 480 600 600 320 240\n": "line 1 of cameras.txt of 0 is not a number of pixels",
        b"9 PINHOLE\n": "line 1 of cameras.txt has 2 values",
        b"\xff\xfa": "cameras.txt is not text",
    }.items():
        with pytest.raises(CameraPathError, match=said):
            read(Files(Path("sparse"), {"images.txt": images, "cameras.txt": cameras}), format="colmap")


TRAJECTORY = '{"class_name": "PinholeCameraTrajectory", "parameters": [%s]}'


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("x.json", TRAJECTORY % '{"extrinsic": [1, 2]}', "extrinsic: expected a list of 16 numbers"),
        (
            "x.json",
            TRAJECTORY % '{"extrinsic": [%s]}' % ", ".join("1" * 16),
            "intrinsic: expected an object, but it is missing",
        ),
        ("x.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "line 4 has 3 numbers, not 4"),
        ("x.log", "0 0 1\n1 0 0 0\n0 1 0 0\n", "it ends inside a pose"),
        ("x.log", "0 0 1\n1 0 0 nan\n0 1 0 0\n", "line 2 has 'nan'"),
        ("x.log", "0 0 1\n" + 4 * "1 0 0 0\n", "it has a matrix that cannot be inverted"),
        ("x.json", "0 0 1\n", "it is not JSON"),
        ("x.trajectory", TRAJECTORY % "", "it has no cameras"),
    ],
)
def test_a_broken_trajectory_of_open3d_is_refused(name: str, content: str, said: str) -> None:
    with pytest.raises(CameraPathError, match=said):
        read(text_file(content, name), format="open3d")
