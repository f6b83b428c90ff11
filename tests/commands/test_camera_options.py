"""The options that say which cameras look at a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from sparklod_cli.cameras import sources
from sparklod_cli.cameras.framing import FILLED, Balls
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.commands.command import Command, values_of
from sparklod_cli.commands.option_groups import Cameras
from sparklod_cli.system.errors import CameraPathError
from sparklod_cli.system.setting_fields import setting
from tests.cameras.known import FOLDER, KNOWN, SIZE, check_pose

#: A ball around (1, 2, 3), of which nine in ten are nearer than 2.
SHELLS = [2.0] * 50 + [1.0] * 45 + [50.0] * 5
TURN = "-1,0,0,0,0,-1,0,0,0,0,1,0,0,0,0,1"


@dataclass(frozen=True)
class Flight(Cameras):
    inputs: tuple[str, ...] = setting("", click.STRING, (), argument=True, nargs=-1)


def scene_of_shells() -> Balls:
    random = np.random.default_rng(1)
    directions = random.normal(size=(len(SHELLS) * 40, 3))
    offsets = directions / np.linalg.norm(directions, axis=1)[:, None] * np.repeat(SHELLS, 40)[:, None]
    center = np.concatenate([offsets, -offsets]) + np.array([1, 2, 3])
    return Balls(center, np.zeros(len(center)))


def run(*arguments: str | Path, scene: Any = scene_of_shells) -> tuple[Result, list[CameraPath]]:
    found: list[CameraPath] = []

    @click.command("traverse", cls=Command, options=Flight)
    @click.pass_context
    def fly(ctx: click.Context, **_: Any) -> None:
        asked = values_of(ctx, Flight)
        found.append(asked.path(lambda: SimpleNamespace(balls=scene, up=None)))

    return CliRunner().invoke(fly, [str(argument) for argument in arguments]), found


def cameras(*arguments: str | Path, scene: Any = scene_of_shells) -> CameraPath:
    result, found = run(*arguments, scene=scene)
    assert result.exit_code == 0, result.output or result.exception
    return found[0]


def usage_error(*arguments: str | Path) -> str:
    result, _ = run(*arguments)
    assert result.exit_code == 2, result.output
    return result.output


def file_error(*arguments: str | Path) -> str:
    result, _ = run(*arguments)
    assert isinstance(result.exception, CameraPathError), result.exception
    return str(result.exception)


def no_scene() -> Balls:
    raise AssertionError("nobody needs to know the scene")


def test_the_default_path_is_an_orbit_that_sees_the_scene() -> None:
    path = cameras()
    assert len(path.cameras) == 60
    camera = path.cameras[0]
    assert (camera.width, camera.height) == (1280, 720)
    offset = camera.position - (1, 2, 3)
    fits = math.atan(FILLED * math.tan(math.radians(30)))
    assert np.linalg.norm(offset) == pytest.approx(2 / math.sin(fits), rel=0.03)
    assert offset[1] < 0, "y is down, and it is above"
    for one, other in zip(path.cameras, cameras("--orbit", "60").cameras, strict=True):
        assert np.array_equal(one.camera_to_world, other.camera_to_world)


def test_an_orbit_follows_its_options() -> None:
    options = ("--orbit", 4, "--center", "0,0,0", "--distance", 10, "--elevation", 0, "--up", "0,0,1")
    path = cameras(*map(str, options), scene=no_scene)
    assert np.allclose([camera.position for camera in path.cameras], [[0, -10, 0], [10, 0, 0], [0, 10, 0], [-10, 0, 0]])


@pytest.mark.parametrize(
    ("axis", "numbers"),
    [("y", "0,1,0"), ("-y", "0,-1,0"), ("z", "0,0,1"), ("-z", "0,0,-1"), ("x", "1,0,0"), ("-x", "-1,0,0")],
)
def test_an_axis_is_up_by_its_name_or_its_numbers(axis: str, numbers: str) -> None:
    named, numbered = (cameras("--orbit", "3", "--up", up).cameras for up in (axis, numbers))
    for one, other in zip(named, numbered, strict=True):
        assert np.array_equal(one.camera_to_world, other.camera_to_world)


def test_a_portrait_orbit_keeps_its_distance() -> None:
    wide, tall = (cameras("--orbit", "1", "--size", size).cameras[0] for size in ("1000x500", "500x1000"))
    assert np.linalg.norm(tall.position - (1, 2, 3)) > 1.5 * np.linalg.norm(wide.position - (1, 2, 3))


def test_a_dolly_lasts_as_long_as_it_is_told() -> None:
    path = cameras("--dolly", "--seconds", "3", "--fps", "10")
    assert len(path.cameras) == 30
    distances = [float(np.linalg.norm(camera.position - (1, 2, 3))) for camera in path.cameras]
    assert distances == sorted(distances, reverse=True)
    assert distances[0] / distances[-1] == pytest.approx(16, rel=0.02)
    assert "more than" in usage_error("--dolly", "--seconds", "1e6")


@pytest.mark.parametrize("orbit", [(), ("--orbit", "24")])
def test_an_orbit_lasts_as_long_as_its_seconds(orbit: tuple[str, ...]) -> None:
    plain, slow = cameras(*orbit).cameras, cameras(*orbit, "--seconds", "12").cameras
    assert [camera.time for camera in slow] == pytest.approx([12 * at / len(plain) for at in range(len(plain))])
    assert all(np.array_equal(a.camera_to_world, b.camera_to_world) for a, b in zip(plain, slow, strict=True))


def test_look_at_is_one_camera_that_looks_there() -> None:
    (camera,) = cameras("--look-at", "-1,2,-3:-1,2,5", scene=no_scene).cameras
    assert camera.position.tolist() == [-1, 2, -3]
    assert camera.forward.tolist() == [0, 0, 1]
    assert camera.camera_to_world[:3, 1].tolist() == [0, -1, 0]


@pytest.mark.parametrize("between", [" ", ";", " ; "])
def test_keyframes_are_passed_through_at_their_times(between: str) -> None:
    views = between.join(["0,0,-5:0,0,0", "5,0,0:0,0,0", "0,0,5:0,0,0"])
    path = cameras("--keyframes", views, "--seconds", "1", "--fps", "10", scene=no_scene)
    assert len(path.cameras) == 21
    assert np.allclose(path.cameras[10].position, (5, 0, 0))
    assert path.cameras[-1].time == 2


@pytest.mark.parametrize("name", ["colmap-text", "colmap-binary", "colmap-binary/images.bin", "inria.json"])
def test_a_camera_path_has_the_cameras_of_its_file(name: str) -> None:
    path = cameras("--camera-path", FOLDER / name, scene=no_scene)
    for camera, known in zip(path.cameras, KNOWN, strict=True):
        check_pose(camera, known)


def test_options_override_what_a_camera_file_says() -> None:
    options = ("--size", "640x480", "--fov", "90", "--every", "3", "--fps", "10", "--camera-format", "tum")
    path = cameras("--camera-path", FOLDER / "tum.txt", *options)
    assert path.numbers == (0, 3)
    assert [camera.time for camera in path.cameras] == pytest.approx([0, 0.3])
    assert (path.cameras[1].width, path.cameras[1].height) == SIZE
    assert path.cameras[1].focal == pytest.approx((240, 240))
    turned = cameras("--camera-path", FOLDER / "tum.txt", "--camera-axes", "opengl-c2w").cameras[1]
    assert np.allclose(turned.forward, -np.array(KNOWN[1].ahead))
    up = cameras("--camera-path", FOLDER / "supersplat-v2.json", "--up", "0,-1,0", "--world-transform", TURN).cameras[0]
    assert np.allclose(up.camera_to_world[:3, 1], (0, 1, 0)), "upside down, as it was wanted"


@pytest.mark.parametrize("name", ["a.txt", "b.json", "c.json"])
def test_a_world_transform_may_be_a_file(name: str, tmp_path: Path) -> None:
    rows = np.array(TURN.split(","), float).reshape(4, 4)
    text = {"a.txt": "\n".join(" ".join(map(str, row)) for row in rows), "b.json": str(rows.tolist())}
    (tmp_path / name).write_text(text.get(name, str(rows.ravel().tolist())))
    for world in (TURN, tmp_path / name):
        path = cameras("--camera-path", FOLDER / "supersplat-v2.json", "--world-transform", world)
        for camera, known in zip(path.cameras, KNOWN, strict=False):
            check_pose(camera, known)
        assert path.notes == ()


def test_wrong_camera_options_are_errors_that_name_them() -> None:
    assert "--orbit and --dolly cannot be used together" in usage_error("--orbit", "3", "--dolly")
    assert "--camera-path and --look-at cannot" in usage_error("--camera-path", "x", "--look-at", "0,0,0:1,1,1")
    assert "--camera-axes can only be used with --camera-path" in usage_error("--camera-axes", "opencv-c2w")
    assert "--center can only be used with --orbit or --dolly" in usage_error(
        "--center", "0,0,0", "--look-at", "0,0,0:1,1,1"
    )
    only = "--seconds can only be used with --orbit or --dolly or --keyframes"
    assert only in usage_error("--seconds", "3", "--look-at", "0,0,0:1,1,1")
    assert "--fps cannot be used with --seconds of an orbit" in usage_error("--seconds", "3", "--fps", "30")
    for wrong in ("1,2,3", "1,2,3:1,2", "1,2,3:1,2,3", "a:b", "1,2,3:4,5,nan"):
        assert "Invalid value for '--look-at'" in usage_error("--look-at", wrong)
    assert "fewer than two keyframes" in usage_error("--keyframes", "1,2,3:4,5,6")
    for wrong in ("640", "640x", "0x480", "640x99999", "640x4.8", "-640x480", "6\u00b2x7"):
        assert "such as 1280x720" in usage_error("--size", wrong)
    for option, wrong in {"--fov": "180", "--fps": "0", "--every": "0", "--orbit": "0", "--elevation": "90"}.items():
        assert f"Invalid value for '{option}'" in usage_error(option, wrong)
    assert "is no direction" in usage_error("--up", "0,0,0")
    assert "--world-transform can only be used with" in usage_error("--orbit", "3", "--world-transform", TURN)
    for wrong, said in {
        TURN.replace("-1", "1", 1): "has a matrix that mirrors",
        TURN.replace("-1", "-2", 1): "has axes that are not at right angles, or not of the same length",
        TURN[:-2]: "has 15 numbers, not 16",
    }.items():
        output = usage_error("--look-at", "0,0,0:0,0,1", "--world-transform", wrong)
        assert f"--world-transform {said}" in " ".join(output.split())


def test_wrong_camera_files_are_errors_that_name_them(tmp_path: Path) -> None:
    missing = tmp_path / "missing.json"
    assert file_error("--camera-path", missing) == f"{missing} cannot be read: no such file or directory"
    assert "is a directory, without images.bin and cameras.bin, or images.txt" in file_error("--camera-path", tmp_path)
    empty = tmp_path / "empty.json"
    empty.touch()
    assert file_error("--camera-path", empty) == f"{empty}: it is empty"
    view = ("--look-at", "0,0,0:0,0,1")
    assert file_error(*view, "--world-transform", missing).startswith(f"{missing} cannot be read")
    (tmp_path / "matrix").write_text("1 2 3")
    assert "--world-transform has 3 numbers, not 16" in file_error(*view, "--world-transform", tmp_path / "matrix")
    (tmp_path / "matrix").write_text("[[1, 2")
    assert "is not JSON" in file_error(*view, "--world-transform", tmp_path / "matrix")


def test_a_file_of_gigabytes_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.cameras.camera_files.LARGEST", 100)
    assert "inria.json is larger than 0 MiB" in file_error("--camera-path", FOLDER / "inria.json")
    assert "it is a pipe or a device" in file_error("--camera-path", "/dev/null")


@pytest.mark.parametrize(
    "options",
    [
        ("--orbit", "1000000", "--distance", "3", "--center", "0,0,0"),
        ("--dolly", "--seconds", "1e6", "--fps", "1e6", "--distance", "3", "--center", "0,0,0"),
        ("--keyframes", "0,0,9:0,0,0 9,0,0:0,0,0", "--seconds", "1e6", "--fps", "1e6"),
    ],
)
def test_too_many_generated_cameras_are_refused(options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    whole = sources.frame_looking

    def counted(*arguments: Any) -> Any:
        made.append(1)
        return whole(*arguments)

    monkeypatch.setattr(sources, "frame_looking", counted)
    output = " ".join(usage_error(*options).split())
    assert f"{options[0]}: it has 1," in output
    assert "cameras, more than 65,536; leave some out with --every" in output
    assert made == []
    count = 10**6 if options[0] == "--orbit" else 10**12
    path = cameras(*options, "--every", str(count // 4), scene=no_scene)
    assert len(path.cameras) == len(made) <= 5
    assert path.numbers[:4] == tuple(range(0, count, count // 4))


def test_the_help_lists_formats_and_axes() -> None:
    text = " ".join(run("--help-all")[0].output.split())
    for said in ("EYE:TARGET", "'EYE:TARGET ...'", "WxH", "sparklod, csv, nerfstudio", "opengl-c2w|opencv-c2w"):
        assert said in text
