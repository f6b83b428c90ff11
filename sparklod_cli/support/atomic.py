"""How a file appears whole or not at all: it gets its name when it is complete. `io.py` alone calls this.

Where the system has unnamed files (Linux), a writer that is killed leaves nothing behind. Elsewhere the file has a name
of its own meanwhile, and a lock for as long as its writer lives: the next run can tell what was left, and removes it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed by others
    fcntl = None  # type: ignore[assignment]

#: Names of files that are not complete.
PARTS = ".sparklod-{}.part"

#: The flag that opens a file without a name in a folder; None where the system has no such files.
UNNAMED: int | None = getattr(os, "O_TMPFILE", None)

#: Where an open file can be had by its number, to give it a name.
OPEN_FILES = Path("/proc/self/fd")

#: Read and written, as bytes, and not by child processes.
_FLAGS = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)

_COPIED = 1 << 20  # bytes at a time


def write(target: Path, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Writes a file that is not there before it is complete; its size.

    A new file gets the permissions that the umask leaves, one that takes the place of another has those of that one,
    and never more, but for those that let a program run as somebody else.

    Args:
        target: not a symbolic link, which would be replaced.
        pieces: of the file.
        overwrite: takes the place of an existing file.

    Raises:
        FileExistsError: there is such a file, and `overwrite` is not set.
        OSError: the file system refused something.
    """
    _sweep(target.parent)
    descriptor = _open_unnamed(target, overwrite)
    if descriptor is None:
        return _write_named(target, pieces, overwrite)
    with os.fdopen(descriptor, "w+b") as file:
        size = _fill(file, pieces)
        try:
            _name(file, target, overwrite)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            file.seek(0)
            _write_named(target, iter(lambda: file.read(_COPIED), b""), overwrite)
    return size


def _fill(file: BinaryIO, pieces: Iterable[bytes]) -> int:
    size = sum(map(file.write, pieces))
    file.flush()
    os.fsync(file.fileno())
    return size


def _replaced_mode(target: Path, overwrite: bool) -> int | None:
    """Permissions of the file that is replaced; None where there is none."""
    try:
        return stat.S_IMODE(target.stat().st_mode) & 0o777 if overwrite else None
    except FileNotFoundError:
        return None


def _first_mode(target: Path, overwrite: bool) -> int:
    """Permissions to make a file with, of which the umask takes some: none that the complete one has not."""
    mode = _replaced_mode(target, overwrite)
    return 0o666 if mode is None else mode & 0o600


def _open_unnamed(target: Path, overwrite: bool) -> int | None:
    """Opens a file without a name where `target` will be; None where that cannot be done."""
    if UNNAMED is None or not OPEN_FILES.exists():
        return None
    try:
        return os.open(target.parent, UNNAMED | os.O_RDWR | os.O_CLOEXEC, _first_mode(target, overwrite))
    except OSError:
        return None


def _name(file: BinaryIO, target: Path, overwrite: bool) -> None:
    """Gives a complete file without a name its name."""
    number = file.fileno()
    mode = _replaced_mode(target, overwrite)
    if mode is None:
        try:
            return _link(number, target)
        except FileExistsError:
            if not overwrite:
                raise
            mode = _replaced_mode(target, overwrite)  # somebody was quicker
    if mode is not None:
        os.fchmod(number, mode)
    _lock(number)
    temporary = _part_of(target)
    try:
        _link(number, temporary)  # no link replaces a file, so there are two names for a moment
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _link(number: int, path: Path) -> None:
    # The folder only makes Python follow the link that the source is.
    os.link(OPEN_FILES / str(number), path, src_dir_fd=number, follow_symlinks=True)


def _write_named(target: Path, pieces: Iterable[bytes], overwrite: bool) -> int:
    """As `write`, by a file that has a name of its own until it is complete."""
    temporary, descriptor = _open_part(target, overwrite)
    try:
        with os.fdopen(descriptor, "w+b") as file:
            size = _fill(file, pieces)
            mode = _replaced_mode(target, overwrite)
            if mode is not None:
                temporary.chmod(mode)
            if fcntl is None:
                file.close()  # no open file can be renamed there
            _rename(temporary, target, overwrite)
    finally:
        temporary.unlink(missing_ok=True)
    return size


def _part_of(target: Path) -> Path:
    """A name beside a file that nobody else has."""
    return target.with_name(PARTS.format(secrets.token_hex(8)))


def _open_part(target: Path, overwrite: bool) -> tuple[Path, int]:
    """Makes a locked file beside `target`; its name, and its descriptor."""
    while True:
        temporary = _part_of(target)
        descriptor = os.open(temporary, _FLAGS | os.O_CREAT | os.O_EXCL, _first_mode(target, overwrite))
        _lock(descriptor)
        with contextlib.suppress(FileNotFoundError):  # swept away before it was locked
            if os.path.samestat(os.fstat(descriptor), temporary.stat()):
                return temporary, descriptor
        os.close(descriptor)


def _rename(temporary: Path, target: Path, overwrite: bool) -> None:
    if overwrite:
        temporary.replace(target)
        return
    try:
        os.link(temporary, target)  # fails where the name is taken; a rename would replace it
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if target.exists():
            raise FileExistsError from None
        temporary.replace(target)


def _lock(descriptor: int) -> None:
    """Locks a file until it is closed, or its process dies, where the file system has locks."""
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)


@functools.lru_cache(256)
def _sweep(folder: Path) -> None:
    """Removes what writers that were killed have left in a folder; once, since all frames may go into one."""
    with contextlib.suppress(OSError):
        for path in list(folder.glob(PARTS.format("*"))):
            with contextlib.suppress(OSError):
                if fcntl is None:
                    path.unlink()
                else:
                    _remove_unlocked(path)


def _remove_unlocked(path: Path) -> None:
    """Removes a file of ours that no living process has locked; `OSError` where it is locked."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)  # it may be read-only
    try:
        about = os.fstat(descriptor)
        if stat.S_ISREG(about.st_mode) and about.st_uid == os.geteuid():
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
    finally:
        os.close(descriptor)
