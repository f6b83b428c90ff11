"""The figure of `traverse --plot`: charts of a path and, below them, the path in the scene, as one PNG."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..cameras.camera import Camera
from ..images.pixels import BACKGROUND, FAINT, INK
from ..model.splats import Splats
from ..render.color_scales import range_of, whole_numbers
from ..system.errors import SparklodError
from ..system.units import count_of, percent_of
from ..tables.assertions import numbers, totals
from ..tables.columns import Row
from .charts import BLUE, GREEN, INDIGO, ORANGE, PINK, YELLOW, Axes, FrameColumns, Series, draw, head, stacked
from .pyvista_scene import Points, PyvistaStage, Viewpoint, bounds, box_lines, evenly, is_drawable, viewpoint, write_png

#: Height of a row of two charts, pixels.
ROW = 255

#: Upper end of an axis over the largest value: leaves room for the labels of marked frames.
HEADROOM = 1.22


@dataclass(frozen=True)
class Panel:
    """One chart of the figure.

    Attributes:
        columns: that the chart needs; without a number in each of them it is left out.
        draw: draws into matplotlib's axes and returns (N,) heights at which frames are marked.
        marks: reasons for marking a frame in this chart.
    """

    title: str
    columns: tuple[str, ...]
    draw: Callable[[Axes, FrameColumns, ModuleType], Series]
    marks: tuple[str, ...] = ()


def _drawn(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    _stack(axes, frames, (("leaves", "leaves", GREEN), ("merged", "interior", BLUE)))
    budget = frames.column("budget")
    axes.plot(frames.x, budget, color=YELLOW, linewidth=1.4, label="budget")
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(np.nanmax(budget))))
    _counted(axes, matplotlib)
    axes.set_ylabel("splats")
    return frames.column("selected")


def _where(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    parts = (("inside", "in_frustum", GREEN), ("outside", "outside", BLUE), ("behind", "behind", INDIGO))
    _stack(axes, frames, parts)
    _counted(axes, matplotlib)
    axes.set_ylabel("splats")
    return frames.column("in_frustum")


def _stack(axes: Axes, frames: FrameColumns, parts: Sequence[tuple[str, str, str]]) -> None:
    floor = np.zeros(len(frames.x))
    for label, name, color in parts:
        top = floor + np.nan_to_num(frames.column(name))
        axes.fill_between(frames.x, floor, top, color=color, linewidth=0, label=label)
        floor = top
    axes.set_ylim(0, max(float(floor.max()) * 1.03, 1))


def _from_zero(axes: Axes, values: Series) -> None:
    axes.set_ylim(0, HEADROOM * float(np.nanmax(values)) or 1)


def _counted(axes: Axes, matplotlib: ModuleType, unit: str = "") -> None:
    """Give the vertical axis ticks at whole numbers, with k and M for thousands and millions."""
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(matplotlib.ticker.EngFormatter(unit, sep=" " if unit else ""))


def _beside(axes: Axes) -> Axes:
    other = axes.twinx()
    other.grid(False)
    return other


def _coarse(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.ratio("pixel_scale_min", "pixel_scale_limit")
    values[~(values > 0)] = np.nan
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.4)
    axes.axhline(1, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), label="limit")
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    # At least from half to twice the limit, so that values close to the limit look close to it.
    finite = [*values[np.isfinite(values)], 1.0]
    axes.set_ylim(min(0.5, 0.8 * min(finite)), max(2.0, 1.6 * max(finite)))
    axes.set_ylabel("times the limit")
    return values


def _churn(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("churn")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.25, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2)
    axes.yaxis.set_major_formatter(lambda value, place: percent_of(value))
    _from_zero(axes, values)
    axes.set_ylabel("share of splats")
    return values


def _fetched(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("bytes_new")
    some = values > 0
    axes.vlines(frames.x[some], 0, values[some], color=ORANGE, linewidth=1.8, label="per frame")
    _counted(axes, matplotlib, "B")
    _from_zero(axes, values)
    axes.set_ylabel("per frame")
    total = _beside(axes)
    fetched = np.nancumsum(values)
    total.plot(frames.x, fetched, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="total")
    _counted(total, matplotlib, "B")
    _from_zero(total, fetched)
    total.set_ylabel("total")
    return values


def _cache(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("missing")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.35, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2, label="nodes missing")
    _from_zero(axes, values)
    _counted(axes, matplotlib)
    axes.set_ylabel("nodes missing")
    chunks = _beside(axes)
    resident = frames.column("chunks_resident")
    chunks.plot(frames.x, resident, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="chunks resident")
    _from_zero(chunks, resident)
    chunks.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5, integer=True))
    chunks.set_ylabel("chunks resident")
    return values


def _depths(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    mean, most = frames.column("level_mean"), frames.column("level_max")
    axes.fill_between(frames.x, frames.column("level_min"), most, color=BLUE, alpha=0.5, linewidth=0, label="range")
    axes.plot(frames.x, mean, color=GREEN, linewidth=1.6, label="mean")
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
    _from_zero(axes, most)
    if frames.has("pixel_scale_limit"):
        axes.set_ylabel("edges from the root")
    else:  # only trees have such a limit
        axes.set_title("Detail levels of the cut")
        axes.set_ylabel("level")
    return mean


def _line(name: str, unit: str, color: str) -> Callable[[Axes, FrameColumns, ModuleType], Series]:
    def draw(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
        values = frames.column(name)
        axes.plot(frames.x, values, color=color, linewidth=1.3)
        _from_zero(axes, values)
        axes.set_ylabel(unit)
        return values

    return draw


PANELS = (
    Panel("Splats drawn", ("leaves", "interior", "budget"), _drawn),
    Panel("Inside or outside the frustum", ("in_frustum", "outside", "behind"), _where),
    Panel("Depth of the cut", ("level_min", "level_mean", "level_max"), _depths),
    Panel("Pixel scale", ("pixel_scale_min", "pixel_scale_limit"), _coarse, ("coarsest",)),
    Panel("Churn", ("churn",), _churn, ("churn",)),
    Panel("Bytes fetched", ("bytes_new",), _fetched, ("bytes",)),
    Panel("Chunk cache", ("missing", "chunks_resident"), _cache, ("missing",)),
    Panel(
        "Time until the cut is resident", ("complete_in_s",), _line("complete_in_s", "seconds", ORANGE), ("incomplete",)
    ),
    Panel("Overdraw", ("overdraw_estimate",), _line("overdraw_estimate", "splats a pixel", ORANGE), ("overdraw",)),
    Panel("Time to find the cut", ("traverse_ms",), _line("traverse_ms", "milliseconds", GREEN)),
)


#: Labels of the reasons for marking a frame (`simulation.summary.MOMENTS`).
CALLED = {
    "churn": "most churn",
    "bytes": "most bytes fetched",
    "coarsest": "coarsest",
    "missing": "most missing",
    "incomplete": "longest until resident",
    "overdraw": "most overdraw",
}


@dataclass(frozen=True)
class Plot:
    """The bytes of a PNG, and the reason why it has no picture of the path, if one was requested."""

    png: bytes
    note: str | None


def plot(rows: Iterable[Row], marked: Mapping[str, int], title: str, scene: PathScene | None = None) -> Plot:
    """Draws charts of all columns that are not empty and, if it can be drawn, the path in the scene.

    Args:
        rows: of all frames; those of single instances are left out.
        marked: numbers of notable frames, by the reason, a key of `CALLED`.

    Raises:
        SparklodError: matplotlib is not installed, or there is no frame.
    """
    frames = totals(rows)
    if not frames:
        raise SparklodError("there is nothing to draw: the path has no frames")
    lines = [(_about(frames), FAINT)]
    if marked:
        lines.append((", ".join(f"{CALLED[reason]}: frame {number:,}" for reason, number in marked.items()), PINK))
    images: list[Any] = [head(_one_line(title), lines, 96 + 26 * len(lines)), draw_charts(frames, marked)]
    note = None
    if scene is not None:
        try:
            picture = picture_of_path(scene)
            images.append(Image.open(io.BytesIO(picture)).convert("RGB"))
        except SparklodError as error:
            note = f"drawn without the picture of the path: {error}"
    return Plot(stacked(*images), note)


def _about(frames: Sequence[Row]) -> str:
    said = [f"{len(frames):,} frame" + ("" if len(frames) == 1 else "s")]
    times = numbers(frames, "time_s")
    if len(set(times)) > 1:
        said.append(f"{times[-1] - times[0]:.3f} s")
    sizes = list(dict.fromkeys((row["width"], row["height"]) for row in frames if row["width"] and row["height"]))
    if sizes:
        said.append(f"{sizes[0][0]} x {sizes[0][1]} pixels" + (" and other sizes" if len(sizes) > 1 else ""))
    budgets = sorted(set(numbers(frames, "budget")))
    if budgets:
        said.append(
            f"a budget of {' to '.join(f'{each:,}' for each in dict.fromkeys([budgets[0], budgets[-1]]))} splats"
        )
    return ", ".join(said)


def _one_line(text: str) -> str:
    plain = "".join(mark if mark.isprintable() else "\N{REPLACEMENT CHARACTER}" for mark in text)
    return plain if len(plain) <= 100 else f"{plain[:99]}…"


def draw_charts(rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    """(H, WIDTH, 3) the charts of a path; a column without a number has none.

    Args:
        rows: one for each frame, at least one.
        marked: numbers of notable frames, by the reason (`Panel.marks`).

    Raises:
        SparklodError: matplotlib is not installed.
    """
    frames = FrameColumns(rows)
    panels = [panel for panel in PANELS if frames.has(*panel.columns)]

    def fill(matplotlib: ModuleType, grid: NDArray[Any]) -> None:
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

    return draw(max(1, -(-len(panels) // 2)), ROW, fill)


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


#: Most splats that are drawn; of more, an even sample.
MOST_POINTS = 600_000

#: Most cameras whose frusta are drawn, and most cameras that the line of the path goes through.
MOST_FRUSTA, MOST_STEPS = 24, 5_000

#: Length of a frustum as a share of the extent of what is shown, and that of the frame whose cut is drawn.
LENGTH, CHOSEN_LENGTH = 0.03, 0.075

#: Colour of the path; the chosen frame is `PINK`.
PATH = "#ffffff"

#: Opacity of lines where splats hide them.
BEHIND = 0.45

#: Left, top, right and bottom of the scene in the picture, 0..1; title, labels and colour scale are around it.
FRAME = (0.09, 0.17, 0.85, 0.93)


@dataclass(frozen=True)
class PathScene:
    """Content of the picture of a camera path.

    Attributes:
        splats: N splats of the cut of one frame.
        depth: (N,) edges from the root to each node of the cut, or the detail level of each splat.
        frame: index of the camera whose cut it is; that camera is marked. None for none.
        title: which of both the depths are, for display.
    """

    cameras: Sequence[Camera]
    splats: Splats
    depth: NDArray[Any]
    frame: int | None = None
    title: str = "tree depth"


@np.errstate(over="ignore", invalid="ignore")  # of numbers that are out of range in the file
def picture_of_path(scene: PathScene, *, size: tuple[int, int] = (1600, 1000)) -> bytes:
    """Return the PNG of a path, its frusta and a cut, whose splats are left out where they are not finite.

    Raises:
        SparklodError: pyvista is not installed or cannot draw here, or there is nothing to draw.
    """
    cameras, splats, depth, frame = scene.cameras, scene.splats, scene.depth, scene.frame
    index = np.flatnonzero(is_drawable(splats))
    if not len(index):
        raise SparklodError("there is nothing to draw: no splat of the cut is finite and has a size")
    drawable = splats.with_max_sh(0).take(index)
    chosen = index[evenly(len(index), MOST_POINTS)]
    shown = splats.with_max_sh(0).take(chosen)
    coloring = whole_numbers(scene.title, depth[chosen], *range_of(depth[chosen]))
    low, high = bounds(drawable)
    way = np.array([camera.position for camera in cameras])
    low, high = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
    eye = _above(cameras, low, high, size)
    parts = _path_lines(cameras, way, frame, float((high - low).max()))
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        drawn = stage.splats(shown, coloring.rgb, eye)
        for ends, color in parts:
            stage.lines(ends, color, 1.0, width=1.5)
        pixels = stage.photograph(eye)
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        for ends, color in parts:
            stage.lines(ends, color, 1.0, width=1.5)
        pixels = _seen_through(pixels, stage.photograph(eye))
    if len(chosen) < len(splats):
        drawn += f", an even sample of {len(chosen):,}"
    title = f"Cut of {count_of(len(splats), 'splat')}"
    said = [f"{drawn}; white: the path and the frusta of {min(len(cameras), MOST_FRUSTA)} of {len(cameras):,} frames"]
    if frame is not None:
        title += f" of frame {frame} at {cameras[frame].time:.3f} s"
        said.append("pink: its frustum")
    return write_png(pixels, title, ["; ".join(said)], coloring, eye, low, high)


def _above(cameras: Sequence[Camera], low: Points, high: Points, size: tuple[int, int]) -> Viewpoint:
    """Return a viewpoint above a corner of the box, with the mean up axis of the cameras upwards."""
    mean = np.sum([camera.camera_to_world[:3, 1] for camera in cameras], axis=0)
    axis = int(np.abs(mean).argmax())
    up = np.zeros(3)
    up[axis] = -1.0 if mean[axis] < 0 else 1.0
    direction = np.insert([-0.62, -1.0], axis, -0.62 * up[axis])
    return viewpoint(box_lines(low[None], high[None]), direction, up, aspect=size[0] / size[1], frame=FRAME)


def _path_lines(cameras: Sequence[Camera], way: Points, frame: int | None, extent: float) -> list[tuple[Points, str]]:
    steps = np.unique([*evenly(len(way), MOST_STEPS), len(way) - 1])
    path = np.repeat(way[steps], 2, axis=0)[1:-1]
    frusta = [frustum_lines(cameras[at], LENGTH * extent) for at in evenly(len(cameras), MOST_FRUSTA)]
    parts = [(np.concatenate([path, *frusta]), PATH)]
    if frame is not None:
        parts.append((frustum_lines(cameras[frame], CHOSEN_LENGTH * extent), PINK))
    return parts


def frustum_lines(camera: Camera, length: float) -> Points:
    """(20, 3) ends of the lines of a frustum, world units: four edges, the far rectangle and a roof on its upper side.

    Args:
        length: distance of the far rectangle along the optical axis, world units.
    """
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    left, right = -cx / fx, (camera.width - cx) / fx
    top, bottom = cy / fy, (cy - camera.height) / fy
    corners = [(left, top, -1), (right, top, -1), (right, bottom, -1), (left, bottom, -1)]
    ridge = ((left + right) / 2, top + 0.35 * (top - bottom), -1)
    local = length * np.array([(0, 0, 0), *corners, ridge], np.float64)
    points = local @ camera.camera_to_world[:3, :3].T + camera.position
    pairs = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)]
    return points[np.array(pairs)].reshape(-1, 3)


def _seen_through(pixels: NDArray[np.uint8], lines: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) a picture in which hidden lines show faintly, mixed in from the same lines on an empty ground."""
    ground = np.array([int(BACKGROUND[at : at + 2], 16) for at in (1, 3, 5)], np.float32)
    covered = np.abs(lines - ground).max(axis=2, keepdims=True) / (255 - ground.min())
    share = BEHIND * np.clip(covered, 0, 1)
    mixed: NDArray[np.uint8] = np.rint((1 - share) * pixels + share * lines).astype(np.uint8)
    return mixed
