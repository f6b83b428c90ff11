"""Baking: from a splat file to a Level-of-Detail file. What `sparklod build-lod` calls, and a program can call."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .codecs import clamps, spz
from .codecs.gpu import dump
from .codecs.options import WriteOptions
from .io import Sink, read_rgba, read_scene
from .lod import quality, quick
from .model.scene import Scene
from .model.selection import Selection
from .model.splats import Splats
from .support.defaults import DEFAULT_BASE, DEFAULT_GROWTH, MAX_SH_DEGREE, METHODS
from .support.errors import FormatError, memory_told
from .support.progress import Progress, silent

#: What has `build`, by method, and what of a recipe it takes.
BUILDERS = {"quick": (quick, "base"), "quality": (quality, "growth")}


@dataclass(frozen=True)
class Recipe:
    """How to bake.

    Attributes:
        method: one of `defaults.METHODS`.
        base: of quick, growth of the cells from level to level, 1.1 to 2.0.
        growth: of quality, the most nodes a leaf, 1.05 to 2.0.
        max_sh: SH degrees above this are left out.
        selection: which splats to keep.
        rgba: a file of colours and opacities that take the place of the splats' own, see `io.read_rgba`.
        encoding: one of `codecs.gpu.table.ENCODINGS`, to write the arrays of that instead of SPZ.
        raw: write their words alone, rather than as .npz.
        spz: how to write SPZ.
        threads: to work on.
    """

    method: str = METHODS[0]
    base: float = DEFAULT_BASE
    growth: float = DEFAULT_GROWTH
    max_sh: int = MAX_SH_DEGREE
    selection: Selection = field(default_factory=Selection)
    rgba: Path | None = None
    encoding: str | None = None
    raw: bool = False
    spz: WriteOptions = field(default_factory=WriteOptions)
    threads: int = 1


@dataclass(frozen=True)
class Baked:
    """What came of it.

    Attributes:
        format: of the input, for people.
        splats, sh_degree: of the input as far as it was kept; `read` counts what was in the file.
        dropped: how many splats were left out, by reason (`selection.REASONS`).
        method: that built the tree.
        nodes, levels: of the tree; a tree of one node has one level.
        bytes: of the output.
        version, fractional_bits: of an SPZ output, else None.
        arrays: shapes of the arrays of another output, in its order.
        clamped: nodes with a value that the output cannot hold, by the column of `Splats` where there are any.
        clamps: at which ends, and how far beyond.
        notes: what the reader had to leave out, for people.
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
    clamps: tuple[clamps.Clamp, ...]
    notes: tuple[str, ...]
    seconds: dict[str, float]


def bake(source: Path, write: Sink, recipe: Recipe, *, progress: Progress = silent) -> Baked:
    """Reads `source`, builds its tree and hands the LoD file to `write`.

    Raises:
        FormatError, InvalidSplatsError, OutputError: see `io.read_scene`, `Selection.apply` and `write`.
        OutOfMemoryError: it does not fit into memory.
    """
    with memory_told():
        return _bake(source, write, recipe, progress)


def _bake(source: Path, write: Sink, recipe: Recipe, progress: Progress) -> Baked:
    threads = recipe.threads
    start = time.perf_counter()
    scene = read_scene(source, threads=threads, progress=progress)
    if scene.tree is not None:
        raise FormatError("it is a Level-of-Detail file already; --unlod writes its splats back out")
    total = len(scene.splats)
    kept, dropped = recipe.selection.apply(_recolored(scene.splats, recipe.rgba).with_max_sh(recipe.max_sh))
    read_done = time.perf_counter()
    antialiased, name, notes = scene.antialiased, scene.format, scene.notes
    count, degree = len(kept), kept.sh_degree
    # Before building, so that what does not fit is said at once.
    if not recipe.encoding:
        spz.settled(Scene(kept), recipe.spz)
    # The builder frees its input as it goes, if nobody else holds it: a third of the peak.
    handed_over = [kept]
    del scene, kept
    builder, setting = BUILDERS[recipe.method]
    nodes, tree = builder.build(handed_over.pop(), getattr(recipe, setting), progress=progress)
    levels = int(tree.depths().max()) + 1
    build_done = time.perf_counter()
    output = Scene(nodes, tree, antialiased)
    arrays = dump.pack(output, recipe.encoding, threads) if recipe.encoding else {}
    options = None if arrays else spz.settled(output, recipe.spz)
    if options is None:
        size = write(dump.encode_raw(arrays) if recipe.raw else dump.encode_npz(arrays))
    else:
        size = write(spz.encode(output, options, threads=threads, progress=progress))
    clamped = {} if arrays else clamps.clamped(nodes, threads)
    ends = tuple(clamps.clamps(nodes, clamped))
    seconds = {
        "read": read_done - start,
        "build": build_done - read_done,
        "write": time.perf_counter() - build_done,
    }
    return Baked(
        format=name,
        read=total,
        splats=count,
        sh_degree=degree,
        dropped=dropped,
        method=recipe.method,
        nodes=len(nodes),
        levels=levels,
        bytes=size,
        version=None if options is None else options.spz_version,
        fractional_bits=None if options is None else options.fractional_bits,
        arrays={array: words.shape for array, words in arrays.items()},
        clamped=clamped,
        clamps=ends,
        notes=notes,
        seconds={stage: round(value, 4) for stage, value in seconds.items()},
    )


def _recolored(splats: Splats, rgba: Path | None) -> Splats:
    """The splats with the colours and opacities of a file; their SH stay, as where Spark is given new colours."""
    if rgba is None:
        return splats
    values = read_rgba(rgba, len(splats))
    return dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
