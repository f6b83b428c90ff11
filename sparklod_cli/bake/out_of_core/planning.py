"""The decision whether a bake goes out of core, and its workspace there: a scratch folder, blocks and an engine."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from ...codecs.reader import Reader
from ...io.reading import Source, absolute_source, open_reader
from ...system.addresses import Place, absolute
from ...system.errors import OutOfMemoryError, ScratchError
from ...system.progress import Progress
from ...system.stdio import name_of
from ...system.units import count_of, format_size
from .. import estimate
from ..identity import BakeIdentity
from ..records import Clock
from ..settings import BakeSettings, Resources
from ..tree_output import BakeOutput
from .in_blocks import InBlocks
from .job import Engine, Job, LocalEngine
from .scratch_folder import at_work
from .store import Store

#: Folder in the scratch folder for the unpacked input.
UNPACKED = "input"


@contextlib.contextmanager
def blocks_for(
    source: Source,
    settings: BakeSettings,
    output: BakeOutput,
    clock: Clock,
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
    """Open the workspace of a bake that goes out of core, if that is needed or requested; None for one in memory.

    Args:
        header: of the input, without a tree.
        folder: scratch folder. Results of an interrupted bake are refused or removed, also by a bake in memory.

    Raises:
        ScratchError: the scratch folder cannot be used, or has too little room.
        FormatError, OutOfMemoryError: as `flow.bake`.
    """
    name = name_of(source)
    if settings.files:
        BakeIdentity.of(source, settings)  # reports a missing one before the bake begins
    memory = estimate.default_memory() if resources.memory is None else resources.memory
    store = Store(folder if engine is None else absolute(folder))  # other processes have working folders of their own
    is_left = bool(store.names())
    why = _reason(header, settings, resources, memory, engine, is_left=is_left)
    whole = _needs_whole_tree(settings)
    if why is not None and whole is not None:
        say(f"{name}: goes on in memory, although {why}: {whole}")
    if why is None or whole is not None:
        if is_left:
            with at_work(
                store, BakeIdentity.of(source, settings), 0, resume=resources.resume, overwrite=overwrite, say=say
            ):
                pass
        yield None
        return
    splats, degree = header.count, min(header.sh_degree, settings.max_sh)
    block_splats = resources.block_splats or estimate.block_splats_within(
        memory, settings.method, splats, degree, in_chunks=output.in_chunks, threads=threads
    )
    scratch = estimate.scratch_bytes(settings.method, splats, degree)
    _check_room(store.folder, scratch)
    say(
        f"{name}: goes out of core, as {why}; {count_of(splats, 'splat')} in blocks of up to"
        f" {block_splats:,}, scratch of about {format_size(scratch)} in {store}"
    )
    identity = BakeIdentity.of(source, settings)
    with (
        at_work(store, identity, block_splats, resume=resources.resume, overwrite=overwrite, say=say) as block_splats,
        _opened(source, store.folder, threads, engine) as stream,
    ):
        settings = dataclasses.replace(settings, rgba=settings.rgba and settings.rgba.absolute())
        job = Job(store, stream, settings, output.needed, output.in_chunks)
        windows = estimate.windows_within(memory, splats, degree, threads)
        yield InBlocks(job, output, clock, engine or LocalEngine(threads), block_splats, windows, progress)


def _reason(
    header: Reader,
    settings: BakeSettings,
    resources: Resources,
    memory: int | None,
    engine: Engine | None,
    *,
    is_left: bool,
) -> str | None:
    """Return why a bake goes out of core, as the end of a sentence; None for one in memory.

    Raises:
        OutOfMemoryError: it would, but its output is made of a whole tree.
    """
    needed = estimate.in_memory_bytes_of(header, settings)
    if memory is not None and needed > memory:
        whole, refines = _needs_whole_tree(settings), settings.refine is not None
        if whole is not None:
            most = estimate.most_in_memory(memory, settings.method, header.sh_degree, refines=refines)
            raise OutOfMemoryError(
                f"{whole}, not in blocks: {count_of(header.count, 'splat')} would take about"
                f" {format_size(needed)} of memory, and {format_size(memory)} are enough for {most:,}; give --memory"
                f" {format_size(estimate.ENOUGH * needed)} or more if the machine has it, or fewer splats"
            )
        allowed = "may take" if resources.memory is None else "--memory gives it"
        return f"it would take about {format_size(needed)} of memory and {allowed} {format_size(memory)}"
    if engine is not None:
        return "a cluster was requested"
    if resources.resume and is_left:
        return "the interrupted bake did"
    return "blocks were requested" if resources.block_splats else None


def _needs_whole_tree(settings: BakeSettings) -> str | None:
    """Return why an output is made in memory only, as the end of a sentence; None if it can be made in blocks."""
    reasons = {
        "--encoding writes arrays as a whole": settings.encoding,
        "--refine fits a whole tree": settings.refine,
        "a simplified scene is a cut of a whole tree": settings.simplify,
        "tiles are made of a whole tree": settings.tiles,
        "detail levels are made of a whole tree": settings.detail,
    }
    return next((reason for reason, setting in reasons.items() if setting is not None), None)


def _check_room(folder: Place, needed: int) -> None:
    """Raise `ScratchError` if there is too little room for a scratch folder, which may already hold results."""
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
    """Open the input such that other processes can read it, whatever their working folders."""
    unpacked = folder.absolute() / UNPACKED if isinstance(folder, Path) else None
    with contextlib.ExitStack() as stack:
        if unpacked is None and engine is not None:
            from .cluster_engine import ClusterEngine

            if isinstance(engine, ClusterEngine):
                # The scratch folder is at an address, so each machine unpacks what it needs.
                unpacked = Path(tempfile.gettempdir()) / f"sparklod-{uuid.uuid4().hex}"
                stack.callback(engine.remove, unpacked)
        yield stack.enter_context(open_reader(absolute_source(source), scratch=unpacked, threads=threads))
