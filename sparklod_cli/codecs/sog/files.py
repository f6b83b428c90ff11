"""The files of a SOG scene, meta.json and images, from a zip or a folder; sizes are checked before decoding."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...support.errors import ChecksumError, FormatError, NotSplatsError
from ...support.units import count_of
from ...support.untrusted import ZIP_ERRORS, parse_json, quoted, quoted_value
from ..compression import check_promise
from ..stream import size_of
from .names import META

Texels = NDArray[np.uint8]

#: Largest meta.json, bytes; codebooks take 15,000.
MAX_META = 1 << 22

#: Compression methods of a zip that SOG uses, and the flag of an encrypted member.
METHODS, ENCRYPTED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), 1

#: Flag of a WebP file's extended header.
ANIMATED = 2

#: Texels that an image may have: a multiple of the splats, and some more, since writers make images square or round
#: sides up to powers of two.
SPARE_FACTOR, SPARE_TEXELS = 4, 1 << 16


class Meta:
    """A meta.json whose values are checked when they are read; a sequence of keys leads to each."""

    def __init__(self, data: bytes) -> None:
        try:
            self.root = parse_json(data)
        except ValueError as error:
            raise FormatError(f"{META} is not JSON: {error}") from None
        if not isinstance(self.root, dict):
            raise NotSplatsError(f"its {META} is not that of a SOG")

    def has(self, key: str) -> bool:
        """Whether there is such a key at the top level, with a value other than null."""
        return self.root.get(key) is not None

    def _get(self, *way: str | int) -> Any:
        value = self.root
        try:
            for key in way:
                value = value[key]
        except (KeyError, IndexError, TypeError):
            raise FormatError(f"{META} has no {_spell(way)}") from None
        return value

    def integer(self, *way: str | int) -> int:
        """A whole number."""
        value = self._get(*way)
        if type(value) is not int:
            raise FormatError(f"{_spell(way)} of {META} is not a whole number")
        return value

    def number(self, *way: str | int) -> float:
        """A finite number."""
        return _finite(self._get(*way), way)

    def numbers(self, count: int, *way: str | int, first_may_be_null: bool = False) -> NDArray[np.float64]:
        """(count,) finite numbers.

        Args:
            count: required length of the list.
            way: keys that lead to the list.
            first_may_be_null: the first number may be null, as an old writer left it in codebooks; it is extrapolated
                by the mean step.
        """
        values = self._get(*way)
        if not isinstance(values, list) or len(values) != count:
            raise FormatError(f"{_spell(way)} of {META} is not a list of {count} numbers")
        if first_may_be_null and values[0] is None:
            rest = [_finite(value, way) for value in values[1:]]
            values = [rest[0] + (rest[0] - rest[-1]) / (count - 1), *rest]
        return np.array([_finite(value, way) for value in values])

    def is_true(self, key: str) -> bool:
        """Whether there is such a key at the top level, and it is true."""
        return self.root.get(key) is True

    def is_text(self, key: str, text: str) -> bool:
        """Whether there is such a key at the top level, and it is this text."""
        return self.root.get(key) == text

    def name(self, *way: str | int) -> str:
        """A text."""
        value = self._get(*way)
        if not isinstance(value, str):
            raise FormatError(f"{_spell(way)} of {META} is not the name of a file")
        return value


def _spell(way: tuple[str | int, ...]) -> str:
    return ".".join(map(str, way))


def _finite(value: Any, way: tuple[str | int, ...]) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e38:
        raise FormatError(f"{_spell(way)} of {META} has {str(value)[:20]!r}, which is not a finite number")
    return float(value)


def names_beside(data: bytes) -> list[str]:
    """The files that a meta.json names, as far as it can be parsed; otherwise none."""
    try:
        root = Meta(data).root
    except FormatError:
        return []
    lists = (value.get("files") for value in root.values() if isinstance(value, dict))
    return [name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)]


class Files:
    """The files of a SOG scene.

    Attributes:
        meta: its meta.json.
        size: bytes of all its files, which bound the sizes that images may announce.
    """

    def __init__(self, file: BinaryIO, beside: Callable[[str], BinaryIO] | None) -> None:
        self.size = size_of(file)
        zipped = file.read(2) == b"PK"
        file.seek(0)
        self._archive = _Archive(file, self.size) if zipped else None
        self._beside = beside
        data = self._archive.read(META) if self._archive else file.read(MAX_META + 1)
        if len(data) > MAX_META:
            raise FormatError(f"{META} has more than {MAX_META:,} bytes, too many for a SOG")
        self.meta = Meta(data)
        if not self._archive:
            self.size += sum(map(self._size_beside, self._names()))

    def _names(self) -> list[str]:
        textures = {"means": 2, "scales": 1, "quats": 1, "sh0": 1} | ({"shN": 2} if self.meta.has("shN") else {})
        return [
            self.meta.name(texture, "files", index) for texture, count in textures.items() for index in range(count)
        ]

    def _open_beside(self, name: str) -> BinaryIO:
        if self._beside is None:
            raise FormatError(f"{META} names {quoted_value(name)}, but other files cannot be opened here")
        return self._beside(name)

    def _size_beside(self, name: str) -> int:
        with self._open_beside(name) as file:
            return size_of(file)

    def _read(self, name: str) -> bytes:
        if self._archive:
            return self._archive.read(name)
        with self._open_beside(name) as file:
            return file.read()

    def image(self, texture: str, index: int, most: int) -> Texels:
        """(height, width, 4) texels of one file of a texture; `FormatError` if there are more than `most`."""
        name = self.meta.name(texture, "files", index)
        data = self._read(name)
        width, height = _webp_size(data, name)
        if width * height > most:
            raise FormatError(f"{quoted_value(name)} has {width} x {height} texels, far too many")
        check_promise(4 * width * height, self.size)
        return _decode_webp(data, name)

    def texels(self, texture: str, index: int, count: int) -> Texels:
        """(count, 4) texels of one file of a texture, row by row."""
        texels = self.image(texture, index, SPARE_FACTOR * count + SPARE_TEXELS).reshape(-1, 4)
        if len(texels) < count:
            name = self.meta.name(texture, "files", index)
            raise FormatError(
                f"{quoted_value(name)} has {count_of(len(texels), 'texel')} for {count_of(count, 'splat')}"
            )
        return texels[:count]


class _Archive:
    """A zip with a meta.json, possibly inside a folder, and files beside it."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._size = size
        try:
            self._zip = zipfile.ZipFile(file)
        except ZIP_ERRORS as error:
            raise FormatError(f"not a complete zip archive: {quoted(error)}") from None
        names = [name for name in self._zip.namelist() if name == META or name.endswith("/" + META)]
        if not names:
            raise NotSplatsError(f"a zip archive without {META} is not a SOG")
        self._folder = min(names, key=len).removesuffix(META)

    def read(self, name: str) -> bytes:
        try:
            member = self._zip.getinfo(self._folder + name)
        except KeyError:
            raise FormatError(f"{META} names {quoted_value(name)}, which is not in the archive") from None
        if member.compress_type not in METHODS or member.flag_bits & ENCRYPTED:
            raise FormatError(f"{quoted_value(name)} is encrypted, or compressed by a method that SOG does not use")
        check_promise(member.file_size, self._size)
        try:
            with self._zip.open(member) as file:
                return file.read(member.file_size)  # without a size it would unpack everything before checking the size
        except ZIP_ERRORS as error:
            kind = ChecksumError if "CRC" in str(error) else FormatError
            raise kind(f"{quoted_value(name)} cannot be unpacked: {quoted(error)}") from None


def _webp_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height from the header of a WebP file: its first chunk, of one of three kinds."""
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30 else b""
    if kind == b"VP8X":  # 24 bits each, minus one
        if data[20] & ANIMATED:
            raise FormatError(f"{quoted_value(name)} is an animation, but SOG needs a still image")
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":  # 14 bits each, minus one, after a byte of signature
        bits = int.from_bytes(data[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":  # 14 bits each, after a frame tag and a start code
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    raise FormatError(f"{quoted_value(name)} is not a WebP image")


def _decode_webp(data: bytes, name: str) -> Texels:
    from PIL.WebPImagePlugin import WebPImageFile  # every command loads this module, and few decode images

    try:
        # Not by Image.open, which warns of large images and refuses larger ones: the size has been checked above.
        with WebPImageFile(io.BytesIO(data)) as image:
            return np.asarray(image if image.mode == "RGBA" else image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FormatError(f"{quoted_value(name)} is a corrupt WebP image: {error}") from None
