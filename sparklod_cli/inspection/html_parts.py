"""Pieces of the HTML of a report: numbers, panels, tables, pictures, and charts as SVG without scripts."""

from __future__ import annotations

import base64
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from ..figures.tree_plot import DescribedPicture
from ..tables.histograms import Histogram, edge_names

#: Width and height of a chart, and what the labels below and the figure above take of it, in units of its view box.
WIDTH, HEIGHT, BELOW, ABOVE = 360, 150, 20, 16

#: Number of labels below a histogram.
LABELS = 5

#: Up to this number of children, every number has its own row; beyond it, ranges double.
SINGLE_CHILDREN = 8


def text_of(value: object) -> str:
    """Escaped text for a page; characters that HTML or UTF-8 cannot hold are replaced."""
    plain = str(value).encode("utf-8", "replace").decode("utf-8")
    return escape("".join(mark if mark.isprintable() or mark in "\n\t" else "\ufffd" for mark in plain))


def chart(counts: Sequence[int], tooltips: Sequence[str], labels: Iterable[tuple[float, str]], summary: str) -> str:
    """Return a bar chart.

    Args:
        labels: positions along the axis, in bars, and their texts.
        summary: description for screen readers.
    """
    most, room = max(counts, default=0), HEIGHT - ABOVE - BELOW
    step = WIDTH / max(1, len(counts))
    gap = min(2.0, step / 5)
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{text_of(summary)}">',
        f'<text class="faint" x="0" y="{ABOVE - 5}">{most:,}</text>',
    ]
    base = HEIGHT - BELOW
    parts.append(f'<line class="line" x1="0" y1="{ABOVE}" x2="{WIDTH}" y2="{ABOVE}"/>')
    for number, (count, tooltip) in enumerate(zip(counts, tooltips, strict=True)):
        # A count above 0 has a visible bar.
        height = max(1.0, room * count / most) if count else 0.0
        x, y = number * step + gap / 2, base - height
        parts.append(f'<g class="bar"><title>{text_of(tooltip)}</title>')
        parts.append(f'<rect class="hit" x="{number * step:.2f}" y="{ABOVE}" width="{step:.2f}" height="{room}"/>')
        parts.append(f'<rect x="{x:.2f}" y="{y:.2f}" width="{step - gap:.2f}" height="{height:.2f}"/></g>')
    parts.append(f'<line class="base" x1="0" y1="{base}" x2="{WIDTH}" y2="{base}"/>')
    for place, text in labels:
        x = place * step
        anchor = "start" if x < 0.06 * WIDTH else "end" if x > 0.94 * WIDTH else "middle"
        parts.append(f'<text class="faint" x="{x:.1f}" y="{HEIGHT - 4}" text-anchor="{anchor}">{text_of(text)}</text>')
    return "".join([*parts, "</svg>"])


def histogram_chart(histogram: Histogram, name: str) -> str:
    """Return a histogram as a chart; an empty text if it has no numbers."""
    counts = [int(count) for count in histogram.counts]
    if not counts:
        return ""
    names = edge_names(histogram.edges)
    tooltips = [f"{low} to {high}: {count:,}" for low, high, count in zip(names, names[1:], counts, strict=False)]
    at = np.unique(np.linspace(0, len(counts), LABELS).round().astype(int))
    labels = [(float(place), f"{histogram.edges[place]:.3g}") for place in at]
    if len(counts) == 1:
        labels = [(0.5, names[0])]
    peak = int(np.argmax(histogram.counts))
    summary = f"Histogram of {name}: {sum(counts):,} numbers from {names[0]} to {names[-1]}, most at {tooltips[peak]}"
    return chart(counts, tooltips, labels, summary)


def children_groups(children: Mapping[str, int]) -> list[tuple[str, int]]:
    """Numbers of nodes by their number of children: first single numbers, then ranges that double."""
    if not children:
        return []
    most = max(int(number) for number in children)
    ranges = [(number, number) for number in range(1, min(SINGLE_CHILDREN, most) + 1)]
    while ranges[-1][1] < most:
        ranges.append((ranges[-1][1] + 1, 2 * ranges[-1][1]))
    ends = [high for _, high in ranges]
    counts = [0] * len(ranges)
    for number, count in children.items():
        counts[bisect_left(ends, int(number))] += count
    names = [f"{low}" if low == high else f"{low:,} to {high:,}" for low, high in ranges]
    return list(zip(names, counts, strict=True))


def bar(*shares: float) -> str:
    """Bars of shares, 0..1, side by side, for a cell of a table whose other cells have the numbers."""
    parts = "".join(
        f'<i class="of{n}" style="width:{100 * share:.2f}%"></i>' for n, share in enumerate(shares) if share
    )
    return f'<div class="track" aria-hidden="true">{parts}</div>'


#: Stands for a missing value.
NONE = "\u2013"


def number_text(value: float | None) -> str:
    """Return a number with separators; an integer exactly."""
    if value is None:
        return NONE
    return f"{value:,}" if isinstance(value, int) else f"{value:,.4g}" if abs(value) < 1e6 else f"{value:.4g}"


def size_text(size: int) -> str:
    """Return an amount of bytes."""
    for unit, power in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= power:
            return f"{size / power:.1f} {unit}"
    return f"{size} bytes"


def panel(title: str, content: str) -> str:
    """Return a box with a heading; nothing where its content is empty."""
    return f'<section class="panel"><h3>{title}</h3>\n{content}\n</section>' if content else ""


def table_of(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> str:
    """Return a table of cells of HTML; the first cell of each row is its heading."""
    columns = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = (f'<tr><th scope="row">{row[0]}</th>{"".join(_cell(cell) for cell in row[1:])}</tr>' for row in rows)
    body = "\n".join(lines)
    return (
        f'<div class="scroll" tabindex="0"><table><caption>{caption}</caption>\n<thead><tr>{columns}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _cell(content: str) -> str:
    return f'<td class="wide">{content}</td>' if content.startswith('<div class="track"') else f"<td>{content}</td>"


def figure_of(picture: DescribedPicture | None, *, small: bool = False) -> str:
    """Return a picture with its description; nothing where there is none."""
    if picture is None:
        return ""
    data, words = base64.b64encode(picture.png).decode("ascii"), picture.description
    image = f'<img alt="Drawing of {text_of(words.partition(";")[0])}" src="data:image/png;base64,{data}">'
    kind = ' class="small"' if small else ""
    return f"<figure{kind}>{image}<figcaption>{text_of(words)}</figcaption></figure>"
