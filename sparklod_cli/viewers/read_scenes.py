"""Reads the scenes of instances, each once."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..codecs.formats import PRECISIONS, RAD
from ..codecs.reader import decode_file
from ..io import opened, size_of_input
from ..model.instances import Instance
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene, facts_of
from ..model.splats import COLUMNS, Splats
from ..model.traversed import DetailScene, TileScene
from ..system.errors import FormatError, InvalidSplatsError, TreeError, memory_errors_translated, naming
from ..system.progress import Progress, silent
from ..system.stdio import DASH
from .loaded_scene import UNNAMED, LoadedScene, bytes_of, nodes_of
from .scenes import Scenes

if TYPE_CHECKING:
    from .paging import Pages


def read_scenes(
    instances: Sequence[Instance],
    *,
    columns: Collection[str] = COLUMNS,
    trees_only: bool = False,
    through: str | None = None,
    precision: str = PRECISIONS[0],
    paged: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Scenes:
    """Read the scenes of instances, each once.

    Splats that cannot be drawn are left out of scenes without trees; `Scenes.notes` has their number.

    Args:
        columns: of `Splats` to read; only with `trees_only`; of scenes without trees all are read.
        trees_only: refuse scenes without a tree, detail levels or tiles, of which no cuts are drawn.
        through: one of `formats.ROUND_TRIPS`, a coding after which splats are drawn; cuts are those of the scene.
        precision: one of `PRECISIONS`, of the nodes that cuts are found with.
        paged: only cuts are needed, so that only those chunks of large RAD trees are read that cuts need.

    Raises:
        FormatError: a file cannot be read, has no tree but needs one, or does not fit the coding; names the file.
        TreeError: a tree is broken; names the file.
        InvalidSplatsError: a scene has nothing to draw; names it.
        OutOfMemoryError: a file does not fit into memory; names it.
    """
    loaded: dict[Path | int, LoadedScene] = {}
    notes, of_instance, chunks = list[str](), list[LoadedScene](), 0
    for source in (instance.source for instance in instances):
        file = source if isinstance(source, Path) else None
        key = file or id(source)
        if key in loaded:
            of_instance.append(loaded[key])
            continue
        found: Pages | Scene | DetailScene | TileScene
        if isinstance(source, Path):
            to_read = columns if trees_only else COLUMNS
            found = _read(source, to_read, precision if paged and through is None else None, threads, progress)
        else:
            found = source
        if isinstance(found, Scene):
            name, scene = file or UNNAMED, found
            try:
                scene.check_tree()
            except TreeError as error:
                raise TreeError(f"{name}: its tree is broken: {error}") from None
            if scene.tree is None and trees_only:
                raise FormatError(
                    f"{name}: it is not a Level-of-Detail tree, Streamed SOG or 3D Tiles; bake it first with sparklod"
                    " build-lod"
                )
            notes += (f"{name}: {note}" for note in scene.notes)
            if scene.tree is None:
                scene = _drawable(str(name), scene, notes)
            size = bytes_of(scene.splats) if file is None else size_of_input(file) or 0
            drawn = _drawn(scene, through, file, threads)
            entry: LoadedScene = LoadedScene(file, size, scene, drawn, chunks, precision, threads)
        elif isinstance(found, (DetailScene, TileScene)):
            entry = _loaded_runs(file, found, through, chunks, threads)
            notes += (f"{entry.name}: {note}" for note in found.notes)
        else:
            from .paging import PagedScene

            assert file is not None
            empty = replace(found.file.scene, tree=LodTree(np.zeros(0, np.uint16), np.zeros(0, np.uint32)))
            entry = PagedScene(file, size_of_input(file) or 0, empty, empty.splats, chunks, pages=found)
        loaded[key] = entry
        of_instance.append(entry)
        chunks += entry.chunks
    return Scenes(instances, list(loaded.values()), of_instance, notes)


def _loaded_runs(
    file: Path | None, found: DetailScene | TileScene, through: str | None, chunks: int, threads: int
) -> LoadedScene:
    """Return all tiles, or all levels and the environment, as one scene with its files."""
    splats = found.splats
    if isinstance(found, DetailScene) and found.environment is not None:
        degree = min(splats.sh_degree, found.environment.sh_degree)
        splats = Splats.concat([part.with_max_sh(degree) for part in (splats, found.environment)])
    if not len(splats):
        raise InvalidSplatsError(f"{file or UNNAMED}: it has no splats")
    scene = Scene(splats, **facts_of(found))
    drawn = _drawn(scene, through, file, threads)
    if isinstance(found, TileScene):
        from .cesium import LoadedTiles

        size = found.header.get("bytes", bytes_of(splats))
        return LoadedTiles(file, size, scene, drawn, chunks, tiles=found)
    from .playcanvas import LoadedDetail, files_in_memory, read_detail_files

    files = files_in_memory(found) if file is None else read_detail_files(file)
    return LoadedDetail(file, int(files.sizes.sum()) + files.manifest, scene, drawn, chunks, detail=found, files=files)


def _drawn(scene: Scene, through: str | None, file: Path | None, threads: int) -> Splats:
    """Return the splats of a scene as they are drawn: after a coding, if there is one."""
    if through is None:
        return scene.splats
    from ..codecs.losses import after

    return after(through, file or Path(UNNAMED), scene, threads)


def _read(
    path: Path, columns: Collection[str], paged: str | None, threads: int, progress: Progress
) -> Pages | Scene | DetailScene | TileScene:
    """Read a file: a scene, or one at several detail levels, or of tiles.

    Args:
        paged: precision of the pages of a file that is too large to be read at once; None to read it nevertheless.
    """
    with naming(path), memory_errors_translated(), opened(path) as (file, form, more):
        if paged is not None and form.name == RAD and path != DASH:
            from ..io.rad_file import RadFile
            from .paging import Pages

            with contextlib.suppress(FormatError):  # which is raised below
                rad = RadFile.of(path, file, more["open_companion"])
                if not rad.fits and rad.header.lod_tree and rad.header.chunk_size == CHUNK_NODES:
                    nodes = functools.partial(nodes_of, precision=paged, threads=1)
                    return Pages(rad, str(path), nodes, threads)
        if form.parts is not None and path != DASH:
            parts: DetailScene | TileScene = form.codec().decode_parts(file, threads=threads, progress=progress, **more)
            return parts
        return decode_file(
            form.codec(), file, threads=threads, progress=progress, columns=columns, validate=False, **more
        )


def _drawable(name: str, scene: Scene, notes: list[str]) -> Scene:
    from ..model.selection import Selection, describe

    with naming(name, InvalidSplatsError):
        splats, dropped = Selection(drop_invalid=True).apply(scene.splats)
    if dropped:
        notes.append(f"{name}: left out {describe(dropped)}")
    return replace(scene, splats=splats)
