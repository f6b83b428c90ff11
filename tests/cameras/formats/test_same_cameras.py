"""The same cameras come out of every format, told by its content alone."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.camera_files import read
from sparklod_cli.cameras.formats.parsing import Files
from sparklod_cli.cameras.formats.table import FORMATS
from tests.cameras.known import (
    FOCAL,
    FOLDER,
    FOV_Y,
    KNOWN,
    LANDMARK,
    OUT_OF_PLAYCANVAS,
    SIZE,
    check_pose,
    files_at,
    pixel,
    read_fixture,
    text_file,
)

pytestmark = pytest.mark.slow

#: What has to be said about a format that leaves things open.
NO_LENS = Settings(size=SIZE, fov_y=FOV_Y)
TURNED = Settings(size=SIZE, world=OUT_OF_PLAYCANVAS)

#: File, its format, how many of the cameras it has, what is said about it, the time of its second camera.
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


def test_every_format_has_a_fixture() -> None:
    assert {form for form, *_ in CASES.values()} == {form.name for form in FORMATS}


def test_each_format_recognises_its_own_files_only() -> None:
    for name, (form, *_) in CASES.items():
        files = files_at(FOLDER / name)
        modules = {row.name: import_module(f"sparklod_cli.cameras.formats.{row.module}") for row in FORMATS}
        recognises = {name: getattr(module, f"recognises_{name.replace('-', '_')}") for name, module in modules.items()}
        assert [name for name, function in recognises.items() if function(files)] == [form]


def test_a_format_that_may_have_another_world_says_so() -> None:
    for name in ("supersplat-v1.json", "splat-transform.json", "nerfstudio.json"):
        assert "--world-transform" in read_fixture(name).notes[-1]
        assert read_fixture(name, Settings(world=np.eye(4))).notes == ()
    assert read_fixture("inria.json").notes == ()


def test_colmap_sorts_by_name_as_people_do() -> None:
    names = [camera.name for camera in read_fixture("colmap-binary").cameras]
    assert names == ["image8.jpg", "image9.jpg", "image10.jpg", "image11.jpg"]


def test_colmap_without_its_cameras_keeps_its_poses() -> None:
    path = read(text_file((FOLDER / "colmap-text" / "images.txt").read_bytes(), "renamed.dat"))
    check_pose(path.cameras[3], KNOWN[3])
    assert path.cameras[0].width == 1280
    assert "its lenses are unknown" in path.notes[0]


@pytest.mark.parametrize("file", ["images.bin", "cameras.bin"])
def test_a_colmap_model_is_found_by_either_of_its_files(file: str) -> None:
    check_pose(read_fixture(f"colmap-binary/{file}").cameras[2], KNOWN[2])


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
    images = b"1 1 0 0 0 0 0 5 9 a b.jpg\n\n2 1 0 0 0 0 0 5 9 c.jpg\n"
    path = read(Files(Path("x"), {"images.txt": images, "cameras.txt": f"9 {line}\n".encode()}), format="colmap")
    assert [camera.name for camera in path.cameras] == ["a b.jpg", "c.jpg"]
    assert path.cameras[0].focal == (fx, fy)
    assert path.notes == ((f"The lens distortion of {said} was ignored.",) if said else ())
