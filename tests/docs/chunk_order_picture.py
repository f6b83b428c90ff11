"""Draws docs/images/chunk-order.svg from docs/streaming-measured.md: `python -m tests.docs.chunk_order_picture`."""

from __future__ import annotations

from tests.conftest import ROOT

PAGE = ROOT / "docs" / "streaming-measured.md"
PICTURE = ROOT / "docs" / "images" / "chunk-order.svg"

#: The first cell of the table's heading.
FIRST = "tree"

#: Width of the names and of a bar of the largest figure, height of a row, in pixels.
NAMES, LENGTH, ROW = 210, 420, 17

#: Colours of the orders, on light and on dark pages.
COLORS = ("#0a84d0", "#e07b39", "#8a94a0")


def table() -> list[list[str]]:
    """The cells of the table, its heading first."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    begin = next(at for at, line in enumerate(lines) if line.startswith(f"| {FIRST} |"))
    rows = []
    for line in lines[begin:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return [rows[0], *rows[2:]]


def picture() -> str:
    """Bars of the megabytes until 90 % of the cut is resident, for each tree and order, relative to Spark's order."""
    heading, *rows = table()
    shown = [at for at, name in enumerate(heading) if name.startswith("MB: ")]
    orders = [heading[at].removeprefix("MB: ") for at in shown]
    reference = shown[orders.index("Spark's")]
    ratios = [[float(row[at]) / float(row[reference]) for at in shown] for row in rows]
    scale = LENGTH / max(max(row) for row in ratios)
    height = (len(rows) * (len(shown) + 1) + 2) * ROW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {NAMES + LENGTH + 60} {height}" '
        'font-family="sans-serif" font-size="12" fill="#7b8794">'
    ]
    for number, order in enumerate(orders):
        x = NAMES + 110 * number
        parts.append(f'<rect x="{x}" y="4" width="10" height="10" fill="{COLORS[number]}"/>')
        parts.append(f'<text x="{x + 15}" y="13">{order}</text>')
    for at, (row, of_row) in enumerate(zip(rows, ratios, strict=True)):
        top = (at * (len(shown) + 1) + 2) * ROW
        parts.append(f'<text x="{NAMES - 8}" y="{top + 2 * ROW - 5}" text-anchor="end">{row[0]}</text>')
        for number, ratio in enumerate(of_row):
            y = top + number * ROW
            parts.append(
                f'<rect x="{NAMES}" y="{y}" width="{ratio * scale:.1f}" height="{ROW - 3}" fill="{COLORS[number]}"/>'
            )
            parts.append(f'<text x="{NAMES + ratio * scale + 5:.1f}" y="{y + 12}">{ratio:.2f}</text>')
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
