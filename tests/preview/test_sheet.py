"""Contact sheets: every picture is in them as it is."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.preview.sheet import cells, grid, sheet


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


def test_pictures_of_a_screen_stand_as_on_one() -> None:
    assert grid(4, (1280, 720)) == (2, 2)
    assert grid(9, (1280, 720)) == (3, 3)
    assert grid(2, (720, 1280)) == (2, 1)
    assert grid(1, (5, 5)) == (1, 1)


def test_one_with_alpha_makes_the_sheet_have_it() -> None:
    plain, clear = pictures(1, 20, 20)[0], pictures(1, 20, 20, channels=4)[0]
    whole = sheet([plain, clear], ["one", "two\n\0"])
    (ax, ay), (bx, by) = cells(2, (20, 20))
    assert whole.shape[2] == 4
    assert np.array_equal(whole[ay : ay + 20, ax : ax + 20, :3], plain)
    assert (whole[ay : ay + 20, ax : ax + 20, 3] == 255).all()
    assert np.array_equal(whole[by : by + 20, bx : bx + 20], clear)


def test_a_caption_is_written() -> None:
    made = pictures(1, 300, 200)
    with_text, without = sheet(made, ["from here"]), sheet(made, [""])
    assert with_text.shape == without.shape
    assert (with_text != without).any()
