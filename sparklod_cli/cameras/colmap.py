"""COLMAP's sparse models: images and cameras, as text or binary. Points are ignored."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from ..system.errors import CameraPathError
from ..system.untrusted import Origin
from .camera import NO_LENS, Frame, Intrinsics, Settings
from .camera_files import CameraJson, Files, Parsed, decoded
from .camera_formats import FORMATS

#: An image of images.bin: number, rotation w x y z, translation x y z, and number of its camera; its name follows.
IMAGE = struct.Struct("<I7dI")

#: A camera of cameras.bin: number, number of its model, width and height; its parameters follow.
CAMERA = struct.Struct("<IiQQ")

COUNT = struct.Struct("<Q")

#: Bytes of a point in an image: x, y, and the number of a 3D point.
POINT = 24

#: Words of an image in a line of images.txt: values of `IMAGE`, and its name, which may contain blanks.
IMAGE_COLUMNS = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID", "NAME")

#: Words of a point in a line of images.txt: x, y, and the number of a 3D point.
POINT_WORDS = 3

#: Values of a camera before its parameters.
CAMERA_COLUMNS = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT")

COMMENT = "# Image list with two lines of data per image"

#: The comment of images.txt and cameras.txt that gives the number of their items.
ANNOUNCED = re.compile(r"#\s*Number of (?:images|cameras):\s*(\d{1,18})\b", re.ASCII | re.IGNORECASE)

#: Sets of files of a model.
NAMES = next(form.names for form in FORMATS if form.name == "colmap")


#: Camera models, in the order of their numbers in cameras.bin: number of focal lengths, 0 if a pinhole camera cannot
#: replace the model, and of parameters after the principal point, which are all of the distortion.
MODELS = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "OPENCV_FISHEYE": (2, 4),
    "FULL_OPENCV": (2, 8),
    "FOV": (2, 1),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
    "THIN_PRISM_FISHEYE": (2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": (2, 12),
    "SIMPLE_DIVISION": (1, 1),
    "DIVISION": (2, 1),
    "SIMPLE_FISHEYE": (1, 0),
    "FISHEYE": (2, 0),
    "EUCM": (2, 2),
    "EQUIRECTANGULAR": (0, 0),
}

#: The cameras by their numbers, each with the name of its model and its lens.
Cameras = dict[int, tuple[str, Intrinsics]]


def recognises_colmap(files: Files) -> bool:
    """Return whether its names or its first comment are COLMAP's, or it begins with an image and a rotation."""
    if any(files.contents.keys() >= set(names) for names in NAMES):
        return True
    if files.text is not None:
        lines = (line for line in files.text.splitlines() if not _is_comment(line))
        return files.text.lstrip().startswith(COMMENT) or _begins_with_rotation(next(lines, ""))
    if len(files.data) < COUNT.size + IMAGE.size:
        return False
    count = COUNT.unpack_from(files.data)[0]
    return 0 < count <= len(files.data) // IMAGE.size and _is_unit(IMAGE.unpack_from(files.data, COUNT.size)[1:5])


def _begins_with_rotation(line: str) -> bool:
    try:
        return _is_unit(_image_of_line(line, "")[2])
    except CameraPathError:
        return False


