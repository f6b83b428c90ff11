"""Atomic writes on this machine: a file gets its name when it is complete; of files that belong together, all or none.

On systems with unnamed files (Linux), a killed writer of one file leaves nothing behind. Elsewhere the file has a
temporary name. Files that belong together are written to a hidden folder beside their places. Writers lock such a file
or folder, so that the next run can recognise and remove the remains of killed writers.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import secrets
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed by others
    fcntl = None  # type: ignore[assignment]

HAS_LOCKS = fcntl is not None

#: Names of incomplete files, and of folders of several of them.
PARTS, STAGES = ".sparklod-{}.part", ".sparklod-{}.parts"

#: Folders are removed with all that is in them, so their names must be ours to the letter.
_STAGE = re.compile(r"\.sparklod-[0-9a-f]{16}\.parts")

#: The folder inside the hidden one for the files that are being replaced.
FORMER = "former"


def unique(name: str) -> str:
    """Return a name of the form `PARTS` or `STAGES` with a random number."""
    return name.format(secrets.token_hex(8))


def lock(descriptor: int) -> None:
    """Lock a file or folder until it is closed or its process ends; do nothing where there are no locks."""
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)


def try_lock(descriptor: int) -> bool:
    """Lock a file without waiting; return False if another process has locked it."""
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
    """Remove the remains of killed writers from a folder; once, as thousands of files may be written there."""
    with contextlib.suppress(OSError):
        for path in [*folder.glob(PARTS.format("*")), *folder.glob(STAGES.format("*"))]:
            with contextlib.suppress(OSError):
                if fcntl is not None:
                    _remove_unlocked(path)
                elif path.match(PARTS.format("*")):
                    path.unlink()


def _remove_unlocked(path: Path) -> None:
    """Remove a file or folder of this user; raise `OSError` if a process has locked it."""
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


#: The flag that opens an unnamed file in a folder; None where the system has none.
UNNAMED: int | None = getattr(os, "O_TMPFILE", None)

#: The folder of open files by descriptor, from which an unnamed file is linked to its name.
OPEN_FILES = Path("/proc/self/fd")

#: For reading and writing bytes; not inherited by child processes.
_FLAGS = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)

_COPY_BYTES = 1 << 20  # per read when a file is copied


def write(target: Path, pieces: Iterable[bytes | memoryview], *, overwrite: bool, sync: bool = True) -> int:
    """Write a file that appears only when it is complete, and return its size in bytes.

    A new file gets the permissions that the umask allows. A replacement gets the permissions of the file it replaces,
    except set-user-id, set-group-id and sticky, and never has more while it is written.

    Args:
        target: path of the file; a symbolic link would be replaced, not followed.
        sync: wait until it is on the disk. Otherwise it may be damaged after a power failure, though not after a kill.

    Raises:
        FileExistsError: the file exists, and `overwrite` is not set.
        OSError: the file system reported an error.
    """
    with contextlib.closing(NewFile(target, overwrite=overwrite)) as new:
        size = sum(map(new.file.write, pieces))
        new.publish(sync=sync)
    return size


class NewFile:
    """A file that is filled, and gets its name by `publish`; until then, `close` leaves nothing behind.

    Attributes:
        file: open for writing and reading.
        part: its temporary name; None for an unnamed file.
    """

    def __init__(self, target: Path, *, overwrite: bool, unnamed: bool = True) -> None:
        sweep(target.parent)
        self._target, self._overwrite = target, overwrite
        self.part: Path | None = None
        mode = _replaced_mode(target, overwrite)
        mode = 0o666 if mode is None else mode & 0o600  # never more than that of the complete file
        if unnamed and UNNAMED is not None and OPEN_FILES.exists():
            with contextlib.suppress(OSError):
                self.file = os.fdopen(os.open(target.parent, UNNAMED | os.O_RDWR | os.O_CLOEXEC, mode), "w+b")
                return
        while True:
            part = target.with_name(unique(PARTS))
            descriptor = os.open(part, _FLAGS | os.O_CREAT | os.O_EXCL, mode)
            lock(descriptor)
            with contextlib.suppress(FileNotFoundError):  # another process removed it before it was locked
                if os.path.samestat(os.fstat(descriptor), part.stat()):
                    self.part, self.file = part, os.fdopen(descriptor, "w+b")
                    return
            os.close(descriptor)

    def publish(self, *, sync: bool = True) -> None:
        """Give the file, which is complete, its name; raise `FileExistsError` if that is taken."""
        self.file.flush()
        number, target = self.file.fileno(), self._target
        if sync:
            os.fsync(number)
        if self.part is not None:
            mode = _replaced_mode(target, self._overwrite)
            if mode is not None:
                self.part.chmod(mode)
            if not HAS_LOCKS:
                self.file.close()  # Windows cannot rename an open file
            rename(self.part, target, self._overwrite)
            return
        target.parent.mkdir(parents=True, exist_ok=True)  # another run that failed may have removed it as empty
        # src_dir_fd has no other effect than that Python follows the symbolic link in /proc.
        link = functools.partial(os.link, OPEN_FILES / str(number), src_dir_fd=number, follow_symlinks=True)
        try:
            mode = _replaced_mode(target, self._overwrite)
            if mode is None:
                try:
                    link(target)
                    return
                except FileExistsError:
                    if not self._overwrite:
                        raise
                    mode = _replaced_mode(target, self._overwrite)  # another process created it first
            if mode is not None:
                os.fchmod(number, mode)
            lock(number)
            temporary = target.with_name(unique(PARTS))
            try:
                link(temporary)  # link() cannot replace a file, so it has two names for a moment
                temporary.replace(target)
            finally:
                temporary.unlink(missing_ok=True)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            self.file.seek(0)
            with contextlib.closing(NewFile(target, overwrite=self._overwrite, unnamed=False)) as copy:
                shutil.copyfileobj(self.file, copy.file, _COPY_BYTES)
                copy.publish()

    def close(self) -> None:
        """Close the file; remove it, if it has no name of its own."""
        try:
            self.file.close()
        finally:
            if self.part is not None:
                self.part.unlink(missing_ok=True)


def check_replaceable(path: Path) -> None:
    """Raise `OSError` where a file or folder cannot be replaced, though others can be written beside it.

    Something is mounted on it, it belongs to another user in a folder such as /tmp, or it is marked as immutable.
    """
    status, folder = path.lstat(), path.parent.stat()
    if os.path.ismount(path):  # `Path.is_mount` is False of files
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(path))
    is_shared = hasattr(os, "geteuid") and folder.st_mode & stat.S_ISVTX
    if is_shared and os.geteuid() not in (0, status.st_uid, folder.st_uid):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(path))
    if stat.S_ISREG(status.st_mode):
        try:
            os.close(os.open(path, _FLAGS | getattr(os, "O_NONBLOCK", 0)))
        except OSError as error:  # a file that is only read may be replaced
            if error.errno == errno.EPERM:
                raise


def _replaced_mode(target: Path, overwrite: bool) -> int | None:
    """Return permissions of the file that will be replaced; None if there is none."""
    try:
        return stat.S_IMODE(target.stat().st_mode) & 0o777 if overwrite else None
    except FileNotFoundError:
        return None


def rename(temporary: Path, target: Path, overwrite: bool) -> None:
    """Give a complete file its name; raise `FileExistsError` if that is taken and `overwrite` is not set."""
    if overwrite:
        temporary.replace(target)
        return
    try:
        os.link(temporary, target)  # fails if the name is taken; a rename would replace that file
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if target.exists():
            raise FileExistsError from None
        temporary.replace(target)


@contextlib.contextmanager
def created(folder: Path) -> Iterator[None]:
    """Create a folder and its parents for a context; at its end, new folders that are empty are removed."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # the first that is not empty ends this
            for each in new:
                each.rmdir()


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Create a locked, hidden folder in a folder for files that belong together; it is removed at the end."""
    sweep(folder)
    descriptor: int | None = None
    while True:
        stage = folder / unique(STAGES)
        stage.mkdir(0o700)
        if not HAS_LOCKS:
            break
        with contextlib.suppress(FileNotFoundError):  # another process removed it before it was locked
            descriptor = os.open(stage, os.O_RDONLY | os.O_CLOEXEC)
            lock(descriptor)
            if stage.exists():
                break
            os.close(descriptor)
    try:
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if descriptor is not None:
            os.close(descriptor)


def add(stage: Path, name: str, pieces: Iterable[bytes]) -> int:
    """Write and sync a file in the hidden folder, in folders there ("0_0/means_l.webp"); return its size in bytes."""
    (stage / name).parent.mkdir(parents=True, exist_ok=True)
    with (stage / name).open("xb") as file:
        size = sum(map(file.write, pieces))
        file.flush()
        os.fsync(file.fileno())
    return size


def publish(stage: Path, names: Collection[str], header: str, *, overwrite: bool, outdated: Iterable[str] = ()) -> None:
    """Give files that were added to a hidden folder their names beside it: all of them, or none.

    A former header is moved away before any other file is touched, and the new one is the last to get its name: for
    some milliseconds there is none. An error or an interrupt at any time leaves the former files; a kill within these
    milliseconds leaves new files without a header. A folder that becomes empty is removed, too; other files in it are
    not touched. Permissions are those of `write`.

    Args:
        names: all files that were added.
        header: the file that readers open first.
        outdated: existing files that are removed where `overwrite` is set.

    Raises:
        FileExistsError: a file exists, and `overwrite` is not set; or something else, such as a link, is in the place
            of a folder. The error has the path.
        OSError: the file system reported an error.
    """
    folder, written = stage.parent, {*names}
    names = [*(name for name in names if name != header), header]
    folders = _folders_of(names)
    new = [each for each in folders if not os.path.lexists(folder / each)]
    try:
        for each in folders:
            if (folder / each).is_symlink() or ((folder / each).exists() and not (folder / each).is_dir()):
                raise FileExistsError(errno.EEXIST, "is not a folder", str(folder / each))
        gone = [name for name in outdated if name not in written] if overwrite else []
        if overwrite:
            (stage / FORMER).mkdir()
            for name in (header, *names[:-1], *gone):
                _put_aside(stage, name)
        else:
            _refuse_existing(folder / name for name in names)
        for each in folders:
            (folder / each).mkdir(exist_ok=True)
        for name in names:
            rename(stage / name, folder / name, overwrite)
        _remove_empty(folder / each for each in _folders_of(gone))
    except BaseException:
        _undo(stage, names)
        _remove_empty(folder / each for each in new)
        raise


def _folders_of(names: Iterable[str]) -> list[str]:
    """Return the folders of files, outer folders first."""
    found = {str(parent) for name in names for parent in PurePosixPath(name).parents if parent.name}
    return sorted(found, key=lambda folder: (folder.count("/"), folder))


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in reversed(list(folders)):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _refuse_existing(paths: Iterable[Path]) -> None:
    for path in paths:
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _put_aside(stage: Path, name: str) -> None:
    """Move a file that will be replaced into the hidden folder; the new one gets its permissions."""
    former, part = stage.parent / name, stage / name
    with contextlib.suppress(FileNotFoundError):
        mode = former.stat().st_mode
        if not stat.S_ISREG(mode):
            raise FileExistsError(errno.EEXIST, "is not a file", str(former))
        if part.exists():
            part.chmod(stat.S_IMODE(mode) & 0o777)
        (stage / FORMER / name).parent.mkdir(parents=True, exist_ok=True)
        former.rename(stage / FORMER / name)


def _undo(stage: Path, names: Collection[str]) -> None:
    """Take the names of new files away again and give former files theirs back, the header's, the last name, at last.

    The folders show which steps were done, so that an interrupt between two steps is undone, too.
    """
    *rest, header = names
    for name in (header, *reversed(rest)):
        path, part = stage.parent / name, stage / name
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            if not part.exists() or path.samefile(part):
                path.unlink()
    former = stage / FORMER
    found = {path.relative_to(former).as_posix(): path for path in former.rglob("*") if not path.is_dir()}
    for name in sorted(found, key=lambda name: name == header):
        target = stage.parent / name
        target.parent.mkdir(parents=True, exist_ok=True)
        found[name].replace(target)
