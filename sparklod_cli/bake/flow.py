"""The flow of a bake, in memory and out of core: read, select, transform, build, refine, order, encode, write."""

from __future__ import annotations

from collections.abc import Callable

from ..system.addresses import Place
from ..system.errors import memory_errors_translated
from ..system.progress import Progress, silent
from .in_memory import InMemory
from .out_of_core.planning import blocks_for, has_published
from .out_of_core.tasks import Engine
from .output import output_of
from .records import Baked, Clock
from .refining import fit_settings, refined
from .settings import BakeSettings, Resources
from .sources import Source


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
    """Read splat files, build a tree of them and write a Level-of-Detail file. The tree of a single one may be kept.

    What does not fit into the memory that it may take is baked out of core: block by block, with a scratch folder.

    Args:
        source: a file of any format that is read, - for standard input, or several files as one scene.
        target: a file of the format that is set, or one of arrays, whatever its name; - is standard output.
        resources: that it may use; None for those of a machine that is otherwise idle.
        engine: runs the tasks of a bake that goes out of core because of it; None for this process.
        say: called with a line when it goes out of core, what is left after an interruption, and what fitting brought.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `read_source`, `Selection.check`, `validation.check_scene` and
            `io.writing.scene_sink`; or the input has a tree, and the settings do not keep it.
        ScratchError: the scratch folder is full, in use, or has the results of another bake.
        OutOfMemoryError: it does not fit into memory.
        CameraPathError: the training cameras cannot be read.
        KeyboardInterrupt: see `refined`.
    """
    with memory_errors_translated():
        fitting, resources = fit_settings(settings), resources or Resources()
        overwrite = overwrite or has_published(source, target, settings, resources)  # its own output
        output, clock = output_of(target, settings, overwrite=overwrite, say=say), Clock()
        with blocks_for(
            source,
            target,
            settings,
            output,
            clock,
            overwrite=overwrite,
            threads=threads,
            progress=progress,
            resources=resources,
            engine=engine,
            say=say,
        ) as blocks:
            work = blocks or InMemory(source, settings, output, clock, threads, progress)
            tree, fit = work.build(), None
            if fitting is not None and settings.simplify is None:  # which fits its one cut
                tree.nodes, fit = refined(tree.scene, fitting, threads=threads, progress=progress, say=say)
                clock.end("refine")
            work.order(tree)
            written = tree.output.write(tree, work.encode, clock, threads, progress)
            traffic = None if blocks is None else blocks.job.store.traffic
    return Baked(
        **vars(written),
        format=tree.format,
        read=tree.read,
        splats=tree.splats,
        sh_degree=tree.sh_degree,
        dropped=tree.dropped,
        method=tree.method,
        nodes=tree.count,
        levels=tree.levels,
        notes=tree.notes,
        seconds=clock.seconds,
        refine=fit,
        blocks=tree.blocks,
        scratch_bytes_written=None if traffic is None else traffic.written,
        scratch_bytes_read=None if traffic is None else traffic.read,
    )
