"""Outputs: a file, a file with siblings, standard output, a device or an address. All files appear, or none.

On systems with unnamed files (Linux), a killed writer of one file leaves nothing behind. Elsewhere the file has a
temporary name. Files that belong together are written to a hidden folder next to their final places. Writers lock
such a file or folder, so that the next run can recognise and remove the remains of killed writers.
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
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, BinaryIO

from .addresses import Address, Place
from .errors import FormatError, OutputError, reason_of
from .stdio import DASH, write_stdout
from .units import format_size

try:
    import fcntl
except ImportError:  # Windows, where a file that is open cannot be removed by others
    fcntl = None  # type: ignore[assignment]

#: Names of files, as paths within the folder of an output ("0_0/meta.json"), and their contents.
Files = Iterable[tuple[str, Iterable[bytes]]]


@dataclass(frozen=True)
class Siblings:
    """Names of the files that a format writes in addition to the first file of an output: chunks, images, or folders.

    Attributes:
        is_member: returns whether a sibling may have this name ("0_0/meta.json").
        is_folder: returns whether a folder of siblings may have this name; None if they share the first file's folder.
        first_folder: the folder that every output has.
        named: yields the names of all siblings from an existing first file and from siblings; raises `OSError` or
            `FormatError` if a file cannot be read. None if all files with such names are siblings.
    """

    is_member: Callable[[str], bool]
    is_folder: Callable[[str], bool] | None = None
    first_folder: str = ""
    named: Callable[[Place], Iterable[str]] | None = None

    def existing(self, target: Place) -> list[str]:
        """Return the names of existing files that could be siblings of a first file, whether it names them or not.

        Raises:
            OutputError: the service of an address does not list files.
        """
        found = list[str]()
        if isinstance(target, Address):
            try:
                found = target.parent.files()
            except OSError as error:
                raise OutputError(f"cannot list {target.parent}: {reason_of(error)}") from None
        else:
            with contextlib.suppress(OSError):
                for each in target.parent.iterdir():
                    if self.is_folder is None:
                        found.append(each.name)
                    elif self.is_folder(each.name) and each.is_dir() and not each.is_symlink():
                        found += [f"{each.name}/{file.name}" for file in each.iterdir()]
        return sorted(filter(self.is_member, found), key=lambda name: (len(name), name))

    def former(self, target: Place, existing: list[str]) -> list[str]:
        """Return those of the `existing` files that belong to a former output, which an overwrite replaces."""
        if self.named is None:
            return existing
        names, known = dict[str, None](), set(existing)
        with contextlib.suppress(OSError, FormatError):  # names that were read before the error are valid
            for name in self.named(target):
                names[name] = None
        return [name for name in names if name in known]


class Output(contextlib.AbstractContextManager["Output"]):
    """Output whose files appear at the end of the context, all or none; it is checked at once, before any work.

    With `overwrite`, existing files are replaced, and surplus files of a former output are removed. An error or an
    interrupt leaves the former files; `publish` describes the effect of a kill. At an address, files are sent one by
    one: the former first file is removed first, the new one must be written last, and an error removes the sent files.

    Args:
        place: path or address of the first file; a symbolic link is followed. - is standard output. A pipe or a device
            is never replaced.
        siblings: names of its siblings; None for an output of one file.
        may_end: the reader of standard output may close it early, see `write_stdout`.

    Raises:
        OutputError: the place cannot be written, see `check_writable`, or cannot take several files; siblings exist, or
            another folder has their name.
    """

    def __init__(
        self, place: Place, *, overwrite: bool, siblings: Siblings | None = None, may_end: bool = False
    ) -> None:
        self.place, self.siblings = place, siblings
        #: The place with symbolic links followed.
        self.target = place if isinstance(place, Address) or place == DASH else Path(os.path.realpath(place))
        self._overwrite, self._may_end = overwrite, may_end
        self._stack = contextlib.ExitStack()
        self._written, self._former = dict[str, None](), list[str]()
        self._ours = {""}  # folders that may hold files
        self._stage: Path | None = None
        self._new: NewFile | None = None
        self._file: BinaryIO | None = None
        if siblings is not None:
            self._check_together(siblings)
        elif place != DASH:
            check_writable(place, overwrite=overwrite)

    def write(self, name: str, pieces: Iterable[bytes]) -> int:
        """Write a file and return its size in bytes; without siblings, all calls write to the same file.

        Args:
            name: path in the folder of the output; a name that no sibling may have means the first file.
        """
        if self.place == DASH:
            return write_stdout(pieces, may_end=self._may_end)
        if self.siblings is None:
            if self._file is None:
                if isinstance(self.target, Address):
                    import tempfile  # as every command loads this module

                    temporary: Any = tempfile.NamedTemporaryFile(prefix="sparklod-")  # noqa: SIM115
                    self._file = self._stack.enter_context(temporary)
                elif isinstance(self.place, Path) and _is_no_file(self.place):
                    self._file = self._stack.enter_context(self.place.open("wb"))
                else:
                    self._stack.enter_context(created(self.target.parent))
                    self._new = NewFile(self.target, overwrite=self._overwrite)
                    self._stack.enter_context(contextlib.closing(self._new))
                    self._file = self._new.file
            return sum(map(self._file.write, pieces))
        if not self._written:
            self._find_former(self.siblings)
            if isinstance(self.target, Address):
                check_writable(self.target, overwrite=self._overwrite)
                self.target.unlink(missing_ok=True)
            else:
                self._stack.enter_context(created(self.target.parent))
                self._stage = self._stack.enter_context(staged(self.target.parent))
        name = name if self.siblings.is_member(name) else self.target.name
        self._check_folder(name.rpartition("/")[0])
        self._written[name] = None
        if isinstance(self.target, Address):
            return (self.target.parent / name).write(pieces)
        assert self._stage is not None
        path = self._stage / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            size = sum(map(file.write, pieces))
            file.flush()
            os.fsync(file.fileno())
        return size

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            with self._stack:
                if error is not None:
                    raise error
                if self._new is not None:
                    self._new.publish()
                elif self._stage is not None:
                    publish(self._stage, self._written, self.target.name, self._overwrite, self._former)
                elif isinstance(self.target, Address) and self._file is not None:
                    check_writable(self.target, overwrite=self._overwrite)
                    self._file.flush()
                    self.target.send(self._file.name)
                elif isinstance(self.target, Address) and self._written:
                    for name in self._former:
                        if name not in self._written:
                            (self.target.parent / name).unlink(missing_ok=True)
        except BaseException as failure:
            if isinstance(self.target, Address):
                for name in reversed(self._written):
                    with contextlib.suppress(OSError):
                        (self.target.parent / name).unlink(missing_ok=True)
            if failure is error and (self.place == DASH or not isinstance(error, OSError)):
                return
            if not isinstance(failure, OSError):
                raise
            if isinstance(failure, FileExistsError):
                taken = failure.filename2 or failure.filename
                raise _taken(Path(taken) if self.siblings is not None and taken else self.place) from None
            raise OutputError(f"cannot write {self.place}: {reason_of(failure)}") from None

    def _check_together(self, siblings: Siblings) -> None:
        if self.place == DASH:
            raise OutputError("standard output cannot take several files; name a file")
        check_writable(self.place, overwrite=self._overwrite)
        is_remote = isinstance(self.target, Address)
        if isinstance(self.place, Path) and _is_no_file(self.place):
            raise OutputError(f"{self.place} is a pipe or a device, which cannot take several files; name a file")
        if is_remote and self._overwrite and siblings.is_folder is None:
            return
        existing = self._find_former(siblings)
        if siblings.is_folder is not None:
            self._check_folder(siblings.first_folder)
            for name in existing if is_remote else ():
                self._check_folder(name.rpartition("/")[0])  # in advance, as nothing can be undone at an address
        else:
            for name in existing:
                place = self.target.parent / name
                if not self._overwrite or (isinstance(place, Path) and _is_no_file(place)):
                    raise _taken(place)

    def _find_former(self, siblings: Siblings) -> list[str]:
        """Find the files of a former output; return all existing files that have names of siblings."""
        existing = siblings.existing(self.target)
        self._former = siblings.former(self.target, existing)
        self._ours = {"", *(name.rpartition("/")[0] for name in self._former)}
        return existing

    def _check_folder(self, folder: str) -> None:
        """Raise `OutputError` if a folder has files and is not part of the former output."""
        if folder in self._ours:
            return
        place = self.target.parent / folder
        try:
            if isinstance(place, Address):
                in_the_way = bool(place.files())
            else:
                in_the_way = os.path.lexists(place) and (
                    place.is_symlink() or not place.is_dir() or any(place.iterdir())
                )
        except OSError as error:
            raise OutputError(f"cannot write {place}: {reason_of(error)}") from None
        if in_the_way:
            raise OutputError(
                f"{place} exists, and {self.target.name} there does not name it; move it away, or name another output"
            )
        self._ours.add(folder)


def write_file(place: Place, pieces: Iterable[bytes], *, overwrite: bool, may_end: bool = False) -> int:
    """Write an `Output` of one file; return its size in bytes."""
    with Output(place, overwrite=overwrite, may_end=may_end) as out:
        return out.write(place.name, pieces)


def check_writable(place: Place, *, overwrite: bool, tried: bool = True) -> None:
    """Raise `OutputError` if a file cannot be written: its name is taken, or permission or room is missing.

    The service of an address has to answer; permission is not tried there, as others would see the file.

    Args:
        tried: try permission and room with a temporary file, see `try_place`.
    """
    try:
        if isinstance(place, Address):
            if place.is_read_only:
                raise OutputError(
                    f"cannot write {place}: {place.scheme}:// is for reading; write a file and upload that"
                )
        elif place.is_dir():
            raise OutputError(f"{place} is a directory")
        if place.is_file() and not overwrite:
            raise _taken(place)
        if tried and isinstance(place, Path):
            if not _is_no_file(place):
                try_place(place)
            elif not os.access(place, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise OutputError(f"cannot write {place}: {reason_of(error)}") from None


def try_place(path: Path, *, least: int = 0) -> None:
    """Raise `OutputError` if a file or a folder of at least `least` bytes cannot be written or replaced.

    A temporary file tries permission and room in its folder, or in the nearest existing folder above.
    """
    try:
        target = Path(os.path.realpath(path))
        nearest = next(folder for folder in target.parents if os.path.lexists(folder))
        if not nearest.is_dir():
            raise OutputError(f"cannot write {path}: {nearest} is a file, not a folder")
        for name in target.relative_to(nearest).parts:
            with contextlib.suppress(FileNotFoundError):
                (nearest / name).lstat()  # raises if the file system does not accept the name
        with contextlib.closing(NewFile(nearest / "tried", overwrite=False)) as new:
            new.file.write(bytes(4096))  # a block of most file systems: fewer bytes may fit into a full one
        if os.path.lexists(target):
            check_replaceable(target)
        free = shutil.disk_usage(nearest).free if least else 0
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None
    if least > free:
        raise OutputError(
            f"cannot write {path}: it takes {format_size(least)} or more, and {format_size(free)} are free there"
        )


def _taken(place: Place) -> OutputError:
    if isinstance(place, Path) and _is_no_file(place):
        return OutputError(f"{place} is not a file; move it away, or name another output")
    return OutputError(f"{place} exists, add --overwrite to replace it")


def _is_no_file(path: Path) -> bool:
    return path.exists() and not path.is_file()


HAS_LOCKS = fcntl is not None

#: Names of incomplete files, and of folders of several of them.
PARTS, STAGES = ".sparklod-{}.part", ".sparklod-{}.parts"

#: Folder inside the hidden one for the files that are replaced.
FORMER = "former"


def lock(descriptor: int, *, wait: bool = True) -> bool:
    """Lock a file or folder until it is closed or this process ends; return True, also on systems without locks.

    Without `wait`, return False if another process has locked it.
    """
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            pass
    return True


@functools.lru_cache(256)
def sweep(folder: Path) -> None:
    """Remove the remains of killed writers from a folder: files and folders of this user that no process has locked.

    A folder is swept only once, as thousands of files may be written to it.
    """
    with contextlib.suppress(OSError):
        for path in [*folder.glob(PARTS.format("*")), *folder.glob(STAGES.format("*"))]:
            with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
                if fcntl is None:
                    if path.match(PARTS.format("*")):
                        path.unlink()
                    continue
                # The file may be read-only.
                descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
                stack.callback(os.close, descriptor)
                status = os.fstat(descriptor)
                # Folders are removed with all of their files, so their names must match exactly.
                is_stage = stat.S_ISDIR(status.st_mode) and re.fullmatch(r"\.sparklod-[0-9a-f]{16}\.parts", path.name)
                if (is_stage or stat.S_ISREG(status.st_mode)) and status.st_uid == os.geteuid():
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if is_stage:
                        shutil.rmtree(path)
                    else:
                        path.unlink()


#: Flag that opens an unnamed file in a folder; None on systems without such files.
UNNAMED: int | None = getattr(os, "O_TMPFILE", None)

#: Folder of open files by descriptor, from which an unnamed file is linked to its name.
OPEN_FILES = Path("/proc/self/fd")

#: For reading and writing bytes; not inherited by child processes.
_FLAGS = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)


def write_atomically(target: Path, pieces: Iterable[bytes | memoryview], *, overwrite: bool, sync: bool = True) -> int:
    """Write a file that appears only when it is complete; return its size in bytes.

    A new file gets the permissions that the umask allows. A replacement gets the permissions of the file it replaces,
    except set-user-id, set-group-id and sticky, and never has more while it is written.

    Args:
        target: path of the file; a symbolic link is replaced, not followed.
        sync: wait until it is on the disk. Otherwise a power failure may damage it, but not a kill.

    Raises:
        FileExistsError: the file exists, and `overwrite` is not set.
    """
    with contextlib.closing(NewFile(target, overwrite=overwrite)) as new:
        size = sum(map(new.file.write, pieces))
        new.publish(sync=sync)
    return size


class NewFile:
    """File that gets its name when `publish` is called; before, `close` removes it.

    Attributes:
        file: open for writing and reading.
        part: temporary path; None for an unnamed file.
    """

    def __init__(self, target: Path, *, overwrite: bool, unnamed: bool = True) -> None:
        sweep(target.parent)
        self._target, self._overwrite = target, overwrite
        self.part: Path | None = None
        mode = _replaced_mode(target, overwrite)
        mode = 0o666 if mode is None else mode & 0o600  # never more permissions than the complete file
        if unnamed and UNNAMED is not None and OPEN_FILES.exists():
            with contextlib.suppress(OSError):
                self.file = os.fdopen(os.open(target.parent, UNNAMED | os.O_RDWR | os.O_CLOEXEC, mode), "w+b")
                return
        while True:
            part = target.with_name(PARTS.format(secrets.token_hex(8)))
            descriptor = os.open(part, _FLAGS | os.O_CREAT | os.O_EXCL, mode)
            lock(descriptor)
            with contextlib.suppress(FileNotFoundError):  # another process removed it before it was locked
                if os.path.samestat(os.fstat(descriptor), part.stat()):
                    self.part, self.file = part, os.fdopen(descriptor, "w+b")
                    return
            os.close(descriptor)

    def publish(self, *, sync: bool = True) -> None:
        """Give the complete file its name; raise `FileExistsError` if it is taken and `overwrite` is not set."""
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
        target.parent.mkdir(parents=True, exist_ok=True)  # a failed run may have removed the empty folder
        # The only effect of src_dir_fd is that Python follows the symbolic link in /proc.
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
            temporary = target.with_name(PARTS.format(secrets.token_hex(8)))
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
                shutil.copyfileobj(self.file, copy.file)
                copy.publish()

    def close(self) -> None:
        """Close the file; remove it unless it was published."""
        try:
            self.file.close()
        finally:
            if self.part is not None:
                self.part.unlink(missing_ok=True)


def check_replaceable(path: Path) -> None:
    """Raise `OSError` if a file or folder cannot be replaced although its folder can be written.

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
        except OSError as error:  # a read-only file may be replaced
            if error.errno == errno.EPERM:
                raise


