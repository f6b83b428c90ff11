"""Outputs: a file, a file and its siblings, standard output, a device or an address. All files appear, or none."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from . import atomic
from .addresses import Address, Place
from .errors import FormatError, OutputError, reason_of
from .stdio import DASH, write_stdout
from .units import format_size

#: Names of files, as paths within the folder of an output ("0_0/meta.json"), and their contents.
Files = Iterable[tuple[str, Iterable[bytes]]]


#: Bytes written to try a folder, a block of most file systems: less may fit into a full one.
_TRIED_BYTES = 4096


@dataclass(frozen=True)
class Siblings:
    """Names of the files that a format writes beside the first file of an output: chunks, images, or folders of them.

    Attributes:
        is_member: whether a name ("0_0/meta.json") is one of them.
        is_folder: whether a name is one of their folders; None where they are in the folder of the first file.
        first_folder: the folder that every output has.
        named: reads all names in an existing first file and in the files that it names; raises `OSError` or
            `FormatError` if it cannot be read. None: every file of such a name belongs to it.
    """

    is_member: Callable[[str], bool]
    is_folder: Callable[[str], bool] | None = None
    first_folder: str = ""
    named: Callable[[Place], Iterable[str]] | None = None

    def existing(self, target: Place) -> list[str]:
        """Return the names of the files beside a first file that could be its siblings, whether it names them or not.

        Raises:
            OutputError: the service does not list the files at an address.
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
        """Return the `existing` files that belong to a former output, which an overwrite removes or replaces."""
        if self.named is None:
            return existing
        names, known = dict[str, None](), set(existing)
        with contextlib.suppress(OSError, FormatError):  # the names that were read before the error count
            for name in self.named(target):
                names[name] = None
        return [name for name in names if name in known]


class Output(contextlib.AbstractContextManager["Output"]):
    """An output, tried when it is made, before any work; its files appear at the end of the context, all or none.

    With `overwrite`, existing files are replaced, and files of a former output without a successor are removed. An
    error or an interrupt leaves the former files. See `atomic.publish` for a kill. At an address, files are sent one by
    one: the former first file is removed first, the new one must be written last, and an error removes the sent files.

    Args:
        place: of the file, or of the first file; a symbolic link is followed. - is standard output. A pipe or a device
            is never replaced.
        siblings: names of the files beside the first one; None for an output of one file.
        may_end: the reader of standard output may close it early, see `write_stdout`.

    Raises:
        OutputError: it cannot be written, see `check_writable`; or it cannot take several files, siblings exist, or
            another folder is in their way.
    """

    def __init__(
        self, place: Place, *, overwrite: bool, siblings: Siblings | None = None, may_end: bool = False
    ) -> None:
        self.place, self.siblings = place, siblings
        self.target = real_target(place)
        self._overwrite, self._may_end = overwrite, may_end
        self._stack = contextlib.ExitStack()
        self._written, self._former = dict[str, None](), list[str]()
        self._ours = {""}  # folders that may hold files
        self._stage: Path | None = None
        self._new: atomic.NewFile | None = None
        self._file: BinaryIO | None = None
        if siblings is not None:
            self._check_together(siblings)
        elif place != DASH:
            check_writable(place, overwrite=overwrite)

    def write(self, name: str, pieces: Iterable[bytes]) -> int:
        """Write a file and return its size in bytes; further calls continue the file of an output of one.

        Args:
            name: in the folder of the output; the name of no sibling means the first file.
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
                    self._stack.enter_context(atomic.created(self.target.parent))
                    self._new = atomic.NewFile(self.target, overwrite=self._overwrite)
                    self._stack.enter_context(contextlib.closing(self._new))
                    self._file = self._new.file
            return sum(map(self._file.write, pieces))
        if not self._written:
            self._find_former(self.siblings)
            if isinstance(self.target, Address):
                check_free(self.target, overwrite=self._overwrite)
                self.target.unlink(missing_ok=True)
            else:
                self._stack.enter_context(atomic.created(self.target.parent))
                self._stage = self._stack.enter_context(atomic.staged(self.target.parent))
        name = name if self.siblings.is_member(name) else self.target.name
        self._check_folder(name.rpartition("/")[0])
        self._written[name] = None
        if isinstance(self.target, Address):
            return (self.target.parent / name).write(pieces)
        assert self._stage is not None
        return atomic.add(self._stage, name, pieces)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            with self._stack:
                if error is not None:
                    raise error
                self._publish()
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

    def _publish(self) -> None:
        if self._new is not None:
            self._new.publish()
        elif isinstance(self.target, Address) and self._file is not None:
            check_free(self.target, overwrite=self._overwrite)
            self._file.flush()
            self.target.send(self._file.name)
        elif isinstance(self.target, Address):
            for name in self._former if self._written else ():
                if name not in self._written:
                    (self.target.parent / name).unlink(missing_ok=True)
        elif self._stage is not None:
            header, overwrite = self.target.name, self._overwrite
            atomic.publish(self._stage, self._written, header, overwrite=overwrite, outdated=self._former)

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
                self._check_folder(name.rpartition("/")[0])  # all of them now: nothing can be undone there later
        else:
            for name in existing:
                place = self.target.parent / name
                if not self._overwrite or (isinstance(place, Path) and _is_no_file(place)):
                    raise _taken(place)

    def _find_former(self, siblings: Siblings) -> list[str]:
        """Find the files of a former output, and return all files there that have names of siblings."""
        existing = siblings.existing(self.target)
        self._former = siblings.former(self.target, existing)
        self._ours = {"", *(name.rpartition("/")[0] for name in self._former)}
        return existing

    def _check_folder(self, folder: str) -> None:
        """Raise `OutputError` if a folder is neither empty nor of the former output."""
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
    """Write an output of one file, see `Output`, and return its size in bytes."""
    with Output(place, overwrite=overwrite, may_end=may_end) as out:
        return out.write(place.name, pieces)


def real_target(place: Place) -> Place:
    """Return the place of an output, with symbolic links followed."""
    return place if isinstance(place, Address) or place == DASH else Path(os.path.realpath(place))


def check_writable(place: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` if a file cannot be written.

    At an address, its service has to answer; permission to write is not tried, as others would see the file.
    """
    check_free(place, overwrite=overwrite)
    if isinstance(place, Path) and not _is_no_file(place):
        try_place(place)
    elif isinstance(place, Path) and not os.access(place, os.W_OK):
        raise OutputError(f"cannot write {place}: {os.strerror(errno.EACCES).lower()}")


