"""Options that name cameras: generated orbits, dollies and keyframes, camera files, and their axes and transforms."""

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
from sparklod_cli.cameras.framing import CAMERAS, FILLED, Balls
from sparklod_cli.cameras.sources import CameraPath
from sparklod_cli.commands.command import Command, values_of
from sparklod_cli.commands.viewing_options import Cameras
from sparklod_cli.system.errors import CameraPathError
from sparklod_cli.system.setting_fields import setting
from tests.cameras.known import FOLDER, KNOWN, SIZE, check_pose

#: Distances from (1, 2, 3), of which nine in ten are less than 2.
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


def no_scene() -> Balls:
    raise AssertionError("these cameras do not depend on the scene")


def run(line: str, scene: Any = scene_of_shells) -> tuple[Result, list[CameraPath]]:
    """Run a command that only has the options of cameras."""
    found: list[CameraPath] = []

    @click.command("traverse", cls=Command, options=Flight)
    @click.pass_context
    def fly(ctx: click.Context, **_: Any) -> None:
        options = values_of(ctx, Flight)
        found.append(options.path(lambda: SimpleNamespace(balls=scene, up=None)))

    return CliRunner().invoke(fly, line), found


def path_of(line: str, scene: Any = scene_of_shells) -> CameraPath:
    result, found = run(line, scene)
    assert result.exit_code == 0, result.output or result.exception
    return found[0]


def distances(path: CameraPath) -> list[float]:
    return [float(np.linalg.norm(camera.position - (1, 2, 3))) for camera in path.cameras]


def are_equal(one: CameraPath, other: CameraPath) -> bool:
    pairs = zip(one.cameras, other.cameras, strict=True)
    return all(np.array_equal(a.camera_to_world, b.camera_to_world) for a, b in pairs)


def test_the_default_path_is_an_orbit_that_sees_the_scene() -> None:
    path = path_of("")
    camera = path.cameras[0]
    assert len(path.cameras) == 60 and (camera.width, camera.height) == (1280, 720)
    fits = math.atan(FILLED * math.tan(math.radians(30)))
    assert distances(path)[0] == pytest.approx(2 / math.sin(fits), rel=0.03)
    assert camera.position[1] < 2, "y is down, and it is above"
    assert are_equal(path, path_of("--orbit 60"))
    wide, tall = (distances(path_of(f"--orbit 1 --size {size}"))[0] for size in ("1000x500", "500x1000"))
    assert tall > 1.5 * wide


def test_an_orbit_follows_its_options() -> None:
    path = path_of("--orbit 4 --center 0,0,0 --distance 10 --elevation 0 --up 0,0,1", no_scene)
    positions = [camera.position for camera in path.cameras]
    assert np.allclose(positions, [[0, -10, 0], [10, 0, 0], [0, 10, 0], [-10, 0, 0]])
    for axis, numbers in (("y", "0,1,0"), ("-y", "0,-1,0"), ("z", "0,0,1"), ("-z", "0,0,-1"), ("x", "1,0,0")):
        assert are_equal(path_of(f"--orbit 3 --up {axis}"), path_of(f"--orbit 3 --up {numbers}"))
    for orbit in ("", "--orbit 24"):
        plain, slow = path_of(orbit), path_of(f"{orbit} --seconds 12")
        count = len(plain.cameras)
        assert [camera.time for camera in slow.cameras] == pytest.approx([12 * at / count for at in range(count)])
        assert are_equal(plain, slow)


def test_look_at_is_one_camera_that_looks_there() -> None:
    (camera,) = path_of("--look-at -1,2,-3:-1,2,5", no_scene).cameras
    assert camera.position.tolist() == [-1, 2, -3] and camera.forward.tolist() == [0, 0, 1]
    assert camera.camera_to_world[:3, 1].tolist() == [0, -1, 0]


