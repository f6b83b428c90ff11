"""Tiles list the splats that overlap them, from near to far."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.render import rasterizer
from sparklod_cli.render.kernels.project import index_of
from sparklod_cli.render.kernels.tiles import sort_into_tiles
from sparklod_cli.render.rasterizer import project_splats, tiles_across
from sparklod_cli.render.settings import RasterSettings
from tests.render.test_rasterizer import camera_at, joined, one, shown


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_tile_lists_the_splats_whose_boxes_overlap_it_from_near_to_far(blocks: int) -> None:
    """Those that are not drawn have empty boxes, and no key."""
    camera = camera_at(size=(200, 150), focal=(100.0, 100.0))
    seen = project_splats(shown(500, spread=2.0, most=3.0), camera, RasterSettings())
    across, down = tiles_across(camera)
    start, splats = sort_into_tiles(seen.keys, seen.boxes, across, down, blocks)
    order = [index_of(key) for key in seen.keys]
    assert 0 < len(order) < 500
    for tile in range(across * down):
        y, x = divmod(tile, across)
        left, right, top, bottom = seen.boxes[order].T
        overlap = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        assert splats[start[tile] : start[tile + 1]].tolist() == np.array(order)[overlap].tolist()
    hidden = np.setdiff1d(np.arange(500), order)
    assert (seen.boxes[hidden, 1] < seen.boxes[hidden, 0]).all()


def test_a_picture_with_more_tiles_than_their_numbers_hold_is_refused() -> None:
    camera = camera_at(size=(rasterizer.MAX_SIDE + 1, 1))
    with pytest.raises(ValueError, match="524,272 along a side"):
        rasterizer.draw(shown(1), camera, RasterSettings())
    widest = camera_at((0, 0, 5), size=(rasterizer.MAX_SIDE, 1), focal=(1e5, 1e5))
    ends = joined(*(one((x, 0, 0), 0.01, 1.0, (1, 1, 1)) for x in (-13.1, 13.1)))
    image = rasterizer.draw(ends, widest, RasterSettings())
    assert image[0, :700].any() and image[0, -700:].any() and not image[0, 700:-700].any()
