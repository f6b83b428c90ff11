"""Baking: from a splat file to a Level-of-Detail file."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .codecs import clamps, spz
from .codecs.clamps import Clamp, Clamps
from .codecs.gpu import dump
from .codecs.options import WriteOptions
from .io import Sink, read_rgba, read_scene, sink
from .lod.builders import BUILDERS, METHODS
from .model.lod_tree import LodTree
from .model.scene import Scene
from .model.selection import Selection
from .model.splats import Splats
from .model.transforms import Transform
from .support.defaults import DEFAULT_BASE, DEFAULT_GROWTH, MAX_SH_DEGREE
from .support.errors import FormatError, InvalidSplatsError, memory_errors_translated
from .support.progress import Progress, silent
from .support.threads import on_threads


@dataclass(frozen=True)
class BakeSettings:
    """How to bake.

    Attributes:
        method: of `lod.builders.BUILDERS`.
        base: of quick, growth of the voxel grid from level to level, 1.1 to 2.0.
        growth: of quality, the largest number of nodes for each leaf, 1.05 to 2.0.
        max_sh: the highest SH degree that is kept.
        selection: which splats are kept; its coordinates are those of the input.
        transform: turns, scales and moves the splats that are kept.
        rgba: a file of colours and opacities that replace the splats' own, see `io.read_rgba`.
        spz: how to write SPZ.
        encoding: of `codecs.gpu.table.ENCODINGS`, to write arrays in that layout instead of SPZ.
        raw: write their words alone, rather than as .npz.
    """

    method: str = METHODS[0]
    base: float = DEFAULT_BASE
    growth: float = DEFAULT_GROWTH
    max_sh: int = MAX_SH_DEGREE
    selection: Selection = field(default_factory=Selection)
    transform: Transform = field(default_factory=Transform)
    rgba: Path | None = None
    spz: WriteOptions = field(default_factory=WriteOptions)
    encoding: str | None = None
    raw: bool = False

    def builder(self) -> Callable[..., tuple[Splats, LodTree]]:
        """What makes `(nodes, tree)` of splats; takes `progress`, too."""
        row = BUILDERS[self.method]
        return functools.partial(row.load().build, **{row.setting: getattr(self, row.setting)})


@dataclass(frozen=True)
class Baked:
    """What was baked.

    Attributes:
        format: of the input, for display.
        read: the number of splats in the input.
        splats, sh_degree: of those that were kept.
        dropped: the number of splats that were left out, by reason (`selection.REASONS`).
        method: that built the tree.
        nodes, levels: of the tree; levels is its depth and 1, so that a tree of one node has one.
        bytes: of the output.
        version, fractional_bits: of an SPZ output, else None.
        arrays: shapes of the arrays of another output, in its order.
        clamped: by the column of `Splats`, the number of nodes with a value that the output cannot hold.
        clamps: at which ends, and how far beyond.
        notes: what the reader had to leave out, for display.
        seconds: by stage (read, build, write).
    """

    format: str
    read: int
    splats: int
    sh_degree: int
    dropped: dict[str, int]
    method: str
    nodes: int
    levels: int
    bytes: int
    version: int | None
    fractional_bits: int | None
    arrays: dict[str, tuple[int, ...]]
    clamped: dict[str, int]
    clamps: tuple[Clamp, ...]
    notes: tuple[str, ...]
    seconds: dict[str, float]


def bake(
    source: Path,
    target: Path,
    settings: BakeSettings,
    *,
    overwrite: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Baked:
    """Reads a splat file, builds its tree and writes a Level-of-Detail file.

    Args:
        source: of any format that is read; - is standard input.
        target: an SPZ file, or one of arrays, whatever its name; - is standard output.
        settings: how.
        overwrite: replace a file that exists.
        threads: to work on.
        progress: told of the stages.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `io.read_scene`, `Selection.apply` and `io.sink`.
        OutOfMemoryError: it does not fit into memory.
    """
    with memory_errors_translated():
        write = sink(target, overwrite=overwrite)
        start = time.perf_counter()
        scene = read_scene(source, threads=threads, progress=progress)
        if scene.tree is not None:
            raise FormatError("it is a Level-of-Detail file already; --unlod writes its splats back out")
        facts: dict[str, Any] = {"format": scene.format, "notes": scene.notes, "read": len(scene.splats)}
        kept, facts["dropped"] = settings.selection.apply(
            _recolored(scene.splats, settings.rgba).with_max_sh(settings.max_sh)
        )
        kept = _transformed(kept, settings.transform)
        read_done = time.perf_counter()
        facts |= {"splats": len(kept), "sh_degree": kept.sh_degree}
        antialiased = scene.antialiased
        # Before building, so that what does not fit is said at once.
        if settings.encoding is None:
            spz.settled(Scene(kept), settings.spz)
        # The builder frees its input as it goes, if nobody else holds it: a third of the peak.
        handed_over = [kept]
        del scene, kept
        with on_threads(threads):
            nodes, tree = settings.builder()(handed_over.pop(), progress=progress)
        levels = int(tree.depths().max()) + 1
        build_done = time.perf_counter()
        facts |= _written(Scene(nodes, tree, antialiased), write, settings, threads, progress)
        seconds = {
            "read": read_done - start,
            "build": build_done - read_done,
            "write": time.perf_counter() - build_done,
        }
    return Baked(
        **facts,
        method=settings.method,
        nodes=len(nodes),
        levels=levels,
        seconds={stage: round(value, 4) for stage, value in seconds.items()},
    )


def _written(scene: Scene, write: Sink, settings: BakeSettings, threads: int, progress: Progress) -> dict[str, Any]:
    """Writes a tree; the facts of `Baked` about that."""
    if settings.encoding is not None:
        arrays = dump.pack(scene, settings.encoding, threads)
        size = write(dump.encode_raw(arrays) if settings.raw else dump.encode_npz(arrays))
        options, beyond = WriteOptions(), Clamps()
    else:
        arrays, options = {}, spz.settled(scene, settings.spz)
        size = write(spz.encode(scene, options, threads=threads, progress=progress))
        beyond = clamps.find(scene.splats, threads)
    return {
        "bytes": size,
        "version": options.spz_version,
        "fractional_bits": options.fractional_bits,
        "arrays": {name: words.shape for name, words in arrays.items()},
        "clamped": beyond.splats,
        "clamps": beyond.ends,
    }


def _transformed(splats: Splats, transform: Transform) -> Splats:
    """Splats turned, scaled and moved.

    Raises:
        InvalidSplatsError: one leaves the range of float32.
    """
    turned = transform.apply(splats)
    if turned is not splats and turned.invalid():
        raise InvalidSplatsError(
            "scaled and moved like this, it leaves the range of float32; give a smaller --scale or --translate"
        )
    return turned


def _recolored(splats: Splats, rgba: Path | None) -> Splats:
    """The splats with the colours and opacities of a file; their SH stay, as where Spark is given new colours."""
    if rgba is None:
        return splats
    values = read_rgba(rgba, len(splats))
    return dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
