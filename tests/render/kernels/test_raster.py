"""Tiles leave out no pixel at which a splat is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.render.kernels.project import END, A, B, C, X, Y
from sparklod_cli.render.kernels.raster import LANES, TILE, box_in_tile, lines_of, tilt_of
from sparklod_cli.render.rasterizer import seen
from sparklod_cli.render.settings import RasterSettings
from tests.render.test_rasterizer import camera_at, shown


@pytest.mark.parametrize("scale", [(0.08, 0.08, 0.08), (0.5, 0.0005, 0.0005), (8.0, 0.01, 0.01), (6.0, 3.0, 0.001)])
def test_rows_beside_an_ellipse_are_those_without_a_pixel_of_it(scale: tuple[float, float, float]) -> None:
    """From small splats to needles that are as long as a splat may be; and half of the box's rows are left out."""
    splats = shown(120, seed=3, most=5.0)
    splats.scale[:] = np.float32(scale)
    camera = camera_at(size=(200, 150), focal=(300.0, 300.0))
    kept = boxed = 0
    for row in seen(splats, camera, RasterSettings()):
        tilt = tilt_of(row)
        for left in range(0, camera.width, TILE):
            for top in range(0, camera.height, TILE):
                x, y, first, last, begin, end = box_in_tile(row, left, top, TILE, TILE)
                dx, dy = np.arange(TILE, dtype=np.float32) - x, (np.arange(TILE, dtype=np.float32) - y)[:, None]
                z2 = (row[A] * dx + 2 * row[B] * dy) * dx + row[C] * dy * dy
                for block in range(begin, end):
                    inside = (z2[:, LANES * block : LANES * (block + 1)] <= row[END]).any(axis=1)
                    inside[:first] = inside[max(first, last) :] = False
                    above, below = lines_of(np.float32(x - LANES * block), y, *tilt, first, last)
                    lines = np.flatnonzero(inside)
                    assert not lines.size or (above <= lines[0] and lines[-1] < below), (row[X], row[Y], left, top)
                    kept, boxed = kept + max(0, below - above), boxed + max(0, last - first)
    assert kept < 0.95 * boxed
