"""How far cuts are from full detail, as pictures: along a camera path, for one budget after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from .cameras.path import CameraPath
from .images.metrics import check_covered, on_background, psnr, ssim, worst_tile
from .io import write_whole
from .lod.budget import Budget
from .lod.settings import LodSettings
from .render.rasterizer import Image
from .render.renderer import Renderer
from .render.settings import RenderSettings
from .scenes.finder import CutFinder
from .scenes.loaded import Scenes
from .support.errors import SparklodError
from .support.parallel import ordered_map
from .support.progress import Progress, silent
from .support.threads import on_threads
from .tables.columns import Row
from .tables.comparison import COLUMNS, rows_by_budget
from .tables.statistics import numbers

#: Threads that measure pictures; each has a few that wait, which take memory.
MEASURERS = 4


class Comparison:
    """Scenes at several budgets, against full detail.

    Args:
        scenes: trees alone, read with all columns of their splats.
        lod: settings of the cuts but for the budget.
        budgets: at least one.
        render: how the pictures are drawn.
        full: what full detail is; the leaves of the trees unless given.

    Attributes:
        leaves: splats of full detail, all instances together.
        counts: of `budgets`, in splats.

    Raises:
        SparklodError: a budget is less than one splat for each instance.
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
        """Rows of `tables.comparison.COLUMNS`: for each camera one for each budget.

        Pictures are drawn one after the other, each on all the threads; meanwhile others are measured.

        Raises:
            SparklodError: full detail covers no pixel of a frame.
        """
        total = len(path.cameras) * len(self.counts)
        for at, row in enumerate(ordered_map(_measured, self._pictures(path, threads), min(threads, MEASURERS))):
            progress("compare", at + 1, total, "picture")
            yield row

    def _pictures(self, path: CameraPath, threads: int) -> Iterator[tuple[Row, Image, Image]]:
        """What is known of a row, its picture, and that of full detail."""
        for number, camera in zip(path.numbers, path.cameras, strict=True):
            with on_threads(threads):
                full = self._full.draw(camera).image
            check_covered(full, f"full detail in frame {number}")
            for count, renderer in zip(self.counts, self._cuts, strict=True):
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
                yield row, drawn.image, full


def _measured(picture: tuple[Row, Image, Image]) -> Row:
    row, image, full = picture
    tiles = []
    for name, gray in (("black", 0.0), ("white", 1.0)):
        a, b = on_background(image, gray), on_background(full, gray)
        row[f"psnr_{name}"], row[f"ssim_{name}"] = psnr(a, b), ssim(a, b)
        tiles.append(worst_tile(a, b))
    for name in ("psnr", "ssim"):
        row[name] = sum(numbers([row], f"{name}_black") + numbers([row], f"{name}_white")) / 2
    worst = min(tiles, key=lambda tile: tile.psnr)
    row |= {"worst_tile_psnr": worst.psnr, "worst_tile_x": worst.x, "worst_tile_y": worst.y}
    return {column.name: column.rounded(row[column.name]) for column in COLUMNS}


def write_charts(target: Path, rows: Sequence[Row], budgets: Sequence[Budget], title: str, *, overwrite: bool) -> None:
    """Writes the charts of a comparison as a .png.

    Args:
        target: the file.
        rows: of `Comparison.run`.
        budgets: of the comparison.
        title: the name of the scene.
        overwrite: replace a file that exists.

    Raises:
        SparklodError: matplotlib is not installed, or the file cannot be written.
    """
    from .figures.comparison_chart import plot

    texts = (budget.text for budget in budgets)
    series = list(zip(texts, rows_by_budget(rows, len(budgets)), strict=True))
    write_whole(target, [plot(series, title)], overwrite=overwrite)
