"""The job that all tasks of a bake out of core share, and the names of their results."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from ...lod.builders import BUILDERS
from ...lod.stages.records import StagedBuilder
from ...model.streams import SceneStream
from ..settings import BakeSettings
from .blocks import Blocks
from .contracts import Store


@dataclass(frozen=True)
class Job:
    """What the tasks of a bake share; small, so it can be pickled.

    Attributes:
        store: of the results.
        stream: the input; can be pickled, too.
        settings: how to bake.
        parts: where each part of the input begins, and at last the count.
        blocks: that the scene is cut into.
        round: how often it was cut before.
        kept: how many splats of the parts before each part are kept; empty before that is known.
        plan: of the builder; None before it is known.
        families: how many each stage made, by its number; empty before they are known.
    """

    store: Store
    stream: SceneStream
    settings: BakeSettings
    parts: tuple[int, ...]
    blocks: Blocks
    round: int = 0
    kept: tuple[int, ...] = ()
    plan: Any = None
    families: tuple[int, ...] = ()

    @property
    def sh_degree(self) -> int:
        """Of the splats that are kept."""
        return min(self.stream.sh_degree, self.settings.max_sh)

    def builder(self) -> StagedBuilder:
        """The builder of the tree."""
        return BUILDERS[self.settings.method].load_stages()

    def part(self, number: int) -> str:
        """The name of what is known of a part of the input, whose splats are in blocks then."""
        return f"scatter-{self.round}/{number}"

    def splats(self, part: int, group: int) -> str:
        """The name of the splats of a part that are in a group of blocks."""
        return f"{self.part(part)}/{group}"


def stage_of(number: int | str) -> str:
    """The name of what is known of a stage, all of whose results are there then."""
    return f"stage/{number}"


def families_of(number: int) -> str:
    """The name of the families of a stage."""
    return f"families/{number}"


def pending_of(number: int) -> str:
    """The name of the nodes that a stage hands on."""
    return f"pending/{number}"


def clean_of(group: int) -> str:
    """The name of the mark that the splats of a group of blocks were removed."""
    return f"clean/{group}"


#: Names of the root, and of the order of all nodes.
ROOT, ORDER = "root", "order"


def forget(store: Store, damaged: Collection[str]) -> None:
    """Removes results that are damaged, and whatever has to be made again for them; stages that are whole are kept."""
    names = set(damaged)
    if names - {ORDER}:
        names |= {ORDER}
        names |= {name for name in store.names() if name.startswith(("scatter-", "clean/"))}
        names |= {stage_of(name.partition("/")[2]) for name in damaged if name.startswith(("families/", "pending/"))}
    if ROOT in damaged:  # the last stage makes it
        numbers = [int(name.partition("/")[2]) for name in store.names() if name.startswith("stage/")]
        names |= {stage_of(max(numbers, default=0))}
    for name in sorted(names):
        store.remove(name)
