"""Whether a bake goes out of core, and what it gets there: a scratch folder, blocks and an engine."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..model.streams import SceneStream
from ..support.addresses import Place, absolute
from ..support.errors import FormatError, HasTreeError, OutOfMemoryError, ScratchError
from ..support.progress import Progress
from ..support.stdin import name_of
from ..support.units import count_of, format_size
from .out_of_core import estimate
from .out_of_core.contracts import Engine
from .out_of_core.manifest import at_work, scratch_folder
from .out_of_core.store import FileStore, store_of
from .output import Output
from .recipe import Recipe, files_named_in, recipe_of
from .resources import Resources
from .settings import BakeSettings
from .sources import Merged, Source, absolute_source, opened_source, placement_of, places_of

if TYPE_CHECKING:
    from .out_of_core.flow import BakedOutOfCore

#: The folder in the scratch folder for what is unpacked of an input.
UNPACKED = "input"


@dataclass(frozen=True)
class Scaled:
    """What was baked out of core.

    Attributes:
        baked: that.
        format, notes: of the input.
        read: splats of the input.
        sh_degree: of the output.
        scratch_bytes_written, scratch_bytes_read: of results in the scratch folder.
    """

    baked: BakedOutOfCore
    format: str
    notes: tuple[str, ...]
    read: int
    sh_degree: int
    scratch_bytes_written: int
    scratch_bytes_read: int


@dataclass(frozen=True)
class _Size:
    """What the header of an input says.

    Attributes:
        splats, sh_degree: of it.
    """

    splats: int
    sh_degree: int


def bake_scaled(
    source: Source,
    target: Place,
    settings: BakeSettings,
    output: Output,
    *,
    overwrite: bool,
    threads: int,
    progress: Progress,
    resources: Resources,
    engine: Engine | None,
    say: Callable[[str], None],
) -> Scaled | None:
    """Bakes out of core if that is needed or wanted; None where a bake in memory will do, or has to.

    Args:
        source, target, settings, overwrite, threads, progress, resources, engine, say: as for `bake`.
        output: of the bake.

    Raises:
        ScratchError: the scratch folder cannot be used, or has too little room.
        FormatError, InvalidSplatsError, OutputError, OutOfMemoryError: as `bake`.
    """
    size = _size_of(source)
    if size is None:
        return None
    memory = estimate.default_memory() if resources.memory is None else resources.memory
    # It reads samples of all inputs, and most bakes in memory need none.
    recipe = functools.lru_cache(1)(lambda: recipe_of(places_of(source), settings, **placement_of(source)))
    if files_named_in(settings):
        recipe()  # so that one that is missing is told of at once
    folder = scratch_folder(target, recipe, resources.scratch_dir)
    if engine is not None:
        folder = absolute(folder)  # other processes work in folders of their own
    store = store_of(folder)
    left = bool(store.names())
    why = _reason(size, settings, memory, resources, engine, is_left=left)
    whole = _as_a_whole(settings)
    if why is not None and whole is not None:
        say(f"{name_of(source)}: goes on in memory, although {why}: {whole}")
        why = None
    if why is None:
        if left:  # refused, or removed
            with _work(store, recipe(), 0, resources, overwrite, say):
                pass
        return None
    from .out_of_core.engine import LocalEngine  # what most bakes do without takes long to load
    from .out_of_core.flow import bake_out_of_core

    degree = min(size.sh_degree, settings.max_sh)
    block_splats = resources.block_splats or _block_splats(
        size.splats, degree, settings.method, memory, in_chunks=output.in_chunks, threads=threads
    )
    needed = estimate.scratch_bytes(settings.method, size.splats, degree)
    if isinstance(folder, Path):
        _check_room(folder, needed)
    say(
        f"{name_of(source)}: goes out of core, as {why}; {count_of(size.splats, 'splat')} in blocks of up to"
        f" {block_splats:,}, scratch of about {format_size(needed)} in {folder}"
    )
    with (
        _work(store, recipe(), block_splats, resources, overwrite, say) as block_splats,
        _opened(source, folder, threads, engine) as stream,
    ):
        baked = bake_out_of_core(
            stream,
            output,
            dataclasses.replace(settings, rgba=settings.rgba and settings.rgba.absolute()),
            store=store,
            engine=engine or LocalEngine(threads),
            block_splats=block_splats,
            threads=threads,
            progress=progress,
        )
        written, read = store.traffic.written, store.traffic.read
        return Scaled(baked, stream.format, stream.notes, stream.count, degree, written, read)


def has_published(source: Source, target: Place, settings: BakeSettings, resources: Resources) -> bool:
    """Return True if a bake resumes one that was interrupted when its output, or a part of it, may have been in place.

    Args:
        source, target, settings, resources: as for `bake`.
    """
    if not resources.resume:
        return False
    from .out_of_core.job import PUBLISHED

    recipe = functools.partial(recipe_of, places_of(source), settings, **placement_of(source))
    return store_of(scratch_folder(target, recipe, resources.scratch_dir)).has(PUBLISHED)


def fits_in_memory(source: Source, settings: BakeSettings, memory: int | None) -> bool:
    """Whether an input can be baked in so much memory; one that cannot be read fits, as whoever bakes it will say why.

    Args:
        source, settings: as for `bake`.
        memory: bytes; None for any number.
    """
    try:
        size = _size_of(source)
    except FormatError:
        return True
    if size is None or memory is None:
        return True
    return estimate.in_memory_bytes(settings.method, size.splats, size.sh_degree) <= memory


def _size_of(source: Source) -> _Size | None:
    """What the headers of an input say; None for a tree."""
    try:
        with opened_source(source) as stream:
            return _Size(stream.count, stream.sh_degree)
    except HasTreeError:
        if isinstance(source, Merged):
            raise
        return None


def _reason(
    size: _Size,
    settings: BakeSettings,
    memory: int | None,
    resources: Resources,
    engine: Engine | None,
    *,
    is_left: bool,
) -> str | None:
    """Why a bake goes out of core, as the end of a sentence; None if it does not."""
    needed = estimate.in_memory_bytes(settings.method, size.splats, size.sh_degree)
    if memory is not None and needed > memory:
        allowed = "may take" if resources.memory is None else "--memory gives it"
        return f"it would take about {format_size(needed)} of memory and {allowed} {format_size(memory)}"
    if engine is not None:
        return "a cluster was asked for"
    if resources.resume and is_left:
        return "it was interrupted there"
    return "blocks were asked for" if resources.block_splats else None


def _as_a_whole(settings: BakeSettings) -> str | None:
    """Why an output is made in memory only, as the end of a sentence; None where it need not be."""
    if settings.encoding is not None:
        return "--encoding writes arrays as a whole"
    if settings.refine is not None:
        return "--refine fits a whole tree"
    return None if settings.detail is None else "detail levels are made of a whole tree"


def _block_splats(
    splats: int, sh_degree: int, method: str, memory: int | None, *, in_chunks: bool, threads: int
) -> int:
    """The splats of a block; `OutOfMemoryError` where there is too little memory for the least ones."""
    found = estimate.block_splats_within(memory, method, splats, sh_degree, in_chunks=in_chunks, threads=threads)
    if found is None:
        least = estimate.out_of_core_bytes(
            method, splats, sh_degree, estimate.LEAST_BLOCK_SPLATS, in_chunks=in_chunks, threads=threads
        )
        raise OutOfMemoryError(
            f"{format_size(memory or 0)} of memory is too little even out of core; give --memory"
            f" {format_size(1.02 * least)} or more"
        )
    return found


def _check_room(folder: Path, needed: int) -> None:
    """Raises `ScratchError` where there is too little room for a scratch folder, which may have some of it already."""
    nearest = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.is_dir())
    free = shutil.disk_usage(nearest).free
    held = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    if needed > free + held:
        raise ScratchError(
            f"{folder} will take about {format_size(needed)}, and {format_size(free)} are free there; free some, or"
            " choose another disk with --scratch-dir"
        )


def _work(
    store: FileStore,
    recipe: Recipe,
    block_splats: int,
    resources: Resources,
    overwrite: bool,
    say: Callable[[str], None],
) -> contextlib.AbstractContextManager[int]:
    from .out_of_core.job import forget

    return at_work(store, recipe, block_splats, resume=resources.resume, overwrite=overwrite, forget=forget, say=say)


@contextlib.contextmanager
def _opened(source: Source, folder: Place, threads: int, engine: Engine | None) -> Iterator[SceneStream]:
    """The input, which the processes of an engine can open, too, whatever folders they work in."""
    from .out_of_core.cluster_engine import ClusterEngine

    if isinstance(folder, Path):
        with opened_source(absolute_source(source), scratch=folder.absolute() / UNPACKED, threads=threads) as stream:
            yield stream
    elif isinstance(engine, ClusterEngine):
        own = Path(tempfile.gettempdir()) / f"sparklod-{uuid.uuid4().hex}"  # each machine unpacks what it needs
        try:
            with opened_source(absolute_source(source), scratch=own, threads=threads) as stream:
                yield stream
        finally:
            engine.remove(own)
    else:
        with opened_source(source, threads=threads) as stream:
            yield stream
