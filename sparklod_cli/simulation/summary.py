"""Summary of a simulation: statistics of its frames, totals, and the most extreme frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, cast

from ..tables.assertions import Number, numbers, statistic, totals
from ..tables.columns import Row
from .columns import COLUMNS

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
    """Statistics over the frames.

    Attributes:
        name: name of a column, or `IN_FRUSTUM`.
        unit: unit of the values; empty for a plain number.
        frames: number of frames with a value.
        min, p50, p95, max: statistics over these frames.
    """

    name: str
    unit: str
    frames: int
    min: Number
    p50: Number
    p95: Number
    max: Number


@dataclass(frozen=True)
class Moment:
    """The frame with the largest value of one of the criteria `MOMENTS`.

    Attributes:
        criterion: name of the criterion.
        frame: its number.
        time_s: seconds on the path.
        name: name of the frame; None if it has none.
        value: the largest value.
        unit: unit of the value; "limit" is a multiple of the pixel scale limit.
    """

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
        frames: number of frames.
        seconds: time from the first frame to the last.
        chunks, bytes: total number and size of the fetched chunks.
        chunks_first, bytes_first: those fetched for the first frame.
        stop_reasons: shares of the frames, 0..1, the most frequent first.
        quantities: statistics; quantities without a value on any frame are omitted.
        moments: the most extreme frames; criteria that no frame meets are omitted.
        loading: times and bytes of `columns.LOADING`, by name; None without a network.
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
        """As plain lists, dicts and numbers, for JSON; quantities and moments by their names."""
        plain = asdict(self)
        for group, name in (("quantities", "name"), ("moments", "criterion")):
            plain[group] = {each.pop(name): each for each in plain[group]}
        return plain


def summarize(rows: Iterable[Row], loading: Row | None = None) -> Summary:
    """Summary of the rows of all frames, in order; rows of single instances are ignored."""
    frames = totals(rows)
    times = numbers(frames, "time_s")
    reasons = Counter(str(row["stop_reason"]) for row in frames if row["stop_reason"] is not None)
    chunks, size = numbers(frames, "chunks_new"), numbers(frames, "bytes_new")
    lookout = Lookout()
    for row in frames:
        lookout.add(row)
    return Summary(
        frames=len(frames),
        seconds=round(times[-1] - times[0], 6) if times else 0.0,
        chunks=int(sum(chunks)),
        bytes=int(sum(size)),
        chunks_first=int(sum(numbers(frames[:1], "chunks_new"))),
        bytes_first=int(sum(numbers(frames[:1], "bytes_new"))),
        stop_reasons={reason: round(count / reasons.total(), 6) for reason, count in reasons.most_common()},
        quantities=tuple(quantity for name in QUANTITIES if (quantity := _quantity(name, frames)) is not None),
        moments=tuple(lookout.moments()),
        loading=loading,
    )


def _quantity(name: str, frames: Sequence[Row]) -> FrameStatistics | None:
    values = [share for row in frames if (share := _share(row)) is not None]
    if name != IN_FRUSTUM:
        values = numbers(frames, name)
    if not values:
        return None
    found = {each: _rounded(statistic(each, values)) for each in STATISTICS}
    return FrameStatistics(name, UNITS.get(name, "share"), len(values), **found)


def _share(row: Row) -> Number | None:
    seen, selected = row["in_frustum"], row["selected"]
    return seen / selected if isinstance(seen, int) and isinstance(selected, int) and selected else None


def _rounded(value: Number) -> Number:
    """Round to nine significant digits, which hides rounding errors of floats."""
    return value if isinstance(value, int) else float(f"{value:.9g}")


def coarseness(row: Row) -> Number | None:
    """Return the smallest pixel scale of a refined node, as a multiple of the limit; None if either is missing."""
    scale, limit = row["pixel_scale_min"], row["pixel_scale_limit"]
    return scale / limit if isinstance(scale, (int, float)) and isinstance(limit, (int, float)) and limit else None


def _cell(name: str) -> Callable[[Row], Number | None]:
    return lambda row: next(iter(numbers([row], name)), None)


#: Criteria for extreme frames: the value of a row, the threshold that it must exceed, and the unit.
MOMENTS: dict[str, tuple[Callable[[Row], Number | None], Number, str]] = {
    "churn": (_cell("churn"), 0, "share"),
    "bytes": (_cell("bytes_new"), 0, "bytes"),
    "coarsest": (coarseness, 1, "limit"),
    "missing": (_cell("missing"), 0, "splats"),
    "incomplete": (_cell("complete_in_s"), 0, "s"),
    "overdraw": (_cell("overdraw_estimate"), 0, ""),
}


class Lookout:
    """Finds the frame with the largest value of each criterion, the first among equals.

    The bytes fetched by the first frame do not count, since it has to fetch everything.
    """

    def __init__(self) -> None:
        self._most: dict[str, tuple[Number, Row]] = {}
        self._frames = 0

    def add(self, row: Row) -> list[str]:
        """Add the row of the next frame; returns the criteria in which it exceeds all earlier frames."""
        found = []
        for criterion, (measure, above, _) in MOMENTS.items():
            value = None if criterion == "bytes" and not self._frames else measure(row)
            if value is not None and value > (self._most[criterion][0] if criterion in self._most else above):
                self._most[criterion] = value, row
                found.append(criterion)
        self._frames += 1
        return found

    def moments(self) -> list[Moment]:
        """Return the extreme frames so far, in the order of `MOMENTS`."""
        moments = []
        for criterion, (_, _, unit) in MOMENTS.items():
            if criterion in self._most:
                value, row = self._most[criterion]
                frame, name = cast("int", row["frame"]), cast("str | None", row["name"])
                time = cast("float | None", row["time_s"])
                moments.append(Moment(criterion, frame, time, name or None, _rounded(value), unit))
        return moments
