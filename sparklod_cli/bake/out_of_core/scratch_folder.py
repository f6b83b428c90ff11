"""The scratch folder of a bake: whose it is, whether a run is at work in it, and what becomes of it at the end."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...system import atomic
from ...system.errors import FormatError, InvalidSplatsError, ScratchError, UnreadableError
from ...system.threads import ordered_map
from ...system.units import count_of
from ...system.untrusted import parse_json
from ..fingerprint import Fingerprint
from .job import forget
from .store import Store

#: How the names of scratch folders end.
SUFFIX = ".sparklod-scratch"

#: The file that the run at work has locked.
LOCK = "lock"

#: Bytes of an output's name up to which that of its scratch folder has it.
NAME_BYTES = 200

#: The name of the result that has the fingerprint.
RECIPE = "recipe"

#: Version of what results have and are called; one that differs cannot be gone on with.
LAYOUT = 1

#: Errors that another run of the same fingerprint would meet again.
HOPELESS = (FormatError, InvalidSplatsError)


@dataclass(frozen=True)
class _Manifest:
    """Manifest that identifies the bake a store belongs to."""

    fingerprint: Fingerprint
    block_splats: int

    def put(self, store: Store) -> None:
        """Write it as a result."""
        text = np.frombuffer(self.fingerprint.to_json(), np.uint8)
        store.put(RECIPE, {"recipe": text, "numbers": np.array([LAYOUT, self.block_splats], np.int64)})

    @classmethod
    def get(cls, store: Store) -> _Manifest | None:
        """Return the one of a store; None where it has none that this version understands."""
        try:
            if not store.is_sound(RECIPE):
                return None
            found = store.get(RECIPE)
            layout, block_splats = found["numbers"].tolist()
            fingerprint = Fingerprint.from_record(parse_json(found["recipe"].tobytes()))
            return cls(fingerprint, block_splats) if layout == LAYOUT else None
        except (KeyError, ValueError):
            return None


@contextlib.contextmanager
def at_work(
    store: Store,
    fingerprint: Fingerprint,
    block_splats: int,
    *,
    resume: bool,
    overwrite: bool,
    say: Callable[[str], None],
) -> Iterator[int]:
    """Yield a context in which a bake puts its results into a store, which is empty at the end if all went well.

    After an error that another run need not meet, or an interrupt, the results stay.

    Args:
        block_splats: of the blocks that the scene is cut into, unless that was done before.
        overwrite: remove them, unless `resume` is set.
        say: told what was found, and what is left.

    Yields:
        the splats of a block: those of the run that began.

    Raises:
        ScratchError: a run is at work there; there are results and neither `resume` nor `overwrite` is set, or they are
            of another fingerprint; or the store cannot be written.
    """
    folder = _folder_of(store)
    with contextlib.nullcontext() if folder is None else locked(folder):  # an address cannot be locked
        former = _Manifest.get(store)
        names = [name for name in store.names() if name != RECIPE]
        if names and not resume and not overwrite:
            raise ScratchError(
                f"an interrupted bake left {store}; go on with it by --resume, or begin anew with --overwrite"
            )
        if names and resume:
            block_splats = _resumed(store, fingerprint, former, names, say)
        else:
            _clear(store)
            _Manifest(fingerprint, block_splats).put(store)
        try:
            yield block_splats
        except BaseException as error:
            hopeless = isinstance(error, HOPELESS) and not isinstance(error, UnreadableError)
            if hopeless or store.names() in ([], [RECIPE]):
                _clear(store)
            elif not isinstance(error, ScratchError):
                say(f"what is done stays in {store}; run it again with --resume to go on")
            raise
        _clear(store)


def _clear(store: Store) -> None:
    """Remove all that is there but the lock; last the files that tell what it is, for a run that is killed here."""
    folder = _folder_of(store)
    if folder is not None:
        for path in sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != LOCK:
                path.unlink(missing_ok=True)
    for name in store.names():
        store.remove(name)


def _resumed(
    store: Store,
    fingerprint: Fingerprint,
    former: _Manifest | None,
    names: list[str],
    say: Callable[[str], None],
) -> int:
    """Check that the results are those of the fingerprint, and remove damaged ones; return the splats of a block."""
    if former is None:
        raise ScratchError(
            f"nothing tells what the results in {store} are of; begin anew with --overwrite, without --resume"
        )
    differences = fingerprint.differences(former.fingerprint)
    if differences:
        raise ScratchError(
            f"{store} has the results of another bake: {'; '.join(differences)}. Begin anew with --overwrite, without"
            " --resume"
        )
    sound = ordered_map(store.is_sound, names, 2)
    damaged = [name for name, is_sound in zip(names, sound, strict=True) if not is_sound]
    if damaged:
        for name in damaged:
            store.remove(name)
        forget(store, damaged)
    lost = f"; {count_of(len(damaged), 'other')} that a failure damaged will be made again" if damaged else ""
    say(f"goes on with {count_of(len(names) - len(damaged), 'result')} in {store}{lost}")
    return former.block_splats


def _folder_of(store: Store) -> Path | None:
    """Return the folder of a store on this machine."""
    return store.folder if isinstance(store.folder, Path) else None


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for one run; it is made if need be, and removed if empty, as are its parents that were made.

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
    """Open and lock the file for that, in a folder that is ours; raises `ScratchError` where it is taken."""
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
    """Remove a folder that has nothing but the file that is locked."""
    with contextlib.suppress(OSError):
        if [*path.parent.iterdir()] == [path]:
            path.unlink()
            path.parent.rmdir()
