"""Pixels and contact sheets."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image, ImageDraw, ImageFont

from sparklod_cli.images import pixels
from sparklod_cli.images.pixels import _fitting, cells, grid, sheet
from sparklod_cli.render.color_scales import VIRIDIS, smooth
from sparklod_cli.render.renderer import averaged, finer
from tests.render.drawables import camera

UNIT = st.floats(0, 1, width=32)
COLORS = st.tuples(UNIT, UNIT, UNIT)


@st.composite
def images(draw: st.DrawFn) -> np.ndarray:
    """Premultiplied, as backends draw them."""
    image = draw(hnp.arrays(np.float32, (3, 4, 4), elements=UNIT))
    image[..., :3] *= image[..., 3:]
    return image


@given(images(), COLORS)
def test_a_background_shows_through_transparency(image: np.ndarray, color: tuple[float, float, float]) -> None:
    result = pixels.over(image, color)
    alpha = image[..., 3:].astype(np.float64)
    assert np.allclose(result[..., :3], image[..., :3] + (1 - alpha) * color, atol=1e-6)
    assert (result[..., 3] == 1).all()
    assert pixels.eight_bits(result).shape == (3, 4, 3)
    assert pixels.over(image, None) is image


@given(images(), COLORS)
def test_straight_alpha_over_a_background_is_the_same_picture(image: np.ndarray, color: tuple[float, ...]) -> None:
    opaque = pixels.eight_bits(pixels.over(image, color))
    codes = pixels.eight_bits(image).astype(np.float64)
    if codes.shape[2] == 3:
        codes = np.dstack([codes, np.full(codes.shape[:2], 255.0)])
    alpha = codes[..., 3:] / 255
    again = codes[..., :3] * alpha + 255 * (1 - alpha) * np.array(color)
    # Half a step of colour, of alpha and of the result.
    assert np.abs(again - opaque).max() <= 1.5 + 1e-3


def test_codes_are_rounded_and_clipped() -> None:
    values = np.array([-1, 0, 0.4 / 255, 0.6 / 255, 254.4 / 255, 254.6 / 255, 1, 7], np.float32)
    image = np.dstack([values[None]] * 3 + [np.ones((1, 8), np.float32)])
    assert pixels.eight_bits(image)[0, :, 0].tolist() == [0, 0, 0, 1, 254, 255, 255, 255]
    clear = pixels.eight_bits(np.zeros((2, 2, 4), np.float32))
    assert clear.shape == (2, 2, 4)
    assert not clear.any()


@given(st.sampled_from([1, 2, 3, 4]), st.lists(UNIT, min_size=4, max_size=4))
def test_supersampling_a_constant_changes_nothing(times: int, color: list[float]) -> None:
    fine = np.broadcast_to(np.array(color, np.float32), (5 * times, 7 * times, 4))
    assert np.array_equal(averaged(fine, times), np.broadcast_to(np.array(color, np.float32), (5, 7, 4)))


@pytest.mark.parametrize("times", [1, 2, 3, 4])
def test_supersampling_takes_the_mean_of_squares(times: int) -> None:
    fine = np.random.default_rng(0).random((3 * times, 2 * times, 4)).astype(np.float32)
    coarse = averaged(fine, times)
    for row in range(3):
        for column in range(2):
            square = fine[row * times : (row + 1) * times, column * times : (column + 1) * times]
            assert np.allclose(coarse[row, column], square.mean(axis=(0, 1)), atol=1e-6)


def test_a_finer_camera_sees_the_same() -> None:
    coarse = camera()
    fine = finer(coarse, 3)
    assert (fine.width, fine.height) == (3 * coarse.width, 3 * coarse.height)
    assert fine.fov_x == pytest.approx(coarse.fov_x)
    assert fine.fov_y == pytest.approx(coarse.fov_y)
    assert finer(coarse, 1) is coarse


@given(images(), images(), st.floats(0.5, 100))
def test_a_difference_is_absolute_and_clipped(a: np.ndarray, b: np.ndarray, gain: float) -> None:
    a, b = (pixels.over(image, (0, 0, 0)) for image in (a, b))
    apart = pixels.difference(a, b, gain)
    assert np.array_equal(apart, pixels.difference(b, a, gain))
    assert np.allclose(apart[..., :3], np.minimum(gain * np.abs(a[..., :3] - b[..., :3]), 1), atol=1e-4)
    assert not pixels.difference(a, a, gain)[..., :3].any()


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("form", ["png", "webp"])
def test_files_hold_every_pixel(form: str, channels: int) -> None:
    codes = np.random.default_rng(1).integers(0, 256, (20, 30, channels)).astype(np.uint8)
    with Image.open(io.BytesIO(pixels.encode(codes, form))) as picture:
        assert picture.format == form.upper()
        assert np.array_equal(np.asarray(picture), codes)


def test_a_picture_of_floats_is_kept_to_the_bit() -> None:
    image = np.random.default_rng(2).random((4, 5, 4)).astype(np.float32)
    again = np.load(io.BytesIO(pixels.encode_floats(image)))
    assert again.dtype == np.float32
    assert np.array_equal(again, image)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_color_scale_is_added_at_the_right(channels: int) -> None:
    bar = smooth("numbers", VIRIDIS, [(0.0, "0"), (1.0, "12 or more")], 0, 12)
    codes = np.full((360, 640, channels), 255, np.uint8)
    result = pixels.with_scale(codes, bar)
    assert result.shape == (360, 640 + pixels.scale_width(640, 360), channels)
    assert np.array_equal(result[:, :640], codes), "it hides nothing"
    assert (result[:, 640:, :3] != 255).any(axis=2).all()
    assert (result[:, 640:, 3:] == 255).all()
    flat = result[..., :3].reshape(-1, 3).astype(int)
    for color in (bar.ramp[0], bar.ramp[-1]):
        assert np.abs(flat - color).max(axis=1).min() <= 3
    small = codes[:100, :100]
    assert pixels.with_scale(small, bar) is small
    assert pixels.scale_width(100, 100) == 0


@pytest.mark.parametrize("size", [1e-4, 3e-3, 0.02, 0.3, 1.0])
def test_a_gain_shows_differences_and_cuts_few(size: float) -> None:
    random = np.random.default_rng(3)
    a = np.full((60, 80, 4), 0.5, np.float32)
    b = a.copy()
    b[20:40, :, :3] += size * random.uniform(-0.5, 0.5, (20, 80, 3)).astype(np.float32)
    gain = pixels.gain_for([pixels.apart(a, b), pixels.apart(a, a)])
    shown = pixels.difference(a, b, gain)[..., :3]
    assert gain in pixels.GAINS
    assert (shown[20:40] < 1).all(axis=2).mean() >= 0.98
    assert shown.max() > 0.39 or gain == pixels.GAINS[-1]
    assert not shown[:20].any()


def test_equal_images_need_no_gain() -> None:
    same = np.ones((8, 8, 4), np.float32)
    assert pixels.gain_for([pixels.apart(same, same)]) == 1


@pytest.mark.parametrize("gain", [0.5, 1.0, 20.0])
def test_the_bar_of_a_difference_has_its_ends(gain: float) -> None:
    bar = pixels.difference_bar(gain)
    assert [place for place, _ in bar.marks] == [0, 0.5, 1]
    assert float(bar.marks[-1][1].removesuffix(" or more")) == pytest.approx(1 / gain)
    assert bar.ramp[0].tolist() == [0, 0, 0]
    assert bar.ramp[-1].tolist() == [255, 255, 255]


def pictures(count: int, width: int, height: int, channels: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(count)
    return [rng.integers(0, 256, (height, width, channels)).astype(np.uint8) for _ in range(count)]


@pytest.mark.parametrize("size", [(64, 36), (30, 90), (1, 1)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 12])
def test_cells_are_the_pictures(count: int, size: tuple[int, int]) -> None:
    width, height = size
    made = pictures(count, width, height)
    whole = sheet(made, [f"a caption that is rather long, of number {n}" for n in range(count)])
    places = cells(count, size)
    assert len(set(places)) == count
    for (x, y), picture in zip(places, made, strict=True):
        assert np.array_equal(whole[y : y + height, x : x + width], picture)
    columns, rows = grid(count, size)
    assert (columns - 1) * rows < count <= columns * rows or columns * (rows - 1) < count <= columns * rows


def test_pictures_are_laid_out_for_a_screen() -> None:
    assert grid(4, (1280, 720)) == (2, 2)
    assert grid(9, (1280, 720)) == (3, 3)
    assert grid(2, (720, 1280)) == (2, 1)
    assert grid(1, (5, 5)) == (1, 1)


def test_one_picture_with_alpha_gives_the_sheet_alpha() -> None:
    plain, clear = pictures(1, 20, 20)[0], pictures(1, 20, 20, channels=4)[0]
    whole = sheet([plain, clear], ["one", "two\n\0"])
    (ax, ay), (bx, by) = cells(2, (20, 20))
    assert whole.shape[2] == 4
    assert np.array_equal(whole[ay : ay + 20, ax : ax + 20, :3], plain)
    assert (whole[ay : ay + 20, ax : ax + 20, 3] == 255).all()
    assert np.array_equal(whole[by : by + 20, bx : bx + 20], clear)


def test_a_caption_of_any_length_takes_few_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = []
    measure = ImageDraw.ImageDraw.textlength

    def counted(self: Any, text: str, *rest: Any, **named: Any) -> float:
        lengths.append(len(text))
        return measure(self, text, *rest, **named)

    monkeypatch.setattr(ImageDraw.ImageDraw, "textlength", counted)
    made = pictures(2, 300, 200)
    assert sheet(made, ["name " * 200_000, "\x07" * 8_000]).shape
    assert len(lengths) < 40
    assert max(lengths) <= 302


@pytest.mark.parametrize("text", ["W" * 100, "i" * 1000, "a b " * 99, "fits"])
def test_a_caption_is_as_long_as_fits(text: str) -> None:
    font, draw = ImageFont.load_default(size=14), ImageDraw.Draw(Image.new("RGB", (8, 8)))
    for width in (1, 20, 150, 400):
        made = _fitting(text, width, draw, font)
        assert draw.textlength(made, font=font) <= width
        whole = made == text
        assert whole or made == "" or made.endswith("…")
        if not whole:
            assert draw.textlength(f"{text[: len(made) + 1].rstrip()}…", font=font) > width, "one more does not fit"


def test_a_caption_is_written() -> None:
    made = pictures(1, 300, 200)
    with_text, without = sheet(made, ["from here"]), sheet(made, [""])
    assert with_text.shape == without.shape
    assert (with_text != without).any()