def check_free(place: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` if a folder or an existing file is in the way, or the name is impossible."""
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
        if isinstance(place, Path) and not _is_no_file(place):
            _nearest_folder(place)
    except OSError as error:
        raise OutputError(f"cannot write {place}: {reason_of(error)}") from None


def try_place(path: Path, *, least: int = 0) -> None:
    """Raise `OutputError` if a file or a folder, of at least `least` bytes, cannot be written or replaced.

    Permission and room are tried by a temporary file in its folder, or in the nearest existing folder on the way to it.
    """
    try:
        target, nearest = Path(os.path.realpath(path)), _nearest_folder(path)
        for name in target.relative_to(nearest).parts:
            with contextlib.suppress(FileNotFoundError):
                (nearest / name).lstat()  # raises where the file system takes no such name
        with contextlib.closing(atomic.NewFile(nearest / "tried", overwrite=False)) as new:
            new.file.write(bytes(_TRIED_BYTES))
        if os.path.lexists(target):
            atomic.check_replaceable(target)
        free = shutil.disk_usage(nearest).free if least else 0
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None
    if least > free:
        raise OutputError(
            f"cannot write {path}: it takes {format_size(least)} or more, and {format_size(free)} are free there"
        )


def _nearest_folder(path: Path) -> Path:
    """Return the nearest existing folder on the way to a file; raise `OutputError` if that is a file."""
    nearest = next(folder for folder in Path(os.path.realpath(path)).parents if os.path.lexists(folder))
    if not nearest.is_dir():
        raise OutputError(f"cannot write {path}: {nearest} is a file, not a folder")
    return nearest


def _taken(place: Place) -> OutputError:
    if isinstance(place, Path) and _is_no_file(place):
        return OutputError(f"{place} is not a file; move it away, or name another output")
    return OutputError(f"{place} exists, add --overwrite to replace it")


def _is_no_file(path: Path) -> bool:
    return path.exists() and not path.is_file()
