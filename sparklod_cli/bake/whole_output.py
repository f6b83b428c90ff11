"""Outputs that are made of all nodes at once, in memory."""

from __future__ import annotations

from typing import NoReturn, TypeVar

from ..codecs.encoder import Encoder, Get, Stored
from ..codecs.statistics import Statistics
from ..model.splats import Splats
from ..model.streams import NodeStream
from ..support.addresses import Place
from ..support.errors import FormatError
from ..support.progress import Progress

#: An output.
Whole = TypeVar("Whole", bound="WholeOutput")


class WholeOutput:
    """The part of an `Output` that refuses to be written window by window.

    Attributes:
        in_chunks: see `Output`.
        made: what is made of the nodes, and how, for the refusal.
    """

    in_chunks = False
    made = ""

    def converting(self: Whole) -> Whole:
        """Nothing of it makes up for rounding."""
        return self

    def keeping(self: Whole, stored: Stored, before: Splats) -> Whole:
        """It has no format that trees are read from."""
        return self

    def repacking(self: Whole, source: Place) -> Whole:
        """It has no format that trees are read from."""
        return self

    @property
    def needed(self) -> frozenset[str]:
        """None: nothing is settled by statistics."""
        return frozenset()

    def check(self, splats: Splats, threads: int) -> None:
        """It holds anything."""

    def check_statistics(self, found: Statistics) -> None:
        """Refuses."""
        self._refuse()

    def encoder(self, nodes: NodeStream, found: Statistics, threads: int, progress: Progress) -> Encoder:
        """Refuses."""
        self._refuse()

    def write_windows(self, encoder: Encoder, get: Get, threads: int, progress: Progress) -> NoReturn:
        """Refuses."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise FormatError(
            f"{self.made} in memory, and this tree does not fit: give more --memory, or write .spz or .rad"
        )
