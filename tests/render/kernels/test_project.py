"""Splats are projected in groups; no splat depends on the others of its group."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.render.kernels.project import GROUP, index_of
from sparklod_cli.render.rasterizer import project_splats
from sparklod_cli.render.settings import SORTS, RasterSettings
from tests.render.test_rasterizer import camera_at, rows, shown


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("scale", [0.08, 8.0])
def test_a_splat_is_projected_alike_among_any_others(scale: float, sort: str) -> None:
    """Small ones, and ones whose axes are shortened; D from 0 to 5; some beside the picture."""
    camera, look, count = camera_at(), RasterSettings(sort=sort), 2 * GROUP + 7
    scene = shown(count, scale=scale, spread=2.0, most=5.0)
    whole = project_splats(scene, camera, look)
    drawn = sorted(index_of(key) for key in whole.keys)
    found = whole.screen[drawn].copy(), whole.boxes.copy()
    assert 0 < len(drawn) < count
    for size in (1, GROUP - 1, GROUP, GROUP + 1):
        first = count - size
        part = project_splats(rows(scene, slice(first, None)), camera, look)
        kept = sorted(index_of(key) for key in part.keys)
        assert [first + i for i in kept] == [i for i in drawn if i >= first]
        np.testing.assert_array_equal(part.screen[kept], found[0][len(drawn) - len(kept) :])
        np.testing.assert_array_equal(part.boxes, found[1][first:])
