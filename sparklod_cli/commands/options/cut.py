"""Which splats a viewer draws of Level-of-Detail trees: the budget, and how much nodes count by size and direction."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import click

from ...codecs.gpu import table
from ...lod import detail_rule
from ...support import defaults
from ..command import COMMON, option, with_options
from ..usage import exclude, flag_of, require
from .common import Command
from .types import Quantity, Real

if TYPE_CHECKING:
    from ...lod.budget import Budget
    from ...lod.detail_rule import DetailRule
    from ...lod.settings import LodSettings
    from ...model.instances import Foveation

HEADING = "Cut"

#: A key of `defaults.PRESETS`.
DEFAULT_PRESET = "desktop"

#: The options of `cut_options` that have no effect where full detail is drawn.
CUTS = (
    "budget",
    "preset",
    "lod_splat_scale",
    "lod_render_scale",
    "pixel_scale_limit",
    "cone_fov0",
    "cone_fov",
    "cone_foveate",
    "outside_foveate",
    "behind_foveate",
    "precision",
    "continuous",
    "blend",
)

#: Options of the cones, which --outside-foveate replaces.
CONES = ("cone_fov0", "cone_fov", "cone_foveate")

#: Options of numbers that the traversal multiplies in float32, and the most that each may be.
MULTIPLIED = ("lod_render_scale", "pixel_scale_limit", "cone_foveate", "outside_foveate", "behind_foveate")
MOST_MULTIPLIED = 1e12


def _budgets(text: str) -> tuple[Budget, ...]:
    from ...lod.budget import parse_budgets

    return parse_budgets(text)


@dataclass(frozen=True)
class Cut:
    """The values of the options of `cut_options`; None for those not given.

    Attributes:
        budget: counts of splats, or shares of the leaves; one, but for comparisons.
        preset: a key of `defaults.PRESETS`; None for the default.
        lod_splat_scale: multiplies the budget.
        lod_render_scale: pixels; smaller nodes are not refined.
        pixel_scale_limit: the same as size over distance.
        cone_fov0, cone_fov: full angles of the foveation cones, degrees.
        cone_foveate, outside_foveate, behind_foveate: priorities, of 1.
        precision: one of `table.PRECISIONS`.
    """

    budget: tuple[Budget, ...] | None
    preset: str | None
    lod_splat_scale: float
    lod_render_scale: float
    pixel_scale_limit: float | None
    cone_fov0: float
    cone_fov: float
    cone_foveate: float
    outside_foveate: float | None
    behind_foveate: float | None
    precision: str

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where options contradict each other, or numbers are out of reach."""
        if self.outside_foveate is not None:
            exclude(ctx, CONES, "--outside-foveate")
        if self.budget is not None:
            exclude(ctx, ["preset"], "--budget")
        if self.pixel_scale_limit is not None:
            exclude(ctx, ["lod_render_scale"], "--pixel-scale-limit")
        for name in MULTIPLIED:
            value = getattr(self, name)
            if value is not None and value > MOST_MULTIPLIED:
                raise click.UsageError(
                    f"{flag_of(ctx, name)} {value:g} is too large; it must be at most {MOST_MULTIPLIED:g}"
                )

    def one_budget(self) -> Budget:
        """The budget, or that of the preset, times --lod-splat-scale.

        Raises:
            click.UsageError: several are given, or it is out of reach.
        """
        from ...lod.budget import LARGEST, Budget

        if self.budget is not None and len(self.budget) > 1:
            texts = ",".join(budget.text for budget in self.budget)
            raise click.UsageError(f"--budget {texts} names several, which only render --compare takes; give one")
        if self.budget:
            budget = self.budget[0]
        else:
            count = defaults.PRESETS[self.preset or DEFAULT_PRESET]
            budget = replace(Budget.of_count(count), by_default=self.preset is None)
        scaled = budget.scaled(self.lod_splat_scale)
        if scaled.count is not None and not scaled.count * scaled.scale <= LARGEST:
            raise click.UsageError(
                f"the budget must be from 1 to 2^53, not {budget.text} times --lod-splat-scale {scaled.scale:g}"
            )
        return scaled

    def settings(self, budget: int, detail: DetailRule) -> LodSettings:
        """Settings of the cuts, with a budget in splats and how detail levels of Streamed SOG are chosen."""
        from ...lod.settings import LodSettings

        return LodSettings(
            budget=budget,
            foveation=self._foveation(),
            pixel_scale_limit=self.pixel_scale_limit,
            render_scale=self.lod_render_scale,
            continuous=self.width,
            detail=detail,
        )

    @property
    def width(self) -> float | None:
        """The width of continuous cuts; None for ordinary ones."""
        return None

    def _foveation(self) -> Foveation:
        from ...model.instances import Cones, Frustum

        behind = self.behind_foveate
        if self.outside_foveate is not None:
            return Frustum(self.outside_foveate, 1.0 if behind is None else behind)
        behind = defaults.BEHIND_FOVEATE if behind is None else behind
        return Cones(self.cone_fov0, self.cone_fov, self.cone_foveate, behind)


