"""Files that the programs themselves wrote, or read: what they say of a camera is what we say."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.camera_files import read
from tests.cameras.known import FOLDER, KNOWN, LANDMARK, files_at, pixel
from tests.interop import npm

pytestmark = pytest.mark.slow

#: The version that has --camera-track; playcanvas is its peer.
SPLAT_TRANSFORM = {"@playcanvas/splat-transform": "3.7.0", "playcanvas": "2.23.3"}

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


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
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    return npm.folder_with(
        SPLAT_TRANSFORM, variable="SPLAT_TRANSFORM_DIR", request=request, tmp_path_factory=tmp_path_factory
    )


def track(**changes: Any) -> dict[str, Any]:
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
    "viewer": track(),
    "viewer that repeats": track(loopMode="repeat"),
    "viewer that repeats to its last key": track(loopMode="repeat", duration=44 / 30),
    "viewer, straight": track(smoothness=0),
    "viewer, in steps": track(interpolation="step"),
    "project": document(),
    "project that ends": document(loop=False, smoothness=0.3),
    "frames": json.loads((FOLDER / "splat-transform.json").read_text(encoding="utf-8")),
}


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
        assert np.allclose(np.linalg.inv(camera.camera_to_world @ FLIP), pose)
        theirs = lens.img_from_cam((pose @ [*LANDMARK, 1])[:3])
        assert np.allclose(pixel(camera, LANDMARK), theirs)


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
        assert np.allclose(np.linalg.inv(camera.camera_to_world @ FLIP), pose, atol=1e-6)
        if suffix == ".json":
            assert (camera.focal, camera.principal) == ((600, 610), (330, 250))


def test_open3d_reads_the_fixture_as_we_do() -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed")
    for name in ("open3d.json", "open3d.log"):
        trajectory = open3d.io.read_pinhole_camera_trajectory(str(FOLDER / name))
        for camera, known in zip(trajectory.parameters, KNOWN, strict=True):
            assert np.allclose(np.linalg.inv(camera.extrinsic)[:3, 3], known.position)
            assert np.allclose(camera.extrinsic[2, :3], known.ahead)
