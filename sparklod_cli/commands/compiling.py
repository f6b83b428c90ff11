"""Messages while kernels are compiled, which happens once on a machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from .console import count_of

if TYPE_CHECKING:
    from .console import Console

#: Seconds that compiling a kernel takes on a fast machine and on a slow one; docs/performance.md has measurements.
SECONDS = (1, 3)


class Reporter:
    """Announces the first kernel that is compiled, shows a bar, and prints at the end how long all of them took.

    Args:
        console: prints it.
        jobs: the jobs of `warmup.JOBS` that follow, which tell how many kernels there will be.
    """

    def __init__(self, console: Console, jobs: Sequence[str]) -> None:
        self._console, self._jobs = console, jobs
        self._total = self._done = 0
        self._seconds = 0.0
        self._troubles: set[str] = set()

    def listen(self) -> Callable[[], None]:
        """Starts listening to the compiler; returns the function that stops it."""
        from ..support import jit

        stop = jit.listen(self._begin, self._end, self._say_once)

        def close() -> None:
            stop()
            if self._done:
                self._console.say(f"compiled {count_of(self._done, 'kernel')} in {self._seconds:.1f} s")

        return close

    def _say_once(self, trouble: str) -> None:
        """Prints each trouble once: what is wrong with the cache is wrong for every kernel."""
        if trouble not in self._troubles:
            self._troubles.add(trouble)
            self._console.say(trouble)

    def _begin(self, name: str) -> None:
        if not self._total:
            self._announce(name)
        self._total = max(self._total, self._done + 1)
        self._console.progress("compiling", self._done, self._total, "kernel")

    def _announce(self, name: str) -> None:
        from ..support import jit
        from ..warmup import missing

        self._total = len({name, *missing(self._jobs)})
        about = " to ".join(f"{max(1, round(self._total * seconds))}" for seconds in SECONDS)
        often = (
            "once; sparklod warmup does it in advance" if jit.CACHE_FOLDER else "in every run: no cache can be written"
        )
        self._console.say(
            f"Compiling {count_of(self._total, 'kernel')} for this machine, about {about} s ({often}) ..."
        )

    def _end(self, seconds: float) -> None:
        self._done += 1
        self._seconds += seconds
        self._console.progress("compiling", self._done, max(self._total, self._done), "kernel")
