"""Files of a SOG scene, meta.json and images, in a zip or a folder; sizes are checked before decoding."""

from __future__ import annotations

import contextlib
import io
import math
import zipfile
from collections.abc import Iterable, Iterator
from typing import IO, BinaryIO

import numpy as np

from ...system.errors import FormatError, NotSplatsError
from ...system.units import count_of
from ...system.untrusted import Json, Origin, quoted_value
from ..compression import check_promise
from ..formats import META, SOG_IMAGES
from ..reader import OpenCompanion, size_of
from ..zip_folder import ZipFolder
from .webp import Pixels, Texels, WebPHeader, pixels_of, read_header

#: Sides of images are multiples of this, as PlayCanvas makes them.
STEP = 4


def size_for(count: int) -> tuple[int, int]:
    """Return width and height of the image for a number of splats: about a square."""
    width = STEP * math.ceil(math.sqrt(count) / STEP)
    return width, STEP * math.ceil(count / width / STEP)


def image_of(texels: Texels, width: int, height: int) -> Texels:
    """Arrange (N, C) texels row by row as (height, width, C), with zeros behind them."""
    image = np.zeros((height * width, texels.shape[1]), np.uint8)
    image[: len(texels)] = texels
    return image.reshape(height, width, -1)


#: Largest meta.json, bytes; codebooks take 15,000.
MAX_META = 1 << 22

#: Permissions of the members of a zip that is written, and the system that has them, 3 for Unix.
MODE, UNIX = 0o100644 << 16, 3

#: Texels that an image may have: a multiple of the splats, and some more, since writers make images square or round
#: sides up to powers of two.
SPARE_FACTOR, SPARE_TEXELS = 4, 1 << 16


#: Largest magnitude of a number in meta.json, so that float32 holds what is computed from it.
LARGEST = 1e38


def parse_meta(data: bytes) -> Json:
    """Parse the meta.json of a SOG."""
    meta = Json.parse(data, Origin(META, FormatError), most=MAX_META)
    if not isinstance(meta.value, dict) or meta.value.keys().isdisjoint(("means", "quats")):
        raise NotSplatsError(f"its {META} is not that of a SOG")
    return meta


def has(meta: Json, key: str) -> bool:
    """Return True if a meta.json has a key with a value that is not null, false, "" or empty, as viewers test it."""
    value = meta.value.get(key)
    return bool(value) or type(value) is int


def image_names(meta: Json) -> list[str]:
    """Return the images of a scene that a meta.json names, texture by texture."""
    images = {texture: len(files) for texture, files in SOG_IMAGES.items() if texture != "shN" or has(meta, "shN")}
    return [meta.text(texture, "files", index) for texture, count in images.items() for index in range(count)]


def companion_names(data: bytes) -> list[str]:
    """Return all files that a meta.json names, images or not; none if it cannot be parsed."""
    try:
        root = parse_meta(data).value
    except FormatError:
        return []
    lists = (value.get("files") for value in root.values() if isinstance(value, dict))
    return [name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)]


class SogFiles:
    """Files of a SOG scene.

    Attributes:
        meta: its meta.json.
        size: bytes of all its files, which bound the sizes that images may announce.
    """

    def __init__(self, file: BinaryIO, open_companion: OpenCompanion | None) -> None:
        self.size = size_of(file)
        zipped = file.read(2) == b"PK"
        file.seek(0)
        self._archive = ZipFolder(file) if zipped else None
        if self._archive is not None and self._archive.first != META:
            raise NotSplatsError(f"a zip archive with {self._archive.first}, not a SOG")
        self._companion = open_companion
        self.meta = parse_meta((self._archive.open(META) if self._archive else file).read(MAX_META + 1))
        self._sizes = {} if self._archive else {name: self._companion_size(name) for name in image_names(self.meta)}
        self.size += sum(self._sizes.values())

    def _open_companion(self, name: str) -> BinaryIO:
        if self._companion is None:
            raise FormatError(f"{META} names {quoted_value(name)}, but other files cannot be opened here")
        return self._companion(name)

    def _companion_size(self, name: str) -> int:
        with self._open_companion(name) as file:
            return size_of(file)

    @contextlib.contextmanager
    def _opened(self, name: str, most: int) -> Iterator[tuple[WebPHeader, IO[bytes]]]:
        """Open an image that may have at most `most` texels, and read its header."""
        with self._archive.opened(name) if self._archive else self._open_companion(name) as file:
            header = read_header(file.read, name)
            if header.width * header.height > most:
                raise FormatError(f"{quoted_value(name)} has {header.width} x {header.height} texels, far too many")
            check_promise(4 * header.width * header.height, self.size)
            yield header, file

    def sides(self, texture: str, index: int, most: int) -> tuple[int, int]:
        """Return the width and height in the header of an image; `FormatError` if it has more than `most` texels."""
        with self._opened(self.meta.text(texture, "files", index), most) as (header, _):
            return header.width, header.height

    def pixels(self, texture: str, index: int, count: int) -> Pixels:
        """Decode the first `count` pixels of an image, row by row; `FormatError` if it has fewer, or far more."""
        name = self.meta.text(texture, "files", index)
        with self._opened(name, SPARE_FACTOR * count + SPARE_TEXELS) as (header, file):
            total = header.width * header.height
            if total < count:
                raise FormatError(f"{quoted_value(name)} has {count_of(total, 'texel')} for {count_of(count, 'splat')}")
            return pixels_of(header, file.read, name)[:count]

    def lossy(self) -> list[str]:
        """Return the names of the images that are compressed with losses."""
        return [name for name in image_names(self.meta) if self._is_lossy(name)]

    def _is_lossy(self, name: str) -> bool:
        try:
            with self._archive.opened(name, whole=False) if self._archive else self._open_companion(name) as file:
                return read_header(file.read, name).lossy
        except FormatError:  # which reading the splats reports
            return False

    def bytes_of(self, texture: str, index: int) -> int:
        """Return the stored size of an image."""
        name = self.meta.text(texture, "files", index)
        return self._archive.bytes_of(name) if self._archive else self._sizes[name]


def zipped(files: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    """Return the bytes of a zip, piece by piece: the same for the same files, as its members have no dates."""
    # A buffer that is emptied member by member could not be sought, and sizes would follow the members' contents.
    buffer, done = io.BytesIO(), 0
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files:
            member = zipfile.ZipInfo(name)  # of 1980, the earliest date
            member.create_system, member.external_attr = UNIX, MODE
            archive.writestr(member, content)
            yield buffer.getvalue()[done:]
            done = buffer.tell()
    yield buffer.getvalue()[done:]
