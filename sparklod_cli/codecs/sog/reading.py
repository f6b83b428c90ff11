"""Reads SOG, whole or as a stream."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...model.streams import SceneStream
from ...support.errors import FormatError, VersionError
from ...support.parallel import blocks_of, for_blocks
from ...support.progress import Progress, silent
from .. import quantize
from ..compression import check_promise
from ..content import Content, Scratch, rows_in
from ..stream import Positioned
from . import codings
from .files import Files, Meta, Texels

#: Most entries of the palette of SH: a label has 16 bits.
MAX_PALETTE = 1 << 16

#: Most splats: a WebP image has at most this many texels.
MAX_SPLATS = 1 << 28


def decode(
    file: BinaryIO,
    *,
    threads: int = 1,
    progress: Progress = silent,
    beside: Callable[[str], BinaryIO] | None = None,
) -> Scene:
    """Reads a .sog archive, or the meta.json of an unpacked one.

    Args:
        file: the archive or the meta.json.
        threads: to decode with.
        progress: called while the images are decoded.
        beside: opens the files that a meta.json names; None if there are none to open.

    Raises:
        FormatError: the file is not SOG, not of version 1 or 2, corrupt, or lacks an image.
    """
    return _content(file, beside, None).scene(threads, progress)


def stream(
    file: BinaryIO,
    *,
    scratch: Scratch,
    threads: int = 1,
    progress: Progress = silent,
    beside: Callable[[str], BinaryIO] | None = None,
) -> SceneStream:
    """The same splats, block by block; raises as `decode`. The images are unpacked to `scratch`, one at a time."""
    return _content(file, beside, functools.partial(_unpacked, scratch, progress)).stream(threads)


@dataclass(frozen=True)
class Step:
    """What is decoded of some images.

    Attributes:
        images: the texture and the number of each.
        fill: called with rows of a scene and, for each image, their (n, 4) texels.
    """

    images: tuple[tuple[str, int], ...]
    fill: Callable[[Splats, list[Texels]], None]


#: Gives the texels of a step that belong to some rows; called with the number of the step.
TexelsOf = Callable[[int, slice], list[Texels]]


def _content(
    file: BinaryIO,
    beside: Callable[[str], BinaryIO] | None,
    unpacked: Callable[[Files, list[Step], int], TexelsOf] | None,
) -> Content:
    """The content of a file; without `unpacked` it can only be read as a whole, an image after the other."""
    files = Files(file, beside)
    meta = files.meta
    version = meta.integer("version") if meta.has("version") else 1
    if version not in (1, 2):
        raise VersionError(f"SOG version {version} is unknown, only 1 and 2 are read")
    if version == 1 and meta.has("opacities"):
        raise VersionError("SOG from before version 1, with separate opacities; only versions 1 and 2 are read")
    count = meta.integer("count") if version == 2 else meta.integer("means", "shape", 0)
    if not 0 < count <= MAX_SPLATS:
        raise FormatError(f"{count:,} splats, but a SOG holds 1 to {MAX_SPLATS:,}")
    palette = _read_palette(files, version) if meta.has("shN") else None
    degree = COEFFICIENTS.index(palette.shape[1]) if palette is not None else 0
    check_promise(count * 4 * (14 + 3 * COEFFICIENTS[degree]), files.size)
    steps = _steps(meta, version, palette)

    def fill_all(out: Splats, start: int, threads: int, progress: Progress) -> None:
        for number, step in enumerate(steps):
            texels = _texels(files, step, count)  # of at most two images at a time
            before = number * count

            def work(part: slice, step: Step = step, texels: list[Texels] = texels) -> None:
                step.fill(rows_in(out, part), [each[part] for each in texels])

            def report(done: int, before: int = before) -> None:
                progress("reading", before + done, len(steps) * count, "texel")

            for_blocks(work, count, threads, report)

    def fill_some(out: Splats, start: int, threads: int, progress: Progress) -> None:
        assert unpacked is not None
        texels_of = unpacked(files, steps, count)

        def work(part: slice) -> None:
            for number, step in enumerate(steps):
                step.fill(rows_in(out, part), texels_of(number, slice(start + part.start, start + part.stop)))

        for_blocks(work, len(out), threads, lambda done: None)

    antialiased = version == 2 and (meta.is_true("antialias") or meta.is_text("model", "antialiased"))
    header = {"version": version, "palette": len(palette) if palette is not None else 0, "bytes": files.size}
    fill = fill_some if unpacked is not None else fill_all
    return Content(count, degree, fill, f"SOG {version}", antialiased, header=header)


def _texels(files: Files, step: Step, count: int) -> list[Texels]:
    return [files.texels(texture, index, count) for texture, index in step.images]


def _unpacked(scratch: Scratch, progress: Progress, files: Files, steps: list[Step], count: int) -> TexelsOf:
    """Texels from a scratch file that has those of all images, one image after the other."""
    images = [len(step.images) for step in steps]

    def pieces() -> Iterator[bytes]:
        for number, step in enumerate(steps):
            for texels in _texels(files, step, count):
                yield from (texels[part].tobytes() for part in blocks_of(count))
            progress("reading", (number + 1) * count, len(steps) * count, "texel")

    source = Positioned(scratch(pieces))

    def texels_of(number: int, part: slice) -> list[Texels]:
        first, places = sum(images[:number]), range(images[number])
        size = 4 * (part.stop - part.start)
        data = (source.read(4 * ((first + place) * count + part.start), size) for place in places)
        return [np.frombuffer(each, np.uint8).reshape(-1, 4) for each in data]

    return texels_of


def _steps(meta: Meta, version: int, palette: FloatArray | None) -> list[Step]:
    scales = quantize.decode_log(_tables(meta, "scales", version, 3))
    colors = _tables(meta, "sh0", version, 4 if version == 1 else 3)
    byte = np.arange(256, dtype=np.uint8)
    opacity = quantize.decode_logit(colors[3]) if version == 1 else quantize.decode_unorm8(byte)
    tables = np.stack([*quantize.decode_dc(colors[:3]), opacity])
    steps = [
        Step((("means", 0), ("means", 1)), functools.partial(_fill_centers, _center_tables(meta))),
        Step((("quats", 0),), _fill_quats),
        Step((("scales", 0),), functools.partial(_fill_scales, scales)),
        Step((("sh0", 0),), functools.partial(_fill_colors, tables)),
    ]
    return steps if palette is None else [*steps, Step((("shN", 1),), functools.partial(_fill_sh, palette))]


def _look_up(columns: list[FloatArray], tables: FloatArray, texels: Texels) -> None:
    """Fills each column, (n,), from a channel of (n, 4) texels by a table of 256 values."""
    for channel, (column, table) in enumerate(zip(columns, tables, strict=True)):
        column[:] = table[texels[:, channel]]


def _fill_scales(tables: FloatArray, splats: Splats, texels: list[Texels]) -> None:
    _look_up(list(splats.scale.T), tables, texels[0])


def _fill_colors(tables: FloatArray, splats: Splats, texels: list[Texels]) -> None:
    _look_up([*splats.rgb.T, splats.opacity], tables, texels[0])


def _tables(meta: Meta, name: str, version: int, channels: int) -> FloatArray:
    """(channels, 256) float32 values of each byte: one codebook in version 2, a range per channel in version 1."""
    if version == 2:
        return np.tile(_codebook(meta, name), (channels, 1))
    low, high = meta.numbers(channels, name, "mins"), meta.numbers(channels, name, "maxs")
    return quantize.range_table(low, high, 256).astype(np.float32)


def _codebook(meta: Meta, name: str) -> FloatArray:
    return meta.numbers(256, name, "codebook", first_may_be_null=True).astype(np.float32)


def _center_tables(meta: Meta) -> FloatArray:
    """(3, 65536) coordinates of each word, between the bounds of sign(x) * log(1 + abs(x))."""
    return codings.center_table(meta.numbers(3, "means", "mins"), meta.numbers(3, "means", "maxs"))


def _fill_centers(tables: FloatArray, splats: Splats, texels: list[Texels]) -> None:
    """Decodes coordinates: 16 bits over two images."""
    low, high = texels
    for axis, table in enumerate(tables):
        splats.center[:, axis] = table[low[:, axis] | high[:, axis].astype(np.uint16) << np.uint16(8)]


def _fill_quats(splats: Splats, texels: list[Texels]) -> None:
    """Decodes rotations."""
    splats.quat_xyzw[:] = codings.decode_quat(texels[0])


def _fill_sh(palette: FloatArray, splats: Splats, texels: list[Texels]) -> None:
    label = texels[0][:, 0] | texels[0][:, 1].astype(np.uint16) << np.uint16(8)
    if label.max(initial=0) >= len(palette):
        raise FormatError(f"SH label {label.max()} is beyond the {len(palette):,} entries of its palette")
    splats.sh[:] = palette[label]


def _read_palette(files: Files, version: int) -> FloatArray:
    """(entries, K, 3) SH coefficients of the palette."""
    image = files.image("shN", 0, MAX_PALETTE * COEFFICIENTS[3])
    width = image.shape[1]
    coefficients = width // codings.PALETTE_WIDTH
    if coefficients not in COEFFICIENTS[1:4] or width % codings.PALETTE_WIDTH:
        raise FormatError(f"its image of SH centroids is {width} texels wide, expected 64 times 3, 8 or 15")
    entries = image[:, :, :3].reshape(-1, coefficients, 3)
    if version == 1:
        low, high = files.meta.number("shN", "mins"), files.meta.number("shN", "maxs")
        return quantize.range_table(low, high, 256).astype(np.float32)[entries]
    bands, count = files.meta.integer("shN", "bands"), files.meta.integer("shN", "count")
    if bands not in (1, 2, 3) or COEFFICIENTS[bands] != coefficients:
        raise FormatError(f"its image of SH centroids has {coefficients} coefficients, not those of {bands} bands")
    if not 0 < count <= len(entries):
        raise FormatError(f"its image of SH centroids has {len(entries):,} entries, not {count:,}")
    return _codebook(files.meta, "shN")[entries[:count]]
