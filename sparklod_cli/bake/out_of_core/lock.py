"""A folder that one run at a time works in."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from ...support import atomic
from ...support.errors import ScratchError

#: The file that the run at work has locked.
LOCK = "lock"


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """A context in which no other run works in a folder; it is made if need be, and removed if nothing is left in it,
    as are those of its parents that were made.

    Raises:
        ScratchError: another run is at work there, it is nobody's scratch folder, or it cannot be made.
    """
    path = folder / LOCK
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(atomic.created(folder.parent))
            descriptor = _opened_lock(path)
        except OSError as error:
            raise ScratchError(
                f"cannot write in the scratch folder {folder}: {(error.strerror or str(error)).lower()}; choose another"
                " one with --scratch-dir"
            ) from None
        try:
            yield
        finally:
            if atomic.HAS_LOCKS:
                _remove_empty(path)
            os.close(descriptor)
            if not atomic.HAS_LOCKS:  # Windows cannot remove a file that is open
                _remove_empty(path)


def _opened_lock(path: Path) -> int:
    """Opens and locks the file for that, in a folder that is ours; raises `ScratchError` where it is taken."""
    folder = path.parent
    with contextlib.suppress(FileNotFoundError):
        if not path.exists() and any(folder.iterdir()):
            raise ScratchError(f"{folder} is no scratch folder of sparklod; move it, or choose another --scratch-dir")
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
        is_free = atomic.try_lock(descriptor)
        with contextlib.suppress(FileNotFoundError):  # the run that had it was done, and removed it
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                if is_free:
                    return descriptor
                os.close(descriptor)
                raise ScratchError(
                    f"another run is at work in {folder}; wait for it, or give this one another output or --scratch-dir"
                )
        os.close(descriptor)


def _remove_empty(path: Path) -> None:
    """Removes a folder that has nothing but the file that is locked."""
    with contextlib.suppress(OSError):
        if [*path.parent.iterdir()] == [path]:
            path.unlink()
            path.parent.rmdir()
