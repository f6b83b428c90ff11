"""Atomic writes of several files that belong together: all of them get their names, or none does.

They are filled and synced in a hidden folder beside their places, which is locked while its writer is alive, so that
the next run can recognise and remove what a killed one left behind. Only then do they get their names, the one that the
others mean nothing without last. Names may have folders, which are made then.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath

from . import atomic

#: The folder inside the hidden one for the files that are being replaced.
FORMER = "former"


def write(
    folder: Path,
    files: Iterable[tuple[str, Iterable[bytes]]],
    *,
    overwrite: bool,
    outdated: Callable[[Collection[str]], Iterable[str]] = lambda names: (),
) -> int:
    """Write files of one folder, and of folders there, that appear together; return their size in bytes.

    The last file is the one that readers open first. Where files are replaced, that one is taken away before any other
    is touched, and is the last to get its name: for that time, some milliseconds, there is none. An error or an
    interrupt at any time leaves the former files; a kill within these milliseconds leaves new ones without the last.
    A folder that a removed file leaves empty is removed, too, and other files in it are not touched.

    Permissions are those of `atomic.write`.

    Args:
        folder: of all files.
        files: the name of each, with the folders that it is in there ("0_0/means_l.webp"), and its content in order.
        outdated: given the names of the files, those of existing files that are removed where `overwrite` is set.

    Raises:
        FileExistsError: a file exists, and `overwrite` is not set; or what is to be a folder is something else, such as
            a link. It has the path.
        OSError: the file system reported an error.
    """
    atomic.sweep(folder)
    with _stage(folder) as stage:
        size, names = 0, list[str]()
        for name, pieces in files:
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            with (stage / name).open("xb") as file:
                size += atomic.fill(file, pieces)
            names.append(name)
        folders = _folders_of(names)
        new = [each for each in folders if not os.path.lexists(folder / each)]
        try:
            _refuse_no_folders(folder / each for each in folders)
            gone = list[str]()
            if overwrite:
                gone = list(outdated(names))
                (stage / FORMER).mkdir()
                _put_aside(stage, [*names[-1:], *names[:-1], *gone])
            else:
                _refuse_existing(folder / name for name in names)
            for each in folders:
                (folder / each).mkdir(exist_ok=True)
            for name in names:
                atomic.rename(stage / name, folder / name, overwrite)
            _remove_empty(folder / each for each in _folders_of(gone))
        except BaseException:
            _undo(stage, names)
            _remove_empty(folder / each for each in new)
            raise
    return size


def _folders_of(names: Iterable[str]) -> list[str]:
    """Return the folders that files are in, by their names, those first that others are in."""
    found = {str(parent) for name in names for parent in PurePosixPath(name).parents if parent.name}
    return sorted(found, key=lambda folder: (folder.count("/"), folder))


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that have nothing in them."""
    for folder in reversed(list(folders)):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _refuse_no_folders(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise FileExistsError(errno.EEXIST, "is not a folder", str(path))


def _refuse_existing(paths: Iterable[Path]) -> None:
    for path in paths:
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _put_aside(stage: Path, names: Sequence[str]) -> None:
    """Move the files that will be replaced into the hidden folder; their permissions go over to the new ones."""
    for name in names:
        former, part = stage.parent / name, stage / name
        with contextlib.suppress(FileNotFoundError):
            mode = former.stat().st_mode
            if not stat.S_ISREG(mode):
                raise FileExistsError(errno.EEXIST, "is not a file", str(former))
            if part.exists():
                part.chmod(stat.S_IMODE(mode) & 0o777)
            (stage / FORMER / name).parent.mkdir(parents=True, exist_ok=True)
            former.rename(stage / FORMER / name)


def _undo(stage: Path, names: Sequence[str]) -> None:
    """Take the names away again that files have been given, and give former files theirs back, the last file last.

    What has been done is seen in the folders, so that an interrupt between two steps is undone, too.
    """
    for name in reversed(names):
        path, part = stage.parent / name, stage / name
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            if not part.exists() or path.samefile(part):
                path.unlink()
    former = stage / FORMER
    found = {path.relative_to(former).as_posix(): path for path in former.rglob("*") if not path.is_dir()}
    for name in sorted(found, key=lambda name: name in names[-1:]):
        target = stage.parent / name
        target.parent.mkdir(parents=True, exist_ok=True)
        found[name].replace(target)


@contextlib.contextmanager
def _stage(folder: Path) -> Iterator[Path]:
    """Return a new hidden folder, locked, which nobody else can look into; it is removed at the end."""
    stage, descriptor = _open_stage(folder)
    try:
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if descriptor is not None:
            os.close(descriptor)


def _open_stage(folder: Path) -> tuple[Path, int | None]:
    """Create a locked, hidden folder; its path, and the descriptor that holds the lock, None where there are none."""
    while True:
        stage = folder / atomic.unique(atomic.STAGES)
        stage.mkdir(0o700)
        if not atomic.HAS_LOCKS:
            return stage, None
        with contextlib.suppress(FileNotFoundError):  # another process removed it before it was locked
            descriptor = os.open(stage, os.O_RDONLY | os.O_CLOEXEC)
            atomic.lock(descriptor)
            if stage.exists():
                return stage, descriptor
            os.close(descriptor)