def _is_unit(quat: Iterable[float]) -> bool:
    return abs(sum(q * q for q in quat) - 1) < 1e-3


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def parse_colmap(files: Files, settings: Settings) -> Parsed:
    """Parse images, which COLMAP writes in any order, sorted by name."""
    cameras = None
    if "cameras.bin" in files.contents:
        cameras = _binary_cameras(files.contents["cameras.bin"])
    elif "cameras.txt" in files.contents:
        cameras = _text_cameras(files.contents["cameras.txt"])
    name = next((name for name in ("images.bin", "images.txt") if name in files.contents), None)
    data = files.contents[name] if name else files.data
    binary = name == "images.bin" or (name is None and files.text is None)
    images = _binary_images(data) if binary else _text_images(data)
    notes = [] if cameras is not None else ["Without a cameras.txt or cameras.bin beside it, its lenses are unknown."]
    frames, used = [], set()
    for row, camera, quat, position in images:
        if cameras is not None and camera not in cameras:
            raise row.error(f"it has camera {camera}, which does not exist")
        model, lens = cameras[camera] if cameras is not None else (None, NO_LENS)
        used.add(model)
        frames.append(Frame(row.pose(quat, position), lens, name=row.text("NAME")))
    distorting = sorted(model for model in used if model and (MODELS[model][1] or "FISHEYE" in model))
    if distorting:
        notes.append(f"The lens distortion of {', '.join(distorting)} was ignored.")
    return Parsed(sorted(frames, key=lambda frame: _natural(frame.name)), tuple(notes))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them, 9 before 10."""
    parts = [(part.lstrip("0") if index % 2 else part) for index, part in enumerate(re.split(r"([0-9]+)", name))]
    return [(len(part) if index % 2 else 0, part) for index, part in enumerate(parts)]


#: An image: its values by the names of `IMAGE_COLUMNS`, number of its camera, rotation w x y z, and translation.
Image = tuple[CameraJson, int, list[float], list[float]]


def _text_images(data: bytes) -> list[Image]:
    """Parse images.txt; a line of points may follow each image, as some programs leave out all, or the empty, ones."""
    lines, announced = _lines(data, "images.txt")
    images: list[Image] = []
    points_may_follow = False
    for number, line in lines:
        if points_may_follow and _is_points(line):
            points_may_follow = False
            continue
        images.append(_image_of_line(line, f"line {number} of images.txt"))
        points_may_follow = True
    _check_count(len(images), announced, "images.txt", "images")
    return images


def _image_of_line(line: str, place: str) -> Image:
    return _image(line.strip().split(maxsplit=len(IMAGE_COLUMNS) - 1), place)


def _image(values: Sequence[Any], place: str) -> Image:
    row = CameraJson.of_row(IMAGE_COLUMNS, values, place)
    _, *numbers, _ = map(row.number, IMAGE_COLUMNS[:-1])
    row.get("IMAGE_ID").identifier()
    return row, row.get("CAMERA_ID").identifier(), numbers[:4], numbers[4:]


def _is_points(line: str) -> bool:
    """Return whether a line has the points of an image, x, y and a whole number each; only four points are checked.

    A line of an image with a name of one number has 10 words, which is no multiple of 3. One with a name such as
    "2024 10 3" begins with a rotation.
    """
    words = line.split(maxsplit=4 * POINT_WORDS)[: 4 * POINT_WORDS]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return False
    of_points = len(words) % POINT_WORDS == 0 and all(number.is_integer() for number in numbers[2::POINT_WORDS])
    return of_points and not _begins_with_rotation(line)


def _text_cameras(data: bytes) -> Cameras:
    lines, announced = _lines(data, "cameras.txt")
    cameras: Cameras = {}
    for number, line in lines:
        key, values = _camera(line.split(), f"line {number} of cameras.txt")
        cameras[key] = values
    _check_count(len(cameras), announced, "cameras.txt", "cameras")
    return cameras


def _camera(values: Sequence[Any], place: str) -> tuple[int, tuple[str, Intrinsics]]:
    """Return the number, model and lens, without its distortion, of a camera: `CAMERA_COLUMNS`, then its parameters."""
    row = CameraJson(dict(zip(CAMERA_COLUMNS, values, strict=False)), Origin(place, CameraPathError))
    row.value["PARAMS"] = list(values[len(CAMERA_COLUMNS) :])
    model = row.text("MODEL")
    focals, others = MODELS.get(model, (0, 0))
    if not focals:
        raise row.get("MODEL").unexpected("a pinhole camera of COLMAP")
    numbers = row.get("PARAMS").numbers(focals + 2 + others)
    size, focal = (row.get("WIDTH").side(), row.get("HEIGHT").side()), (numbers[0], numbers[focals - 1])
    return row.get("CAMERA_ID").identifier(), (model, Intrinsics(size, focal, (numbers[focals], numbers[focals + 1])))


def _lines(data: bytes, name: str) -> tuple[list[tuple[int, str]], int | None]:
    """Return the numbered lines of a file, and the count that its comments announce, None without one."""
    text = decoded(data)
    if text is None:
        raise CameraPathError(f"{name} is not text")
    lines = list(enumerate(text.splitlines(), 1))
    announced = [int(match[1]) for _, line in lines if line.startswith("#") and (match := ANNOUNCED.match(line))]
    return [row for row in lines if not _is_comment(row[1])], sum(announced) if announced else None


def _check_count(count: int, announced: int | None, name: str, items: str) -> None:
    if announced is not None and count != announced:
        raise CameraPathError(
            f"{name} has {count:,} {items}, but its comment announces {announced:,}: it may be cut short;"
            " if it is complete, correct the comment"
        )


def _binary_images(data: bytes) -> Iterator[Image]:
    reader = _Reader(data, "images.bin", IMAGE.size + 1 + COUNT.size)
    for _ in range(reader.count):
        values = reader.take(IMAGE)
        name = reader.text()
        (points,) = reader.take(COUNT)
        reader.skip(points * POINT)
        yield _image((*values, name), f"image {values[0]}")
    reader.finish()


def _binary_cameras(data: bytes) -> Cameras:
    reader, cameras = _Reader(data, "cameras.bin", CAMERA.size), Cameras()
    for _ in range(reader.count):
        key, number, *size = reader.take(CAMERA)
        if not 0 <= number < len(MODELS):
            raise CameraPathError(f"camera {key} is of model {number}, which is unknown")
        model, counts = list(MODELS.items())[number]
        numbers = reader.take(struct.Struct(f"<{2 + sum(counts)}d"))
        cameras[key] = _camera((key, model, *size, *numbers), f"camera {key}")[1]
    reader.finish()
    return cameras


class _Reader:
    """Reads through the bytes of a file; `CameraPathError` if they end too early.

    Args:
        least: bytes of the smallest item.

    Attributes:
        count: number of items that the file announces.
    """

    def __init__(self, data: bytes, name: str, least: int) -> None:
        self._data, self._name, self._at = data, name, 0
        (self.count,) = self.take(COUNT)
        if self.count > (len(data) - COUNT.size) // least:
            raise CameraPathError(f"{name} announces {self.count:,} items, more than it can hold")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        self.skip(layout.size)
        return layout.unpack_from(self._data, self._at - layout.size)

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise CameraPathError(f"{self._name} ends inside a name")
        name = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return name

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._data):
            raise CameraPathError(f"{self._name} ends before all of its data")

    def finish(self) -> None:
        if left := len(self._data) - self._at:
            raise CameraPathError(f"{self._name} has {left:,} bytes after the {self.count:,} items that it announces")