@dataclass(frozen=True)
class PictureCut(Cut):
    """The values of the options of `cut_options` with `pictures`.

    Attributes:
        full: draw full detail.
        continuous: nodes fade into their children.
        blend: ratio of the pixel scales between which they do.
    """

    full: bool
    continuous: bool
    blend: float | None

    def check(self, ctx: click.Context) -> None:
        super().check(ctx)
        if self.full:
            exclude(ctx, CUTS, "--full")
        if not self.continuous:
            require(ctx, ["blend"], "--continuous")

    @property
    def width(self) -> float | None:
        return (self.blend or defaults.BLEND) if self.continuous else None


def cut_options(command: Command, *, pictures: bool = False) -> Command:
    """The options of `Cut`.

    Args:
        command: that gets them.
        pictures: those of `PictureCut`, too.
    """
    add = functools.partial(option, heading=HEADING)
    several = "; with --compare several, such as 5%,500k" if pictures else ""
    priority = "of 1, which is that of nodes in the middle"
    of_pictures = (
        option("--full", heading=COMMON, is_flag=True, help="Draw full detail: all leaves, however many there are."),
        add(
            "--continuous",
            is_flag=True,
            help="Blend nodes and their children where one replaces the other, so that nothing pops; draws 18 to 40 %"
            " more splats than the budget.",
        ),
        add(
            "--blend",
            metavar="X",
            type=Real(1, min_open=True),
            help="With --continuous: ratio of the pixel scales between which nodes blend."
            f"  [default: {defaults.BLEND:g}]",
        ),
    )
    return with_options(
        command,
        option(
            "--budget",
            heading=COMMON,
            type=Quantity("N|P%,..." if pictures else "N|P%", _budgets),
            help="Largest number of splats to draw, such as 500k, or a share of the leaves, such as 5%"
            f"{several}.  [default: that of --preset]",
        ),
        *(of_pictures if pictures else ()),
        add(
            "--preset",
            type=click.Choice(list(defaults.PRESETS)),
            help="Budget of a device: Spark 2's, or that of Spark's LoD design with preview-desktop and mobile."
            f"  [default: {DEFAULT_PRESET}; for Streamed SOG PlayCanvas's, {detail_rule.BUDGET:,} splats]",
        ),
        add(
            "--lod-splat-scale",
            metavar="X",
            type=Real(0, min_open=True),
            default=1.0,
            help="Factor by which the budget is multiplied.",
        ),
        add(
            "--lod-render-scale",
            metavar="X",
            type=Real(0),
            default=1.0,
            help="Stop refining nodes smaller than this many pixels.",
        ),
        add(
            "--pixel-scale-limit",
            metavar="X",
            type=Real(0),
            help="Stop refining nodes of this size over distance, or smaller.  [default: that of a pixel, times"
            " --lod-render-scale]",
        ),
        add(
            "--cone-fov0",
            metavar="DEGREES",
            type=Real(0, 180),
            default=defaults.CONE_FOV0,
            help="Full angle of the inner foveation cone, in degrees: full priority inside it.",
        ),
        add(
            "--cone-fov",
            metavar="DEGREES",
            type=Real(0, 180),
            default=defaults.CONE_FOV,
            help="Full angle of the outer cone, in degrees, where priority has fallen to --cone-foveate.",
        ),
        add(
            "--cone-foveate",
            metavar="X",
            type=Real(0),
            default=defaults.CONE_FOVEATE,
            help=f"Priority of nodes at the outer cone, {priority}.",
        ),
        add(
            "--outside-foveate",
            metavar="X",
            type=Real(0),
            help="Priority of nodes outside the frustum, in place of the cones, as in Spark's LoD design.",
        ),
        add(
            "--behind-foveate",
            metavar="X",
            type=Real(0),
            help="Priority of nodes behind the camera."
            f"  [default: {defaults.BEHIND_FOVEATE:g}; 1 with --outside-foveate]",
        ),
        add(
            "--precision",
            type=click.Choice(table.PRECISIONS),
            default=table.PRECISIONS[0],
            help="Precision of the centres and sizes that cuts are found with: the file's, its half floats, or what"
            " Spark has of the file, for the same cuts to the last node: ext with extSplats, else packed, or"
            " packed-pages of a RAD file that it streams.",
        ),
    )
