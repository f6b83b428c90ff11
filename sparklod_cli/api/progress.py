"""The argument `progress` of public functions: a callback, or a class of progress bars such as `tqdm.tqdm`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from ..support.progress import Progress, silent

#: A callback `(stage, done, total, unit)`, a class of bars that is called as `tqdm.tqdm` is, or None.
Told = Progress | type[Any] | None


class _Bars:
    """One bar for each stage, of a class that makes bars."""

    def __init__(self, kind: type[Any]) -> None:
        self._kind, self._stage = kind, ""
        self._bar: Any = None

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if self._bar is None or stage != self._stage:
            self.close()
            self._stage, self._bar = stage, self._kind(total=total, desc=stage, unit=f" {unit}s", leave=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Ends the bar of the last stage."""
        if self._bar is not None:
            self._bar.close()


@contextlib.contextmanager
def telling(progress: Told) -> Iterator[Progress]:
    """The callback for work inside; bars are closed at its end."""
    if progress is None:
        yield silent
    elif isinstance(progress, type):
        bars = _Bars(progress)
        try:
            yield bars
        finally:
            bars.close()
    else:
        yield progress
