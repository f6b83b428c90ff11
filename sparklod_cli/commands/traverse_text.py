"""A summary of `sparklod traverse` as a person reads it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..support.printable import printable
from .console import count_of, size_of

if TYPE_CHECKING:
    from ..simulation.summary import FrameStatistics, Moment, Summary
    from ..tables.columns import Row

#: No line is longer; names of frames are cut to fit.
WIDTH = 100

#: Names of the quantities, and how a number of each is printed.
QUANTITIES = {
    "selected": ("splats drawn", "count"),
    "budget_used": ("budget used", "share"),
    "pixel_scale_min": ("pixel scale", "plain"),
    "projected_px_p95": ("large splats, px", "fixed"),
    "overdraw_estimate": ("overdraw", "fixed"),
    "in_frustum_share": ("inside the frustum", "share"),
    "chunks_new": ("chunks fetched", "count"),
    "bytes_new": ("bytes fetched", "bytes"),
    "missing": ("missing", "count"),
    "complete_in_s": ("complete in", "seconds"),
    "churn": ("churn", "share"),
    "traverse_ms": ("traversal", "ms"),
}

#: What a frame is worth a look for, with its value.
MOMENTS = {
    "churn": ("{} of the splats pop", "share"),
    "bytes": ("{} are fetched", "bytes"),
    "coarsest": ("coarsest: {} times the pixel limit", "plain"),
    "missing": ("{} splats are drawn too coarse", "count"),
    "incomplete": ("{} until it is complete", "seconds"),
    "overdraw": ("{} splats cover a pixel", "fixed"),
}

STOPS = {
    "budget": "at the budget",
    "pixel": "at the pixel limit",
    "exhausted": "in full detail",
    "missing": "at missing chunks",
    "distance": "at the levels that distances ask for",
}


def lines(summary: Summary) -> list[str]:
    """Return the lines of a summary, none longer than `WIDTH`."""
    return [_cut(line) for line in _lines(summary)]


def _lines(summary: Summary) -> Iterator[str]:
    yield _row("path", f"{count_of(summary.frames, 'frame')}, {summary.seconds:.3f} s")
    if summary.stop_reasons:
        stops = (f"{_share(share)} {STOPS.get(reason, reason)}" for reason, share in summary.stop_reasons.items())
        yield _row("stops", ", ".join(stops))
    if summary.chunks:
        first = f"{size_of(summary.bytes_first)} of it in {count_of(summary.chunks_first, 'chunk')} for the first frame"
        yield _row("fetches", f"{size_of(summary.bytes)} in {count_of(summary.chunks, 'chunk')}, {first}")
    if summary.loading:
        yield _row("opens", _loading(summary.loading))
    if summary.quantities:
        yield _row("a frame", f"{'':<18} {'min':>12} {'median':>12} {'p95':>12} {'max':>12}")
        for quantity in summary.quantities:
            yield _row("", _quantity(quantity))
    if summary.moments:
        yield _row("look at", f"{'frame':>7} {'time':>11}")
        for moment in summary.moments:
            yield _row("", _moment(moment))


def _row(name: str, text: str) -> str:
    return f"  {name:<10} {text}".rstrip()


def _loading(figures: Row) -> str:
    """Return a phrase on the waiting times of a visitor who opens the page in front of the first camera."""
    parts = []
    for what, name in (("first picture", "first_picture"), ("90 %", "resident_90"), ("all", "resident_all")):
        seconds, size = figures[f"{name}_s"], figures.get(f"{name}_bytes")
        text = "never" if seconds is None else f"after {seconds:.2f} s"
        parts.append(f"{what} {text}" + (f" and {size_of(size)}" if isinstance(size, int) else ""))
    return ", ".join(parts)


def _quantity(quantity: FrameStatistics) -> str:
    name, style = QUANTITIES[quantity.name]
    numbers = (quantity.min, quantity.p50, quantity.p95, quantity.max)
    return f"{name:<18} " + " ".join(f"{_said(number, style):>12}" for number in numbers)


def _moment(moment: Moment) -> str:
    text, style = MOMENTS[moment.what]
    time = "" if moment.time_s is None else f"{moment.time_s:.3f} s"
    name = f"  {printable(moment.name, WIDTH)}" if moment.name else ""
    return f"{moment.frame:>7,} {time:>11}  {text.format(_said(moment.value, style))}{name}"


def _said(value: float, style: str) -> str:
    """Return a number with its unit."""
    if style == "count":
        return f"{round(value):,}"
    if style == "share":
        return _share(value)
    if style == "bytes":
        return size_of(round(value)) if value else "0"
    if style == "seconds":
        return f"{value:.2f} s"
    if style == "ms":
        return f"{value:.2f} ms"
    return f"{value:.1f}" if style == "fixed" else f"{value:.4g}"


def _share(value: float) -> str:
    return f"{100 * value:.1f} %"


def _cut(line: str) -> str:
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 1]}…"
