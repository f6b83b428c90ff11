"""`Progress`, the callback by which long work reports what it has done."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called now and then with a stage ("reading", "building", "encoding"), how much of it is done, and the unit."""

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None: ...


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """A `Progress` that does nothing."""
