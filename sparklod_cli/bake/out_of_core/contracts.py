"""What a bake out of core consists of: tasks whose results are files in a store, and an engine that runs them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from ...support.progress import Progress

Arrays = Mapping[str, NDArray[Any]]


class Traffic:
    """Bytes of results that a store has written and read in this process; a copy in another one begins at 0."""

    def __init__(self) -> None:
        self.written = self.read = 0
        self._lock = threading.Lock()

    def add(self, *, written: int = 0, read: int = 0) -> None:
        """Counts bytes; may be called by several threads at once."""
        with self._lock:
            self.written += written
            self.read += read

    def __reduce__(self) -> tuple[type[Traffic], tuple[()]]:
        return Traffic, ()


class Store(Protocol):
    """Where the results of tasks are: a folder, or a URL that several machines reach. Small, so it can be pickled.

    A result appears whole or not at all. Methods may be called by several threads at once, and raise `ScratchError`
    where the results cannot be read or written, which says what to do.
    """

    @property
    def traffic(self) -> Traffic:
        """What was written and read."""

    def has(self, name: str) -> bool:
        """Whether there is a result."""

    def put(self, name: str, arrays: Arrays) -> None:
        """Writes a result; replaces one of this name. An array may be empty, and of any shape."""

    def get(self, name: str, keys: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
        """Reads a result, or some of its arrays."""

    def rows(self, name: str, key: str, start: int, stop: int) -> NDArray[Any]:
        """Reads rows of an array and nothing else."""

    def shape(self, name: str, key: str) -> tuple[int, ...]:
        """The shape of an array."""

    def remove(self, name: str) -> None:
        """Removes a result, if it is there."""

    def names(self) -> list[str]:
        """The names of all results, in order."""

    def is_sound(self, name: str) -> bool:
        """Whether a result is there, and has the bytes that were put; reads all of it."""


@dataclass(frozen=True)
class Task:
    """A piece of work, which may be done again: it gives the same result.

    Attributes:
        name: its own, and that of its result in the store; a task whose result is there is done.
        run: a function of a module, called as `run(job, *arguments, threads=, progress=)`; it puts the result.
        arguments: small, and can be pickled.
        needs: names of the tasks that must be done before.
        weight: how much work it is, splats.
    """

    name: str
    run: Callable[..., None]
    arguments: tuple[Any, ...] = ()
    needs: tuple[str, ...] = ()
    weight: int = 1


class Engine(Protocol):
    """Runs tasks."""

    def run(self, stage: str, tasks: Sequence[Task], job: Any, progress: Progress) -> None:
        """Runs those tasks whose results are not there, each after what it needs.

        Args:
            stage: word for the progress ("building").
            tasks: in an order in which they could run one after the other.
            job: the first argument of all of them; can be pickled, and has a `store`.
            progress: told of the weights that are done.

        Raises:
            SparklodError: a task failed, after it was tried again where that could help; the text says what to do.
        """