@pytest.mark.parametrize("between", [" ", ";", " ; "])
def test_keyframes_are_passed_through_at_their_times(between: str) -> None:
    views = between.join(["0,0,-5:0,0,0", "5,0,0:0,0,0", "0,0,5:0,0,0"])
    path = path_of(f"--keyframes '{views}' --seconds 1 --fps 10", no_scene)
    assert len(path.cameras) == 21 and path.cameras[-1].time == 2
    assert np.allclose(path.cameras[10].position, (5, 0, 0))


def test_options_override_a_camera_file() -> None:
    file = f"--camera-path {FOLDER / 'tum.txt'}"
    path = path_of(f"{file} --size 640x480 --fov 90 --every 3 --fps 10 --camera-format tum")
    assert path.numbers == (0, 3) and [camera.time for camera in path.cameras] == pytest.approx([0, 0.3])
    assert (path.cameras[1].width, path.cameras[1].height) == SIZE
    assert path.cameras[1].focal == pytest.approx((240, 240))
    turned = path_of(f"{file} --camera-axes opengl-c2w").cameras[1]
    assert np.allclose(turned.forward, -np.array(KNOWN[1].ahead))


@pytest.mark.parametrize("form", ["words", "a.txt", "b.json", "c.json"])
def test_a_world_transform_is_numbers_or_a_file(form: str, tmp_path: Path) -> None:
    rows = np.array(TURN.split(","), float).reshape(4, 4)
    text = {"a.txt": "\n".join(" ".join(map(str, row)) for row in rows), "b.json": str(rows.tolist())}
    (tmp_path / form).write_text(text.get(form, str(rows.ravel().tolist())))
    world = TURN if form == "words" else tmp_path / form
    file = f"--camera-path {FOLDER / 'supersplat-v2.json'} --world-transform {world}"
    path = path_of(file)
    for camera, known in zip(path.cameras, KNOWN, strict=False):
        check_pose(camera, known)
    assert path.notes == ()
    up = path_of(f"{file} --up 0,-1,0").cameras[0].camera_to_world[:3, 1]
    assert np.allclose(up, (0, 1, 0)), "upside down, as the option says"


@pytest.mark.parametrize(
    ("content", "line", "said"),
    [
        ("", "--camera-path file", "file: it is empty"),
        ("1 2 3", "--look-at 0,0,0:0,0,1 --world-transform file", "--world-transform has 3 numbers, not 16"),
        ("[[1, 2", "--look-at 0,0,0:0,0,1 --world-transform file", "is not JSON"),
        ("[" + "1, " * 100, "--camera-path file", "file is larger than 0 MiB"),
    ],
)
def test_broken_camera_files_are_named(
    content: str, line: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sparklod_cli.cameras.camera_files.LARGEST", 100)
    monkeypatch.chdir(tmp_path)
    Path("file").write_text(content)
    result, _ = run(line)
    assert isinstance(result.exception, CameraPathError) and said in str(result.exception)


@pytest.mark.parametrize(
    "line",
    [
        "--orbit 1000000 --distance 3 --center 0,0,0",
        "--dolly --seconds 1e6 --fps 1e6 --distance 3 --center 0,0,0",
        "--keyframes '0,0,9:0,0,0 9,0,0:0,0,0' --seconds 1e6 --fps 1e6",
    ],
)
def test_too_many_generated_cameras_are_refused(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made, whole = [], sources.frame_looking

    def counted(*arguments: Any) -> Any:
        made.append(1)
        return whole(*arguments)

    monkeypatch.setattr(sources, "frame_looking", counted)
    result, _ = run(line)
    output = " ".join(result.output.split())
    assert result.exit_code == 2 and f"{line.split()[0]}: it has 1," in output
    assert "cameras, more than 65,536; leave some out with --every" in output and len(made) <= CAMERAS
    count = 10**6 if line.startswith("--orbit") else 10**12
    path = path_of(f"{line} --every {count // 4}", no_scene)
    assert len(path.cameras) <= 5 and len(made) <= 2 * CAMERAS + 5
    assert path.numbers[:4] == tuple(range(0, count, count // 4))
