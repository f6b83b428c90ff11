"""How detail levels of Streamed SOG are chosen, and which options are not for it, or for it alone."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from ...lod import detail_rule
from ..command import option, with_options
from ..usage import refuse, require
from .common import Command
from .cut import CUTS
from .streaming import OF_LOADING
from .types import Real

if TYPE_CHECKING:
    from ...scenes.loaded import Scenes

HEADING = "Streamed SOG"

#: The options of `detail_options`.
OPTIONS = ("budget_mode", "lod_base_distance", "lod_multiplier", "lod_behind_penalty", "lod_underfill")

#: Options of render and traverse that are for trees alone, because Streamed SOG has no nodes to refine, and those of
#: Spark's pages.
OF_TREES = (
    *("lod_render_scale", "pixel_scale_limit", "cone_fov0", "cone_fov", "cone_foveate", "outside_foveate"),
    *("behind_foveate", "precision", "continuous", "blend", "chunk_cache", "indices_out", "padded"),
)


@dataclass(frozen=True)
class Detail:
    """The values of the options of `detail_options`.

    Attributes:
        budget_mode: one of `detail_rule.BUDGET_MODES`.
        lod_base_distance: world units; None for the default.
        lod_multiplier: of distances, from level to level.
        lod_behind_penalty: factor of distances.
        lod_underfill: levels; None for the default.
    """

    budget_mode: str
    lod_base_distance: float | None
    lod_multiplier: float
    lod_behind_penalty: float
    lod_underfill: int | None

    def check(self, ctx: click.Context) -> None:
        """Raises a `click.UsageError` where an option has nothing to do."""
        if self.budget_mode != "limit":
            # A budget that is always spent depends on ratios of distances alone.
            require(ctx, ["lod_base_distance"], "--budget-mode limit")
        if ctx.params["bandwidth"] is None:
            require(ctx, ["lod_underfill"], "--bandwidth")

    def rule(self) -> detail_rule.DetailRule:
        """How levels are chosen."""
        return detail_rule.DetailRule(
            mode=self.budget_mode,
            base_distance=self.lod_base_distance or detail_rule.BASE_DISTANCE,
            multiplier=self.lod_multiplier,
            behind_penalty=self.lod_behind_penalty,
            underfill=self.lod_underfill or 0,
        )


def check_scenes(ctx: click.Context, scenes: Scenes) -> None:
    """Raise a `click.UsageError` where an option is for trees or Streamed SOG, and the files are something else."""
    if scenes.details:
        streamed = "is for trees; use --budget, --budget-mode and --lod-multiplier for Streamed SOG"
        refuse(ctx, [name for name in OF_TREES if name in ctx.params], streamed)
    elif scenes.trees:
        refuse(ctx, OPTIONS, "is for Streamed SOG, and no file is; --budget and --preset are for trees, too")
    else:
        plain = (
            "is for Level-of-Detail files, and no file is one, so that all splats are drawn; bake one with build-lod"
        )
        refuse(ctx, (*CUTS, *OF_LOADING, *OPTIONS), plain)


def detail_options(command: Command) -> Command:
    """The options of `Detail`."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--budget-mode",
            type=click.Choice(detail_rule.BUDGET_MODES),
            default=detail_rule.BUDGET_MODES[0],
            help="Spend the whole budget, or take the levels that distances ask for, and coarser ones only where those"
            " exceed it.",
        ),
        add(
            "--lod-base-distance",
            metavar="X",
            type=Real(detail_rule.LEAST_BASE_DISTANCE),
            help="Distance at which level 1 replaces full detail, in world units; with --budget-mode limit."
            f"  [default: {detail_rule.BASE_DISTANCE:g}]",
        ),
        add(
            "--lod-multiplier",
            metavar="X",
            type=Real(detail_rule.LEAST_MULTIPLIER),
            default=detail_rule.MULTIPLIER,
            help="Ratio of the distances at which successive levels begin.",
        ),
        add(
            "--lod-behind-penalty",
            metavar="X",
            type=Real(1),
            default=detail_rule.BEHIND_PENALTY,
            help="Factor of the distance of regions straight behind the camera.",
        ),
        add(
            "--lod-underfill",
            metavar="N",
            type=click.IntRange(0, 100),
            help="With --bandwidth: while the file of a level loads, draw one that is up to this many levels coarser."
            "  [default: 0]",
        ),
    )
