"""Folders of outputs, which exist only where there is something in them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def created(folder: Path) -> Iterator[None]:
    """A context in which a folder exists; those that it creates are removed at its end if they are empty, as after a
    failure."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # the first that has something in it ends this
            for each in new:
                each.rmdir()
