"""`Progress`, the callback with which long operations report their progress."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called repeatedly with a stage ("reading", "building", "encoding"), the amount done, the total and the unit."""

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None: ...


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """Report nothing."""
