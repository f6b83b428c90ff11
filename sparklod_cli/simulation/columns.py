"""The columns of the table of a traversal, which has a row for each frame: names, units, precision and meaning."""

from __future__ import annotations

from ..tables.columns import FRAME, Column

COLUMNS = (
    *FRAME,
    Column("instance", str, "", "", "name of the instance, or `total` for all together"),
    *(Column(f"position_{axis}", float, ".6f", "world units", "position of the camera") for axis in "xyz"),
    *(Column(f"forward_{axis}", float, ".6f", "", "unit vector along the optical axis") for axis in "xyz"),
    Column("fov_y_deg", float, ".4f", "degrees", "vertical field of view"),
    Column("width", int, "", "px", "width of the image"),
    Column("height", int, "", "px", "height of the image"),
    Column("budget", int, "", "splats", "largest number of splats that may be drawn, all instances together"),
    Column(
        "pixel_scale_limit",
        float,
        ".6g",
        "",
        "nodes at or below this pixel scale are not refined; by default the angular size of a pixel",
    ),
    Column("selected", int, "", "splats", "splats drawn: the nodes of the cut"),
    Column("leaves", int, "", "splats", "leaves among them: splats of full detail"),
    Column("interior", int, "", "splats", "merged splats among them"),
    Column("budget_used", float, ".4f", "share", "selected over budget"),
    Column(
        "stop_reason",
        str,
        "",
        "",
        "why the cut is not finer: `budget`: refining one more node would exceed it; `pixel`: no node above the "
        "pixel-scale limit is left to refine; `missing`: the children of the nodes to be refined are not resident; "
        "`exhausted`: only leaves are left; of Streamed SOG"
        " and 3D Tiles `distance`: no region or tile is near enough to be finer",
    ),
    Column("pixel_scale_min", float, ".6g", "", "pixel scale down to which all nodes have been refined"),
    Column("frontier", int, "", "splats", "of the cut, nodes still waiting to be refined when the search stops"),
    Column(
        "level_min",
        int,
        "",
        "",
        "smallest depth of a node of the cut, edges from the root; of Streamed SOG the finest detail level",
    ),
    Column("level_mean", float, ".3f", "", "mean depth of the nodes of the cut, or detail level of its splats"),
    Column("level_max", int, "", "", "largest depth of a node of the cut, or detail level"),
    Column("in_frustum", int, "", "splats", "of the cut, splats inside the frustum: their centre is in the image"),
    Column("outside", int, "", "splats", "of the cut, splats in front of the camera but outside the frustum"),
    Column("behind", int, "", "splats", "of the cut, splats behind the camera"),
    Column("projected_px_p50", float, ".3f", "px", "median projected size of the splats inside the frustum"),
    Column("projected_px_p95", float, ".3f", "px", "95th percentile of the projected sizes"),
    Column(
        "overdraw_estimate",
        float,
        ".3f",
        "",
        "mean number of splats on a pixel: their areas out to sqrt(8) standard deviations, over that of the image",
    ),
    Column(
        "chunks_touched",
        int,
        "",
        "chunks",
        "chunks of 65,536 nodes that the search for the cut reads, or would read if they were resident; of Streamed SOG"
        " and 3D Tiles files that are drawn from or asked for",
    ),
    Column("chunks_new", int, "", "chunks", "chunks that arrived since the previous frame"),
    Column(
        "bytes_new",
        int,
        "",
        "bytes",
        "bytes that arrived since the previous frame: chunks and header of RAD, chunk files and manifest of Streamed "
        "SOG; of SPZ, which has no chunks, as if the file were cut evenly",
    ),
    Column("chunks_resident", int, "", "chunks", "chunks in the cache after this frame"),
    Column(
        "missing",
        int,
        "",
        "splats",
        "nodes drawn although they should be refined, because their children are not resident; of Streamed SOG splats "
        "that should be drawn, but whose chunk files are not resident",
    ),
    Column(
        "complete_in_s",
        float,
        ".4f",
        "s",
        "with `--bandwidth`: time until the whole cut is resident, if the camera stays and the chunks are known",
    ),
    Column("added", int, "", "splats", "nodes of the cut that the previous frame did not draw"),
    Column("removed", int, "", "splats", "nodes that only the previous frame drew"),
    Column(
        "churn",
        float,
        ".4f",
        "share",
        "(added + removed) over the splats of both frames: 0 if nothing changes, 1 if everything does",
    ),
    Column("traverse_ms", float, ".3f", "ms", "time to find the cut, on one thread; left out with `--no-timing`"),
)

#: Figures of a visitor who opens a page in front of the first camera and waits there, with `--bandwidth`. No table has
#: them, but the summary, and assertions can be about them.
LOADING = (
    Column("first_picture_s", float, ".4f", "s", "time until anything is drawn"),
    Column("resident_90_s", float, ".4f", "s", "time until 90 % of the splats of the cut are resident"),
    Column("resident_90_bytes", int, "", "bytes", "bytes that have arrived by then"),
    Column("resident_all_s", float, ".4f", "s", "time until the whole cut is resident"),
    Column("resident_all_bytes", int, "", "bytes", "bytes that have arrived by then"),
)

#: Columns that Streamed SOG and 3D Tiles have no values for.
OF_TREES = ("pixel_scale_limit", "pixel_scale_min", "frontier")

#: Columns of viewers that have a budget, which CesiumJS has not.
OF_BUDGETS = ("budget", "budget_used")

#: Columns that differ from run to run.
TIMING = ("traverse_ms",)

#: Why all cells of a column can be empty.
EMPTY = {
    "time_s": "the path has no times",
    "complete_in_s": "it needs --bandwidth",
    "traverse_ms": "--no-timing leaves it out",
    **dict.fromkeys(
        ("added", "removed", "churn"), "it compares a frame with the one before, and there is only one frame"
    ),
    **dict.fromkeys(("pixel_scale_limit", "frontier"), "only trees have it, not Streamed SOG or 3D Tiles"),
    "pixel_scale_min": "no node was refined, or it is Streamed SOG or 3D Tiles",
    **dict.fromkeys(OF_BUDGETS, "CesiumJS, which draws 3D Tiles, has no budget"),
    **dict.fromkeys(("projected_px_p50", "projected_px_p95"), "no splat is inside the frustum on any frame"),
    **dict.fromkeys((column.name for column in LOADING), "it needs --bandwidth, and a --chunk-cache that suffices"),
}
