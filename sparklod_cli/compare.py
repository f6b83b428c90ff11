"""Image errors of cuts against full detail, along a camera path, for one budget after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from .cameras.sources import CameraPath
from .images.metrics import (
    BACKGROUNDS,
    Mask,
    check_covered,
    edge_psnr,
    edges,
    on_background,
    popping,
    psnr,
    ssim,
    worst_tile,
)
from .lod.budget import Budget
from .lod.settings import LodSettings
from .render.rasterizer import Image
from .render.renderer import Renderer
from .render.settings import RenderSettings
from .scenes.finder import CutFinder
from .scenes.loaded import Scenes
from .system.errors import SparklodError
from .system.progress import Progress, silent
from .system.threads import on_threads, ordered_map
from .tables.assertions import numbers
from .tables.columns import Row
from .tables.comparison import COLUMNS

#: Threads that measure pictures; each has a few that wait, which take memory.
MEASURERS = 4


@dataclass(frozen=True, eq=False)
class PicturePair:
    """A cut's picture and that of full detail, of one camera.

    Attributes:
        row: the cells known so far.
        image, full: (H, W, 4) of the cut and of full detail.
        edges: (H, W) where full detail has edges.
        before: the pictures, of the same budget, that they follow in a movement; None for the first. Those have no
            `before`, so that no more than two frames are kept.
    """

    row: Row
    image: Image
    full: Image
    edges: Mask
    before: PicturePair | None


class Comparison:
    """Scenes at several budgets, against full detail.

    Args:
        scenes: trees alone, read with all columns of their splats.
        lod: settings of the cuts but for the budget.
        full: full detail; None for the leaves of the trees.

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
        """Yield rows of `tables.comparison.COLUMNS`: for each camera one for each budget.

        Cells of `popping` are empty where a camera does not follow the one before it (`CameraPath.follows`).

        Pictures are drawn one after the other, each on all the threads; meanwhile others are measured.

        Raises:
            SparklodError: full detail covers no pixel of a frame.
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
            check_covered(full, f"full detail in frame {number}")
            where, follows, frame = edges(full), path.follows(at), []
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
    """Return the complete row of a comparison, with the errors of the picture."""
    row, before = pictures.row, pictures.before
    tiles = []
    for name, gray in BACKGROUNDS.items():
        a, b = on_background(pictures.image, gray), on_background(pictures.full, gray)
        row[f"psnr_{name}"], row[f"ssim_{name}"] = psnr(a, b), ssim(a, b)
        row[f"edge_psnr_{name}"] = edge_psnr(a, b, pictures.edges)
        row[f"popping_{name}"] = None
        if before is not None:
            earlier = on_background(before.image, gray), on_background(before.full, gray)
            row[f"popping_{name}"] = popping(a, b, *earlier)
        tiles.append(worst_tile(a, b))
    for name in ("psnr", "ssim", "edge_psnr", "popping"):
        values = numbers([row], f"{name}_black") + numbers([row], f"{name}_white")
        row[name] = sum(values) / len(values) if values else None
    worst = min(tiles, key=lambda tile: tile.psnr)
    row |= {"worst_tile_psnr": worst.psnr, "worst_tile_x": worst.x, "worst_tile_y": worst.y}
    return {column.name: column.rounded(row.get(column.name)) for column in COLUMNS}
