"""Reads and writes splat files, the parts of RAD files, and arrays in the layouts of viewers' memory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ..codecs.formats import (
    DEFAULT_COMPRESSION,
    ENCODINGS,
    MANIFEST,
    NPZ,
    RAW_SUFFIXES,
    WRITABLE,
    RadOptions,
    SogOptions,
    WriteOptions,
    ending_of,
)
from ..codecs.reader import check_valid
from ..codecs.spark_codings import SplatEncoding
from ..io.files import open_named, readable
from ..io.reading import read_scene
from ..io.writing import parts_output, scene_output, write_scene
from ..lod.tree_settings import DetailSettings
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, FloatArray
from ..system.errors import (
    FormatError,
    InvalidSplatsError,
    TreeError,
    UnreadableError,
    memory_errors_translated,
    naming,
)
from ..system.output import Output
from ..system.threads import thread_count
from .arguments import ProgressLike, file_path, progress_callback, scene_like

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..codecs.rad.rad_header import RadHeader
    from ..codecs.rad.rad_reader import RadChunk

#: Errors of public functions to which the name of the file is added.
OF_FILES = (FormatError, InvalidSplatsError, TreeError)


@dataclass(frozen=True, eq=False, repr=False)
class Tree(Scene):
    """A scene with a Level-of-Detail tree: its splats are the nodes, and `tree` links parents with children."""

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
        columns: of `Splats` to read; the others may be 0. None for all.

    Raises:
        FormatError: the file cannot be read, is of no known format, or is broken.
        TreeError: the tree is broken.
        OutOfMemoryError: the scene does not fit into memory.
    """
    path = Path(path)
    with progress_callback(progress) as callback, memory_errors_translated(), naming(path, OF_FILES):
        if unknown := sorted(set(columns or ()) - set(COLUMNS)):
            raise ValueError(f"there is no column {', '.join(unknown)}; give some of {', '.join(COLUMNS)}")
        every = COLUMNS if columns is None else columns
        count, validate = thread_count(threads), columns is None
        scene = read_scene(path, columns=every, threads=count, progress=callback, validate=validate)
        if scene.tree is not None:
            scene.tree.validate()
    return as_tree(scene)


def as_tree(scene: Scene) -> Scene:
    """Return a scene that has a tree as a `Tree`, and any other unchanged."""
    if scene.tree is None or isinstance(scene, Tree):
        return scene
    return Tree(**{each.name: getattr(scene, each.name) for each in fields(Scene)})


def pack(scene: Scene, encoding: str, *, threads: int | None = None) -> dict[str, NDArray[np.uint32]]:
    """Pack a scene into the layout of a viewer's memory, as `convert --layout` does (docs/formats/memory.md).

    Args:
        encoding: "packed", "ext", "lodtree" (of a tree) or "texture".

    Returns:
        arrays of uint32 words by name, with N rows each, except a texture.

    Raises:
        InvalidSplatsError, TreeError: a splat is invalid, or the tree is broken.
        ValueError: there is no such encoding, or the scene has no tree for it.
    """
    from ..codecs import layouts

    if encoding not in ENCODINGS:
        raise ValueError(f"there is no encoding {encoding!r}; give one of {', '.join(ENCODINGS)}")
    count = thread_count(threads)
    check_valid(scene_like(scene).splats, count)
    return layouts.pack_layout(scene, encoding, count)


def unpack(arrays: Mapping[str, NDArray[np.uint32]], *, threads: int | None = None) -> Scene:
    """Unpack the scene in arrays of `pack` or of a viewer; it is a `Tree` if they have the words of a LodTree.

    Args:
        arrays: of the encodings "packed" or "ext", and "lodtree" for a tree.

    Raises:
        FormatError: an array is missing, or has another shape or type.
        TreeError: the tree is broken.
    """
    from ..codecs import layouts

    count = thread_count(threads)
    tree = layouts.unpack_nodes(arrays).tree if "lod_tree" in arrays else None
    if "packed" in arrays:
        encoding = SplatEncoding(lod_opacity=tree is not None)
        splats = layouts.unpack_packed(arrays, encoding, threads=count)
    else:
        splats = layouts.unpack_ext(arrays, threads=count)
    if tree is None:
        return Scene(splats)
    if len(tree) != len(splats):
        raise FormatError(f"{len(tree):,} nodes but {len(splats):,} splats")
    tree.validate()
    return Tree(splats, tree)


