"""The columns of a simulation's table: names, units, precision and meaning, each told once."""

from __future__ import annotations

from dataclasses import dataclass

#: What a cell holds; None where there is nothing to say, such as the churn of the first frame.
Cell = int | float | str | None


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: as in the header.
        kind: the type of its cells, where they are not empty: int, float or str.
        digits: format of a float (".6f" is fixed, ".6g" significant digits); empty otherwise.
        unit: for people; empty for a plain number, count or text.
        meaning: one phrase.
    """

    name: str
    kind: type
    digits: str
    unit: str
    meaning: str

    def rounded(self, value: Cell) -> Cell:
        """A value as precise as this column is: rows hold these, so every format tells the same numbers."""
        if not self.digits or value is None:
            return value
        return float(format(value, self.digits)) + 0.0  # which makes -0 a 0

    def text(self, value: Cell) -> str:
        """A cell of a CSV file."""
        if value is None:
            return ""
        return format(value, self.digits) if self.digits else str(value)


COLUMNS = (
    Column("frame", int, "", "", "number of the frame on the path, from 0; `--every` leaves gaps"),
    Column("time_s", float, ".6f", "s", "time on the path"),
    Column("name", str, "", "", "of the frame, where the path's file has names"),
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

#: The columns of one row, by name.
Row = dict[str, Cell]
