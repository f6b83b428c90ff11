"""Charts of a traversal: its columns over time, as small multiples. The only module that imports matplotlib."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.text import BACKGROUND, FAINT, INK, LINE
from ..support.optional import optional_import
from ..tables.columns import Row
from .panels import PANELS
from .series import PINK, Frames

#: Resolution in pixels an inch; width of the figure and height of a row of two charts, in pixels.
DPI, WIDTH, ROW = 100, 1600, 255

#: Ground of a chart.
PANEL = "#141b24"

Axes = Any


def load_matplotlib() -> ModuleType:
    """Imports matplotlib without pyplot, whose global state belongs to the calling program.

    Raises:
        SparklodError: it is not installed.
    """
    with optional_import("charts are drawn by matplotlib", "render"):
        import matplotlib
        import matplotlib.backends.backend_agg
        import matplotlib.figure
        import matplotlib.ticker
    return matplotlib


def draw(rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    """(H, WIDTH, 3) the charts of a path; a column without a number has none.

    Args:
        rows: one for each frame, at least one.
        marked: numbers of frames worth a look, by the reason (`Panel.marks`).

    Raises:
        SparklodError: matplotlib is not installed.
    """
    matplotlib = load_matplotlib()
    with styled(matplotlib):
        return _draw(matplotlib, rows, marked)


@contextlib.contextmanager
def styled(matplotlib: ModuleType) -> Iterator[None]:
    """Applies `style` inside the context, whatever a matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style())
        yield


def style() -> dict[str, Any]:
    """matplotlib's parameters for charts in the colours of the rendered figures."""
    return {
        "axes.edgecolor": LINE, "axes.facecolor": PANEL, "axes.labelcolor": FAINT, "axes.titlecolor": INK,
        "axes.labelsize": 10, "axes.titlesize": 12, "axes.titlelocation": "left", "axes.titlepad": 8,
        "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
        "axes.grid": True, "grid.color": LINE, "grid.alpha": 0.22, "grid.linewidth": 0.8,
        "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
        "legend.fontsize": 9.5, "legend.frameon": False, "legend.labelcolor": FAINT,
        "figure.facecolor": BACKGROUND,
    }  # fmt: skip


def _draw(matplotlib: ModuleType, rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    frames = Frames(rows)
    panels = [panel for panel in PANELS if frames.has(*panel.columns)]
    lines = max(1, -(-len(panels) // 2))
    figure = matplotlib.figure.Figure((WIDTH / DPI, ROW * lines / DPI), DPI, layout="constrained")
    canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    figure.get_layout_engine().set(rect=(0.012, 0.008, 0.976, 0.992), wspace=0.05, hspace=0.05)
    grid = figure.subplots(lines, 2, squeeze=False).ravel()
    for axes in grid[len(panels) :]:
        axes.remove()
    places = {row["frame"]: at for at, row in enumerate(rows)}
    for panel, axes in zip(panels, grid, strict=False):
        axes.set_title(panel.title)
        heights = panel.draw(axes, frames, matplotlib)
        margin = 0.004 * (frames.x[-1] - frames.x[0])  # so that markers at either end are not cut
        axes.set_xlim(frames.x[0] - margin, frames.x[-1] + margin)
        axes.xaxis.set_major_formatter(frames.tick)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, borderpad=0, handlelength=1.4)
        for reason, number in marked.items():
            at = places[number]
            axes.axvline(frames.x[at], color=PINK, alpha=0.28, linewidth=0.9)
            if reason in panel.marks:
                _mark(axes, number, frames.x[at], heights[at], at > 0.85 * len(rows))
    canvas.draw()
    pixels: NDArray[np.uint8] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def _mark(axes: Axes, number: int, x: float, y: float, left: bool) -> None:
    axes.plot([x], [y], "o", color=PINK, markersize=6, zorder=5, clip_on=False)
    axes.annotate(
        f"frame {number:,}",
        (x, y),
        (-8 if left else 8, 3),
        textcoords="offset points",
        color=INK,
        fontsize=9.5,
        ha="right" if left else "left",
        va="bottom",
        annotation_clip=False,
    )
