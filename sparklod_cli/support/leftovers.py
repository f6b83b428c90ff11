"""Incomplete outputs: their names and locks while they are written, and what removes those of killed writers."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import secrets
import shutil
import stat
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed by others
    fcntl = None  # type: ignore[assignment]

HAS_LOCKS = fcntl is not None

#: Names of incomplete files, and of folders of several of them.
PARTS, STAGES = ".sparklod-{}.part", ".sparklod-{}.parts"

#: Folders are removed with all that is in them, so their names must be ours to the letter.
_STAGE = re.compile(r"\.sparklod-[0-9a-f]{16}\.parts")


def unique(name: str) -> str:
    """`PARTS` or `STAGES` with a number that nobody else has."""
    return name.format(secrets.token_hex(8))


def lock(descriptor: int) -> None:
    """Locks a file or folder until it is closed or its process ends; does nothing where there are no locks."""
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)


def try_lock(descriptor: int) -> bool:
    """Locks a file as `lock` does, without waiting; returns False if somebody else has locked it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


@functools.lru_cache(256)
def sweep(folder: Path) -> None:
    """Removes what killed writers have left in a folder; once, as it may get thousands of files."""
    with contextlib.suppress(OSError):
        for path in [*folder.glob(PARTS.format("*")), *folder.glob(STAGES.format("*"))]:
            with contextlib.suppress(OSError):
                if fcntl is not None:
                    _remove_unlocked(path)
                elif path.match(PARTS.format("*")):
                    path.unlink()


def _remove_unlocked(path: Path) -> None:
    """Removes a file or folder of this user that no process has locked; raises `OSError` if it is locked."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # it may be read-only
    try:
        status = os.fstat(descriptor)
        is_stage = stat.S_ISDIR(status.st_mode) and _STAGE.fullmatch(path.name)
        if (is_stage or stat.S_ISREG(status.st_mode)) and status.st_uid == os.geteuid():
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if is_stage:
                shutil.rmtree(path)
            else:
                path.unlink()
    finally:
        os.close(descriptor)
