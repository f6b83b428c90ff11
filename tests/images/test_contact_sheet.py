"""Contact sheets: every picture is in them as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from sparklod_cli.images.contact_sheet import _fitting, cells, grid, sheet


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
