"""Lossless WebP: every image as libwebp has it, every transform as RFC 9649 words it, in bands, in little memory."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.WebPImagePlugin import WebPImageFile

from fixtures import by_hand_sog
from sparklod_cli.codecs.kernels import webp_pixels, webp_transforms
from sparklod_cli.codecs.kernels.webp_transforms import Transform
from sparklod_cli.codecs.sog import lossless, webp
from sparklod_cli.support.errors import FormatError
from tests.references.webp_transforms import channels, joined, uncorrelated, unpredicted

Texels = NDArray[np.uint8]
Pixels = NDArray[np.uint32]


def encoded(texels: Texels, quality: int = 50, method: int = 1) -> bytes:
    file = io.BytesIO()
    Image.fromarray(texels).save(file, "WEBP", lossless=True, exact=True, quality=quality, method=method)
    return file.getvalue()


def decoded(data: bytes, most: int = 1 << 30) -> Pixels:
    """All pixels, where a read gives at most so many bytes."""
    file = io.BytesIO(data)
    header = webp.read_header(file.read, "x.webp")
    out = np.concatenate(
        [band.copy() for band in webp.bands(header, lambda size: file.read(min(size, most)), "x.webp")]
    )
    assert len(out) == header.width * header.height
    return out


def by_libwebp(data: bytes) -> Pixels | None:
    """The same by Pillow; None if it refuses."""
    try:
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, EOFError):
        return None
    return joined(texels.reshape(-1, 4)[:, [3, 0, 1, 2]].astype(np.int64))


def pictures() -> dict[str, Texels]:
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:40, :52]
    smooth = np.stack([x * 4 + y, y * 5, 255 - x * 3], axis=-1)
    few = {f"{n} colours": rng.integers(0, 256, (n, 4), np.uint8)[rng.integers(0, n, (37, 41))] for n in (2, 3, 9, 200)}
    return few | {
        "smooth": (smooth % 256).astype(np.uint8),
        "smooth with noise": np.clip(smooth + rng.normal(0, 3, smooth.shape), 0, 255).astype(np.uint8),
        "noise": rng.integers(0, 256, (33, 29, 4), np.uint8),
        "dark noise": np.clip(rng.geometric(0.05, (80, 90, 3)), 0, 255).astype(np.uint8),
        "repeated": np.tile(rng.integers(0, 256, (8, 8, 3), np.uint8), (6, 7, 1)),
        "one pixel": np.full((1, 1, 4), 77, np.uint8),
        "a row": rng.integers(0, 9, (1, 500, 3), np.uint8),
        "a column": rng.integers(0, 9, (500, 1, 3), np.uint8),
    }


PICTURES = pictures()


@pytest.mark.parametrize("name", PICTURES)
def test_pixels_are_those_of_libwebp(name: str) -> None:
    for quality, method in ((0, 0), (50, 1), (100, 6)):
        data = encoded(PICTURES[name], quality, method)
        expected = by_libwebp(data)
        assert expected is not None
        np.testing.assert_array_equal(decoded(data), expected)
        np.testing.assert_array_equal(decoded(data, most=7), expected)


def test_the_pictures_have_every_transform(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds, make = set[int](), lossless._transform
    monkeypatch.setattr(lossless, "_transform", lambda bits, kind, *sides: kinds.add(kind) or make(bits, kind, *sides))
    for texels in PICTURES.values():
        decoded(encoded(texels, 100, 6))
    assert kinds == {0, 1, 2, 3, webp_transforms.OPAQUE}


def test_codes_longer_than_their_table_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lossless, "MOST_BITS", ((1 << 16, 2),))
    for texels in PICTURES.values():
        data = encoded(texels, 100, 6)
        np.testing.assert_array_equal(decoded(data), by_libwebp(data))


def test_an_image_larger_than_what_is_kept_of_it_is_decoded() -> None:
    """More pixels than stay in memory, more bytes than are read at a time, and copies from far above."""
    rng = np.random.default_rng(8)
    texels = np.tile(rng.integers(0, 256, (300, 1900, 3), np.uint8) & np.uint8(0x0F), (4, 1, 1))
    data = encoded(texels, 20, 0)
    assert texels[..., 0].size > 2 * lossless.REACH
    assert len(data) > 3 * lossless.PIECE
    np.testing.assert_array_equal(decoded(data), by_libwebp(data))


def test_memory_does_not_grow_with_the_image() -> None:
    small, large = (by_hand_sog.flat_webp(side, side, (9, 8, 7, 6)) for side in (2000, 4000))
    peaks = []
    for data in (small, small, large):
        file = io.BytesIO(data)
        tracemalloc.start()
        try:
            for band in webp.bands(webp.read_header(file.read, "x"), file.read, "x"):
                assert band[0] == band[-1] == 0x06090807
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[2] < 16e6  # of 64 MB that its pixels are
    assert peaks[2] < 1.2 * peaks[1]


def test_an_image_that_a_transform_needs_is_whole_however_large() -> None:
    """No cache, and five simple codes of one symbol of 8 bits: green, red, blue, alpha, distance."""
    code = "0" + "".join("101" + f"{symbol:08b}"[::-1] for symbol in (3, 2, 4, 1, 0))
    data = int(code[::-1], 2).to_bytes(-(-len(code) // 8), "little")
    coded = lossless.Coded(lossless.Bits(io.BytesIO(data).read), 2 * lossless.REACH // 1000 + 9, 1000)
    assert len(coded.all()) > 2 * lossless.REACH + lossless.LONGEST
    assert (coded.all() == 0x01020304).all()


# --- What is damaged --------------------------------------------------------------------------------------------------


def damaged() -> Iterator[bytes]:
    rng = np.random.default_rng(9)
    for texels in PICTURES.values():
        data = encoded(texels, 100, 6)
        for _ in range(40):
            changed = bytearray(data)
            for place in rng.integers(21, len(data), rng.integers(1, 4)):
                changed[place] ^= 1 << rng.integers(8)
            yield bytes(changed)


def test_damaged_images_are_refused_or_are_those_of_libwebp() -> None:
    refused, same, stricter = 0, 0, 0
    for data in damaged():
        expected = by_libwebp(data)
        try:
            found = decoded(data)
        except FormatError as error:
            assert str(error).startswith("'x.webp' is ")
            refused += 1
            stricter += expected is not None  # which lets data end some bits early
            continue
        np.testing.assert_array_equal(found, expected)
        same += 1
    assert refused > 50
    assert same > 50
    assert stricter <= 0.05 * refused


def test_images_that_are_cut_are_refused() -> None:
    for name in ("smooth with noise", "3 colours", "one pixel"):
        data = encoded(PICTURES[name])
        for end in range(len(data)):
            with pytest.raises(FormatError):
                decoded(data[:end])


@pytest.mark.parametrize(
    ("bits", "reason"),
    [
        ("1" + "01" + "1" + "01", "a transform twice"),  # subtracted green has no data of its own
        ("0" + "1" + "0011", "colours, more than"),
        ("0" + "0" + "0" + "1000" + "0" * 200, "incomplete"),
    ],
)
def test_headers_that_cannot_be_are_refused(bits: str, reason: str) -> None:
    """The bits behind those that say version 0."""
    start = f"{0x2F:08b}"[::-1] + "0" * 28 + "0" + "000"
    code = int((start + bits)[::-1], 2).to_bytes(-(-len(start + bits) // 8), "little")
    with pytest.raises(lossless.ImageError, match=reason):
        list(lossless.LosslessImage(io.BytesIO(code).read).bands())


# --- The kernels beside their twins -----------------------------------------------------------------------------------


def undone(kind: int, image: Pixels, tiles: Pixels, shift: int) -> Pixels:
    """An image, by the kernel, three rows at a time."""
    height, width = image.shape
    transform = Transform(kind, width, tiles.ravel(), tiles.shape[1], shift, np.zeros(width, np.uint32))
    rows = []
    for row in range(0, height, 3):
        part = np.concatenate([np.zeros(width, np.uint32), image[row : row + 3].ravel()])
        given = part if kind == webp_transforms.PREDICTOR else part[width:]
        webp_transforms.undo(transform, given, row, given)
        rows.append(part[width:].reshape(-1, width))
    return np.concatenate(rows)


@pytest.mark.parametrize("mode", range(16))
def test_each_prediction_is_that_of_the_rfc(mode: int) -> None:
    rng = np.random.default_rng(mode)
    image = rng.integers(0, 1 << 32, (11, 13), np.uint32)
    image[6:] &= np.uint32(0x07070707)  # small differences, so that not all is clamped
    tiles = rng.integers(0, 1 << 32, (3, 4), np.uint32) & np.uint32(0xFFFF00FF) | np.uint32(mode << 8)
    expected = joined(unpredicted(channels(image), channels(tiles), 2))
    np.testing.assert_array_equal(undone(webp_transforms.PREDICTOR, image, tiles, 2), expected)


def test_shares_of_colours_are_those_of_the_rfc() -> None:
    rng = np.random.default_rng(3)
    image, tiles = rng.integers(0, 1 << 32, (11, 13), np.uint32), rng.integers(0, 1 << 32, (3, 4), np.uint32)
    expected = joined(uncorrelated(channels(image), channels(tiles), 2))
    np.testing.assert_array_equal(undone(webp_transforms.COLOR, image, tiles, 2), expected)


def test_distances_of_neighbours_are_in_the_order_of_the_rfc() -> None:
    assert len(webp_pixels.NEAR) == 120
    assert webp_pixels.NEAR[:8].tolist() == [[0, 1], [1, 0], [1, 1], [-1, 1], [0, 2], [2, 0], [1, 2], [-1, 2]]
    assert webp_pixels.NEAR[34:40].tolist() == [[0, 5], [3, 4], [-3, 4], [4, 3], [-4, 3], [5, 0]]
    assert webp_pixels.NEAR[-3:].tolist() == [[-7, 7], [8, 6], [8, 7]]
