"""The flow of a bake, in memory and out of core: read, select, transform, build, refine, order, encode, write."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..codecs.formats import META, RAD_SUFFIX
from ..codecs.reader import Reader
from ..io.reading import Source, open_reader
from ..lod.tree_settings import METHODS
from ..model.scene import up_note
from ..system.addresses import Place
from ..system.errors import memory_errors_translated
from ..system.progress import Progress, silent
from ..system.stdio import DASH
from . import estimate
from .built_tree import build, output_of, put_in_order, write_whole, write_windows
from .settings import Baked, BakeSettings, Resources

if TYPE_CHECKING:
    from .job import Engine

#: Suffix of scratch folders.
SCRATCH = ".sparklod-scratch"

#: Longest output name, bytes, that the name of its scratch folder contains: file systems allow 255 in all.
NAME_BYTES = 200


def bake(
    source: Source,
    target: Place,
    settings: BakeSettings,
    *,
    overwrite: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    resources: Resources | None = None,
    engine: Engine | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Baked:
    """Read splat files, build a tree of them or keep that of a single input, and write a Level-of-Detail file.

    A scene too large for memory is baked out of core: block by block, with a scratch folder.

    Args:
        target: has the format of the settings, whatever its name; - is standard output.
        resources: None for the default ones.
        engine: runs the tasks of a bake, which then goes out of core; None for this process.
        say: receives one-line messages for the user.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `io.open_reader`, `Selection.check`, `reader.check_valid` and
            `system.output.Output`; or the input has a tree, and the settings do not keep it.
        ScratchError: the scratch folder is full, in use, or belongs to another bake.
        OutOfMemoryError: the scene does not fit into memory.
        CameraPathError: the training cameras cannot be read.
        KeyboardInterrupt: see `refined`.
    """
    with memory_errors_translated(), contextlib.ExitStack() as stack:
        resources, fitting, cameras, blocks = resources or Resources(), settings.refine, None, None
        overwrite = overwrite or (resources.resume and has_published(source, target, settings, resources))
        tree = output_of(target, settings, overwrite=overwrite)
        if settings.camera_path is not None:
            from ..cameras.camera_files import read_path

            path = read_path(settings.camera_path)
            fitting, cameras = fitting and dataclasses.replace(fitting, path=path), path.cameras
        opened = stack.enter_context(contextlib.ExitStack())
        reader = opened.enter_context(open_reader(source, threads=threads))
        if not reader.has_tree and _may_need_blocks(reader, source, target, settings, resources, engine):
            from .planning import blocks_for

            blocks = stack.enter_context(
                blocks_for(
                    source,
                    tree,
                    header=reader,
                    folder=scratch_folder(source, target, settings, resources.scratch_dir),
                    overwrite=overwrite,
                    threads=threads,
                    progress=progress,
                    resources=resources,
                    engine=engine,
                    say=say,
                )
            )
        baked = tree.baked
        baked.format, baked.notes, baked.read = reader.format, reader.notes, reader.count
        if settings.up is None and reader.up and reader.up_by:
            baked.notes += (up_note(reader.up, reader.up_by),)
        if blocks is None:
            tree.nodes = reader.scene(progress=progress)
        opened.close()
        del reader  # which may hold much memory
        if blocks is None:
            build(tree, source, threads, progress)
            if fitting is not None and settings.simplify is None:  # of a simplified scene, its one cut is fitted
                from .simplifying import refined

                tree.nodes, baked.refine = refined(tree.scene, fitting, threads=threads, progress=progress, say=say)
                tree.end("refine")
            put_in_order(tree, threads, progress)
        else:
            blocks.build(tree)
            blocks.order(tree)
        if tree.form is None:
            write_whole(tree, threads, progress, refine=fitting, cameras=cameras, say=say)
        else:
            write_windows(tree, None if blocks is None else blocks.encode, threads, progress)
        if blocks is not None:
            store = blocks.job.store
            baked.scratch_bytes_written, baked.scratch_bytes_read = store.written, store.read
    return baked


def has_published(source: Source, target: Place, settings: BakeSettings, resources: Resources) -> bool:
    """Return whether an interrupted bake may have put all or part of its output in place."""
    from .job import PUBLISHED
    from .store import Store

    return Store(scratch_folder(source, target, settings, resources.scratch_dir)).has(PUBLISHED)


def scratch_folder(source: Source, target: Place, settings: BakeSettings, parent: Place | None) -> Place:
    """Return the scratch folder of a bake; for standard output, a temporary folder that is named after the input.

    Args:
        parent: folder for the scratch folders of several bakes; None for the folder of the output.
    """
    if target == DASH:
        from .identity import BakeIdentity

        parent = parent or Path(tempfile.gettempdir())
        return parent / f"standard-output-{BakeIdentity.of(source, settings).digest[:8]}{SCRATCH}"

    def digest(text: str) -> str:
        return hashlib.blake2b(os.fsencode(text), digest_size=4).hexdigest()

    short = target.name if len(os.fsencode(target.name)) <= NAME_BYTES else f"output-{digest(target.name)}"
    if parent is None:
        return target.parent / f"{short}{SCRATCH}"
    whole = os.path.realpath(target) if isinstance(target, Path) else target.url
    return parent / f"{short}-{digest(whole)}{SCRATCH}"


def _may_need_blocks(
    header: Reader, source: Source, target: Place, settings: BakeSettings, resources: Resources, engine: Engine | None
) -> bool:
    """Return whether a bake may go out of core, or an interrupted bake may have left a scratch folder."""
    # `planning` reports a missing file of the settings early.
    if engine is not None or settings.files or not isinstance(target, Path):
        return True
    if resources != Resources(memory=resources.memory):
        return True
    # A scene of one small block takes hardly less memory out of core, so the available memory does not matter.
    if resources.memory is not None or header.count > estimate.LEAST_BLOCK_SPLATS:
        memory = estimate.default_memory() if resources.memory is None else resources.memory
        if memory is not None and estimate.in_memory_bytes(settings, header.count, header.sh_degree) > memory:
            return True
    if target == DASH:
        return any(Path(tempfile.gettempdir()).glob(f"standard-output-*{SCRATCH}"))
    return scratch_folder(source, target, settings, None).exists()


def stage_shares(settings: BakeSettings) -> dict[str, float]:
    """Return the stages of a bake in order, by their names in its progress, with the relative time of each.

    Estimates, from bakes of 500,000 splats on two threads. An input may need fewer stages.
    """
    is_quick = settings.method == METHODS[0]
    is_file = settings.detail is None and settings.tiles is None
    has_chunks = is_file and settings.suffix == RAD_SUFFIX
    has_palette = is_file and (settings.options.rad.sh_codes is not None or settings.suffix in (".sog", META))
    rows = [
        ("reading", 1.0, True),
        ("building", 2.0 if is_quick else 5.0, True),
        ("pruning", 1.0, not is_quick),
        ("ordering", 1.0, not (is_quick and has_chunks)),
        ("simplifying", 10.0, settings.simplify is not None),
        ("refining", 100.0, settings.refine is not None),
        ("arranging", 2.0, has_chunks),
        ("dividing", 5.0, not is_file),
        ("errors", 10.0, settings.detail is not None),
        ("bisecting", 5.0, has_palette),
        ("clustering", 15.0, has_palette),
        ("encoding", 2.0, is_file),
        ("writing", 1.0 if has_chunks else 4.0, True),
    ]
    return {stage: share for stage, share, occurs in rows if occurs}
