"""Scratch folder of a bake: ownership, locking and clean-up."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ...system import atomic
from ...system.errors import FormatError, InvalidSplatsError, ScratchError, UnreadableError, reason_of
from ...system.threads import ordered_map
from ...system.units import count_of
from ...system.untrusted import parse_json
from ..identity import BakeIdentity
from .job import forget
from .store import Store

#: File that the running bake has locked.
LOCK = "lock"

#: Result with the identity of the bake, and its one array.
MANIFEST = "manifest"

#: Version of the names and contents of results; a bake of another version cannot be resumed.
LAYOUT = 2

#: Errors that another run of the same bake would meet again.
HOPELESS = (FormatError, InvalidSplatsError)


@contextlib.contextmanager
def at_work(
    store: Store,
    identity: BakeIdentity,
    block_splats: int,
    *,
    resume: bool,
    overwrite: bool,
    say: Callable[[str], None],
) -> Iterator[int]:
    """Lock a scratch folder for the tasks of a bake, and remove the folder at the end.

    The results stay after an interrupt, and after an error that another run need not meet.

    Args:
        block_splats: size of a block, unless a resumed bake has another.
        overwrite: remove results of an earlier bake, unless `resume` is set.
        say: receives one-line messages for the user.

    Yields:
        size of a block; that of the bake that is resumed.

    Raises:
        ScratchError: another run is at work there; there are results and neither `resume` nor `overwrite` is set, or
            they belong to another bake; or the store cannot be written.
    """
    folder = store.folder
    with locked(folder) if isinstance(folder, Path) else contextlib.nullcontext():  # an address cannot be locked
        former = _read_manifest(store)
        names = [name for name in store.names() if name != MANIFEST]
        if names and not resume and not overwrite:
            raise ScratchError(
                f"an interrupted bake left {store}; continue it with --resume, or begin anew with --overwrite"
            )
        if names and resume:
            block_splats = _resume(store, identity, former, names, say)
        else:
            _clear(store)
            manifest = {"layout": LAYOUT, "block_splats": block_splats, "bake": dataclasses.asdict(identity)}
            store.put(MANIFEST, {MANIFEST: np.frombuffer(json.dumps(manifest).encode(), np.uint8)})
        try:
            yield block_splats
        except BaseException as error:
            hopeless = isinstance(error, HOPELESS) and not isinstance(error, UnreadableError)
            if hopeless or store.names() in ([], [MANIFEST]):
                _clear(store)
            elif not isinstance(error, ScratchError):
                say(f"finished work stays in {store}; run the command again with --resume to continue")
            raise
        _clear(store)


def _read_manifest(store: Store) -> tuple[BakeIdentity, int] | None:
    """Read the identity of the bake and the size of its blocks; None if missing or from another version."""
    try:
        if store.is_sound(MANIFEST):
            manifest = parse_json(store.get(MANIFEST)[MANIFEST].tobytes())
            if manifest["layout"] == LAYOUT:
                return BakeIdentity.from_record(manifest["bake"]), int(manifest["block_splats"])
    except (KeyError, TypeError, ValueError):
        pass
    return None


def _clear(store: Store) -> None:
    """Remove everything but the lock; the manifest last, for a run that is killed here."""
    folder = store.folder
    if isinstance(folder, Path):
        for path in sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != LOCK:
                path.unlink(missing_ok=True)
    for name in store.names():
        store.remove(name)


def _resume(
    store: Store,
    identity: BakeIdentity,
    former: tuple[BakeIdentity, int] | None,
    names: list[str],
    say: Callable[[str], None],
) -> int:
    """Check that the results belong to the bake, and remove damaged ones; return the size of a block."""
    if former is None:
        raise ScratchError(
            f"{store} has no record of its bake's inputs and settings; begin anew with --overwrite, without --resume"
        )
    if differences := identity.differences(former[0]):
        raise ScratchError(
            f"{store} has the results of another bake: {'; '.join(differences)}. Begin anew with --overwrite, without"
            " --resume"
        )
    sound = ordered_map(store.is_sound, names, 2)
    damaged = [name for name, is_sound in zip(names, sound, strict=True) if not is_sound]
    forget(store, damaged)
    lost = f"; {count_of(len(damaged), 'other')} that a failure damaged will be made again" if damaged else ""
    say(f"continues with {count_of(len(names) - len(damaged), 'result')} in {store}{lost}")
    return former[1]


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for one run; it and its parents are created if missing, and removed at the end if empty.

    Raises:
        ScratchError: another run is at work there, it is not a scratch folder, or it cannot be created.
    """
    path = folder / LOCK
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(atomic.created(folder.parent))
            descriptor = _opened_lock(path)
        except OSError as error:
            raise ScratchError(
                f"cannot write in the scratch folder {folder}: {reason_of(error)}; choose another"
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
    """Create and lock the file; raise `ScratchError` if another run has locked it, or the folder is not ours."""
    folder = path.parent
    with contextlib.suppress(FileNotFoundError):
        if not path.exists() and any(folder.iterdir()):
            raise ScratchError(f"{folder} is not a scratch folder; move it, or choose another --scratch-dir")
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
    """Remove a folder that holds only its lock."""
    with contextlib.suppress(OSError):
        if [*path.parent.iterdir()] == [path]:
            path.unlink()
            path.parent.rmdir()
