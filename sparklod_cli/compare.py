"""How far cuts are from full detail, as pictures: along a camera path, for one budget after another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .cameras.camera import Camera
from .cameras.path import CameraPath
from .images.metrics import check_covered, psnr, ssim, worst_tile
from .lod.budget import Budget
from .lod.continuous import ContinuousCuts, parts_of
from .lod.traversal import Matrix, Traversal
from .model.splats import Splats
from .render.backends import Draw
from .render.rasterizer import Image
from .render.settings import RasterSettings
from .render.shading import show
from .simulation.frames import LodSettings, view_of
from .support.defaults import MAX_SH_DEGREE
from .support.errors import SparklodError
from .support.parallel import ordered_map
from .support.progress import Progress, silent
from .tables.columns import FRAME, Column, Row
from .tables.statistics import numbers, statistic
from .world import World

#: Threads that measure pictures; each has a few that wait, which take memory.
MEASURERS = 4

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
    Column("worst_tile_psnr", float, ".3f", "dB", "PSNR of the tile of 64 x 64 pixels that is farthest off, on either"),
    Column("worst_tile_x", int, "", "px", "its left side"),
    Column("worst_tile_y", int, "", "px", "its upper side"),
)


@dataclass(frozen=True)
class ComparisonSettings:
    """How the pictures are made.

    Attributes:
        draw: what draws them.
        look: how splats become pixels.
        max_sh: degrees of spherical harmonics above this are left out.
        width: of continuous cuts, see `continuous`; None for ordinary ones.
    """

    draw: Draw
    look: RasterSettings
    max_sh: int = MAX_SH_DEGREE
    width: float | None = None


class Comparison:
    """A world at several budgets.

    Args:
        world: read with all columns of its splats.
        viewer: its foveation and its pixel limit count; its own budget does not.
        budgets: at least one.
        how: pictures are made.

    Attributes:
        leaves: splats of full detail, all instances together.
        counts: of `budgets`.

    Raises:
        SparklodError: a budget is less than one splat for each instance.
    """

    def __init__(self, world: World, viewer: LodSettings, budgets: Sequence[Budget], how: ComparisonSettings) -> None:
        self._world, self._viewer, self._how = world, viewer, how
        of_trees = []
        for tree in world.trees:
            assert tree.scene.tree is not None
            of_trees.append(self._kept(tree.scene.splats.take(tree.scene.tree.is_leaf)))
        self._full = [(of_trees[instance.tree], instance.object_to_world) for instance in world.instances]
        self.leaves = sum(len(splats) for splats, _ in self._full)
        self.counts = [budget.of(self.leaves) for budget in budgets]
        instances = world.foveated(viewer.foveation)
        for budget, count in zip(budgets, self.counts, strict=True):
            if count < len(instances):
                raise SparklodError(
                    f"a budget of {budget.text} is less than one splat for each of {len(instances)} instances"
                )
        # One for each budget: a traversal begins where its last cut ended.
        self._traversals = [Traversal(world.forest, instances) for _ in budgets]
        self._continuous = ContinuousCuts(self._traversals[0]) if how.width is not None else None

    def run(self, path: CameraPath, *, threads: int = 1, progress: Progress = silent) -> Iterator[Row]:
        """Rows of `COLUMNS`: for each camera one for each budget.

        Pictures are made one after the other, each on all threads that kernels have; meanwhile others are measured.

        Raises:
            SparklodError: full detail covers no pixel of a frame.
        """
        total = len(path.cameras) * len(self.counts)
        for at, row in enumerate(ordered_map(_measured, self._pictures(path), min(threads, MEASURERS))):
            progress("compare", at + 1, total, "picture")
            yield row

    def _pictures(self, path: CameraPath) -> Iterator[tuple[Row, Image, Image]]:
        """What is known of a row, its picture, and that of full detail."""
        for number, camera in zip(path.numbers, path.cameras, strict=True):
            full = self._draw(self._full, camera)
            check_covered(full, f"full detail in frame {number}")
            for count, traversal in zip(self.counts, self._traversals, strict=True):
                parts = self._parts(camera, count, traversal)
                row: Row = {
                    "frame": number,
                    "time_s": camera.time,
                    "name": camera.name,
                    "budget": count,
                    "share": count / self.leaves,
                    "selected": sum(len(splats) for splats, _ in parts),
                }
                yield row, self._draw(parts, camera), full

    def _parts(self, camera: Camera, budget: int, traversal: Traversal) -> list[tuple[Splats, Matrix]]:
        """What is drawn of each instance."""
        view = view_of(camera)
        smallest = self._viewer.smallest(camera)
        if self._continuous is not None:
            assert self._how.width is not None
            blended = self._continuous.cut(view, budget=budget, smallest=smallest, width=self._how.width)
            return [(self._kept(splats), matrix) for splats, matrix in parts_of(self._world, blended)]
        cut = traversal.cut(view, budget=budget, smallest=smallest)
        return [
            (self._kept(self._world.trees[instance.tree].scene.splats.take(nodes)), instance.object_to_world)
            for instance, nodes in zip(self._world.instances, cut.indices(), strict=True)
        ]

    def _kept(self, splats: Splats) -> Splats:
        return splats.with_max_sh(self._how.max_sh)

    def _draw(self, parts: Sequence[tuple[Splats, Matrix]], camera: Camera) -> Image:
        return self._how.draw(show(parts, camera), camera, self._how.look)


def on_background(image: Image, gray: float) -> Image:
    """(H, W, 3), 0..1: an image of which red, green and blue are multiplied by alpha, on a background 0..1."""
    return np.clip(image[..., :3] + np.float32(gray) * (1 - image[..., 3:]), 0, 1)


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


@dataclass(frozen=True)
class OfBudget:
    """What the frames of a budget come to.

    Attributes:
        text: the budget, as it was given.
        budget, share: see `COLUMNS`.
        frames: how many.
        selected: mean.
        psnr, psnr_min, psnr_max, psnr_black, psnr_white: dB; means but for the least and the most.
        ssim, ssim_min: mean and least.
        worst_tile_psnr: the least, dB.
        worst_frame, worst_tile_x, worst_tile_y: where that is.
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
    worst_tile_psnr: float
    worst_frame: int
    worst_tile_x: int
    worst_tile_y: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def rows_of(rows: Iterable[Row], budgets: Sequence[Budget]) -> list[list[Row]]:
    """The rows of each budget, in the order of the frames."""
    every = list(rows)
    return [every[at :: len(budgets)] for at in range(len(budgets))]


