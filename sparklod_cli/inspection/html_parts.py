"""Pieces of the HTML of a report: numbers, panels, tables and pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

from ..figures.svg import text_of
from ..figures.tree_plot import Picture

#: Stands for a missing value.
NONE = "\u2013"


def number_text(value: float | None) -> str:
    """A number with separators; an integer exactly."""
    if value is None:
        return NONE
    return f"{value:,}" if isinstance(value, int) else f"{value:,.4g}" if abs(value) < 1e6 else f"{value:.4g}"


def size_text(size: int) -> str:
    """An amount of bytes."""
    for unit, power in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= power:
            return f"{size / power:.1f} {unit}"
    return f"{size} bytes"


def panel(title: str, content: str) -> str:
    """A box with a heading; nothing where its content is empty."""
    return f'<section class="panel"><h3>{title}</h3>\n{content}\n</section>' if content else ""


def table_of(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> str:
    """A table of cells of HTML; the first cell of each row is its heading."""
    columns = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = (f'<tr><th scope="row">{row[0]}</th>{"".join(_cell(cell) for cell in row[1:])}</tr>' for row in rows)
    body = "\n".join(lines)
    return (
        f'<div class="scroll" tabindex="0"><table><caption>{caption}</caption>\n<thead><tr>{columns}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _cell(content: str) -> str:
    return f'<td class="wide">{content}</td>' if content.startswith('<div class="track"') else f"<td>{content}</td>"


def figure_of(picture: Picture | None, *, small: bool = False) -> str:
    """A picture with its description; nothing where there is none."""
    if picture is None:
        return ""
    data, words = base64.b64encode(picture.png).decode("ascii"), picture.description
    image = f'<img alt="Drawing of {text_of(words.partition(";")[0])}" src="data:image/png;base64,{data}">'
    kind = ' class="small"' if small else ""
    return f"<figure{kind}>{image}<figcaption>{text_of(words)}</figcaption></figure>"
