"""WebP images: pixels are those that were written; what libwebp refuses, and what is not a still image, is refused."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fixtures import by_hand_sog
from sparklod_cli.codecs.sog import webp
from sparklod_cli.system.errors import FormatError

Texels = NDArray[np.uint8]


def encoded(texels: Texels, quality: int = 50, method: int = 1) -> bytes:
    file = io.BytesIO()
    Image.fromarray(texels).save(file, "WEBP", lossless=True, exact=True, quality=quality, method=method)
    return file.getvalue()


def decoded(data: bytes, most: int = 1 << 30) -> Texels:
    """(height, width, 4) R G B A, where a read gives at most so many bytes."""
    file = io.BytesIO(data)
    header = webp.read_header(file.read, "x.webp")
    pixels = webp.pixels_of(header, lambda size: file.read(min(size, most)), "x.webp")
    shape = header.height, header.width, 4
    return pixels.astype("<u4").view(np.uint8).reshape(shape)[..., [2, 1, 0, 3]]


def chunk(kind: bytes, content: bytes) -> bytes:
    return kind + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)


def extended(flags: int, width: int, height: int, *chunks: bytes) -> bytes:
    """A file with an extended header."""
    sides = b"".join(struct.pack("<I", side - 1)[:3] for side in (width, height))
    body = b"WEBP" + chunk(b"VP8X", bytes([flags, 0, 0, 0]) + sides) + b"".join(chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


RNG = np.random.default_rng(7)
PICTURES = {
    "noise": RNG.integers(0, 256, (33, 29, 4), np.uint8),
    "opaque": np.tile(RNG.integers(0, 256, (8, 8, 3), np.uint8), (6, 7, 1)),
    "3 colours": RNG.integers(0, 256, (3, 4), np.uint8)[RNG.integers(0, 3, (37, 41))],
    "one pixel": np.full((1, 1, 4), 77, np.uint8),
    "a row": RNG.integers(0, 9, (1, 500, 3), np.uint8),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pixels_are_those_that_were_written(name: str) -> None:
    texels = PICTURES[name]
    opaque = np.full((*texels.shape[:2], 1), 255, np.uint8)
    expected = texels if texels.shape[2] == 4 else np.concatenate([texels, opaque], axis=2)
    for quality, method in ((0, 0), (100, 6)):
        data = encoded(texels, quality, method)
        np.testing.assert_array_equal(decoded(data), expected)
        np.testing.assert_array_equal(decoded(data, most=7), expected)


def test_an_extended_header_is_read() -> None:
    texels = PICTURES["3 colours"]
    height, width = texels.shape[:2]
    data = extended(0x10, width, height, encoded(texels)[12:])
    np.testing.assert_array_equal(decoded(data), texels)


# --- What is damaged --------------------------------------------------------------------------------------------------


def is_refused(data: bytes) -> bool:
    """Whether it is; otherwise it has as many pixels as its header says."""
    try:
        decoded(data)
    except FormatError as error:
        assert str(error).startswith("'x.webp' is ")
        return True
    return False


def test_images_that_are_cut_are_refused() -> None:
    for name in ("noise", "3 colours", "one pixel"):
        data = encoded(PICTURES[name])
        assert not is_refused(data)
        assert all(is_refused(data[:end]) for end in range(len(data)))


def broken_containers() -> Iterator[tuple[str, bytes]]:
    texels = PICTURES["3 colours"]
    height, width = texels.shape[:2]
    data = encoded(texels)
    image, size = data[12:], len(data)
    for wrong in (0, size - 40, 1 << 31):
        yield f"RIFF of {wrong} bytes", data[:4] + struct.pack("<I", wrong) + data[8:]
        yield f"chunk of {wrong} bytes", data[:16] + struct.pack("<I", wrong) + data[20:]
    yield "a larger canvas", extended(0x10, width + 4, height, image)
    yield "no image", extended(0x10, width, height)
    yield "an animation", extended(0x12, width, height, image)
    yield "another kind", data[:12] + b"VP8Z" + data[16:]
    yield "no RIFF", b"RIFX" + data[4:]


@pytest.mark.parametrize(("name", "data"), [pytest.param(*each, id=each[0]) for each in broken_containers()])
def test_containers_that_do_not_fit_together_are_refused(name: str, data: bytes) -> None:
    assert is_refused(data)


def test_an_image_of_one_colour_is_decoded() -> None:
    assert (decoded(by_hand_sog.flat_webp(2000, 1000, (9, 8, 7, 6))) == [9, 8, 7, 6]).all()