def read_rad_header(path: Path | str) -> RadHeader:
    """Read only the header of a RAD file, whose chunks may be missing.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.

    Raises:
        FormatError: the file cannot be read, or its header is no RAD header or contradicts itself.
    """
    with _opened_rad(Path(path)) as (_, header):
        return header


def read_rad_chunk(path: Path | str, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Read the header of a RAD file and one chunk, as a viewer that streams the file does.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.
        number: of the chunk, from 0; `read_rad_header(path).chunks` lists all.
        palette: (codes, K, 3) SH coefficients, the `palette` of chunk 0, if the file has one. Without it, the other
            chunks of such a file have `labels` and no SH.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        TypeError: the number is not an integer.
        ValueError: there is no such chunk, or the palette and the file have different SH degrees.
    """
    from ..codecs.rad.rad_reader import RadReader

    path = Path(path)
    if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
        raise TypeError(f"number is {number!r}; give a whole number, which counts chunks from 0")
    with memory_errors_translated(), _opened_rad(path) as (file, header):
        if not 0 <= number < len(header.chunks):
            raise ValueError(f"number is {number}; its chunks are 0 to {len(header.chunks) - 1}")
        return RadReader(header, file, functools.partial(open_named, path), palette).read_chunk(number)


@contextlib.contextmanager
def _opened_rad(path: Path) -> Iterator[tuple[BinaryIO, RadHeader]]:
    """Open a RAD file and read its header; a `FormatError` names the file."""
    from ..codecs.format_rules import check_rules
    from ..codecs.rad.rad_header import header_violations, read_header

    with naming(path, OF_FILES), readable():
        if path.exists() and not path.is_file():
            raise UnreadableError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            header = read_header(file)
            check_rules(header_violations(header))
            yield file, header


@dataclass(frozen=True)
class Written:
    """File that `write` wrote.

    Attributes:
        format: for display ("SPZ", "PLY"), or the name of an encoding.
        bytes: size of the file, or of all files.
    """

    path: Path
    format: str
    bytes: int


def write(
    path: Path | str,
    scene: Scene,
    *,
    overwrite: bool = False,
    spz_version: int | None = None,
    fractional_bits: int | None = None,
    compression_level: int = DEFAULT_COMPRESSION,
    chunked: bool = False,
    rad: RadOptions | None = None,
    sog: SogOptions | None = None,
    glb_profile: str | None = None,
    encoding: str | None = None,
    detail: DetailSettings | None = None,
    environment: Scene | None = None,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Written:
    """Write a scene or a tree; all its files appear, or none.

    Nodes keep their order, see `arrange_chunks`. The bytes do not depend on the number of threads.

    Args:
        path: its suffix chooses the format: .spz or .rad; for a scene without a tree, also .ply, .sog, .glb or .splat.
            The first of several files is named: meta.json, which has the images of an unpacked SOG beside it; for a
            tree, lod-meta.json, which has the folders of a Streamed SOG beside it.
        spz_version: of SPZ, 2, 3, or for a scene without a tree 4; None for 3.
        fractional_bits: of SPZ positions, 0 to 24; None for as many as suit the scene.
        compression_level: of SPZ and RAD, 1 (fast) to 9 (small).
        chunked: of RAD: write each chunk into a file of its own, NAME-0.radc and so on, beside the header.
        rad: further options of RAD.
        sog: options of SOG.
        glb_profile: of GLB, "khronos" (default, the extension KHR_gaussian_splatting) or "cesium" (SPZ inside).
        encoding: write the arrays of "packed", "ext", "lodtree" or "texture" instead, as .npz, or only the words if the
            path ends in .bin or .raw.
        detail: of a Streamed SOG, regions and detail levels to make.
        environment: of a Streamed SOG, a scene without a tree whose splats are always drawn, such as a sky.

    Raises:
        FormatError: the format cannot hold the scene, or there is no such format.
        InvalidSplatsError: the scene has no splats, or invalid ones (see `Scene.from_arrays`).
        OutputError: the file exists, or cannot be written.
        TreeError: the tree is broken.
        TypeError: an option has the wrong type.
        ValueError: an option is out of its range, or belongs to another format.
    """
    path, count = file_path(path), thread_count(threads)
    form = None if encoding is not None else WRITABLE.get(ending_of(path.name))
    written = None if form is None else form.name
    streamed = encoding is None and path.name == MANIFEST
    spz, parts = (spz_version, fractional_bits), (detail, environment)
    for text, applies, *values in (
        ("spz_version and fractional_bits are of SPZ; leave them out, or write a .spz", written == "SPZ", *spz),
        ("chunked and rad are of RAD; leave them out, or write a .rad", written == "RAD", rad, chunked or None),
        ("sog is of SOG; leave it out, or write a .sog", written == "SOG" or streamed, sog),
        ("glb_profile is of GLB; leave it out, or write a .glb", written == "GLB", glb_profile),
        (f"detail and environment are of Streamed SOG; leave them out, or write a {MANIFEST}", streamed, *parts),
    ):
        if not applies and any(value is not None for value in values):
            raise ValueError(f"{path}: {text}")
    ranges = rad.ranges if isinstance(rad, RadOptions) else None
    kinds = {"detail": DetailSettings, "rad": RadOptions, "sog": SogOptions, "ranges": SplatEncoding}
    for (name, kind), value in zip(kinds.items(), (detail, rad, sog, ranges), strict=True):
        if not isinstance(value, (kind, NoneType)):
            raise TypeError(f"{name} is {value!r}; give {'a ' if name == 'ranges' else ''}{kind.__name__}")
    rad = dataclasses.replace(rad or RadOptions(), chunked=chunked or (rad is not None and rad.chunked))
    sog = sog or SogOptions()
    options = WriteOptions(spz_version, fractional_bits, compression_level, rad, sog, glb_profile=glb_profile)
    if not len(scene_like(scene).splats):
        raise InvalidSplatsError(f"{path}: the scene has no splats to write")
    with progress_callback(progress) as callback, memory_errors_translated():
        if encoding is not None:
            from ..codecs import layouts

            suffix = path.suffix.lower()
            if suffix not in (NPZ, *RAW_SUFFIXES):
                known = ", ".join((NPZ, *RAW_SUFFIXES))
                raise FormatError(f"{path}: arrays are written as {known}, which the name does not end in")
            out = Output(path, overwrite=overwrite)
            with naming(path, OF_FILES):
                arrays = pack(scene, encoding, threads=count)
            with out:
                size = out.write(path.name, layouts.encode_arrays(arrays, raw=suffix in RAW_SUFFIXES))
            return Written(path, encoding, size)
        with naming(path, OF_FILES):
            check_valid(scene.splats, count)
            if environment is not None:
                check_valid(scene_like(environment).splats, count)
        if streamed:
            from ..bake.parts_output import write_levels

            out = parts_output(path, overwrite=overwrite)
            if scene.tree is None:
                raise FormatError(
                    f"{path}: detail levels are cuts of a tree; build_lod makes one, best by method='quality'"
                )
            if environment is not None and environment.tree is not None:
                raise FormatError(f"{path}: the environment has a tree; extract_leaves gives its splats")
            if environment is not None and not len(environment.splats):
                raise InvalidSplatsError(f"{path}: the environment has no splats to write")
            always, detail = None if environment is None else environment.splats, detail or DetailSettings()
            size, _ = write_levels(scene, always, out, detail, options, lambda stage: None, count, callback)
            return Written(path, "Streamed SOG", size)
        if form is None or (scene.tree is not None and not form.trees):
            known = ", ".join(ending for ending, each in WRITABLE.items() if each.trees or scene.tree is None)
            what = "a tree" if scene.tree is not None else "a scene"
            raise FormatError(f"{path}: {what} is written as {known}, which the name does not end in")
        out = scene_output(path, form, chunked=rad.chunked, overwrite=overwrite)
        size = write_scene(out, form, scene, options, threads=count, progress=callback)
        return Written(path, form.name, size)
