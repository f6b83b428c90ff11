"""Number codings of SOG, the kernels that fill columns from pixels, and the WebP images that hold them."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from PIL import Image

from sparklod_cli.codecs import sog_images
from sparklod_cli.codecs import sog_images as codings
from sparklod_cli.codecs.kernels import texels
from sparklod_cli.codecs.sog_images import CODES, codebook, even_codebook, nearest
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import rotation_degrees, stated_degrees
from tests.references.sh_palettes import decode_quat


def quats() -> np.ndarray:
    rng = np.random.default_rng(3)
    some = rng.normal(size=(20_000, 4)).astype(np.float32)
    axes = np.concatenate([np.eye(4), -np.eye(4)]).astype(np.float32)
    halves = np.array([[a, b, c, d] for a in (1, -1) for b in (1, -1) for c in (1, -1) for d in (1, -1)], np.float32)
    return np.ascontiguousarray(normalized_quat(np.concatenate([some, axes, halves])))


def test_rotations_come_back_within_the_stated_error() -> None:
    given = quats()
    back = decode_quat(codings.encode_quat(given))
    assert rotation_degrees(back, given).max() <= stated_degrees(codings.quat_components)


NUMBERS = st.floats(-(2.0**50), 2.0**50, width=32)


def error(values: np.ndarray, book: np.ndarray) -> float:
    return float(((values.astype(np.float64) - book[nearest(values, book)]) ** 2).mean())


@given(arrays(np.float32, st.integers(1, 300), elements=NUMBERS))
def test_few_numbers_are_exact_and_any_book_is_ascending_and_keeps_the_range(values: np.ndarray) -> None:
    book = codebook(values)
    assert (book.dtype, book.shape) == (np.float32, (CODES,))
    assert (np.diff(book.astype(np.float64)) >= 0).all()
    assert (book[0], book[-1]) == (values.min(), values.max())
    if len(np.unique(values)) <= CODES:
        np.testing.assert_array_equal(book[nearest(values, book)], values)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 9.0]))
def test_no_other_code_is_nearer(seed: int, spread: float) -> None:
    values = np.random.default_rng(seed).lognormal(0, spread, 600).astype(np.float32)
    book = codebook(values).astype(np.float64)
    off = np.abs(values - book[nearest(values, book.astype(np.float32))])
    np.testing.assert_array_equal(off, np.abs(values[:, None] - book).min(axis=1))


@given(st.integers(0, 2**32 - 1), st.floats(1, 150), st.floats(0, 100))
def test_no_number_is_far_from_an_even_book(seed: int, extent: float, gap: float) -> None:
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.uniform(0, extent, 600), [-gap - 1]]).astype(np.float32)
    book = even_codebook(values)
    assert book[0] == values.min()
    assert (np.diff(book) >= 0).all()
    assert np.abs(values - book[nearest(values, book)]).max() <= np.ptp(values[:-1]) / 254 / 2 * 1.001 + 1e-5


DISTRIBUTIONS = {
    "even": lambda rng: rng.uniform(-3, 5, 40_000),
    "normal": lambda rng: rng.normal(-5, 1, 40_000),
    "two heaps": lambda rng: np.concatenate([rng.normal(-9, 0.1, 20_000), rng.normal(3, 0.5, 20_000)]),
    "heavy tails": lambda rng: rng.standard_t(2, 40_000),
    "few values often, others rarely": lambda rng: np.where(
        rng.random(40_000) < 0.99, np.rint(rng.normal(0, 20, 40_000)), rng.normal(0, 20, 40_000)
    ),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_a_book_is_better_than_equal_steps_and_not_far_from_the_best(name: str) -> None:
    values = DISTRIBUTIONS[name](np.random.default_rng(1)).astype(np.float32)
    found = error(values, codebook(values))
    assert found < 1.001 * error(values, np.linspace(values.min(), values.max(), CODES, dtype=np.float32))
    if name in ("even", "normal"):
        # Panter and Dite's least error of N codes: (integral of density ** (1 / 3)) ** 3 / (12 * N ** 2).
        least = 8**2 / 12 / CODES**2 if name == "even" else 3**0.5 * np.pi / 2 / CODES**2
        assert found < 1.6 * least


# --- Kernels that fill columns from pixels, against numpy -------------------------------------------------------------

RNG = np.random.default_rng(2)
BYTES = RNG.integers(0, 256, (5000, 4), np.uint8)  # red, green, blue, alpha
PIXELS = (BYTES.astype(np.uint32) << np.array([16, 8, 0, 24], np.uint32)).sum(axis=1).astype(np.uint32)


def test_two_bytes_make_the_words_of_coordinates() -> None:
    tables = RNG.normal(size=(3, 1 << 16)).astype(np.float32)
    center = np.full((len(PIXELS), 3), np.nan, np.float32)
    texels.place_bytes(PIXELS, center.view(np.uint8), 0)
    texels.place_bytes(PIXELS[::-1].copy(), center.view(np.uint8), 1)
    texels.look_up_words(center.view(np.uint32), tables, center)
    words = BYTES[:, :3] + 256 * BYTES[::-1, :3].astype(np.int64)
    np.testing.assert_array_equal(center, np.stack([tables[axis][words[:, axis]] for axis in range(3)], axis=1))


def test_channels_are_looked_up_each_in_its_table() -> None:
    tables = RNG.normal(size=(4, 256)).astype(np.float32)
    out = np.empty((len(PIXELS), 4), np.float32)
    texels.look_up(PIXELS, np.array([16, 8, 0, 24], np.uint32), tables, out)
    np.testing.assert_array_equal(out, np.stack([tables[k][BYTES[:, k]] for k in range(4)], axis=1))


def test_rotations_are_those_of_numpy_to_the_last_bit() -> None:
    codes = BYTES.copy()
    codes[:, 3] = RNG.integers(250, 256, len(codes))
    codes[:100, :3] = RNG.choice([0, 255], (100, 3))  # longer than 1
    pixels = (codes.astype(np.uint32) << np.array([16, 8, 0, 24], np.uint32)).sum(axis=1).astype(np.uint32)
    out = np.empty((len(codes), 4), np.float32)
    texels.fill_quats(pixels, codings.quat_components(), out)
    np.testing.assert_array_equal(out.view(np.uint32), decode_quat(codes).view(np.uint32))


def test_rows_are_gathered_unless_a_label_is_beyond_them() -> None:
    labels = (BYTES[:, 0] + 256 * BYTES[:, 1].astype(np.int64)).astype(np.int64)
    rows = RNG.normal(size=(int(labels.max()) + 1, 9)).astype(np.float32)
    out = np.zeros((len(PIXELS), 9), np.float32)
    assert texels.gather_rows(PIXELS, rows, out) == labels.max()
    np.testing.assert_array_equal(out, rows[labels])
    out[:] = 5
    assert texels.gather_rows(PIXELS, rows[:-1], out) == labels.max()
    assert (out == 5).all()


# --- WebP -------------------------------------------------------------------------------------------------------------

Texels = NDArray[np.uint8]


def encoded(texels: Texels, quality: int = 50, method: int = 1) -> bytes:
    file = io.BytesIO()
    Image.fromarray(texels).save(file, "WEBP", lossless=True, exact=True, quality=quality, method=method)
    return file.getvalue()


def decoded(data: bytes, most: int = 1 << 30) -> Texels:
    """(height, width, 4) R G B A, where a read gives at most so many bytes."""
    file = io.BytesIO(data)
    header = sog_images.read_header(file.read, "x.webp")
    pixels = sog_images.pixels_of(header, lambda size: file.read(min(size, most)), "x.webp")
    shape = header.height, header.width, 4
    return pixels.astype("<u4").view(np.uint8).reshape(shape)[..., [2, 1, 0, 3]]


def chunk(kind: bytes, content: bytes) -> bytes:
    return kind + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)


def extended(flags: int, width: int, height: int, *chunks: bytes) -> bytes:
    """A file with an extended header."""
    sides = b"".join(struct.pack("<I", side - 1)[:3] for side in (width, height))
    body = b"WEBP" + chunk(b"VP8X", bytes([flags, 0, 0, 0]) + sides) + b"".join(chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


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
