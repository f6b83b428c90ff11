"""COLMAP's sparse models: images and cameras, as text or binary. Points are ignored."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ...support.errors import CameraPathError
from ..frame import NO_LENS, Frame, Intrinsics, Settings
from .source import Files, Parsed, finite, posed, side

#: An image of images.bin: number, rotation w x y z, translation x y z, and number of its camera; its name follows.
IMAGE = struct.Struct("<I7dI")

#: A camera of cameras.bin: number, number of its model, width and height; its parameters follow.
CAMERA = struct.Struct("<IiQQ")

COUNT = struct.Struct("<Q")

#: Bytes of a point in an image: x, y, and the number of a 3D point.
POINT = 24

#: Values of an image in a line of images.txt; its points follow in the next line.
IMAGE_WORDS = 10

COMMENT = "# Image list with two lines of data per image"


@dataclass(frozen=True)
class Model:
    """A camera model.

    Attributes:
        name: in cameras.txt; cameras.bin has the index in `MODELS` instead.
        focals: number of focal lengths, 1 or 2; 0 for a model that a pinhole camera cannot replace.
        others: number of parameters after the principal point, all of the distortion.
    """

    name: str
    focals: int
    others: int

    @property
    def count(self) -> int:
        """Number of parameters of a camera."""
        return self.focals + 2 + self.others

    @property
    def distorts(self) -> bool:
        """Whether its images may differ from those of a pinhole camera."""
        return self.others > 0 or "FISHEYE" in self.name


MODELS = (
    Model("SIMPLE_PINHOLE", 1, 0),
    Model("PINHOLE", 2, 0),
    Model("SIMPLE_RADIAL", 1, 1),
    Model("RADIAL", 1, 2),
    Model("OPENCV", 2, 4),
    Model("OPENCV_FISHEYE", 2, 4),
    Model("FULL_OPENCV", 2, 8),
    Model("FOV", 2, 1),
    Model("SIMPLE_RADIAL_FISHEYE", 1, 1),
    Model("RADIAL_FISHEYE", 1, 2),
    Model("THIN_PRISM_FISHEYE", 2, 8),
    Model("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    Model("SIMPLE_DIVISION", 1, 1),
    Model("DIVISION", 2, 1),
    Model("SIMPLE_FISHEYE", 1, 0),
    Model("FISHEYE", 2, 0),
    Model("EUCM", 2, 2),
    Model("EQUIRECTANGULAR", 0, 0),
)

#: The cameras by their numbers, each with its model and its lens.
Cameras = dict[int, tuple[Model, Intrinsics]]


def recognises(files: Files) -> bool:
    """Return whether the file begins with the comment of images.txt, or like images.bin with a rotation."""
    data = _images(files)
    if data.lstrip().startswith(COMMENT.encode()):
        return True
    if len(data) < COUNT.size + IMAGE.size:
        return False
    quat = IMAGE.unpack_from(data, COUNT.size)[1:5]
    return 0 < COUNT.unpack_from(data)[0] <= len(data) // IMAGE.size and abs(sum(q * q for q in quat) - 1) < 1e-3


def _images(files: Files) -> bytes:
    """Return the bytes of images.bin or images.txt, or else of the first file."""
    named = (files.contents[name] for name in ("images.bin", "images.txt") if name in files.contents)
    return next(named, files.data)


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its images, sorted by name: COLMAP writes them in any order."""
    if "cameras.bin" in files.contents:
        cameras = dict(_binary_cameras(files.contents["cameras.bin"]))
    else:
        cameras = dict(_text_cameras(files.contents.get("cameras.txt", b"")))
    data = _images(files)
    images = _binary_images(data) if b"\0" in data[: 1 << 16] else _text_images(data)
    notes = [] if cameras else ["Without a cameras.txt or cameras.bin beside it, its lenses are unknown."]
    frames = []
    used = set()
    for image, camera, quat, position, name in images:
        if cameras and camera not in cameras:
            raise CameraPathError(f"image {image} has camera {camera}, which does not exist")
        model, lens = cameras[camera] if cameras else (None, NO_LENS)
        used.add(model)
        frames.append(Frame(posed(quat, position, f"image {image}"), lens, name=name))
    distorting = sorted(model.name for model in used if model and model.distorts)
    if distorting:
        notes.append(f"The lens distortion of {', '.join(distorting)} was ignored.")
    return Parsed(sorted(frames, key=lambda frame: _natural(frame.name)), tuple(notes))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts 9 before 10 in names."""
    parts = [(part.lstrip("0") if index % 2 else part) for index, part in enumerate(re.split(r"([0-9]+)", name))]
    return [(len(part) if index % 2 else 0, part) for index, part in enumerate(parts)]


#: An image: number, number of its camera, rotation w x y z, translation x y z, and name.
Image = tuple[int, int, list[float], list[float], str]


def _text_images(data: bytes) -> Iterator[Image]:
    lines = enumerate(_lines(data, "images.txt"), 1)
    for number, line in lines:
        words = line.split(maxsplit=IMAGE_WORDS - 1)
        if not words or words[0].startswith("#"):
            continue
        way = f"line {number} of images.txt"
        if len(words) != IMAGE_WORDS:
            raise CameraPathError(f"{way} has {len(words)} values, an image has {IMAGE_WORDS}")
        image, *numbers, camera = (finite(word, way) for word in words[:9])
        yield int(image), int(camera), numbers[:4], numbers[4:], words[9].strip()
        next(lines, None)  # the points of the image; the line is empty without any


def _text_cameras(data: bytes) -> Iterator[tuple[int, tuple[Model, Intrinsics]]]:
    for number, line in enumerate(_lines(data, "cameras.txt"), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        way = f"line {number} of cameras.txt"
        if len(words) < 4:
            raise CameraPathError(f"{way} has {len(words)} values, a camera has more")
        model = next((model for model in MODELS if model.name == words[1]), None)
        if model is None:
            raise CameraPathError(f"{way} has a camera model {words[1][:30]!r}, which is unknown")
        key, width, height, *numbers = (finite(word, way) for word in (words[0], *words[2:]))
        yield int(key), (model, lens_of(model, width, height, numbers, way))


def _lines(data: bytes, name: str) -> list[str]:
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CameraPathError(f"{name} is not text") from None


def _binary_images(data: bytes) -> Iterator[Image]:
    reader = _Reader(data, "images.bin")
    (count,) = reader.take(COUNT)
    reader.expect(count, IMAGE.size + 1 + COUNT.size)
    for _ in range(count):
        image, *numbers, camera = reader.take(IMAGE)
        name = reader.text()
        (points,) = reader.take(COUNT)
        reader.skip(points * POINT)
        way = f"image {image}"
        yield image, camera, [finite(x, way) for x in numbers[:4]], [finite(x, way) for x in numbers[4:]], name


def _binary_cameras(data: bytes) -> Iterator[tuple[int, tuple[Model, Intrinsics]]]:
    reader = _Reader(data, "cameras.bin")
    (count,) = reader.take(COUNT)
    reader.expect(count, CAMERA.size)
    for _ in range(count):
        key, number, width, height = reader.take(CAMERA)
        way = f"camera {key}"
        if not 0 <= number < len(MODELS):
            raise CameraPathError(f"{way} is of model {number}, which is unknown")
        model = MODELS[number]
        numbers = [finite(value, way) for value in reader.take(struct.Struct(f"<{model.count}d"))]
        yield key, (model, lens_of(model, width, height, numbers, way))


class _Reader:
    """Reads through the bytes of a file; `CameraPathError` if they end too early."""

    def __init__(self, data: bytes, name: str) -> None:
        self._data, self._name, self._at = data, name, 0

    def expect(self, count: int, least: int) -> None:
        """Check that `count` items of at least `least` bytes can follow."""
        if count > (len(self._data) - self._at) // least:
            raise CameraPathError(f"{self._name} announces {count:,} items, more than it can hold")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        self.skip(layout.size)
        return layout.unpack_from(self._data, self._at - layout.size)

    def text(self) -> str:
        """Return the text up to a zero byte."""
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


def lens_of(model: Model, width: float, height: float, numbers: list[float], way: str) -> Intrinsics:
    """Return the lens of a camera, without its distortion.

    Raises:
        CameraPathError: the number of parameters or the size is wrong, or it is not a pinhole camera.
    """
    if not model.focals:
        raise CameraPathError(f"{way} is {model.name}, which is not a pinhole camera")
    if len(numbers) != model.count:
        raise CameraPathError(f"{way} has {len(numbers)} parameters, not the {model.count} of {model.name}")
    principal = numbers[model.focals], numbers[model.focals + 1]
    return Intrinsics((side(width, way), side(height, way)), (numbers[0], numbers[model.focals - 1]), principal)
