"""Writing splat files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from types import NoneType

from ..codecs.formats import DEFAULT_COMPRESSION, MANIFEST, NPZ, RAW_SUFFIXES, WRITABLE, ending_of
from ..codecs.options import RadOptions, SogOptions, WriteOptions
from ..codecs.reader import check_valid
from ..codecs.spark_codings import SplatEncoding
from ..io.writing import parts_output, scene_output, write_scene
from ..lod.tree_settings import DetailSettings
from ..model.scene import Scene
from ..system.errors import FormatError, InvalidSplatsError, memory_errors_translated, naming
from ..system.output import Output
from ..system.progress import Progress
from ..system.threads import thread_count
from .arguments import ProgressLike, file_path, progress_callback, scene_like
from .files import OF_FILES, pack


@dataclass(frozen=True)
class Written:
    """A file that was written.

    Attributes:
        path: of the file.
        format: for display ("SPZ", "PLY"), or the name of an encoding.
        bytes: its size.
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
    """Write a scene, or a tree, whole or not at all. Nodes keep their order, see `arrange_chunks`.

    Args:
        path: of the file, whose suffix chooses the format: .spz or .rad; for a scene without a tree, .ply, .sog,
            .glb or .splat, too. Of several files, it names the first, and all appear or none: meta.json has the images
            of an unpacked SOG beside it; for a tree, lod-meta.json has the folders of a Streamed SOG.
        scene: what is written.
        overwrite: replace a file that exists.
        spz_version: of SPZ, 2, 3, or for a scene without a tree 4; None for 3.
        fractional_bits: of SPZ positions, 0 to 24; None for as many as suit the scene.
        compression_level: of SPZ and RAD, 1 (fast) to 9 (small).
        chunked: of RAD: write each chunk into a file of its own, NAME-0.radc and so on, beside the header; all files
            appear, or none.
        rad: further options of RAD.
        sog: options of SOG.
        glb_profile: of GLB, "khronos" (the extension KHR_gaussian_splatting; unless given) or "cesium" (SPZ inside).
        encoding: write the arrays of "packed", "ext", "lodtree" or "texture" as .npz instead, or as the words alone
            where the path ends in .bin or .raw.
        detail: of a Streamed SOG, which regions and detail levels are made of the tree.
        environment: of a Streamed SOG, a scene without a tree whose splats are always drawn, such as a sky.
        threads: to encode on; None for all processors. The bytes do not depend on it.
        progress: called with how much is done.

    Raises:
        FormatError: the format cannot hold the scene, or there is no such format.
        InvalidSplatsError: the scene has no splats, or invalid ones (`Scene.from_arrays` says which these are).
        OutputError: the file exists, or cannot be written.
        TreeError: the tree is broken.
        TypeError: an option is of another type.
        ValueError: an option is out of its range, or is of another format.
    """
    path, count = file_path(path), thread_count(threads)
    form = None if encoding is not None else WRITABLE.get(ending_of(path.name))
    written = None if form is None else form.name
    streamed = encoding is None and path.name == MANIFEST
    if (spz_version is not None or fractional_bits is not None) and written != "SPZ":
        raise ValueError(f"{path}: spz_version and fractional_bits are of SPZ; leave them out, or write a .spz")
    if (rad is not None or chunked) and written != "RAD":
        raise ValueError(f"{path}: chunked and rad are of RAD; leave them out, or write a .rad")
    if sog is not None and written != "SOG" and not streamed:
        raise ValueError(f"{path}: sog is of SOG; leave it out, or write a .sog")
    if glb_profile is not None and written != "GLB":
        raise ValueError(f"{path}: glb_profile is of GLB; leave it out, or write a .glb")
    if (detail is not None or environment is not None) and not streamed:
        raise ValueError(f"{path}: detail and environment are of Streamed SOG; leave them out, or write a {MANIFEST}")
    ranges = rad.ranges if isinstance(rad, RadOptions) else None
    for name, value, kind in (
        ("detail", detail, DetailSettings),
        ("rad", rad, RadOptions),
        ("sog", sog, SogOptions),
        ("ranges", ranges, SplatEncoding),
    ):
        if not isinstance(value, (kind, NoneType)):
            raise TypeError(f"{name} is {value!r}; give {'a ' if name == 'ranges' else ''}{kind.__name__}")
    rad = dataclasses.replace(rad or RadOptions(), chunked=chunked or (rad is not None and rad.chunked))
    sog = sog or SogOptions()
    options = WriteOptions(spz_version, fractional_bits, compression_level, rad, sog, glb_profile=glb_profile)
    if not len(scene_like(scene).splats):
        raise InvalidSplatsError(f"{path}: the scene has no splats to write")
    with progress_callback(progress) as callback, memory_errors_translated():
        if encoding is not None:
            return _write_arrays(path, scene, encoding, overwrite=overwrite, threads=count)
        with naming(path, OF_FILES):
            check_valid(scene.splats, count)
            if environment is not None:
                check_valid(scene_like(environment).splats, count)
        if streamed:
            out = parts_output(path, overwrite=overwrite)
            return _write_levels(out, scene, environment, detail or DetailSettings(), options, count, callback)
        if form is None or (scene.tree is not None and not form.trees):
            known = ", ".join(ending for ending, each in WRITABLE.items() if each.trees or scene.tree is None)
            what = "a tree" if scene.tree is not None else "a scene"
            raise FormatError(f"{path}: {what} is written as {known}, which the name does not end in")
        out = scene_output(path, form, chunked=rad.chunked, overwrite=overwrite)
        size = write_scene(out, form, scene, options, threads=count, progress=callback)
        return Written(path, form.name, size)


def _write_levels(
    out: Output,
    scene: Scene,
    environment: Scene | None,
    settings: DetailSettings,
    options: WriteOptions,
    threads: int,
    progress: Progress,
) -> Written:
    from ..bake.parts_output import write_levels

    path = out.place
    assert isinstance(path, Path)
    if scene.tree is None:
        raise FormatError(f"{path}: detail levels are cuts of a tree; build_lod makes one, best by method='quality'")
    if environment is not None and scene_like(environment).tree is not None:
        raise FormatError(f"{path}: the environment has a tree; extract_leaves gives its splats")
    if environment is not None and not len(environment.splats):
        raise InvalidSplatsError(f"{path}: the environment has no splats to write")
    always = None if environment is None else environment.splats
    size, _ = write_levels(scene, always, out, settings, options, lambda stage: None, threads, progress)
    return Written(path, "Streamed SOG", size)


def _write_arrays(path: Path, scene: Scene, encoding: str, *, overwrite: bool, threads: int) -> Written:
    from ..codecs import array_files

    if path.suffix.lower() not in (NPZ, *RAW_SUFFIXES):
        known = ", ".join((NPZ, *RAW_SUFFIXES))
        raise FormatError(f"{path}: arrays are written as {known}, which the name does not end in")
    out = Output(path, overwrite=overwrite)
    with naming(path, OF_FILES):
        arrays = pack(scene, encoding, threads=threads)
    with out:
        size = out.write(path.name, array_files.encode_arrays(arrays, raw=path.suffix.lower() in RAW_SUFFIXES))
        return Written(path, encoding, size)
