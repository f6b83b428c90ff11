"""Colours tell splats apart, and their scale says what they mean."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.figures.node_colors import color_by
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.render.color_scales import MAGMA, PLASMA, VIRIDIS, ramp
from tests.scenes import random_splats

pytestmark = pytest.mark.slow


def brightness(colors: np.ndarray) -> np.ndarray:
    linear = (colors / 255) ** 2.2
    return np.asarray(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize("stops", [VIRIDIS, PLASMA, MAGMA])
def test_ramps_get_brighter_all_the_way(stops: tuple[str, ...]) -> None:
    assert (np.diff(brightness(ramp(stops, 50))) > 0).all()
    assert ramp(stops, 1).shape == (1, 3)


def test_colors_tell_sizes_apart() -> None:
    splats = random_splats(500)
    index = np.arange(100, 300)
    coloring = color_by("size", splats, index, None)
    assert coloring.title == "feature size"
    assert coloring.rgb.shape == (200, 3)
    order = np.argsort(spark_size(splats)[index])
    assert (np.diff(brightness(coloring.rgb[order])) >= 0).all()
    places = [place for place, _ in coloring.marks]
    assert len(places) > 3
    assert 0 <= min(places) <= max(places) <= 1


def test_equal_splats_have_one_color() -> None:
    splats = random_splats(5).take(np.zeros(5, np.int64))
    for by in ("size", "opacity", "chunk"):
        coloring = color_by(by, splats, np.arange(5), None)
        assert len(np.unique(coloring.rgb, axis=0)) == 1
        assert coloring.marks


def test_every_level_has_a_colour_and_a_mark() -> None:
    splats = random_splats(1000)
    depth = np.repeat(np.arange(10, dtype=np.int32), 100)
    depth[-1] = -1
    many = color_by("level", splats, np.arange(0, 900), depth)
    assert [text for _, text in many.marks] == [str(level) for level in range(9)]
    assert len(np.unique(many.rgb, axis=0)) == 9
    one = color_by("level", splats, np.arange(300, 400), depth)
    assert [text for _, text in one.marks] == [str(level) for level in range(10)]
    assert len(np.unique(one.rgb, axis=0)) == 1


def test_few_levels_at_the_ends_do_not_take_colors_from_the_others() -> None:
    depth = np.concatenate([np.zeros(2), np.repeat([5, 6, 7], 300), np.full(3, 60)]).astype(np.int32)
    coloring = color_by("level", random_splats(len(depth)), np.arange(len(depth)), depth)
    assert [text for _, text in coloring.marks] == ["5 or less", "6", "7 or more"]


def test_opacities_above_one_are_labelled_as_lod_opacity() -> None:
    splats = random_splats(1000)
    assert color_by("opacity", splats, np.arange(1000), None).title == "opacity"
    splats.opacity[0] = 50
    coloring = color_by("opacity", splats, np.arange(1000), None)
    assert coloring.title == "opacity (D)"
    assert coloring.marks[-1] == (1.0, "1 or more")
