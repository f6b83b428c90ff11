"""Paths that need no file: where their cameras are, and that nothing jumps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras import sources
from sparklod_cli.cameras.camera import Frame, Intrinsics, Settings, look_at
from sparklod_cli.cameras.sources import (
    Key,
    between,
    cameras_of,
    cardinal_tangents,
    catmull_rom_tangents,
    centripetal_knots,
    hermite,
)
from sparklod_cli.system.errors import CameraPathError

DOWN_Y = (0.0, -1.0, 0.0)


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
    frames = sources.orbit_frames(np.arange(12), 12, center, distance, elevation, up)
    offsets = positions(frames) - center
    axis = np.array(up) / np.linalg.norm(up)
    assert np.allclose(np.linalg.norm(offsets, axis=1), distance)
    assert np.allclose(offsets @ axis, distance * math.sin(elevation))
    assert np.allclose(aheads(frames), -offsets / distance)
    around = offsets - (offsets @ axis)[:, None] * axis
    turns = np.cross(around, np.roll(around, -1, axis=0)) @ axis
    assert np.allclose(turns, (distance * math.cos(elevation)) ** 2 * math.sin(2 * math.pi / 12)), "to the left, evenly"
    assert all(frame.matrix[:3, 1] @ axis > 0 for frame in frames)


@pytest.mark.parametrize(("up", "front"), [((0, -1, 0), (0, 0, -1)), ((0, 1, 0), (0, 0, 1)), ((0, 0, 1), (0, -1, 0))])
def test_a_scene_is_first_seen_from_its_front(up: tuple[float, ...], front: tuple[float, ...]) -> None:
    assert np.allclose(positions(sources.orbit_frames(np.arange(4), 4, (0, 0, 0), 2, 0, up))[0], 2 * np.array(front))
    assert np.allclose(positions(sources.dolly_frames(np.arange(4), 4, (0, 0, 0), 2, 1, 0, up))[0], 2 * np.array(front))


def test_distances_of_a_dolly_have_one_ratio() -> None:
    frames = sources.dolly_frames(np.arange(9), 9, (1, 1, 1), 16.0, 1.0, math.radians(20), DOWN_Y)
    distances = np.linalg.norm(positions(frames) - 1, axis=1)
    assert distances[[0, -1]] == pytest.approx([16, 1])
    assert np.allclose(distances[1:] / distances[:-1], 16 ** (-1 / 8))
    assert np.allclose(aheads(frames), aheads(frames)[0])


def test_looking_along_up_still_makes_a_camera() -> None:
    for up in (DOWN_Y, (0, 0, 0)):
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
    frames = moved(KEYS, 200, DOWN_Y)
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


def test_keyframes_with_times_are_passed_in_time() -> None:
    keys = [Key((float(t), 0.0, 0.0), (0.0, 0.0, 99.0), time=10 + t) for t in (0, 1, 3, 4)]
    frames = moved(keys, 4, DOWN_Y)
    assert len(frames) == 17
    assert np.allclose(positions(frames)[:, 0], np.arange(17) / 4), "equally fast all along"
    assert [frame.time for frame in frames] == pytest.approx(np.arange(17) / 4)


def test_keyframes_in_one_place_turn_the_camera() -> None:
    keys = [Key((0.0, 0.0, 0.0), (math.sin(a), 0.0, math.cos(a))) for a in (0, 1, 1.5)]
    frames = moved(keys, 30, DOWN_Y)
    assert np.allclose(positions(frames), 0)
    assert np.allclose(aheads(frames)[-1], (math.sin(1.5), 0, math.cos(1.5)))
    same = moved([keys[0], keys[0]], 10, DOWN_Y)
    assert len(same) == 21
    assert np.allclose(aheads(same), (0, 0, 1))


def test_keyframes_without_a_lens_keep_the_given_one() -> None:
    lens = Intrinsics((640, 480), (600, 610), (300, 200))
    keys = [Key(key.eye, key.target) for key in KEYS]
    assert all(frame.lens == lens for frame in moved(keys, 5, DOWN_Y, lens))
    mixed = moved([keys[0], KEYS[1]], 5, DOWN_Y)
    assert mixed[0].lens.fov == pytest.approx(math.radians(60))


@pytest.mark.parametrize(
    ("times", "said"),
    [((0.0, None), "some have none"), ((1.0, 1.0), "do not increase"), ((0.0, 1e300), "are more than")],
)
def test_keyframe_times_that_do_not_rise_are_refused(times: tuple[float | None, ...], said: str) -> None:
    keys = [Key(key.eye, key.target, time=time) for key, time in zip(KEYS, times, strict=False)]
    with pytest.raises(CameraPathError, match=said):
        moved(keys, 30, DOWN_Y)


def test_centripetal_splines_make_no_loop() -> None:
    """Two near points between far ones: evenly spaced knots would overshoot them, and come back."""
    points = np.array([[-10.0, 0], [0, 0], [0.1, 0], [0.1, 10]])
    at = np.linspace(0, 1, 2001)

    def curve(knots: NDArray[np.float64]) -> NDArray[np.float64]:
        return hermite(knots, points, catmull_rom_tangents(knots, points), at * knots[-1])

    assert np.diff(curve(centripetal_knots(points))[:, 0])[:1000].min() > -1e-12
    assert curve(np.arange(4.0))[:, 0].max() > 0.5


def test_both_tangents_reproduce_straight_lines_and_catmull_rom_parabolas() -> None:
    knots, at = np.array([0.0, 1.0, 1.5, 4.0]), np.linspace(0, 4, 50)
    line = np.stack([2 * knots - 1, knots], axis=1)
    for tangents in (catmull_rom_tangents, cardinal_tangents):
        assert np.allclose(hermite(knots, line, tangents(knots, line), at)[:, 0], 2 * at - 1)
    parabola = (knots**2)[:, None]
    assert np.allclose(hermite(knots, parabola, catmull_rom_tangents(knots, parabola), at)[:, 0], at**2)


def test_generated_cameras_have_times_by_the_frame_rate() -> None:
    path = cameras_of(sources.orbit_frames(np.arange(4), 4, (0, 0, 0), 1, 0, DOWN_Y), Settings(fps=2), "an orbit")
    assert [camera.time for camera in path.cameras] == [0, 0.5, 1, 1.5]
    assert path.format == "an orbit"
    assert path.notes == ()
