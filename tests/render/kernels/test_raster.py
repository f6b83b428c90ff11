"""Tiles leave out no pixel at which a splat is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.render.kernels.project import HALF_HEIGHT, HALF_WIDTH, LEAST, TILE, X, Y, exponent, index_of
from sparklod_cli.render.kernels.raster import BLOCKS, LANES, measure
from sparklod_cli.render.rasterizer import project_splats
from sparklod_cli.render.settings import RasterSettings
from tests.render.test_rasterizer import camera_at, shown


@pytest.mark.parametrize("scale", [(0.08, 0.08, 0.08), (0.5, 0.0005, 0.0005), (8.0, 0.01, 0.01), (6.0, 3.0, 0.001)])
def test_rows_beside_an_ellipse_are_those_without_a_pixel_of_it(scale: tuple[float, float, float]) -> None:
    """From small splats to needles that are as long as a splat may be; and half of the box's rows are left out."""
    splats = shown(120, seed=3, most=5.0)
    splats.scale[:] = np.float32(scale)
    camera = camera_at(size=(200, 150), focal=(300.0, 300.0))
    kept = boxed = 0
    seen = project_splats(splats, camera, RasterSettings())
    across, down = np.meshgrid(np.arange(TILE), np.arange(TILE))
    for key in seen.keys:
        row, box = seen.screen[index_of(key)], seen.boxes[index_of(key)]
        for left in range(0, camera.width, TILE):
            for top in range(0, camera.height, TILE):
                local, lines = row.copy(), np.empty((BLOCKS, 2), np.int32)
                size = min(TILE, camera.height - top), min(TILE, camera.width - left)
                measure(local, left, top, *size, lines)
                inside = exponent(row, left + across + 0.5 - row[X], top + down + 0.5 - row[Y]) >= row[LEAST]
                inside[size[0] :] = inside[:, size[1] :] = False
                in_box = (box[0] * TILE <= left <= box[1] * TILE) and (box[2] * TILE <= top <= box[3] * TILE)
                assert in_box or not inside.any(), (row[X], row[Y], left, top)
                rows = np.abs(top + np.arange(TILE) + 0.5 - row[Y]) <= row[HALF_HEIGHT]
                for block, (above, below) in enumerate(lines):
                    assert 0 <= above <= TILE and 0 <= below <= size[0]
                    drawn = np.flatnonzero(inside[:, LANES * block : LANES * (block + 1)].any(axis=1))
                    assert not drawn.size or (above <= drawn[0] and drawn[-1] < below), (row[X], row[Y], left, top)
                    first = left + LANES * block
                    if first - row[HALF_WIDTH] <= row[X] <= first + LANES + row[HALF_WIDTH]:
                        kept, boxed = kept + max(0, below - above), boxed + rows.sum()
    assert kept < 0.95 * boxed
