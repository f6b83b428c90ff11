"""The job that all tasks of a bake out of core share, and the names of their results."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from ...codecs.encoder import Encoder
from ...lod.builders import BUILDERS
from ...lod.stage_records import StagedBuilder
from ...model.streams import SceneStream
from ..settings import BakeSettings
from .blocks import BlockDivision
from .store import Store

#: Those of a scene that is not cut yet.
NO_BLOCKS = BlockDivision((), ())


@dataclass(frozen=True)
class Job:
    """Data that all tasks of a bake share; small, so it can be pickled.

    Attributes:
        stream: the input; can be pickled, too.
        needed: statistics by which the output is settled.
        in_chunks: the output has the order for streaming.
        parts: where each part of the input begins, and at last the count; none before that is known.
        blocks: that the scene is cut into; none before that is known.
        round: how often it was cut before.
        selected: how many splats of the parts before each part are selected; empty before that is known.
        plan: of the builder; None before it is known.
        families: how many each stage made, by its number; empty before they are known.
        encoder: of the output; None before the statistics of all nodes are known.
    """

    store: Store
    stream: SceneStream
    settings: BakeSettings
    needed: frozenset[str]
    in_chunks: bool
    parts: tuple[int, ...] = ()
    blocks: BlockDivision = NO_BLOCKS
    round: int = 0
    selected: tuple[int, ...] = ()
    plan: Any = None
    families: tuple[int, ...] = ()
    encoder: Encoder | None = None

    @property
    def sh_degree(self) -> int:
        """SH degree of the splats that are kept."""
        return min(self.stream.sh_degree, self.settings.max_sh)

    def builder(self) -> StagedBuilder:
        """Return the builder of the tree."""
        return BUILDERS[self.settings.method].load()

    def part(self, number: int) -> str:
        """Return the name of what is known of a part of the input, whose splats are in blocks then."""
        return f"scatter-{self.round}/{number}"

    def splats(self, part: int, group: int) -> str:
        """Return the name of the splats of a part that are in a group of blocks."""
        return f"{self.part(part)}/{group}"


#: Names of results by number: what is known of a stage, all of whose results are there then; its families; the nodes
#: that it hands on; what a window of nodes is gathered by; that window as it is written; and the mark that the splats
#: of a group of blocks were removed.
stage_of, families_of, pending_of = "stage/{}".format, "families/{}".format, "pending/{}".format
window_of, encoded_of, clean_of = "order/{}".format, "encoded/{}".format, "clean/{}".format

#: Names of the root, of what is known of all nodes when they are in order, and of the mark that the output is published
#: from then on.
ROOT, ORDER, PUBLISHED = "root", "order", "published"


def forget(store: Store, damaged: Collection[str]) -> None:
    """Remove results that are damaged, and whatever has to be made again for them; stages that are whole are kept."""
    names = set(damaged)
    if any(name.startswith("order") for name in damaged):
        names |= {ORDER}
    numbers = {name.partition("/")[2] for name in damaged if name.startswith(("stage/", "families/", "pending/"))}
    if ROOT in damaged:  # the last stage makes it
        numbers |= {str(max(_numbers(store, "stage/"), default=0))}
    if numbers or any(name.startswith("scatter-") for name in damaged):
        names |= {stage_of(number) for number in numbers}
        names |= {name for name in store.names() if name.startswith(("scatter-", "clean/"))}
    for name in sorted(names):
        store.remove(name)


def _numbers(store: Store, prefix: str) -> list[int]:
    """Return the numbers of the results whose names begin like this."""
    return [int(name.removeprefix(prefix)) for name in store.names() if name.startswith(prefix)]
