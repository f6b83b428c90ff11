"""Whether a bake goes out of core, and what it gets there: a scratch folder, blocks and an engine."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ...codecs.reader import Reader
from ...system.addresses import Place, absolute
from ...system.errors import OutOfMemoryError, ScratchError
from ...system.progress import Progress
from ...system.stdio import name_of
from ...system.units import count_of, format_size
from .. import estimate
from ..identity import BakeIdentity
from ..output import BakeOutput
from ..records import Clock
from ..settings import BakeSettings, Resources
from ..sources import Source, absolute_source, open_source
from .job import Engine, Job, LocalEngine
from .scratch_folder import at_work
from .store import Store

if TYPE_CHECKING:
    from .in_blocks import InBlocks

#: The folder in the scratch folder for what is unpacked of an input.
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

    Raises:
        ScratchError: the scratch folder cannot be used, or has too little room.
        FormatError, OutOfMemoryError: as `flow.bake`.
    """
    memory = estimate.default_memory() if resources.memory is None else resources.memory
    if settings.files:
        BakeIdentity.of(source, settings)  # reports a missing one at once
    if engine is not None:
        folder = absolute(folder)  # other processes work in folders of their own
    store = Store(folder)
    is_left = bool(store.names())
    needed = estimate.in_memory_bytes_of(header, settings)
    whole, why = _as_a_whole(settings), None
    if memory is not None and needed > memory:
        if whole is not None:
            raise _too_large(header, settings, needed, memory, whole)
        allowed = "may take" if resources.memory is None else "--memory gives it"
        why = f"it would take about {format_size(needed)} of memory and {allowed} {format_size(memory)}"
    elif engine is not None:
        why = "a cluster was asked for"
    elif resources.resume and is_left:
        why = "it was interrupted there"
    elif resources.block_splats:
        why = "blocks were asked for"
    if why is not None and whole is not None:
        say(f"{name_of(source)}: goes on in memory, although {why}: {whole}")
        why = None
    work = functools.partial(at_work, store, resume=resources.resume, overwrite=overwrite, say=say)
    if why is None:
        if is_left:  # refused, or removed
            with work(BakeIdentity.of(source, settings), 0):
                pass
        yield None
        return
    from .in_blocks import InBlocks  # what most bakes do without takes long to load

    splats, degree = header.count, min(header.sh_degree, settings.max_sh)
    block_splats = resources.block_splats or estimate.block_splats_within(
        memory, settings.method, splats, degree, in_chunks=output.in_chunks, threads=threads
    )
    scratch = estimate.scratch_bytes(settings.method, splats, degree)
    if isinstance(folder, Path):
        _check_room(folder, scratch)
    say(
        f"{name_of(source)}: goes out of core, as {why}; {count_of(splats, 'splat')} in blocks of up to"
        f" {block_splats:,}, scratch of about {format_size(scratch)} in {folder}"
    )
    with (
        work(BakeIdentity.of(source, settings), block_splats) as block_splats,
        _opened(source, folder, threads, engine) as stream,
    ):
        settings = dataclasses.replace(settings, rgba=settings.rgba and settings.rgba.absolute())
        job = Job(store, stream, settings, output.needed, output.in_chunks)
        windows = estimate.windows_within(memory, splats, degree, threads)
        yield InBlocks(job, output, clock, engine or LocalEngine(threads), block_splats, windows, progress)


def _as_a_whole(settings: BakeSettings) -> str | None:
    """Return why an output is made in memory only, as the end of a sentence; None where it need not be."""
    if settings.encoding is not None:
        return "--encoding writes arrays as a whole"
    if settings.refine is not None:
        return "--refine fits a whole tree"
    if settings.simplify is not None:
        return "a simplified scene is a cut of a whole tree"
    if settings.tiles is not None:
        return "tiles are made of a whole tree"
    return None if settings.detail is None else "detail levels are made of a whole tree"


def _too_large(header: Reader, settings: BakeSettings, needed: int, memory: int, whole: str) -> OutOfMemoryError:
    """Return the error for a bake that cannot go out of core and needs more memory than it may take.

    Args:
        whole: of `_as_a_whole`.
    """
    refines = settings.refine is not None
    most = estimate.most_in_memory(memory, settings.method, header.sh_degree, refines=refines)
    return OutOfMemoryError(
        f"{whole}, not in blocks: {count_of(header.count, 'splat')} would take about"
        f" {format_size(needed)} of memory, and {format_size(memory)} are enough for {most:,}; give --memory"
        f" {format_size(estimate.ENOUGH * needed)} or more if the machine has it, or fewer splats"
    )


def _check_room(folder: Path, needed: int) -> None:
    """Raise `ScratchError` where there is too little room for a scratch folder, which may have some of it already."""
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
    """Open the input so that the processes of an engine can open it, too, whatever folders they work in."""
    from .cluster_engine import ClusterEngine

    if isinstance(folder, Path):
        with open_source(absolute_source(source), scratch=folder.absolute() / UNPACKED, threads=threads) as stream:
            yield stream
    elif isinstance(engine, ClusterEngine):
        own = Path(tempfile.gettempdir()) / f"sparklod-{uuid.uuid4().hex}"  # each machine unpacks what it needs
        try:
            with open_source(absolute_source(source), scratch=own, threads=threads) as stream:
                yield stream
        finally:
            engine.remove(own)
    else:
        with open_source(source, threads=threads) as stream:
            yield stream
