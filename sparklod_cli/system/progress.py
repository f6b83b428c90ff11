"""`Progress`, the callback with which long operations report their progress."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Protocol


class Progress(Protocol):
    """Called repeatedly with a stage ("reading", "building", "encoding"), the amount done, the total and the unit."""

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None: ...


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """Report nothing."""


class StagedProgress:
    """Progress through several stages, as that of one job.

    Args:
        shares: the relative time of each stage, in order.
    """

    def __init__(self, shares: Mapping[str, float]) -> None:
        whole = sum(shares.values())
        begin = accumulate((share / whole for share in shares.values()), initial=0.0)
        self._stages = {stage: (at, share / whole) for at, (stage, share) in zip(begin, shares.items(), strict=False)}
        self._reached = 0.0

    def reach(self, stage: str, done: int, total: int) -> float:
        """Return the share of the job that is done, 0 to 1; it never falls, and an unknown stage adds nothing."""
        begin, share = self._stages.get(stage, (0.0, 0.0))
        self._reached = min(max(self._reached, begin + share * done / max(total, 1)), 1.0)
        return self._reached