def _replaced_mode(target: Path, overwrite: bool) -> int | None:
    """Return the permissions of the file that is replaced; None for a new file."""
    try:
        return stat.S_IMODE(target.stat().st_mode) & 0o777 if overwrite else None
    except FileNotFoundError:
        return None


def rename(temporary: Path, target: Path, overwrite: bool) -> None:
    """Rename a complete file; raise `FileExistsError` if the name is taken and `overwrite` is not set."""
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
    """Create a folder and its parents; at the end of the context, remove those of them that are empty."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        _remove_empty(reversed(new))


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Create a hidden, locked folder for files that belong together; it is removed at the end of the context."""
    sweep(folder)
    descriptor: int | None = None
    while True:
        stage = folder / STAGES.format(secrets.token_hex(8))
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


def publish(stage: Path, names: Collection[str], header: str, overwrite: bool, outdated: Iterable[str]) -> None:
    """Move files from a hidden folder to the folder around it: all of them, or none.

    The former header is moved away before any other file is touched, and the new one comes last: for some
    milliseconds there is none. An error or an interrupt at any time leaves the former files; a kill within these
    milliseconds leaves new files without a header. Folders that become empty are removed; other files in them are
    not touched. Permissions are those of `write_atomically`.

    Args:
        names: all files in the hidden folder.
        header: the file that readers open first.
        outdated: existing files to be removed if `overwrite` is set.

    Raises:
        FileExistsError: a file exists and `overwrite` is not set, or a folder's name belongs to something else, such as
            a link. The error has the path.
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
    """Return the folders that hold these files, outermost first."""
    found = {str(parent) for name in names for parent in PurePosixPath(name).parents if parent.name}
    return sorted(found, key=lambda folder: (folder.count("/"), folder))


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove the empty folders among these, which are listed outermost first."""
    for folder in reversed(list(folders)):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _put_aside(stage: Path, name: str) -> None:
    """Move a file that is replaced into the hidden folder; give its permissions to the new one."""
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
    """Remove new files from their final places and move former files back; the header, the last name, comes last.

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
