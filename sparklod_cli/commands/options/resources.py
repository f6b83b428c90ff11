"""Options of `sparklod build-lod` for scenes that do not fit into memory, and for runs that go on later."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import click

from ...support.units import parse_size
from ..command import option, with_options
from ..paths import OutputPath
from .common import Command
from .types import Quantity

if TYPE_CHECKING:
    from ...bake.settings import Resources

HEADING = "Large scenes"

#: Parameters of bakes, which mean nothing where trees are only converted back.
OF_BAKES = ("memory", "scratch_dir", "resume")


def _memory(text: str) -> int:
    size = parse_size(text)
    if not text.strip()[-1:].isalpha():
        raise ValueError(f"{text!r} has no unit; write {text.strip()}G or {text.strip()}MB")
    if size < 1:
        raise ValueError(f"{text!r} is no memory to work in; give some, such as 4G")
    return size


def resources_options(command: Command) -> Command:
    """The options that `resources` reads."""
    add = functools.partial(option, heading=HEADING)
    return with_options(
        command,
        add(
            "--memory",
            type=Quantity("SIZE", _memory),
            help="Memory that a bake may take, such as 4G or '600 MB'. A scene that needs more is baked out of core:"
            " block by block, with a scratch folder.  [default: 75 % of what is available]",
        ),
        add(
            "--scratch-dir",
            metavar="DIR",
            type=OutputPath(folder=True, addresses=True),
            help="Where a bake out of core makes its scratch folder, which is removed at the end.  [default: beside the"
            " output]",
            show_default=False,
        ),
        add(
            "--resume",
            is_flag=True,
            help="Go on with a bake out of core that was interrupted; it must be the same bake. Without one, begin.",
        ),
    )


def resources_of(ctx: click.Context) -> Resources:
    """What the bakes may use; loads numpy."""
    from ...bake.settings import Resources

    asked = ctx.params
    return Resources(memory=asked["memory"], scratch_dir=asked["scratch_dir"], resume=asked["resume"])
