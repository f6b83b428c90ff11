"""Splats are projected alone, tiles list those that overlap them, and leave out no pixel at which one is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.render import rasterizer
from sparklod_cli.render.kernels.project import GROUP, HALF_HEIGHT, HALF_WIDTH, LEAST, TILE, X, Y, exponent, index_of
from sparklod_cli.render.kernels.raster import BLOCKS, LANES, measure
from sparklod_cli.render.rasterizer import project_splats, sort_into_tiles, tiles_across
from sparklod_cli.render.settings import SORTS, RasterSettings
from tests.render.test_rasterizer import camera_at, joined, one, shown
from tests.render.test_rasterizer import rows as rows_of


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_tile_lists_the_splats_whose_boxes_overlap_it_from_near_to_far(blocks: int) -> None:
    """Those that are not drawn have empty boxes, and no key."""
    camera = camera_at(size=(200, 150), focal=(100.0, 100.0))
    _, boxes, keys = project_splats(shown(500, spread=2.0, most=3.0), camera, RasterSettings())
    across, down = tiles_across(camera)
    start, splats = sort_into_tiles(boxes, keys, across, down, blocks)
    order = [index_of(key) for key in keys]
    assert 0 < len(order) < 500
    for tile in range(across * down):
        y, x = divmod(tile, across)
        left, right, top, bottom = boxes[order].T
        overlap = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        assert splats[start[tile] : start[tile + 1]].tolist() == np.array(order)[overlap].tolist()
    hidden = np.setdiff1d(np.arange(500), order)
    assert (boxes[hidden, 1] < boxes[hidden, 0]).all()


def test_a_picture_with_more_tiles_than_their_numbers_hold_is_refused() -> None:
    camera = camera_at(size=(rasterizer.MAX_SIDE + 1, 1))
    with pytest.raises(ValueError, match="524,272 along a side"):
        rasterizer.draw(shown(1), camera, RasterSettings())
    widest = camera_at((0, 0, 5), size=(rasterizer.MAX_SIDE, 1), focal=(1e5, 1e5))
    ends = joined(*(one((x, 0, 0), 0.01, 1.0, (1, 1, 1)) for x in (-13.1, 13.1)))
    image = rasterizer.draw(ends, widest, RasterSettings())
    assert image[0, :700].any() and image[0, -700:].any() and not image[0, 700:-700].any()


@pytest.mark.parametrize("scale", [(0.08, 0.08, 0.08), (0.5, 0.0005, 0.0005), (8.0, 0.01, 0.01), (6.0, 3.0, 0.001)])
def test_rows_beside_an_ellipse_are_those_without_a_pixel_of_it(scale: tuple[float, float, float]) -> None:
    """From small splats to needles that are as long as a splat may be; and half of the box's rows are left out."""
    splats = shown(120, seed=3, most=5.0)
    splats.scale[:] = np.float32(scale)
    camera = camera_at(size=(200, 150), focal=(300.0, 300.0))
    kept = boxed = 0
    screen, boxes, keys = project_splats(splats, camera, RasterSettings())
    across, down = np.meshgrid(np.arange(TILE), np.arange(TILE))
    for key in keys:
        row, box = screen[index_of(key)], boxes[index_of(key)]
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


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("scale", [0.08, 8.0])
def test_a_splat_is_projected_alike_among_any_others(scale: float, sort: str) -> None:
    """Small ones, and ones whose axes are shortened; D from 0 to 5; some beside the picture."""
    camera, look, count = camera_at(), RasterSettings(sort=sort), 2 * GROUP + 7
    scene = shown(count, scale=scale, spread=2.0, most=5.0)
    screen, boxes, keys = project_splats(scene, camera, look)
    drawn = sorted(index_of(key) for key in keys)
    found = screen[drawn].copy(), boxes.copy()
    assert 0 < len(drawn) < count
    for size in (1, GROUP - 1, GROUP, GROUP + 1):
        first = count - size
        screen, boxes, keys = project_splats(rows_of(scene, slice(first, None)), camera, look)
        kept = sorted(index_of(key) for key in keys)
        assert [first + i for i in kept] == [i for i in drawn if i >= first]
        np.testing.assert_array_equal(screen[kept], found[0][len(drawn) - len(kept) :])
        np.testing.assert_array_equal(boxes, found[1][first:])
