"""Calls that a Dask cluster works on: tries that are worth it, workers that are lost, a scheduler that goes away."""

from __future__ import annotations

import contextlib
import errno
import queue
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from typing import Any

from ...system.errors import OutOfMemoryError, SparklodError

#: Seconds to wait before a call that failed is tried again: networks recover, and shared folders show files late.
PAUSES = (1.0, 5.0)

#: Seconds between two looks at the cluster while nothing ends.
TICK = 1.0

#: Seconds after which a cluster without workers is mentioned.
PATIENCE = 10.0

#: Errors of the system that another try does not mend: no room, no right.
LASTING = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.ENAMETOOLONG}

#: Seconds to wait for the message of a nanny that ended a worker for its memory: it may come after the loss.
NANNY_DELAY = 3.0

#: Topics of the scheduler's messages about workers, and of the nannies' about memory.
TOPICS = ("all", "worker-restart-memory")

#: States of a future that has ended. Others are "pending", and "lost" with the worker that held its result.
ENDED = {"finished", "error", "cancelled"}

#: Names of tasks that a message lists.
LISTED = 3

LESS_MEMORY = (
    "give a smaller --memory, which makes smaller blocks, or let fewer workers share a machine; what is done is kept,"
    " and --resume continues"
)


class Connection:
    """A client of a cluster, and what is known of its workers. Used as a context manager."""

    def __init__(self, client: Any, say: Callable[[str], None]) -> None:
        """Take a `distributed.Client`, and what is told of workers that are lost."""
        self.client, self.say = client, say
        self._losses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._starved = set[str]()
        self._alone_since: float | None = None

    def __enter__(self) -> Connection:
        for topic in TOPICS:
            self.client.subscribe_topic(topic, self._keep)
        return self

    def __exit__(self, *_: object) -> None:
        if self.alive:
            for topic in TOPICS:
                self.client.unsubscribe_topic(topic)

    @property
    def alive(self) -> bool:
        """Whether the scheduler is there."""
        return bool(self.client.status == "running")

    def workers(self) -> dict[str, Any]:
        """Return what the scheduler knows of each worker, by its address."""
        with self.guarded():
            known: dict[str, Any] = dict(self.client.scheduler_info()["workers"])
        return known

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """Turn an error of the connection into one for people."""
        try:
            yield
        except (OSError, CancelledError, RuntimeError, AttributeError):
            raise self.gone() from None

    def gone(self) -> SparklodError:
        """Return the error where the scheduler does not answer any more."""
        return SparklodError(
            "the scheduler of the cluster does not answer any more; what is done is kept: start the cluster again, and"
            " add --resume"
        )

    def look(self) -> None:
        """Tell of workers that were lost, and where there are none; raise a `SparklodError` without a scheduler."""
        self.tell_losses()
        if not self.alive:
            raise self.gone()
        if self.workers():
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif self._alone_since + PATIENCE < time.monotonic():
            self.say("the cluster has no workers at the moment; waiting for some (Ctrl-C ends this)")
            self._alone_since = float("inf")

    def tell_losses(self) -> None:
        """Say which workers were lost, and what is done again because of it."""
        with contextlib.suppress(queue.Empty):
            while True:
                lost = self._losses.get_nowait()
                names = sorted(_name_of(key) for key in lost.get("processing-tasks") or ())
                again = f"; to be done again: {', '.join(names[:LISTED])}" if names else ""
                again += f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
                why = "ran out of memory" if lost["worker"] in self._starved else "was lost"
                self.say(f"worker {lost['worker']} {why}{again}")

    def failure(self, name: str, future: Any) -> Exception:
        """Return the error of a call that did not end well."""
        if future.status == "cancelled":
            return self.gone()
        with self.guarded():
            error: Exception = future.exception()
        if type(error).__name__ == "KilledWorker":
            worker = str(error.last_worker.address)  # type: ignore[attr-defined]
            if self._was_starved(worker):
                return OutOfMemoryError(f"{name} does not fit into the memory of a worker; {LESS_MEMORY}")
            return SparklodError(
                f"each worker that did {name} was lost, the last one {worker}. Its log may tell why; if the system"
                f" ended them for want of memory, {LESS_MEMORY}"
            )
        if isinstance(error, OutOfMemoryError):
            return OutOfMemoryError(f"{name}: {error}; {LESS_MEMORY}")
        return error

    def _was_starved(self, worker: str) -> bool:
        """Return whether a nanny ended this lost worker for its memory."""
        deadline = time.monotonic() + NANNY_DELAY
        while worker not in self._starved and time.monotonic() < deadline:
            time.sleep(TICK / 20)
        return worker in self._starved

    def _keep(self, event: tuple[float, Any]) -> None:
        """Keep what the scheduler tells; called on the client's own thread."""
        message = event[1]
        if not isinstance(message, dict):
            return
        if "rss" in message:
            self._starved.add(str(message.get("worker")))
        elif message.get("action") == "remove-worker" and not message.get("expected"):
            self._losses.put(message)


