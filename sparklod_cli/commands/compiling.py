"""Messages while kernels are compiled, which happens once on a machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from .console import count_of

if TYPE_CHECKING:
    from .console import Console


class Reporter:
    """Announces the first kernel that is compiled, shows a bar, and prints at the end how long all of them took.

    Args:
        console: prints it.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._begun = self._done = 0
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

    def _begin(self, _name: str) -> None:
        if not self._begun:
            self._announce()
        self._begun += 1
        self._show()

    def _announce(self) -> None:
        from ..support import jit
        from ..warmup import missing

        advance = f"once; sparklod warmup compiles all {len(missing())} in advance"
        often = advance if jit.CACHE_FOLDER else "in every run: no cache can be written"
        self._console.say(f"Compiling kernels for this machine, half a minute or less ({often}) ...")

    def _end(self, seconds: float) -> None:
        self._done += 1
        self._seconds += seconds
        self._show()

    def _show(self) -> None:
        self._console.progress("compiling", self._done, 0, "kernel")  # how many a command needs is not known
