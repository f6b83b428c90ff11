"""Decision to bake out of core, and the scratch folder with its lock, which holds the results meanwhile."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..codecs.reader import Reader
from ..io.reading import Source, absolute_source, open_reader
from ..system.addresses import Place, absolute
from ..system.errors import FormatError, InvalidSplatsError, OutOfMemoryError, ScratchError, UnreadableError, reason_of
from ..system.output import HAS_LOCKS, created, lock
from ..system.progress import Progress
from ..system.stdio import name_of
from ..system.threads import ordered_map
from ..system.units import count_of, format_size, megabytes
from ..system.untrusted import parse_json
from . import estimate
from .built_tree import BuiltTree
from .identity import BakeIdentity
from .in_blocks import InBlocks
from .job import Engine, Job, LocalEngine, forget
from .settings import Resources
from .store import Store

#: Folder in the scratch folder for the unpacked input.
UNPACKED = "input"


@contextlib.contextmanager
def blocks_for(
    source: Source,
    tree: BuiltTree,
    *,
    header: Reader,
    folder: Place,
    overwrite: bool,
    threads: int,
    progress: Progress,
    resources: Resources,
    engine: Engine | None,
    say: Callable[[str], None],
) -> Iterator[InBlocks | None]:
    """Prepare a bake that must or shall go out of core, and yield it; yield None for a bake in memory.

    Args:
        header: of the input, without a tree.
        folder: scratch folder. Results of an interrupted bake are refused or removed, also by a bake in memory.

    Raises:
        ScratchError: the scratch folder cannot be used, or has too little room.
        FormatError: as `flow.bake`.
        OutOfMemoryError: as `flow.bake`; or the output is made of a whole tree, which memory cannot hold.
    """
    name, settings = name_of(source), tree.settings
    identity = BakeIdentity.of(source, settings)  # reports a missing file before the bake begins
    memory = estimate.default_memory() if resources.memory is None else resources.memory
    store = Store(folder if engine is None else absolute(folder))  # other processes have working folders of their own
    is_left = bool(store.names())
    wholes = {
        "--refine fits a whole tree": settings.refine,
        "a simplified scene is a cut of a whole tree": settings.simplify,
        "tiles are made of a whole tree": settings.tiles,
        "detail levels are made of a whole tree": settings.detail,
    }
    whole = next((reason for reason, setting in wholes.items() if setting is not None), None)
    why = None  # the bake goes out of core
    needed = estimate.in_memory_bytes(settings, header.count, header.sh_degree)
    if memory is not None and needed > memory:
        if whole is not None:
            most = estimate.most_in_memory(memory, settings, header.sh_degree)
            raise OutOfMemoryError(
                f"{whole}, not in blocks: {count_of(header.count, 'splat')} would take about"
                f" {format_size(needed)} of memory, and {format_size(memory)} are enough for {most:,}; give --memory"
                f" {megabytes(estimate.ENOUGH * needed)} or more if the machine has it, or fewer splats"
            )
        allowed = "may take" if resources.memory is None else "--memory gives it"
        why = f"it would take about {format_size(needed)} of memory and {allowed} {format_size(memory)}"
    elif engine is not None:
        why = "a cluster was requested"
    elif resources.resume and is_left:
        why = "the interrupted bake did"
    elif resources.block_splats:
        why = "blocks were requested"
    work = functools.partial(at_work, store, identity, resume=resources.resume, overwrite=overwrite, say=say)
    if why is not None and whole is not None:
        say(f"{name}: goes on in memory, although {why}: {whole}")
    if why is None or whole is not None:
        if is_left:
            with work(0):
                pass
        yield None
        return
    splats, degree = header.count, min(header.sh_degree, settings.max_sh)
    block_splats = resources.block_splats or estimate.block_splats_within(
        memory, settings.method, splats, degree, in_chunks=tree.in_chunks, threads=threads
    )
    scratch = estimate.scratch_bytes(settings.method, splats, degree)
    _check_room(store.folder, scratch)
    say(
        f"{name}: goes out of core, as {why}; {count_of(splats, 'splat')} in blocks of up to"
        f" {block_splats:,}, scratch of about {format_size(scratch)} in {store}"
    )
    with work(block_splats) as block_splats, _opened(source, store.folder, threads, engine) as stream:
        settings = dataclasses.replace(settings, rgba=settings.rgba and settings.rgba.absolute())
        assert tree.form is not None  # other outputs need the whole tree
        job = Job(store, stream, settings, tree.form.codec().needed(tree.options), tree.in_chunks)
        windows = estimate.windows_within(memory, splats, degree, threads)
        yield InBlocks(job, engine or LocalEngine(threads), block_splats, windows, progress)


def _check_room(folder: Place, needed: int) -> None:
    """Raise `ScratchError` if a scratch folder, which may already hold results, will not fit onto its disk."""
    if not isinstance(folder, Path):
        return
    nearest = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.is_dir())
    free = shutil.disk_usage(nearest).free
    held = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    if needed > free + held:
        raise ScratchError(
            f"{folder} will take about {format_size(needed)}, and {format_size(free)} are free there; free some, or"
            " choose another disk with --scratch-dir"
        )


@contextlib.contextmanager
def _opened(source: Source, folder: Place, threads: int, engine: Engine | None) -> Iterator[Reader]:
    """Open the input so that processes with other working folders can read it."""
    unpacked = folder.absolute() / UNPACKED if isinstance(folder, Path) else None
    with contextlib.ExitStack() as stack:
        if unpacked is None and engine is not None:
            from .cluster import ClusterEngine

            if isinstance(engine, ClusterEngine):
                # The scratch folder is at an address, so each machine unpacks what it needs.
                unpacked = Path(tempfile.gettempdir()) / f"sparklod-{uuid.uuid4().hex}"
                stack.callback(engine.remove, unpacked)
        yield stack.enter_context(open_reader(absolute_source(source), scratch=unpacked, threads=threads))


#: File that the running bake has locked; and the result, and its array, with the identity of the bake.
LOCK, MANIFEST = "lock", "manifest"

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
    """Lock a scratch folder for the tasks of a bake, and remove it at the end; yield the size of a block.

    The results stay after an interrupt, and after an error that another run may avoid. A resumed bake keeps its size of
    blocks. `overwrite` removes the results of an earlier bake, unless `resume` is set.

    Raises:
        ScratchError: another run uses the folder; there are results and neither `resume` nor `overwrite` is set, or
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
            if former is None:
                raise ScratchError(
                    f"{store} has no record of its bake's inputs and settings; begin anew with --overwrite, without"
                    " --resume"
                )
            if differences := identity.differences(former[0]):
                raise ScratchError(
                    f"{store} has the results of another bake: {'; '.join(differences)}. Begin anew with --overwrite,"
                    " without --resume"
                )
            sound = ordered_map(store.is_sound, names, 2)
            damaged = [name for name, is_sound in zip(names, sound, strict=True) if not is_sound]
            forget(store, damaged)
            lost = f"; {count_of(len(damaged), 'other')} that a failure damaged will be made again" if damaged else ""
            say(f"continues with {count_of(len(names) - len(damaged), 'result')} in {store}{lost}")
            block_splats = former[1]
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
    """Remove everything but the lock, and the manifest last, so that a killed run leaves no results without it."""
    folder = store.folder
    if isinstance(folder, Path):
        for path in sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != LOCK:
                path.unlink(missing_ok=True)
    for name in store.names():
        store.remove(name)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for one run; create it and its parents, and remove those at the end that are empty."""
    path = folder / LOCK
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(created(folder.parent))
            descriptor = _opened_lock(path)
        except OSError as error:
            raise ScratchError(
                f"cannot write in the scratch folder {folder}: {reason_of(error)}; choose another"
                " one with --scratch-dir"
            ) from None
        try:
            yield
        finally:
            if not HAS_LOCKS:  # Windows cannot remove an open file
                os.close(descriptor)
            with contextlib.suppress(OSError):
                if [*folder.iterdir()] == [path]:
                    path.unlink()
                    folder.rmdir()
            if HAS_LOCKS:
                os.close(descriptor)


def _opened_lock(path: Path) -> int:
    """Create and lock the file; raise `ScratchError` if another run has locked it, or other files fill the folder."""
    folder = path.parent
    with contextlib.suppress(FileNotFoundError):
        if not path.exists() and any(folder.iterdir()):
            raise ScratchError(f"{folder} is not a scratch folder; move it, or choose another --scratch-dir")
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
        is_free = lock(descriptor, wait=False)
        with contextlib.suppress(FileNotFoundError):  # the run that had locked it has ended and removed it
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                if is_free:
                    return descriptor
                os.close(descriptor)
                raise ScratchError(
                    f"another run is at work in {folder}; wait for it, or give this one another output or --scratch-dir"
                )
        os.close(descriptor)
