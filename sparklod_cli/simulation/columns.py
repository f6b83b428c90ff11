"""The columns of the table of a traversal, a row for each frame: names, units, precision and meaning."""

from __future__ import annotations

from collections.abc import Sequence

from ..support.errors import SparklodError
from ..tables.columns import FRAME, Column
from ..tables.files import near

COLUMNS = (
    *FRAME,
    Column("instance", str, "", "", "name of an instance, or `total` for all of them together"),
    Column("position_x", float, ".6f", "world units", "where the camera is"),
    Column("position_y", float, ".6f", "world units", "where the camera is"),
    Column("position_z", float, ".6f", "world units", "where the camera is"),
    Column("forward_x", float, ".6f", "", "unit vector along the optical axis"),
    Column("forward_y", float, ".6f", "", "unit vector along the optical axis"),
    Column("forward_z", float, ".6f", "", "unit vector along the optical axis"),
    Column("fov_y_deg", float, ".4f", "degrees", "vertical field of view"),
    Column("width", int, "", "px", "of the image"),
    Column("height", int, "", "px", "of the image"),
    Column("budget", int, "", "splats", "the most that may be drawn, all instances together"),
    Column("pixel_scale_limit", float, ".6g", "", "pixel scale at or below which no node is divided: a pixel's"),
    Column("selected", int, "", "splats", "the cut: what is drawn"),
    Column("leaves", int, "", "splats", "of them, those of full detail"),
    Column("interior", int, "", "splats", "of them, those that stand for others"),
    Column("budget_used", float, ".4f", "share", "selected over budget"),
    Column(
        "stop_reason",
        str,
        "",
        "",
        "`budget`: dividing one more node would exceed it; `pixel`: what could be divided is no larger than the limit; "
        "`missing`: what should be divided has children that are not there; "
        "`exhausted`: everything is drawn in full detail",
    ),
    Column("pixel_scale_min", float, ".6g", "", "the pixel scale down to which everything has been divided"),
    Column("frontier", int, "", "splats", "of the cut, those that still wait in the queue when it stops"),
    Column("level_min", int, "", "", "fewest links from the root to a node of the cut"),
    Column("level_mean", float, ".3f", "", "mean number of links from the root"),
    Column("level_max", int, "", "", "most links from the root"),
    Column("in_frustum", int, "", "splats", "of the cut, those with their centre in the picture"),
    Column("outside", int, "", "splats", "of the cut, those in front of the camera but beside the picture"),
    Column("behind", int, "", "splats", "of the cut, those behind the camera"),
    Column("projected_px_p50", float, ".3f", "px", "median size on the screen of those in the picture"),
    Column("projected_px_p95", float, ".3f", "px", "95th percentile of the same"),
    Column(
        "overdraw_estimate",
        float,
        ".3f",
        "",
        "how many splats cover a pixel, in the mean: areas out to sqrt(8) standard deviations, over the picture's",
    ),
    Column("chunks_touched", int, "", "chunks", "chunks of 65,536 nodes that finding the cut looks into, or wants to"),
    Column("chunks_new", int, "", "chunks", "chunks that have arrived since the frame before"),
    Column("bytes_new", int, "", "bytes", "of the file that those take"),
    Column("chunks_resident", int, "", "chunks", "chunks in the cache after this frame"),
    Column(
        "missing", int, "", "splats", "nodes drawn though they should be divided, because their children are not there"
    ),
    Column(
        "complete_in_s",
        float,
        ".4f",
        "s",
        "with `--bandwidth`: how long until the whole cut is there, if the camera rests and all its chunks are known",
    ),
    Column("added", int, "", "splats", "of the cut, those that the frame before did not draw"),
    Column("removed", int, "", "splats", "those that only the frame before did draw"),
    Column(
        "churn", float, ".4f", "share", "(added + removed) over what both frames draw: 0 nothing pops, 1 everything"
    ),
    Column("traverse_ms", float, ".3f", "ms", "time to find the cut, on one thread; left out with `--no-timing`"),
)

#: Columns that differ from run to run.
TIMING = ("traverse_ms",)

#: Why all cells of a column can be empty.
EMPTY = {
    "time_s": "the path has no times",
    "complete_in_s": "it needs --bandwidth",
    "traverse_ms": "--no-timing leaves it out",
    "added": "it compares a frame with the one before, and there is only one frame",
    "removed": "it compares a frame with the one before, and there is only one frame",
    "churn": "it compares a frame with the one before, and there is only one frame",
    "projected_px_p50": "no splat is inside the frustum on any frame",
    "projected_px_p95": "no splat is inside the frustum on any frame",
}


class UnknownColumnError(SparklodError):
    """There is no column of such a name."""


def select(names: Sequence[str] = (), *, timing: bool = True) -> tuple[Column, ...]:
    """Columns by their names, in this order; all of them, in the order of `COLUMNS`, for no names.

    Args:
        names: of columns; one that comes twice is taken once.
        timing: with those that differ from run to run.

    Raises:
        UnknownColumnError: there is no such column; names those that come near.
    """
    every = {column.name: column for column in COLUMNS}
    for name in names:
        if name not in every:
            raise UnknownColumnError(f"there is no column {name!r}{near(name, every)}")
    chosen = dict.fromkeys(names) if names else every
    return tuple(every[name] for name in chosen if timing or name not in TIMING)
