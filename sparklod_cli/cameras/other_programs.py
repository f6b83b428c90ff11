"""Camera files of other programs, but for COLMAP's.

They are nerfstudio's camera paths, transforms.json of datasets, Inria's cameras.json, Open3D's
PinholeCameraTrajectory, as .json and .log, and trajectories of the TUM benchmark and evo; settings.json of SuperSplat's
viewer, document.json of its projects, and splat-transform's camera track.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np

from ..system.errors import CameraPathError
from ..system.untrusted import Origin, quoted_value
from .camera import NO_LENS, Frame, Intrinsics, Matrix, Numbers, Settings, frame_looking, pose
from .camera_files import CameraJson, Files, Parsed
from .sources import along, cardinal_tangents, hermite

#: The camera types of nerfstudio's paths that are read as pinhole cameras.
PINHOLES = ("perspective", "fisheye")

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Values of these without an effect. Others need not be numbers, as distortion is ignored.
UNDISTORTED = (0, "", "0", "0.0")

#: Beginnings of the names of camera models that a pinhole camera cannot replace.
PANORAMAS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180")


def recognises_nerfstudio(files: Files) -> bool:
    """Return whether the file has a camera_path."""
    return files.json is not None and files.json.has("camera_path")


def parse_nerfstudio(files: Files, settings: Settings) -> Parsed:
    """Parse a path that nerfstudio's viewer saved. Keyframes are ignored: the frames are interpolated from them."""
    root = files.object()
    kind = root.optional("camera_type", CameraJson.text, PINHOLES[0])
    if kind not in PINHOLES:
        raise CameraPathError(f"its camera_type {kind[:20]!r} is not that of a pinhole camera")
    size = None
    if root.has("render_width", "render_height"):
        size = root.get("render_width").side(), root.get("render_height").side()

    def frame(item: CameraJson) -> Frame:
        degrees = item.optional("fov", CameraJson.number)  # vertical, as in three.js; the aspect is that of the size
        fov = None if degrees is None else math.radians(degrees)
        return Frame(item.get("camera_to_world").matrix_4x4(), Intrinsics(size, fov=fov))

    frames = list(map(frame, root.items("camera_path")))
    fps = root.optional("fps", CameraJson.number, 0.0)
    notes = ("Its fisheye cameras are read as pinhole cameras.",) if kind == "fisheye" else ()
    return Parsed(frames, notes, fps if fps > 0 else None)


def recognises_transforms(files: Files) -> bool:
    """Return whether its frames have a transform_matrix."""
    root = files.json
    return root is not None and root.has("frames") and root.get("frames").first_has("transform_matrix")


def parse_transforms(files: Files, settings: Settings) -> Parsed:
    """Parse a dataset of nerfstudio, Instant NGP or the original NeRF; frames are in the order of the file."""
    root = files.object()
    items = list(root.items("frames"))
    notes = []
    model = root.label("camera_model")
    if model.startswith(PANORAMAS):
        raise CameraPathError(f"its camera_model {model[:24]!r} is not that of a pinhole camera")
    if any(place.has(key) and place.value[key] not in UNDISTORTED for place in (root, *items) for key in DISTORTION):
        notes.append("Its lens distortion was ignored.")
    if root.has("applied_transform"):
        notes.append("Its applied_transform was not undone.")
    frames = []
    for item in items:
        matrix = item.get("transform_matrix").matrix_4x4(3, 4)
        frames.append(Frame(matrix, _lens(item, root), name=item.label("file_path")))
    return Parsed(frames, tuple(notes))


def _lens(item: CameraJson, root: CameraJson) -> Intrinsics:
    """Return the lens of a frame; values that the frame lacks are those of the whole file."""

    def number(key: str) -> float | None:
        return (item if item.has(key) else root).optional(key, CameraJson.number)

    width, height = ((item if item.has(key) else root).optional(key, CameraJson.side) for key in ("w", "h"))
    angle_x, angle_y = number("camera_angle_x"), number("camera_angle_y")
    fov, along = (angle_x, "x") if angle_x is not None else (angle_y, "y")
    if width is None or height is None:
        return Intrinsics(fov=fov, fov_along=along)
    fx, fy = number("fl_x"), number("fl_y")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    focal = (fx, fy) if fx is not None and fy is not None else None
    cx, cy = number("cx"), number("cy")
    principal = (cx, cy) if cx is not None and cy is not None else None
    return Intrinsics((width, height), focal, principal, fov, along)


def recognises_inria(files: Files) -> bool:
    """Return whether the file is a list of positions and rotations."""
    return files.json is not None and files.json.first_has("position", "rotation")


