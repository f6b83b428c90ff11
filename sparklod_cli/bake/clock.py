"""`Clock`: how long the stages of a bake took."""

from __future__ import annotations

import time


class Clock:
    """How long the stages took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def end(self, stage: str) -> None:
        """Ends a stage; the next one begins."""
        now = time.perf_counter()
        self.seconds[stage] = round(now - self._start, 4)
        self._start = now
