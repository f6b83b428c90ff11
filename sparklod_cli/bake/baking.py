"""From a splat file to a Level-of-Detail file, or from one format of such files to another."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..codecs.sound import check_scene
from ..codecs.statistics import Statistics
from ..io import read_rgba, read_stored
from ..lod.builders import BUILDERS
from ..lod.check import select
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import Splats
from ..support.addresses import Place
from ..support.errors import memory_errors_translated
from ..support.parallel import on_threads
from ..support.progress import Progress, silent
from .checks import transformed
from .clock import Clock
from .environment import divided, read_environment
from .kept_tree import check_kept, has_format_of
from .out_of_core.contracts import Engine
from .output import Output, output_of
from .refining import Refined, fit_settings, refined
from .resources import Resources
from .scaling import Scaled, bake_scaled, has_published
from .settings import BakeSettings
from .sources import Merged, Source, read_source
from .written import WrittenTree


@dataclass(frozen=True, kw_only=True)
class Baked(WrittenTree):
    """What was baked.

    Attributes:
        format: of the input, for display.
        read: the number of splats in the input, which are nodes where it has a tree.
        splats, sh_degree: of those that were kept; the leaves of a tree.
        dropped: the number of splats that were left out, by reason (`selection.REASONS`).
        method: that built the tree; None for the tree of the input.
        nodes, levels: of the tree; levels is its depth and 1, so that a tree of one node has one.
        notes: what the reader had to leave out, for display.
        seconds: by stage (read, build, order, refine, arrange, levels, errors, write).
        refine: what fitting merged splats brought; None where that was not asked for.
        blocks: that were built one after the other, out of core; None in memory.
        scratch_bytes_written, scratch_bytes_read: in the scratch folder; None in memory.
    """

    format: str
    read: int
    splats: int
    sh_degree: int
    dropped: dict[str, int]
    method: str | None
    nodes: int
    levels: int
    notes: tuple[str, ...]
    seconds: dict[str, float]
    refine: Refined | None = None
    blocks: int | None = None
    scratch_bytes_written: int | None = None
    scratch_bytes_read: int | None = None


@dataclass(frozen=True)
class _Made:
    """What is written.

    Attributes:
        built: the tree, in a list so that whoever takes it out can free it.
        leaves: how many it has.
        dropped: the splats that were left out, by reason.
        output: where it goes.
        environment: splats that are no part of the tree.
        is_ordered: its nodes are in the order of a file of the same format already.
        counted: statistics of its leaves, see `Output.check`; None where there are none.
    """

    built: list[tuple[Splats, LodTree]]
    leaves: int
    dropped: dict[str, int]
    output: Output
    environment: Splats | None = None
    is_ordered: bool = False
    counted: Statistics | None = None


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
    """Reads splat files, builds a tree of them and writes a Level-of-Detail file. The tree of a single one may be kept.

    What does not fit into the memory that it may take is baked out of core: block by block, with a scratch folder.

    Args:
        source: a file of any format that is read, - for standard input, or several files as one scene.
        target: a file of the format that is set, or one of arrays, whatever its name; - is standard output.
        settings: how.
        overwrite: replace files that exist.
        threads: to work on.
        progress: told of the stages.
        resources: that it may use; None for those of a machine that is otherwise idle.
        engine: runs the tasks of a bake that goes out of core because of it; None for this process.
        say: told in a line that it goes out of core, what is left after an interruption, and what fitting brought.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `read_source`, `Selection.apply`, `sound.check_scene` and
            `io.scene_sink`; or the input has a tree, and the settings do not keep it.
        ScratchError: the scratch folder is full, in use, or has the results of another bake.
        OutOfMemoryError: it does not fit into memory.
        CameraPathError: the training cameras cannot be read.
        KeyboardInterrupt: see `refined`.
    """
    with memory_errors_translated():
        fitting = fit_settings(settings)
        resources = resources or Resources()
        overwrite = overwrite or has_published(source, target, settings, resources)  # its own output
        output, clock = output_of(target, settings, overwrite=overwrite), Clock()
        scaled = bake_scaled(
            source,
            target,
            settings,
            output,
            overwrite=overwrite,
            threads=threads,
            progress=progress,
            resources=resources,
            engine=engine,
            say=say,
        )
        if scaled is not None:
            return _baked_of(scaled, settings)
        # A list, so that whoever takes the scene out of it can free it.
        scenes = [read_source(source, threads=threads, progress=progress)]
        form, notes, read = scenes[0].format, scenes[0].notes, len(scenes[0])
        about: dict[str, Any] = {"antialiased": scenes[0].antialiased, "up": settings.up_of(scenes[0].up)}
        has_tree = scenes[0].tree is not None
        environment = read_environment(settings, threads=threads, progress=progress)
        if has_tree:
            made = _kept(source, scenes, settings, output, clock)
        else:
            made = _built(scenes, settings, output, clock, threads, progress)
        (nodes, tree), fitted = made.built.pop(), None
        if fitting is not None:
            whole = Scene(nodes, tree, **about)
            whole, fitted = refined(whole, fitting, threads=threads, progress=progress, say=say)
            nodes = whole.splats
            clock.end("refine")
        check_scene(Scene(nodes, tree), threads)
        if made.output.in_chunks and not made.is_ordered:
            with on_threads(threads):
                from ..lod.chunk_order import chunk_order
                from ..lod.families import taken

                order, child_start = chunk_order(nodes, tree, progress=progress)
                built = [(nodes, tree)]
                del nodes, tree
                nodes, tree = taken(built, order, child_start)
            clock.end("arrange")
        environment = made.environment if environment is None else environment
        counted = made.counted if fitting is None else None
        written = made.output.write(Scene(nodes, tree, **about), environment, clock, threads, progress, counted)
    return Baked(
        **vars(written),
        format=form,
        read=read,
        splats=made.leaves,
        sh_degree=nodes.sh_degree,
        dropped=made.dropped,
        method=None if has_tree else settings.method,
        nodes=len(nodes),
        levels=int(tree.depths().max()) + 1,
        notes=notes,
        seconds=clock.seconds,
        refine=fitted,
    )


def _baked_of(scaled: Scaled, settings: BakeSettings) -> Baked:
    """The report of a bake out of core."""
    made, tally = scaled.baked, scaled.baked.findings.tally
    return Baked(
        **vars(made.written),
        format=scaled.format,
        read=scaled.read,
        splats=tally.kept,
        sh_degree=scaled.sh_degree,
        dropped=tally.dropped,
        method=settings.method,
        nodes=made.nodes,
        levels=made.levels,
        notes=scaled.notes,
        seconds=made.seconds,
        blocks=made.blocks,
        scratch_bytes_written=scaled.scratch_bytes_written,
        scratch_bytes_read=scaled.scratch_bytes_read,
    )


def _kept(source: Source, scenes: list[Scene], settings: BakeSettings, output: Output, clock: Clock) -> _Made:
    """The tree that the input has."""
    scene = scenes.pop()
    check_kept(scene, settings)
    assert scene.tree is not None
    leaves, is_ordered = int(np.count_nonzero(scene.tree.is_leaf)), False
    if not has_format_of(scene, settings):
        output = output.converting()
    else:
        assert not isinstance(source, Merged)  # of which no part is a tree
        if settings.refine is None:
            output = output.repacking(source)
        else:
            output, is_ordered = output.keeping(read_stored(source), scene.splats), True
    clock.end("read")
    return _Made([(scene.splats, scene.tree)], leaves, {}, output, is_ordered=is_ordered)


def _built(
    scenes: list[Scene], settings: BakeSettings, output: Output, clock: Clock, threads: int, progress: Progress
) -> _Made:
    """A tree of the splats of the input."""
    scene = scenes.pop()
    read = _recolored(scene.splats, settings.rgba).with_max_sh(settings.max_sh)
    kept, dropped = select(settings.selection, read, threads)
    kept, far = divided(kept, settings)
    kept = transformed(kept, settings.transform)
    environment = None if far is None else transformed(far, settings.transform)
    clock.end("read")
    counted = output.check(kept, threads)  # before building, so that what does not fit is said at once
    leaves = len(kept)
    # The builder frees its input as it goes, if nobody else holds it: a third of the peak.
    handed_over = [kept]
    del scene, read, kept, far
    with on_threads(threads):
        build, setting = settings.builder()
        built = [build(handed_over.pop(), setting, progress=progress)]
        if BUILDERS[settings.method].in_bands and not output.in_chunks:
            from ..lod.band_order import banded

            built = [banded(built)]
    clock.end("build")
    return _Made(built, leaves, dropped, output, environment, counted=counted)


def _recolored(splats: Splats, rgba: Path | None) -> Splats:
    """The splats with the colours and opacities of a file; their SH stay, as where Spark is given new colours."""
    if rgba is None:
        return splats
    values = read_rgba(rgba, len(splats))
    return dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
