"""Results of a traversal: the columns of its table, which has a row for each frame, its summary, and its outputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from ..system.output import check_writable
from ..tables.columns import FRAME, Column, Number, Row, TableOutput, numbers, statistic, totals

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

#: Waits of a visitor who opens a page in front of the first camera and stays there, with `--bandwidth`. They are in the
#: summary and may be asserted, but are no columns of the table.
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

#: Reasons why all cells of a column may be empty.
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

UNITS = {column.name: column.unit for column in COLUMNS}

#: The share of the cut inside the frustum; a quotient of two columns.
IN_FRUSTUM = "in_frustum_share"

#: Quantities with statistics, in the order of the summary.
QUANTITIES = (
    "selected", "budget_used", "pixel_scale_min", "projected_px_p95", "overdraw_estimate", IN_FRUSTUM,
    "chunks_new", "bytes_new", "missing", "complete_in_s", "churn", "traverse_ms",
)  # fmt: skip

STATISTICS = ("min", "p50", "p95", "max")


@dataclass(frozen=True)
class FrameStatistics:
    """Statistics of a column, or of `IN_FRUSTUM`, over the `frames` that have a value of it."""

    name: str
    unit: str
    frames: int
    min: Number
    p50: Number
    p95: Number
    max: Number


@dataclass(frozen=True)
class Moment:
    """The frame with the largest value of one of the criteria `MOMENTS`; the unit "limit" is the pixel-scale limit."""

    criterion: str
    frame: int
    time_s: float | None
    name: str | None
    value: Number
    unit: str


@dataclass(frozen=True)
class Summary:
    """Summary of a simulation.

    Attributes:
        seconds: time from the first frame to the last.
        chunks, bytes: total number and size of the fetched chunks.
        chunks_first, bytes_first: those fetched for the first frame.
        stop_reasons: shares of the frames, 0..1, the most frequent first.
        quantities: statistics; quantities without a value on any frame are omitted.
        moments: the most extreme frames; criteria that no frame meets are omitted.
        loading: times and bytes of `LOADING`, by name; None without a network.
    """

    frames: int
    seconds: float
    chunks: int
    bytes: int
    chunks_first: int
    bytes_first: int
    stop_reasons: dict[str, float]
    quantities: tuple[FrameStatistics, ...]
    moments: tuple[Moment, ...]
    loading: Row | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain lists, dicts and numbers for JSON; quantities and moments are dicts by their names."""
        plain = asdict(self)
        for group, name in (("quantities", "name"), ("moments", "criterion")):
            plain[group] = {each.pop(name): each for each in plain[group]}
        return plain


def summarize(rows: Iterable[Row], loading: Row | None = None) -> Summary:
    """Return the summary of the rows of all frames, in order; rows of single instances are ignored."""
    frames = totals(rows)
    times = numbers(frames, "time_s")
    reasons = Counter(str(row["stop_reason"]) for row in frames if row["stop_reason"] is not None)
    chunks, size = numbers(frames, "chunks_new"), numbers(frames, "bytes_new")
    most: Extremes = {}
    for row in frames:
        add_extremes(most, row, is_first=row is frames[0])
    drawn = [(row["in_frustum"], row["selected"]) for row in frames]
    shares = [seen / all_ for seen, all_ in drawn if isinstance(seen, int) and isinstance(all_, int) and all_]
    quantities = []
    for name in QUANTITIES:
        if values := shares if name == IN_FRUSTUM else numbers(frames, name):
            found = {each: _rounded(statistic(each, values)) for each in STATISTICS}
            quantities.append(FrameStatistics(name, UNITS.get(name, "share"), len(values), **found))
    return Summary(
        frames=len(frames),
        seconds=round(times[-1] - times[0], 6) if times else 0.0,
        chunks=int(sum(chunks)),
        bytes=int(sum(size)),
        chunks_first=int(sum(numbers(frames[:1], "chunks_new"))),
        bytes_first=int(sum(numbers(frames[:1], "bytes_new"))),
        stop_reasons={reason: round(count / reasons.total(), 6) for reason, count in reasons.most_common()},
        quantities=tuple(quantities),
        moments=tuple(moments_of(most)),
        loading=loading,
    )


def _rounded(value: Number) -> Number:
    """Round to nine significant digits, which hides rounding errors of floats."""
    return value if isinstance(value, int) else float(f"{value:.9g}")


#: Criteria for extreme frames: the column, None for the least pixel scale of a refined node as a multiple of the limit;
#: the value that a frame must exceed; and the unit.
MOMENTS: dict[str, tuple[str | None, Number, str]] = {
    "churn": ("churn", 0, "share"),
    "bytes": ("bytes_new", 0, "bytes"),
    "coarsest": (None, 1, "limit"),
    "missing": ("missing", 0, "splats"),
    "incomplete": ("complete_in_s", 0, "s"),
    "overdraw": ("overdraw_estimate", 0, ""),
}


#: By criterion, the largest value so far, and the first row that has it.
Extremes = dict[str, tuple[Number, Row]]


def add_extremes(most: Extremes, row: Row, *, is_first: bool) -> list[str]:
    """Add the row of the next frame, and return the criteria in which it exceeds all earlier frames.

    The bytes of the first frame do not count, since it fetches everything.
    """
    criteria = []
    for criterion, (column, above, _) in MOMENTS.items():
        if criterion == "bytes" and is_first:
            continue
        value = next(iter(numbers([row], column or "pixel_scale_min")), None)
        if column is None and value is not None:
            limit = next(iter(numbers([row], "pixel_scale_limit")), 0)
            value = value / limit if limit else None
        if value is not None and value > (most[criterion][0] if criterion in most else above):
            most[criterion] = value, row
            criteria.append(criterion)
    return criteria


def moments_of(most: Extremes) -> list[Moment]:
    """Return the frame of each criterion that any frame meets, in the order of `MOMENTS`."""
    moments = []
    for criterion, (value, row) in sorted(most.items(), key=lambda item: [*MOMENTS].index(item[0])):
        frame, time = cast("int", row["frame"]), cast("float | None", row["time_s"])
        name = cast("str | None", row["name"]) or None
        moments.append(Moment(criterion, frame, time, name, _rounded(value), MOMENTS[criterion][2]))
    return moments


@dataclass(frozen=True)
class FrameOutputs:
    """Destinations of the frames of a simulation.

    Attributes:
        indices: folder for the node indices of each cut; None for none.
        padded: pad the index files to whole rows of `ROW`.
        plot: file of the charts; None for none.
    """

    table: TableOutput
    indices: Path | None = None
    padded: bool = False
    plot: Path | None = None
    overwrite: bool = False

    def check(self) -> None:
        self.table.check()
        if self.plot is not None:
            check_writable(self.plot, overwrite=self.overwrite)
            from ..images.charts import load_matplotlib

            load_matplotlib()
        if self.indices is not None:
            check_writable(self.indices / "0.npy", overwrite=True)

    def check_frames(self, numbers: Sequence[int], instances: int) -> None:
        """Raise an `OutputError` if an index file of a frame exists and may not be replaced."""
        for file in self.index_files(numbers, instances):
            check_writable(file, overwrite=self.overwrite, tried=False)

    def index_files(self, numbers: Sequence[int], instances: int) -> Iterator[Path]:
        if self.indices is not None:
            names = [""] if instances == 1 else [f".{instance}" for instance in range(instances)]
            for number in numbers:
                yield from (self.indices / f"{number:06d}{name}.npy" for name in names)
