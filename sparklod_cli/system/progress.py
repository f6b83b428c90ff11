"""`Progress`, the callback to which long operations report their progress."""

from __future__ import annotations

from collections.abc import Callable

#: Called repeatedly with a stage ("reading", "building", "encoding"), the amount done, the total and the unit.
Progress = Callable[[str, int, int, str], None]


def silent(stage: str, done: int, total: int, unit: str) -> None:
    """Report nothing."""
