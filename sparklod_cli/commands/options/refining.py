"""Options of `sparklod build-lod` for merged splats that are fitted to pictures of full detail."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import click

from ...fitting.settings import MOST_SEED, MOST_STEPS
from ..command import option, with_options
from ..paths import InputPath
from ..usage import exclude, is_given, require
from .common import Command
from .types import Codes

if TYPE_CHECKING:
    from ...fitting.settings import FitSettings

HEADING = "Refining"

#: Parameters that mean nothing without --refine, and those that mean nothing with it: it works in memory.
OF_REFINING, OF_SCRATCH = ("camera_path", "seed"), ("scratch_dir", "resume")

#: An example of a number of steps that pays.
EXAMPLE_STEPS = 2000

#: What --refine is without a number.
DEFAULT = "default"


class _Steps(Codes):
    """A number of steps, or `DEFAULT`, which becomes 0."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        return 0 if value == DEFAULT else super().convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return "[STEPS]"


def refining_options(command: Command) -> Command:
    """The options that `fit_settings_of` reads."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--refine",
            type=_Steps(1, MOST_STEPS, example=EXAMPLE_STEPS),
            is_flag=False,
            flag_value=DEFAULT,
            help="Fit merged splats to pictures of full detail, in STEPS pictures of cuts: minutes, for cuts that come"
            " closer to it. The leaves stay as they are, and so does the tree of a Level-of-Detail file. Ctrl-C ends"
            " it early and keeps what was gained.  [default, without STEPS: by the size of the tree]",
            show_default=False,
        ),
        add(
            "--camera-path",
            metavar="FILE",
            type=InputPath(),
            help="Cameras that --refine fits for, in the coordinates of the output, in any format that render reads:"
            " those of visitors whose paths are known.  [default: cameras around and inside the scene]",
            show_default=False,
        ),
        add(
            "--seed",
            metavar="N",
            type=click.IntRange(0, MOST_SEED),
            default=0,
            help="Seed of the cameras and budgets that --refine draws at random.",
        ),
    )


def check_refining(ctx: click.Context) -> None:
    """Raises a `click.UsageError` where options contradict --refine, or mean nothing without it."""
    if is_given(ctx, "refine"):
        exclude(ctx, OF_SCRATCH, "--refine, which needs the whole tree in memory")
    else:
        require(ctx, OF_REFINING, "--refine")


def fit_settings_of(ctx: click.Context) -> FitSettings | None:
    """How merged splats are fitted; None without --refine."""
    from ...fitting.settings import FitSettings

    asked = ctx.params
    return None if asked["refine"] is None else FitSettings(steps=asked["refine"] or None, seed=asked["seed"])
