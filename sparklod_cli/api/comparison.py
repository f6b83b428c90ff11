"""Comparison of cuts with full detail: pictures, a table of their errors, and a summary by budget."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras.camera import Camera
from ..cameras.sources import MOST_TURN, CameraPath
from ..codecs.formats import PRECISIONS
from ..images import metrics
from ..lod.budget import Budget
from ..render.rasterizer import Image
from ..render.render_settings import RenderSettings
from ..render.renderer import Renderer
from ..system.errors import SparklodError, memory_errors_translated
from ..system.output import check_writable, write_file
from ..system.progress import Progress, silent
from ..system.threads import on_threads, ordered_map
from ..tables.assertions import check
from ..tables.columns import FRAME, Column, Row, Table, numbers, statistic
from ..viewers.scenes import CutFinder, Scenes
from ..viewers.viewer_settings import LodSettings
from .arguments import BudgetLike, ProgressLike, budget_like, path_like, progress_callback
from .views import Viewed, scenes_of, trees_of

if TYPE_CHECKING:
    from ..tables.assertions import Assertion, Outcome
    from ..tables.columns import Filter, TableOutput

COLUMNS = (
    *FRAME,
    Column("budget", int, "", "splats", "the most that may be drawn, all instances together"),
    Column("share", float, ".6g", "share", "budget over the splats of full detail"),
    Column("selected", int, "", "splats", "what is drawn; with `--continuous` more than the budget, as some fade"),
    Column("psnr_black", float, ".3f", "dB", "PSNR against full detail, both on black; 100 if they are the same"),
    Column("psnr_white", float, ".3f", "dB", "the same on white"),
    Column("psnr", float, ".3f", "dB", "mean of the two"),
    Column("ssim_black", float, ".5f", "", "SSIM against full detail, both on black; 1 if they are the same"),
    Column("ssim_white", float, ".5f", "", "the same on white"),
    Column("ssim", float, ".5f", "", "mean of the two"),
    Column("edge_psnr_black", float, ".3f", "dB", "PSNR at the edges of full detail, on black; empty if it has none"),
    Column("edge_psnr_white", float, ".3f", "dB", "the same on white"),
    Column("edge_psnr", float, ".3f", "dB", "mean of the two"),
    Column("worst_tile_psnr", float, ".3f", "dB", "PSNR of the tile of 64 x 64 pixels that is farthest off, on either"),
    Column("worst_tile_x", int, "", "px", "its left side"),
    Column("worst_tile_y", int, "", "px", "its upper side"),
    Column("popping_black", float, ".4f", "8 bits", "change since the last frame beyond that of full detail, on black"),
    Column("popping_white", float, ".4f", "8 bits", "the same on white"),
    Column("popping", float, ".4f", "8 bits", "mean of the two; empty where a frame follows none"),
)

#: Why all cells of a column may be empty.
EMPTY = {
    **dict.fromkeys(
        ("popping_black", "popping_white", "popping"),
        f"no frame follows another; a path has times, and turns by at most {MOST_TURN:g} degrees a frame",
    ),
    **dict.fromkeys(("edge_psnr_black", "edge_psnr_white", "edge_psnr"), "full detail has no edges in any frame"),
}


@dataclass(frozen=True)
class BudgetSummary:
    """Summary of the frames of a budget: means of the `COLUMNS`, and extremes, as the names say.

    Attributes:
        text: the budget as the user wrote it.
        edge_psnr, edge_psnr_min: of frames that have edges; None without any.
        worst_tile_psnr: least of all frames, dB; `worst_frame`, `worst_tile_x` and `worst_tile_y` locate the tile.
        popping, popping_max, popping_frame: mean, greatest, and its frame; None where no frame follows another.
    """

    text: str
    budget: int
    share: float
    frames: int
    selected: float
    psnr: float
    psnr_min: float
    psnr_max: float
    psnr_black: float
    psnr_white: float
    ssim: float
    ssim_min: float
    edge_psnr: float | None
    edge_psnr_min: float | None
    worst_tile_psnr: float
    worst_frame: int
    worst_tile_x: int
    worst_tile_y: int
    popping: float | None
    popping_max: float | None
    popping_frame: int | None


def rows_by_budget(rows: Iterable[Row], budgets: int) -> list[list[Row]]:
    """Divide the rows of a comparison into those of each budget, in the order of the frames."""
    every = list(rows)
    return [every[at::budgets] for at in range(budgets)]


def summarize(rows: Iterable[Row], budgets: Sequence[str]) -> list[BudgetSummary]:
    """Summarize the rows of a comparison for each budget, whose texts name the summaries."""
    return list(map(_summary, budgets, rows_by_budget(rows, len(budgets))))


def _summary(text: str, rows: Sequence[dict[str, Any]]) -> BudgetSummary:
    def of(name: str, which: str = "mean") -> Any:
        cells = numbers(rows, name)
        return float(f"{statistic(which, cells):.9g}") if cells else None

    worst = min(rows, key=itemgetter("worst_tile_psnr"))
    popped = [row for row in rows if row["popping"] is not None]
    means = ("selected", "psnr", "psnr_black", "psnr_white", "ssim", "edge_psnr", "popping")
    return BudgetSummary(
        text=text,
        budget=rows[0]["budget"],
        share=rows[0]["share"],
        frames=len(rows),
        worst_tile_psnr=of("worst_tile_psnr", "min"),
        worst_frame=worst["frame"],
        worst_tile_x=worst["worst_tile_x"],
        worst_tile_y=worst["worst_tile_y"],
        popping_frame=max(popped, key=itemgetter("popping"))["frame"] if popped else None,
        **{name: of(name) for name in means},
        **{f"{name}_min": of(name, "min") for name in ("psnr", "ssim", "edge_psnr")},
        **{f"{name}_max": of(name, "max") for name in ("psnr", "popping")},
    )


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonTable(Table):
    """Table of a comparison: for each camera one row for each budget, whose texts are `budgets`."""

    budgets: Sequence[str]

    def summary(self) -> list[BudgetSummary]:
        """Return means and extremes over the frames of each budget."""
        return summarize(self.rows, self.budgets)


#: Most threads that measure pictures, as each has a few pictures waiting in memory.
MEASURERS = 4


@dataclass(frozen=True, eq=False)
class PicturePair:
    """Pictures of a cut and of full detail by one camera.

    Attributes:
        row: cells that need no measurement.
        image, full: (H, W, 4) of the cut and of full detail.
        edges: (H, W) where full detail has edges.
        before: pictures of the previous frame at the same budget, without their own `before`, so that only two frames
            are in memory; None where the camera does not follow another.
    """

    row: Row
    image: Image
    full: Image
    edges: metrics.Mask
    before: PicturePair | None


class Comparison:
    """Comparison of scenes at several budgets with full detail.

    Args:
        scenes: trees only, read with all columns of their splats.
        lod: settings of the cuts, except the budget.
        full: scenes that are full detail; None for the leaves of the trees.
    """

    def __init__(
        self,
        scenes: Scenes,
        lod: LodSettings,
        budgets: Sequence[Budget],
        render: RenderSettings,
        *,
        full: Scenes | None = None,
    ) -> None:
        self._full = Renderer(CutFinder(full or scenes, None), render, [])
        self.leaves = len((full or scenes).full())
        self.counts = [budget.of(self.leaves) for budget in budgets]
        for budget, count in zip(budgets, self.counts, strict=True):
            if count < len(scenes.instances):
                raise SparklodError(
                    f"a budget of {budget.text} is less than one splat for each of {len(scenes.instances)} instances"
                )
        finder = CutFinder(scenes, replace(lod, budget=max(self.counts)))
        self._cuts = [Renderer(finder.with_budget(count), render, []) for count in self.counts]

    def run(self, path: CameraPath, *, threads: int = 1, progress: Progress = silent) -> Iterator[Row]:
        """Yield rows of `COLUMNS`: for each camera one for each budget.

        Cells of `popping` are empty where a camera does not follow the one before it (`CameraPath.follows`). Pictures
        are drawn one after the other, each on all threads, while others are measured.
        """
        total = len(path.cameras) * len(self.counts)
        for at, row in enumerate(ordered_map(measured, self._pictures(path, threads), min(threads, MEASURERS))):
            progress("compare", at + 1, total, "picture")
            yield row

    def _pictures(self, path: CameraPath, threads: int) -> Iterator[PicturePair]:
        last: list[PicturePair] = []
        for at, (number, camera) in enumerate(zip(path.numbers, path.cameras, strict=True)):
            with on_threads(threads):
                full = self._full.draw(camera).image
            metrics.check_covered(full, f"full detail in frame {number}")
            where, follows, frame = metrics.edges(full), path.follows(at), []
            for which, (count, renderer) in enumerate(zip(self.counts, self._cuts, strict=True)):
                with on_threads(threads):
                    drawn = renderer.draw(camera)
                row: Row = {
                    "frame": number,
                    "time_s": camera.time,
                    "name": camera.name,
                    "budget": count,
                    "share": count / self.leaves,
                    "selected": drawn.splats,
                }
                before = replace(last[which], before=None) if follows else None
                frame.append(PicturePair(row, drawn.image, full, where, before))
                yield frame[-1]
            last = frame


def measured(pictures: PicturePair) -> Row:
    """Measure the errors of a picture, and return the complete row of the comparison."""
    row, before = pictures.row, pictures.before
    tiles = []
    for name, gray in metrics.BACKGROUNDS.items():
        a, b = metrics.on_background(pictures.image, gray), metrics.on_background(pictures.full, gray)
        row[f"psnr_{name}"], row[f"ssim_{name}"] = metrics.psnr(a, b), metrics.ssim(a, b)
        row[f"edge_psnr_{name}"] = metrics.edge_psnr(a, b, pictures.edges)
        row[f"popping_{name}"] = None
        if before is not None:
            earlier = metrics.on_background(before.image, gray), metrics.on_background(before.full, gray)
            row[f"popping_{name}"] = metrics.popping(a, b, *earlier)
        tiles.append(metrics.worst_tile(a, b))
    for name in ("psnr", "ssim", "edge_psnr", "popping"):
        values = numbers([row], f"{name}_black") + numbers([row], f"{name}_white")
        row[name] = sum(values) / len(values) if values else None
    worst = min(tiles, key=lambda tile: tile.psnr)
    row |= {"worst_tile_psnr": worst.psnr, "worst_tile_x": worst.x, "worst_tile_y": worst.y}
    return {column.name: column.rounded(row.get(column.name)) for column in COLUMNS}


def compare(
    viewed: Viewed,
    scene: Viewed | None,
    cameras: CameraPath | Iterable[Camera],
    *,
    budgets: Sequence[BudgetLike],
    settings: LodSettings | None = None,
    render: RenderSettings | None = None,
    precision: str = PRECISIONS[0],
    threads: int | None = None,
    progress: ProgressLike = None,
) -> ComparisonTable:
    """Compare cuts with full detail: PSNR, SSIM and PSNR at edges, on black and on white.

    Popping is measured as well where cameras follow each other, with later times. The table does not depend on the
    number of threads.

    Args:
        viewed: a tree, a scene at several detail levels, or instances of trees or of such scenes.
        scene: full detail; None for the leaves of the trees, or level 0.
        settings: of the cuts; by default Spark 2's foveation and no pixel-scale limit.
        render: by default as Spark 2 draws.
        precision: see `cut`.

    Raises:
        FormatError: a scene to be cut has no tree.
        SparklodError: a budget is less than one splat for each instance, or full detail covers no pixel.
    """
    if isinstance(budgets, (str, int, float, np.number)):
        raise TypeError(f"budgets is {budgets!r}; give a list of budgets")
    if not budgets:
        raise ValueError("there are no budgets; give at least one")
    with on_threads(threads) as count, progress_callback(progress) as callback, memory_errors_translated():
        scenes = trees_of(viewed, count, precision)
        full = None if scene is None else scenes_of(scene, count)
        given = [budget_like(budget) for budget in budgets]
        lod = settings or LodSettings(pixel_scale_limit=0.0)
        comparison = Comparison(scenes, lod, given, render or RenderSettings(), full=full)
        rows = list(comparison.run(path_like(cameras), threads=count, progress=callback))
    return ComparisonTable(rows, COLUMNS, [budget.text for budget in given])


def check_chart(plot: Path, *, overwrite: bool) -> None:
    """Raise a `SparklodError` if a chart cannot be written or drawn."""
    from ..images.charts import load_matplotlib

    check_writable(plot, overwrite=overwrite)
    load_matplotlib()


def compare_files(
    scenes: Scenes,
    cameras: CameraPath,
    budgets: Sequence[Budget],
    lod: LodSettings,
    render: RenderSettings,
    table: TableOutput,
    *,
    asserts: Sequence[tuple[int | None, Assertion]] = (),
    plot: Path | None = None,
    overwrite: bool = False,
    passed: Filter | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> tuple[int, list[BudgetSummary], list[Outcome]]:
    """Compare cuts of scenes with full detail, and write the table and the charts.

    Args:
        asserts: assertions, each with the index of its budget; None for all budgets.
        passed: filter for the bytes of a table on standard output.

    Returns:
        number of splats of full detail, all instances together; summary of each budget; outcomes of the assertions.
    """
    texts = [budget.text for budget in budgets]
    with on_threads(threads):
        comparison = Comparison(scenes, lod, budgets, render)
        rows = list(comparison.run(cameras, threads=threads, progress=progress))
    table.write(rows, passed=passed)
    groups = rows_by_budget(rows, len(budgets))
    if plot is not None:
        from ..images.charts import plot_comparison

        write_file(plot, [plot_comparison(list(zip(texts, groups, strict=True)), scenes.title)], overwrite=overwrite)
    outcomes = [each for at, what in asserts for each in check([what], rows if at is None else groups[at], empty=EMPTY)]
    return comparison.leaves, summarize(rows, texts), outcomes
