"""Splat files and scenes: read, write, build a tree, take its leaves, inspect."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from ..io import examine_scene, read_scene, write_whole
from ..model.scene import Scene, Tree
from ..model.splats import COLUMNS
from ..support.defaults import DEFAULT_BASE, DEFAULT_COMPRESSION, DEFAULT_GROWTH, MAX_SH_DEGREE, METHODS
from ..support.errors import FormatError, memory_told
from ..support.threads import on_threads, thread_count
from .progress import Told, telling

if TYPE_CHECKING:
    from ..inspection.report import Report
    from ..model.selection import Selection


@dataclass(frozen=True)
class Written:
    """A file that was written.

    Attributes:
        path: of the file.
        format: for people ("SPZ", "PLY"), or the name of an encoding.
        bytes: its size.
    """

    path: Path
    format: str
    bytes: int


def read(
    path: Path | str, *, columns: Collection[str] | None = None, threads: int | None = None, progress: Told = None
) -> Scene:
    """Reads a splat file of any known format, which its content tells; a `Tree` where it has a Level-of-Detail tree.

    Args:
        path: of a file, or of a folder that holds an unpacked SOG.
        columns: of `Splats`, where not all are needed; the others may be 0.
        threads: to decode on; None for all processors.
        progress: is told how much is done.

    Raises:
        FormatError: it cannot be read, is of no known format, or broken.
        TreeError: its tree is broken.
        OutOfMemoryError: it does not fit into memory.
    """
    with telling(progress) as told, memory_told():
        count = thread_count(threads)
        if columns is None:
            scene = read_scene(Path(path), threads=count, progress=told)
        else:
            unknown = sorted(set(columns) - set(COLUMNS))
            if unknown:
                raise ValueError(f"there is no column {', '.join(unknown)}; give some of {', '.join(COLUMNS)}")
            scene = examine_scene(Path(path), columns=columns, threads=count, progress=told)
    if scene.tree is not None:
        scene.tree.validate()
    return as_tree(scene)


def as_tree(scene: Scene) -> Scene:
    """A scene as a `Tree` where it has one."""
    if scene.tree is None or isinstance(scene, Tree):
        return scene
    return Tree(**{each.name: getattr(scene, each.name) for each in fields(Scene)})


def write(
    path: Path | str,
    scene: Scene,
    *,
    overwrite: bool = False,
    spz_version: int | None = None,
    fractional_bits: int | None = None,
    compression_level: int = DEFAULT_COMPRESSION,
    encoding: str | None = None,
    threads: int | None = None,
    progress: Told = None,
) -> Written:
    """Writes a scene, or a tree, whole or not at all.

    Args:
        path: of the file. A tree is written as SPZ, a scene in the format of the suffix: .spz, .ply or .splat.
        scene: what is written.
        overwrite: replace a file that exists.
        spz_version: of SPZ, 2 or 3; None for 3.
        fractional_bits: of SPZ positions, 0 to 24; None for as many as suit the scene.
        compression_level: of SPZ, 1 (fast) to 9 (small).
        encoding: write the arrays of "packed", "ext", "lodtree" or "texture" as .npz instead, or as the words alone
            where the path ends in .bin or .raw.
        threads: to encode on; None for all processors. The bytes do not depend on it.
        progress: is told how much is done.

    Raises:
        FormatError: the format cannot hold the scene, or there is no such format.
        OutputError: the file exists, or cannot be written.
        ValueError: an option is out of its range.
    """
    from ..codecs.formats import WRITABLE
    from ..codecs.gpu import dump
    from ..codecs.gpu.table import ENCODINGS, RAW_SUFFIXES
    from ..codecs.options import WriteOptions

    path, count = Path(path), thread_count(threads)
    suffix = path.suffix.lower()
    with telling(progress) as told, memory_told():
        if encoding is not None:
            if encoding not in ENCODINGS:
                raise ValueError(f"there is no encoding {encoding!r}; give one of {', '.join(ENCODINGS)}")
            arrays = dump.pack(scene, encoding, count)
            pieces = dump.encode_raw(arrays) if suffix in RAW_SUFFIXES else dump.encode_npz(arrays)
            return Written(path, encoding, write_whole(path, pieces, overwrite=overwrite))
        form = WRITABLE.get(suffix)
        if form is None or (scene.tree is not None and suffix != ".spz"):
            what, known = ("a tree", ".spz") if scene.tree is not None else ("a scene", ", ".join(WRITABLE))
            raise FormatError(f"{path}: {what} is written as {known}, which the name does not end in")
        options = WriteOptions(spz_version, fractional_bits, compression_level)
        pieces = form.codec().encode(scene, options, threads=count, progress=told)
        return Written(path, form.name, write_whole(path, pieces, overwrite=overwrite))


def build_lod(
    scene: Scene,
    *,
    method: str = METHODS[0],
    base: float = DEFAULT_BASE,
    growth: float = DEFAULT_GROWTH,
    max_sh: int = MAX_SH_DEGREE,
    selection: Selection | None = None,
    threads: int | None = None,
    progress: Told = None,
) -> Tree:
    """Builds the Level-of-Detail tree of a scene; the same scene and options give the same tree.

    Args:
        scene: without a tree.
        method: "quick" or "quality".
        base: of quick, growth of the voxel grid from level to level, 1.1 to 2.0.
        growth: of quality, the most nodes for each leaf, 1.05 to 2.0.
        max_sh: SH degrees above this are left out.
        selection: which splats to keep; all that can be drawn, unless given.
        threads: to work on; None for all processors.
        progress: is told how much is done.

    Raises:
        FormatError: the scene has a tree already.
        InvalidSplatsError: some splats are invalid and `selection` does not drop them, or none is left.
        ValueError: there is no such method.
    """
    from ..bake import BUILDERS
    from ..model.selection import Selection

    if scene.tree is not None:
        raise FormatError("the scene has a Level-of-Detail tree already; extract_leaves gives its splats")
    if method not in BUILDERS:
        raise ValueError(f"there is no method {method!r}; give one of {', '.join(BUILDERS)}")
    builder, setting = BUILDERS[method]
    with on_threads(threads), telling(progress) as told, memory_told():
        kept, _ = (selection or Selection()).apply(scene.splats.with_max_sh(max_sh))
        # A builder frees its input as it goes where nobody else holds it.
        nodes, tree = builder.build(kept, {"base": base, "growth": growth}[setting], progress=told)
    return Tree(nodes, tree, scene.antialiased)


def extract_leaves(tree: Scene) -> Scene:
    """The splats that a tree was built of, in the order of its leaves.

    Raises:
        FormatError: the scene has no tree.
    """
    import dataclasses

    import numpy as np

    if tree.tree is None:
        raise FormatError("the scene has no Level-of-Detail tree whose leaves could be taken")
    leaves = tree.splats.take(tree.tree.is_leaf)
    leaves = dataclasses.replace(leaves, opacity=np.minimum(leaves.opacity, np.float32(1)))
    return Scene(leaves, antialiased=tree.antialiased, format=tree.format, header=tree.header)


def inspect(
    path: Path | str,
    *,
    values: bool = False,
    all_quantities: bool = False,
    check: bool = False,
    threads: int | None = None,
    progress: Told = None,
) -> Report:
    """What is in a file and, if asked for, what is wrong with it; `Report.as_dict` is what `inspect --json` prints.

    Args:
        path: of a splat file, or of a folder that holds an unpacked SOG.
        values: look at the numbers of the splats.
        all_quantities: every quantity of them.
        check: look for what is wrong. A file that cannot be read is a finding, not an error.
        threads: to decode on; None for all processors.
        progress: is told how much is done.
    """
    from ..inspection import report

    wanted = report.Wanted(values=values or all_quantities, all_quantities=all_quantities, check=check)
    with telling(progress) as told, memory_told():
        found, _ = report.inspect(Path(path), wanted, threads=thread_count(threads), progress=told)
    return found
