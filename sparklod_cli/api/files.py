"""Splat files and scenes: read, build a tree, take its leaves, inspect."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from ..io import examine_scene, read_scene
from ..lod.builders import BUILDERS, METHODS
from ..model.scene import Scene, Tree
from ..model.splats import COLUMNS
from ..support.defaults import (
    DEFAULT_BASE,
    DEFAULT_GROWTH,
    MAX_BASE,
    MAX_GROWTH,
    MAX_SH_DEGREE,
    MIN_BASE,
    MIN_GROWTH,
)
from ..support.errors import FormatError, InvalidSplatsError, TreeError, memory_errors_translated
from ..support.parallel import on_threads, thread_count
from .arguments import scene_like, whole_within, within
from .progress import Told, telling

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..fitting.settings import FitSettings
    from ..inspection.report import Report
    from ..model.selection import Selection


def read(
    path: Path | str, *, columns: Collection[str] | None = None, threads: int | None = None, progress: Told = None
) -> Scene:
    """Reads a splat file; its content tells the format. The scene is a `Tree` if the file has a Level-of-Detail tree.

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
    with telling(progress) as told, memory_errors_translated(), naming(path):
        count = thread_count(threads)
        if columns is None:
            scene = read_scene(path, threads=count, progress=told)
        else:
            unknown = sorted(set(columns) - set(COLUMNS))
            if unknown:
                raise ValueError(f"there is no column {', '.join(unknown)}; give some of {', '.join(COLUMNS)}")
            scene = examine_scene(path, columns=columns, threads=count, progress=told)
        if scene.tree is not None:
            scene.tree.validate()
    return as_tree(scene)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Puts the file before what is wrong with it: Python, unlike a command, says nothing before it."""
    try:
        yield
    except (FormatError, InvalidSplatsError, TreeError) as error:
        raise type(error)(f"{path}: {error}") from None


def as_tree(scene: Scene) -> Scene:
    """A scene as a `Tree` where it has one."""
    if scene.tree is None or isinstance(scene, Tree):
        return scene
    return Tree(**{each.name: getattr(scene, each.name) for each in fields(Scene)})


def build_lod(
    scene: Scene,
    *,
    method: str = METHODS[0],
    base: float = DEFAULT_BASE,
    growth: float = DEFAULT_GROWTH,
    max_sh: int = MAX_SH_DEGREE,
    selection: Selection | None = None,
    refine: bool | int | FitSettings = False,
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
        refine: fit merged splats to pictures of full detail: True, or in how many steps, or how. The function `refine`
            does the same and tells what it brought.
        threads: to work on; None for all processors.
        progress: called with how much is done.

    Raises:
        FormatError: the scene has a tree already.
        InvalidSplatsError: some splats are invalid and `selection` does not drop them, or none is left.
        ValueError: there is no such method, or an option is out of its range.
    """
    from ..bake import BakeSettings
    from ..lod.band_order import banded
    from ..lod.check import select
    from ..model.selection import Selection
    from .refining import asked_for, refined_tree

    if scene_like(scene).tree is not None:
        raise FormatError("the scene has a Level-of-Detail tree already; extract_leaves gives its splats")
    if method not in BUILDERS:
        raise ValueError(f"there is no method {method!r}; give one of {', '.join(BUILDERS)}")
    within("base", base, MIN_BASE, MAX_BASE)
    within("growth", growth, MIN_GROWTH, MAX_GROWTH)
    whole_within("max_sh", max_sh, 0, MAX_SH_DEGREE)
    fitting = asked_for(refine)
    build, setting = BakeSettings(method=method, base=base, growth=growth).builder()
    with on_threads(threads), telling(progress) as told, memory_errors_translated():
        kept, _ = select(selection or Selection(), scene.splats.with_max_sh(max_sh), thread_count(threads))
        # A builder frees its input as it goes where nobody else holds it.
        built = build(kept, setting, progress=told)
        nodes, links = banded([built]) if BUILDERS[method].in_bands else built
        made = Tree(nodes, links, scene.antialiased, up=scene.up)
        return made if fitting is None else refined_tree(made, fitting, thread_count(threads), told, None)[0]


def extract_leaves(tree: Scene) -> Scene:
    """The splats that a tree was built of, in the order of its leaves.

    Raises:
        FormatError: the scene has no tree.
    """
    from ..extract_leaves import leaves_of

    return leaves_of(scene_like(tree))


def pack(scene: Scene, encoding: str, *, threads: int | None = None) -> dict[str, NDArray[np.uint32]]:
    """A scene in the layout of a viewer's memory, as `build-lod --encoding` writes it; docs/formats.md has the words.

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
    from ..codecs.gpu import dump
    from ..codecs.gpu.table import ENCODINGS
    from ..codecs.sound import check_scene

    if encoding not in ENCODINGS:
        raise ValueError(f"there is no encoding {encoding!r}; give one of {', '.join(ENCODINGS)}")
    count = thread_count(threads)
    check_scene(scene_like(scene), count)
    return dump.pack(scene, encoding, count)


def unpack(arrays: Mapping[str, NDArray[np.uint32]], *, threads: int | None = None) -> Scene:
    """The scene that arrays of `pack`, or of a viewer, hold; a `Tree` where the words of a LodTree are among them.

    Args:
        arrays: those of "packed" or of "ext", and of "lodtree" where there is a tree.
        threads: to decode on; None for all processors.

    Raises:
        FormatError: an array is missing, or has another shape or type.
        TreeError: the tree is broken.
    """
    from ..codecs.gpu import ext_splats, lod_tree, packed_splats
    from ..codecs.splat_encoding import SplatEncoding

    count = thread_count(threads)
    tree = lod_tree.unpack(arrays).tree if "lod_tree" in arrays else None
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
    progress: Told = None,
) -> Report:
    """What is in a file and, if asked for, what is wrong with it; `Report.as_dict` is what `inspect --json` prints.

    Args:
        path: of a splat file, or of a folder that holds an unpacked SOG.
        values: look at the numbers of the splats.
        all_quantities: every quantity of them.
        check: look for what is wrong. A file that cannot be read is a finding, not an error.
        threads: to decode on; None for all processors.
        progress: called with how much is done.
    """
    from ..inspection import report

    wanted = report.ReportSettings(values=values or all_quantities, all_quantities=all_quantities, check=check)
    with telling(progress) as told, memory_errors_translated():
        found, _ = report.inspect(Path(path), wanted, threads=thread_count(threads), progress=told)
    return found