def _name_of(key: Any) -> str:
    """Return what a person calls a call, by its key."""
    return str(key[-1] if isinstance(key, tuple) else key)


class Pool:
    """Calls that were handed to a cluster and have not ended. Used as a context manager, which cancels what is left."""

    def __init__(self, connection: Connection, stage: str) -> None:
        self._connection = connection
        self._prefix = f"{stage}-{uuid.uuid4().hex[:8]}"
        self._calls = dict[str, tuple[int, tuple[Any, ...]]]()
        self._futures = dict[str, Any]()
        self._tries = dict[str, int]()
        self._paused: list[tuple[float, str]] = []
        self._ended: queue.SimpleQueue[str] = queue.SimpleQueue()

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.tell_losses()
        if self._futures and self._connection.alive:
            with contextlib.suppress(Exception):  # the scheduler is gone by now
                self._connection.client.cancel(list(self._futures.values()), force=True)

    def __bool__(self) -> bool:
        return bool(self._calls)

    def submit(self, name: str, place: int, *call: Any) -> None:
        """Hand a call to the cluster.

        Args:
            name: its own in this pool.
            place: calls of lower places come first.
            call: a function, and its arguments.
        """
        self._calls[name] = place, call
        key = (f"{self._prefix}-{self._tries.get(name, 0)}", name)
        with self._connection.guarded():
            future = self._connection.client.submit(*call, key=key, pure=False, priority=-place)
        self._futures[name] = future
        future.add_done_callback(lambda _: self._ended.put(name))

    def next(self) -> tuple[str, Any, Exception | None]:
        """Wait for a call that ends: its name, its result, and the error that it failed with, if it did."""
        while True:
            self._go_on()
            try:
                name = self._ended.get(timeout=TICK)
            except queue.Empty:
                self._connection.look()
                continue
            status = self._futures[name].status
            if status not in ENDED:  # its worker was lost since: the scheduler has it done again
                self._ask_again(name)
                continue
            future = self._futures.pop(name)
            if status == "finished":
                with self._connection.guarded():
                    result = future.result()
                del self._calls[name]
                return name, result, None
            error = self._connection.failure(name, future)
            if not self._is_worth_another(name, error):
                del self._calls[name]
                return name, None, error

    def _ask_again(self, name: str) -> None:
        """Look at a call once more, after a while."""
        self._connection.look()
        loop = self._connection.client.loop
        loop.add_callback(loop.call_later, TICK, self._ended.put, name)

    def _is_worth_another(self, name: str, error: Exception) -> bool:
        """Return whether a call is tried again, after a pause."""
        tried = self._tries.get(name, 0)
        if not isinstance(error, OSError) or error.errno in LASTING or tried >= len(PAUSES):
            return False
        self._tries[name] = tried + 1
        self._paused.append((time.monotonic() + PAUSES[tried], name))
        return True

    def _go_on(self) -> None:
        """Submit calls that have paused long enough."""
        due = [name for when, name in self._paused if when <= time.monotonic()]
        self._paused = [each for each in self._paused if each[1] not in due]
        for name in due:
            place, call = self._calls[name]
            self.submit(name, place, *call)
