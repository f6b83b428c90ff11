"""Splat files: read, inspect, pack for a viewer; RAD in parts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..io import rad_file
from ..io.reading import read_scene
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, FloatArray
from ..system.errors import FormatError, InvalidSplatsError, TreeError, memory_errors_translated, naming
from ..system.threads import thread_count
from .arguments import ProgressLike, progress_callback, scene_like

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..codecs.rad.rad_header import RadHeader
    from ..codecs.rad.rad_writer import RadChunk
    from ..inspection.report import Report

#: Errors of public functions that begin with the name of the file.
OF_FILES = (FormatError, InvalidSplatsError, TreeError)


@dataclass(frozen=True, eq=False, repr=False)
class Tree(Scene):
    """A scene with a Level-of-Detail tree: its splats are the nodes, and `tree` says which are whose children."""

    tree: LodTree = field()

    def _facts(self) -> list[str]:
        nodes, leaves = len(self.splats), int(np.count_nonzero(self.tree.is_leaf))
        try:
            self.check_tree()
            depth = f"depth {self.tree.depths().max()}"
        except TreeError as error:
            depth = f"broken: {error}"
        counts = [f"{nodes:,} node{'s' * (nodes != 1)}", f"{leaves:,} leaves", depth]
        return [*counts, *super()._facts()[1:]]


def read(
    path: Path | str,
    *,
    columns: Collection[str] | None = None,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Scene:
    """Read a splat file, whose content determines the format. The scene is a `Tree` if the file has one.

    Args:
        path: of a file, or of a folder that holds an unpacked SOG or a Streamed SOG, of which level 0 is read.
        columns: of `Splats`, where not all are needed; the others may be 0.
        threads: to decode on; None for all processors.
        progress: called with how much is done.

    Raises:
        FormatError: it cannot be read, is of no known format, or broken.
        TreeError: its tree is broken.
        OutOfMemoryError: it does not fit into memory.
    """
    path = Path(path)
    with progress_callback(progress) as callback, memory_errors_translated(), naming(path, OF_FILES):
        count = thread_count(threads)
        if columns is None:
            scene = read_scene(path, threads=count, progress=callback)
        else:
            unknown = sorted(set(columns) - set(COLUMNS))
            if unknown:
                raise ValueError(f"there is no column {', '.join(unknown)}; give some of {', '.join(COLUMNS)}")
            scene = read_scene(path, columns=columns, threads=count, progress=callback, validate=False)
        if scene.tree is not None:
            scene.tree.validate()
    return as_tree(scene)


def as_tree(scene: Scene) -> Scene:
    """Return a scene as a `Tree` where it has one."""
    if scene.tree is None or isinstance(scene, Tree):
        return scene
    return Tree(**{each.name: getattr(scene, each.name) for each in fields(Scene)})


def pack(scene: Scene, encoding: str, *, threads: int | None = None) -> dict[str, NDArray[np.uint32]]:
    """Return a scene in the layout of a viewer's memory, as `convert --layout` writes it (docs/formats/memory.md).

    Args:
        scene: a scene or a tree.
        encoding: "packed", "ext", "lodtree" (of a tree) or "texture".
        threads: to encode on; None for all processors.

    Returns:
        arrays of uint32 words by their names, N rows each but for a texture.

    Raises:
        InvalidSplatsError, TreeError: a splat is invalid, or the tree is broken.
        ValueError: there is no such encoding, or no tree for it.
    """
    from ..codecs import array_files
    from ..codecs.formats import ENCODINGS
    from ..codecs.reader import check_valid

    if encoding not in ENCODINGS:
        raise ValueError(f"there is no encoding {encoding!r}; give one of {', '.join(ENCODINGS)}")
    count = thread_count(threads)
    check_valid(scene_like(scene).splats, count)
    return array_files.pack_layout(scene, encoding, count)


def unpack(arrays: Mapping[str, NDArray[np.uint32]], *, threads: int | None = None) -> Scene:
    """Return the scene in arrays of `pack`, or of a viewer; a `Tree` where the words of a LodTree are among them.

    Args:
        arrays: those of "packed" or of "ext", and of "lodtree" where there is a tree.
        threads: to decode on; None for all processors.

    Raises:
        FormatError: an array is missing, or has another shape or type.
        TreeError: the tree is broken.
    """
    from ..codecs import ext_splats, packed_splats, spark_nodes
    from ..codecs.spark_codings import SplatEncoding

    count = thread_count(threads)
    tree = spark_nodes.unpack(arrays).tree if "lod_tree" in arrays else None
    if "packed" in arrays:
        encoding = SplatEncoding(lod_opacity=tree is not None)
        splats = packed_splats.unpack(arrays, encoding, threads=count)
    else:
        splats = ext_splats.unpack(arrays, threads=count)
    if tree is None:
        return Scene(splats)
    if len(tree) != len(splats):
        raise FormatError(f"{len(tree):,} nodes but {len(splats):,} splats")
    tree.validate()
    return Tree(splats, tree)


def inspect(
    path: Path | str,
    *,
    values: bool = False,
    all_quantities: bool = False,
    check: bool = False,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Report:
    """Report the contents and faults of a file; `inspect --json` prints `Report.as_dict`.

    Args:
        path: of a splat file, or of a folder that holds an unpacked SOG.
        values: look at the numbers of the splats.
        all_quantities: every quantity of them.
        check: look for faults. An unreadable file is a finding, not an error.
        threads: to decode on; None for all processors.
        progress: called with how much is done.
    """
    from ..inspection import report

    wanted = report.ReportSettings(values=values or all_quantities, all_quantities=all_quantities, check=check)
    with progress_callback(progress) as callback, memory_errors_translated():
        found, _ = report.inspect(Path(path), wanted, threads=thread_count(threads), progress=callback)
    return found


def read_rad_header(path: Path | str) -> RadHeader:
    """Read the header of a RAD file alone; its chunks may be missing.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.

    Raises:
        FormatError: it cannot be read, is not a RAD header, or contradicts itself.
    """
    path = Path(path)
    with naming(path, OF_FILES):
        return rad_file.read_rad_header(path)


def read_rad_chunk(path: Path | str, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Read the header of a RAD file and the bytes of one chunk, as a viewer does that streams it.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.
        number: of the chunk, from 0; `read_rad_header(path).chunks` has them all.
        palette: (codes, K, 3) SH coefficients, the `palette` of chunk 0, where the file has one. Without it, the other
            chunks of such a file have `labels` and no SH.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        TypeError: the number is not a whole one.
        ValueError: there is no such chunk, or the palette is of another SH degree than the file.
    """
    path = Path(path)
    if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
        raise TypeError(f"number is {number!r}; give a whole number, which counts chunks from 0")
    with naming(path, OF_FILES), memory_errors_translated():
        return rad_file.read_rad_chunk(path, number, palette=palette)