def parse_inria(files: Files, settings: Settings) -> Parsed:
    """Parse the cameras.json beside the splats; cameras are in the order of the file, test cameras first."""
    frames = []
    for item in files.object().items():
        rotation = np.array(item.get("rotation").matrix(3, columns=3)).reshape(3, 3)
        lens = Intrinsics()
        if item.has("width", "height"):
            size = item.get("width").side(), item.get("height").side()
            lens = Intrinsics(size, (item.number("fx"), item.number("fy")) if item.has("fx", "fy") else None)
        frames.append(Frame(pose(rotation, item.get("position").numbers(3)), lens, name=item.label("img_name")))
    return Parsed(frames)


CLASS = "PinholeCameraTrajectory"

#: Lines of a pose in a .log file: three whole numbers, and a camera-to-world matrix.
LOG_LINES = 5

#: Open3D's pixel coordinates are whole numbers at the centres of pixels, ours at their corners.
HALF = 0.5

#: Numbers of a line of a TUM trajectory.
COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def recognises_open3d(files: Files) -> bool:
    """Return whether the file is JSON of `CLASS`, or begins with three whole numbers and a row of four numbers."""
    if files.json is not None:
        return files.json.has("class_name") and files.json.value["class_name"] == CLASS
    rows = [line.split() for line in (files.text or "").split("\n", 2)[:2]]
    try:
        return len(rows) == 2 and len(list(map(int, rows[0]))) == 3 and len(list(map(float, rows[1]))) == 4
    except ValueError:
        return False


def parse_open3d(files: Files, settings: Settings) -> Parsed:
    """Parse a trajectory; a .log has no lenses."""
    if files.json is None and files.path.suffix.lower() != ".json":
        return Parsed(_frames_of_log(files.lines()))
    root, frames = files.object(), []
    if not recognises_open3d(files):
        raise CameraPathError(f"it is not a {CLASS}")
    for camera in root.items("parameters"):
        extrinsic, intrinsic = camera.get("extrinsic").numbers(16), camera.get("intrinsic")  # column by column
        fx, _, _, _, fy, _, x, y, _ = intrinsic.get("intrinsic_matrix").numbers(9)
        size = intrinsic.get("width").side(), intrinsic.get("height").side()
        lens = Intrinsics(size, (fx, fy), (x + HALF, y + HALF))
        frames.append(Frame(np.array(extrinsic).reshape(4, 4).T, lens))
    return Parsed(frames)


def _frames_of_log(lines: list[str]) -> list[Frame]:
    rows: list[list[float]] = []
    for number, words in _rows(lines):
        row = CameraJson(words, Origin(f"line {number}", CameraPathError))
        rows.append(row.numbers(4 if len(rows) % LOG_LINES else 3))
    if len(rows) % LOG_LINES:
        raise CameraPathError("it ends inside a pose")
    poses = [np.array(rows[at + 1 : at + LOG_LINES]) for at in range(0, len(rows), LOG_LINES)]
    try:
        with np.errstate(all="ignore"):
            return [Frame(np.linalg.inv(pose), NO_LENS) for pose in poses]  # extrinsics, as in a .json
    except np.linalg.LinAlgError:
        raise CameraPathError("it has a matrix that cannot be inverted") from None


def recognises_tum(files: Files) -> bool:
    """Return whether the first line that is not a comment has eight numbers."""
    words = next(_rows((files.text or "").splitlines()), (0, []))[1]
    try:
        return len([float(word) for word in words]) == len(COLUMNS)
    except ValueError:
        return False


def parse_tum(files: Files, settings: Settings) -> Parsed:
    """Parse a pose per line: `timestamp tx ty tz qx qy qz qw`."""
    frames = []
    for line, words in _rows(files.lines()):
        row = CameraJson.of_row(COLUMNS, words, f"line {line}")
        time, *position, x, y, z, w = map(row.number, COLUMNS)
        frames.append(Frame(row.pose([w, x, y, z], position), time=time))
    return Parsed(frames)


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words


#: Up axis and frame rate of PlayCanvas.
UP = (0.0, 1.0, 0.0)
FRAME_RATE = 30.0

#: Field of view in degrees of a version 1 file without one: of its animation, and of its first view.
FOV_TRACK, FOV_VIEW = 60.0, 75.0

#: Version of SuperSplat's settings.
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
    """Parse the first animation, or else the views.

    Files have keys of position, target and field of view on a time line counted in frames, and a smoothness; frames
    between the keys are interpolated as in SuperSplat.
    """
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
    for index, item in enumerate(item for one in sets[:1] for item in one.items("poses")):
        frame = item.optional("frame", CameraJson.number, index * rate)
        if frame < count:
            keys[frame] = _values(item, _fov(root))
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
