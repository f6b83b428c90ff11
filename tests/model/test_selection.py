"""What is kept, what is dropped, and that it is said."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sparklod_cli.model import selection
from sparklod_cli.model.selection import Selection, describe
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import InvalidSplatsError
from tests.scenes import random_splats


def with_value(splats: Splats, name: str, row: int, value: float) -> Splats:
    column = getattr(splats, name).copy()
    column.reshape(len(splats), -1)[row, -1] = value
    return dataclasses.replace(splats, **{name: column})


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_an_error_or_dropped(name: str, value: float) -> None:
    splats = with_value(random_splats(9, sh_degree=1), name, 4, value)
    with pytest.raises(InvalidSplatsError, match=r"1 of 9 splats is not finite .* splat 4\), add --on-invalid drop"):
        Selection().apply(splats)
    kept, dropped = Selection(drop_invalid=True).apply(splats)
    assert dropped == {"non_finite": 1}
    assert np.array_equal(kept.center, np.delete(splats.center, 4, axis=0))


@pytest.mark.parametrize(("invalid", "advised"), [(1, True), (4, True), (5, False), (9, False), (10, False)])
@pytest.mark.parametrize("kind", ["center", "scale"])
def test_splats_are_left_out_by_advice_only_where_most_stay(invalid: int, advised: bool, kind: str) -> None:
    splats = random_splats(10)
    for row in range(invalid):
        splats = with_value(splats, kind, row, -1 if kind == "scale" else np.nan)
    with pytest.raises(InvalidSplatsError) as caught:
        Selection().apply(splats)
    assert ("--on-invalid drop" in str(caught.value)) is advised
    assert ("export it again" in str(caught.value)) is not advised


def test_no_advice_empties_a_scene() -> None:
    splats = with_value(random_splats(10), "opacity", 3, np.nan)
    with pytest.raises(InvalidSplatsError, match=r"1 of 10 .* and no other splat is left \(9 cropped\)$"):
        Selection(min_box=(100, 100, 100)).apply(splats)
    with pytest.raises(InvalidSplatsError, match="add --on-invalid drop to leave them out"):
        Selection(min_box=tuple(splats.center[0].tolist()), max_box=tuple(splats.center[0].tolist())).apply(splats)


def test_huge_finite_numbers_are_finite() -> None:
    splats = dataclasses.replace(random_splats(3), center=np.full((3, 3), 3e38, np.float32))
    kept, dropped = Selection().apply(splats)
    assert len(kept) == 3
    assert not dropped


def test_a_splat_is_counted_once_by_the_first_reason() -> None:
    splats = random_splats(20)
    opacity, scale = splats.opacity.copy(), splats.scale.copy()
    opacity[:3], opacity[3:5] = 0, 0.001
    scale[2:4] = 0
    scale[10, :2] = 0  # a needle is a splat
    splats = dataclasses.replace(splats, opacity=opacity, scale=scale)
    kept, dropped = Selection(min_opacity=0.01).apply(splats)
    assert dropped == {"zero_opacity": 3, "zero_scale": 1, "low_opacity": 1}
    assert len(kept) == 15
    assert describe(dropped) == "3 zero opacity, 1 zero scale, 1 below --min-opacity"


def test_cropping_keeps_what_lies_on_the_border() -> None:
    splats = random_splats(4)
    center = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [3, 0, 4]], np.float32)
    splats = dataclasses.replace(splats, center=center)

    def left(**how: object) -> list[list[float]]:
        return Selection(**how).apply(splats)[0].center.tolist()

    assert left(min_box=(1, 0, 0)) == [[1, 0, 0], [3, 0, 4]]
    assert left(max_box=(1, 2, 0)) == [[0, 0, 0], [1, 0, 0], [0, 2, 0]]
    tenth = dataclasses.replace(random_splats(1), center=np.full((1, 3), 0.1, np.float32))
    assert Selection(min_box=(0.1,) * 3, max_box=(0.1,) * 3).apply(tenth)[1] == {}
    assert left(min_box=(0, 0, 0), max_box=(0, 2, 0)) == [[0, 0, 0], [0, 2, 0]]
    assert left(within=((0, 0, 0), 5)) == center.tolist()
    assert left(within=((0, 0, 0), 1)) == [[0, 0, 0], [1, 0, 0]]
    assert Selection(within=((0, 0, 0), 1)).apply(splats)[1] == {"cropped": 2}


def test_nothing_left_is_an_error_that_says_why() -> None:
    splats = random_splats(5)
    with pytest.raises(InvalidSplatsError, match=r"no splat is left of 5 \(5 cropped\)"):
        Selection(min_box=(100, 100, 100)).apply(splats)
    with pytest.raises(InvalidSplatsError, match="it has no splats"):
        Selection().apply(random_splats(0))


def test_a_selection_of_all_copies_nothing() -> None:
    splats = random_splats(5)
    assert Selection().apply(splats)[0] is splats


@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_are_examined_as_the_whole(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = with_value(with_value(random_splats(100, seed=3), "center", 71, np.nan), "opacity", 12, 0)
    keep, tally = Selection(drop_invalid=True).examine(splats)
    monkeypatch.setattr(selection, "EXAMINED", 16)
    kept, dropped = Selection(drop_invalid=True).apply(splats, threads=threads)
    assert dropped == tally.dropped == {"non_finite": 1, "zero_opacity": 1}
    assert np.array_equal(kept.center, splats.center[keep])
    with pytest.raises(InvalidSplatsError, match="splat 71"):
        Selection().apply(splats, threads=threads)
