"""Fields without an influence on the picture refuse no cameras, and nothing is left out without a word."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.system.errors import CameraPathError
from tests.cameras.known import FOLDER, text_file

EYE = np.eye(4).tolist()


def read_json(root: Any) -> CameraPath:
    return read(text_file(json.dumps(root)))


def inria(**fields: Any) -> CameraPath:
    return read_json([{"position": [0, 0, -3], "rotation": np.eye(3).tolist(), **fields}])


def transforms(**fields: Any) -> CameraPath:
    return read_json({"frames": [{"transform_matrix": EYE, **fields}]})


def own(**fields: Any) -> CameraPath:
    return read_json({"format": "sparklod-camera-path", "frames": [{"matrix": EYE, **fields}]})


NAMED = {"img_name": inria, "file_path": transforms, "name": own}


@pytest.mark.parametrize("key", NAMED)
@pytest.mark.parametrize(
    ("value", "name"),
    [
        (0, "0"),
        (17, "17"),
        (1.5, "1.5"),
        (10**30, "1e+30"),
        (True, "True"),
        (None, ""),
        ("", ""),
        ("a b", "a b"),
        (["a"], "['a']"),
        ({"a": 1}, "{'a': 1}"),
    ],
)
def test_a_name_is_a_label_of_any_type(key: str, value: Any, name: str) -> None:
    assert [camera.name for camera in NAMED[key](**{key: value})] == [name]


@pytest.mark.parametrize("value", ["unknown", None, [], "0", 0, 0.0])
def test_distortion_that_is_ignored_need_not_be_a_number(value: Any) -> None:
    distorts = value in ("unknown", [])
    for path in (transforms(k1=value), read_json({"k1": value, "frames": [{"transform_matrix": EYE}]})):
        assert path.notes == (("Its lens distortion was ignored.",) if distorts else ())


def test_a_camera_model_that_is_no_text_is_no_panorama() -> None:
    assert len(read_json({"camera_model": 3, "frames": [{"transform_matrix": EYE}]})) == 1


def test_frames_beside_keyframes_are_refused() -> None:
    with pytest.raises(CameraPathError, match="it has frames and keyframes; give one of them"):
        read_json({"format": "sparklod-camera-path", "frames": [{"matrix": EYE}], "keyframes": []})


def test_blank_lines_of_a_log_are_skipped() -> None:
    log = (FOLDER / "open3d.log").read_text()
    blank = read(text_file("\n\n".join(log.splitlines()) + "\n\n", "x.log"), format="open3d")
    assert len(blank) == len(read(text_file(log, "x.log")))


def test_animations_beside_the_first_are_noted() -> None:
    root = json.loads((FOLDER / "supersplat-v2.json").read_text())
    assert read_json(root).notes[:-1] == ()
    root["animTracks"] *= 3
    assert read_json(root).notes[0] == "Only the first of its 3 animations was read."


def test_pose_sets_and_poses_that_are_not_read_are_noted() -> None:
    root = json.loads((FOLDER / "supersplat-document.json").read_text())
    assert read_json(root).notes[:-1] == ()
    root["poseSets"][0]["poses"].append({**root["poseSets"][0]["poses"][0], "frame": 99})
    root["poseSets"] *= 2
    assert read_json(root).notes[:2] == (
        "Only the first of its 2 pose sets was read.",
        "Poses beyond the end of its time line were ignored (1).",
    )