def summarize(rows: Iterable[Row], budgets: Sequence[Budget]) -> list[OfBudget]:
    """What the rows of `Comparison.run` come to, for each budget."""
    return [_summary(budget, mine) for budget, mine in zip(budgets, rows_of(rows, budgets), strict=True)]


def _summary(budget: Budget, rows: Sequence[Row]) -> OfBudget:
    def of(name: str, which: str = "mean") -> float:
        return float(f"{statistic(which, numbers(rows, name)):.9g}")

    worst = min(rows, key=lambda row: numbers([row], "worst_tile_psnr")[0])
    first = rows[0]
    return OfBudget(
        text=budget.text,
        budget=int(numbers([first], "budget")[0]),
        share=float(numbers([first], "share")[0]),
        frames=len(rows),
        selected=of("selected"),
        psnr=of("psnr"),
        psnr_min=of("psnr", "min"),
        psnr_max=of("psnr", "max"),
        psnr_black=of("psnr_black"),
        psnr_white=of("psnr_white"),
        ssim=of("ssim"),
        ssim_min=of("ssim", "min"),
        worst_tile_psnr=of("worst_tile_psnr", "min"),
        **{
            name: int(numbers([worst], column)[0])
            for name, column in (
                ("worst_frame", "frame"),
                ("worst_tile_x", "worst_tile_x"),
                ("worst_tile_y", "worst_tile_y"),
            )
        },
    )
