"""PlayCanvas: settings.json of SuperSplat's viewer, document.json of its projects, and splat-transform's camera track.

SuperSplat's files have keys of position, target and field of view on a time line counted in frames, and a smoothness;
frames between the keys are interpolated as in SuperSplat.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from ..system.errors import CameraPathError
from ..system.untrusted import quoted_value
from .camera import Frame, Intrinsics, Matrix, Numbers, Settings, frame_looking
from .camera_files import CameraJson, Files, Parsed
from .sources import along, cardinal_tangents, hermite

UP = (0.0, 1.0, 0.0)
FRAME_RATE = 30.0

#: Field of view in degrees of a version 1 file without one: of its animation, and of its first view.
FOV_TRACK, FOV_VIEW = 60.0, 75.0

VERSION = 2


def recognises_supersplat(files: Files) -> bool:
    """Return whether the file has poses, animations or cameras of SuperSplat."""
    root = files.json
    if root is None:
        return False
    return (
        root.has("poseSets")
        or root.has("animTracks")
        or root.has("version", "cameras")
        or root.has("camera", "background")
    )


@np.errstate(all="ignore")  # numbers may have any size; the resulting poses are checked
def parse_supersplat(files: Files, settings: Settings) -> Parsed:
    """Parse the first animation, or else the views."""
    root = files.object()
    if root.has("poseSets"):
        return _of_document(root, settings)
    if root.has("version") and root.value["version"] != VERSION:
        raise CameraPathError(f"version {quoted_value(root.value['version'])} of SuperSplat's settings is unknown")
    tracks = list(root.items("animTracks")) if root.has("animTracks") else []
    if tracks:
        path = _of_track(tracks[0], _fov(root), not root.has("version"), settings)
        notes = (f"Only the first of its {len(tracks):,} animations was read.",) if len(tracks) > 1 else ()
        return dataclasses.replace(path, notes=notes)
    single = [root.get("camera")]
    views = [camera.get("initial") for camera in root.items("cameras")] if root.has("cameras") else single
    return Parsed([_looking(_values(view, FOV_VIEW), None, settings) for view in views])


def _of_track(track: CameraJson, fov: float, first_version: bool, settings: Settings) -> Parsed:
    """Parse an item of animTracks. Version 1 has one field of view for all keys; its first files count in seconds."""
    rate = track.optional("frameRate", CameraJson.positive, FRAME_RATE)
    times = np.array(track.get("keyframes", "times").numbers())
    if not track.has("frameRate"):
        times = times * FRAME_RATE
    values = track.get("keyframes", "values")
    points = np.empty((len(times), 7))
    for column, key in ((0, "position"), (3, "target")):
        points[:, column : column + 3] = np.reshape(values.get(key).numbers(3 * len(times)), (-1, 3))
    points[:, 6] = values.get("fov").numbers(len(times)) if values.has("fov") else fov
    duration = track.get("duration").positive()
    smoothness = track.optional("smoothness", CameraJson.number, float(not first_version))
    length = None
    if len(times) and track.has("loopMode") and track.value["loopMode"] == "repeat":
        length = (duration + (duration == times[-1] / rate)) * rate
    step = track.has("interpolation") and track.value["interpolation"] == "step"
    at = _curve(times, points, smoothness, length, step)
    count = duration * rate
    return _sampled(at, float(round(count)) if math.isfinite(count) else count, rate, settings)


def _of_document(root: CameraJson, settings: Settings) -> Parsed:
    """Parse a project; poses beyond the end of its time line are ignored, with a note."""
    line = root.get("timeline")
    count, rate = line.number("frames"), line.optional("frameRate", CameraJson.positive, FRAME_RATE)
    keys = {}
    late = 0
    sets = list(root.items("poseSets"))  # SuperSplat writes one set or none
    for index, pose in enumerate(pose for one in sets[:1] for pose in one.items("poses")):
        frame = pose.optional("frame", CameraJson.number, index * rate)
        if frame < count:
            keys[frame] = _values(pose, _fov(root))
        else:
            late += 1
    notes = [f"Only the first of its {len(sets):,} pose sets was read."] if len(sets) > 1 else []
    if late:
        notes.append(f"Poses beyond the end of its time line were ignored ({late:,}).")
    smoothness = line.optional("smoothness", CameraJson.number, 1.0)
    looping = not line.has("loop") or line.value["loop"] is True
    times = np.array(sorted(keys))
    points = np.array([keys[time] for time in times]).reshape(-1, 7)
    curve = _curve(times, points, smoothness, count if looping else None, False)
    return dataclasses.replace(_sampled(curve, float(math.floor(count)), rate, settings), notes=tuple(notes))


def _values(view: CameraJson, fov: float) -> list[float]:
    degrees = view.optional("fov", CameraJson.number, fov)
    return [*view.get("position").numbers(3), *view.get("target").numbers(3), degrees]


def _fov(root: CameraJson) -> float:
    camera = root.get("camera")
    return camera.number("fov") if camera.has("fov") else FOV_TRACK


def _curve(
    times: Matrix, points: Matrix, smoothness: float, length: float | None, step: bool
) -> Callable[[Matrix], Matrix]:
    """Return a function that interpolates between (n, 7) points, keys at (n,) times in frames.

    `length` is that of a loop, in frames, None for a path that does not repeat. `smoothness` is 0, for straight lines,
    to 1; `step` holds each key until the next.
    """
    if not len(times):
        raise CameraPathError("it has no keyframes")
    if length is not None and len(times) > 1 and not step:  # two more keys at either end close the loop
        times = np.concatenate([times[-2:] - length, times, times[:2] + length])
        points = np.concatenate([points[-2:], points, points[:2]])
    if not (np.diff(times) > 0).all():
        raise CameraPathError("the times of its keyframes do not increase, or go beyond its end")
    if step or len(times) == 1:
        return lambda at: points[np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)]
    tangents = smoothness * cardinal_tangents(times, points)
    return lambda at: hermite(times, points, tangents, np.clip(at, times[0], times[-1]))


def _sampled(curve: Callable[[Matrix], Matrix], count: float, rate: float, settings: Settings) -> Parsed:
    """Return all frames of a path of `count` frames; --fps changes their number, not the duration."""
    fps = settings.fps or rate

    def at(numbers: Numbers) -> list[Frame]:
        times = numbers / fps
        samples = along(curve, times * rate)
        return [_looking(sample, float(time), settings) for sample, time in zip(samples, times, strict=True)]

    return Parsed(at, fps=rate, count=max(count, 1) / rate * fps - 1e-6)


def _looking(sample: Matrix | list[float], time: float | None, settings: Settings) -> Frame:
    """Return a frame whose field of view spans the longer side of the image."""
    lens = Intrinsics(fov=math.radians(sample[6]), fov_along="longer")
    return frame_looking(sample[:3], sample[3:6], settings.up or UP, lens, time)


def recognises_camera_track(files: Files) -> bool:
    """Return whether its frames have a position and a target."""
    root = files.json
    return root is not None and root.has("frames") and root.get("frames").first_has("position", "target")


def parse_camera_track(files: Files, settings: Settings) -> Parsed:
    """Parse the plain camera track of splat-transform: `{frameRate, frames: [{position, target, fov, up}]}`."""
    root = files.object()
    fps, items = root.optional("frameRate", CameraJson.positive), list(root.items("frames"))

    def frame(item: CameraJson) -> Frame:
        lens = Intrinsics(fov=item.optional("fov", lambda fov: math.radians(fov.number())))  # vertical
        up = item.optional("up", lambda up: up.numbers(3)) or settings.up or UP
        return frame_looking(item.get("position").numbers(3), item.get("target").numbers(3), up, lens)

    return Parsed(list(map(frame, items)), fps=fps, turned=all(item.has("up") for item in items))
