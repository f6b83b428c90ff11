"""Opened files that wait for the next read: headers, bounds and palettes are not read again for every few splats."""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
from collections.abc import Callable, Hashable, Iterator

from ..model.streams import SceneStream

#: An open file, and the stream of it.
Opened = tuple[contextlib.ExitStack, SceneStream]

#: Files that wait at most: a palette takes up to 12 MB, and each is an open file. Chosen.
MOST = 4

_LOCK = threading.Lock()

#: By what tells them apart, the one that waits longest first; one that is in use is not among them.
_IDLE: list[tuple[Hashable, Opened]] = []


@contextlib.contextmanager
def borrowed(key: Hashable, opened: Callable[[], Opened]) -> Iterator[SceneStream]:
    """A stream that nobody else reads meanwhile: one that waits, or else a new one. It waits afterwards.

    Args:
        key: tells a file, its version and how it is read from others.
        opened: makes a new one.
    """
    found = _taken(key) or opened()
    sound = False
    try:
        yield found[1]
        sound = True
    except GeneratorExit:  # whoever reads wants no more
        sound = True
        raise
    finally:
        if sound:
            _put(key, found)
        else:
            found[0].close()


def close_idle(matches: Callable[[Hashable], bool] = lambda key: True) -> None:
    """Closes the files that wait, or those whose keys match."""
    with _LOCK:
        closing = [item for item in _IDLE if matches(item[0])]
        _IDLE[:] = [item for item in _IDLE if not matches(item[0])]
    for _, (stack, _) in closing:
        stack.close()


def _taken(key: Hashable) -> Opened | None:
    with _LOCK:
        place = next((place for place, (other, _) in enumerate(_IDLE) if other == key), None)
        return None if place is None else _IDLE.pop(place)[1]


def _put(key: Hashable, opened: Opened) -> None:
    with _LOCK:
        _IDLE.append((key, opened))
        closing = _IDLE.pop(0)[1] if len(_IDLE) > MOST else None
    if closing is not None:
        closing[0].close()


atexit.register(close_idle)
if hasattr(os, "register_at_fork"):  # a child shares the position in a file with its parent
    os.register_at_fork(after_in_child=_IDLE.clear)
