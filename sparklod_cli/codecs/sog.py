"""PlayCanvas's SOG: splats as WebP images with a texel per splat, and a meta.json that defines their values.

A scene is a zip (.sog) or an unpacked folder. Version 2 maps bytes to values by codebooks, version 1 by ranges.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import BinaryIO

import numpy as np

from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..support.errors import FormatError, VersionError
from ..support.parallel import for_blocks
from ..support.progress import Progress, silent
from . import quantize
from .compression import check_promise
from .sog_files import Files, Meta, Texels

#: Entries in a row of the image of SH centroids.
PALETTE_WIDTH = 64

#: Most entries of the palette of SH: a label has 16 bits.
MAX_PALETTE = 1 << 16

#: Most splats: a WebP image has at most this many texels.
MAX_SPLATS = 1 << 28

#: Alpha of a rotation's texel minus the index, in w x y z, of the largest component.
FIRST_TAG = 252

#: One pass over all splats: fills the rows of a slice.
Pass = Callable[[slice], None]


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
    splats = Splats.empty(count, degree)
    passes = 5 if palette is not None else 4
    for index, work in enumerate(_passes(files, version, splats, palette)):
        before = index * count

        def report(done: int, before: int = before) -> None:
            progress("reading", before + done, passes * count, "texel")

        for_blocks(work, count, threads, report)
    antialiased = version == 2 and meta.has("antialias") and meta.flag("antialias")
    header = {"version": version, "palette": len(palette) if palette is not None else 0, "bytes": files.size}
    return Scene(splats, antialiased=antialiased, format=f"SOG {version}", header=header)


def _passes(files: Files, version: int, splats: Splats, palette: FloatArray | None) -> Iterator[Pass]:
    """Decodes the images one after the other, so that at most two are in memory."""
    count = len(splats)
    yield _centers(splats, files.texels("means", 0, count), files.texels("means", 1, count), files.meta)
    yield functools.partial(_fill_quats, splats, files.texels("quats", 0, count))
    scales = quantize.decode_log(_tables(files.meta, "scales", version, 3))
    yield functools.partial(_look_up, list(splats.scale.T), files.texels("scales", 0, count), scales)
    colors = _tables(files.meta, "sh0", version, 4 if version == 1 else 3)
    byte = np.arange(256, dtype=np.uint8)
    opacity = quantize.decode_logit(colors[3]) if version == 1 else quantize.decode_unorm8(byte)
    tables = np.stack([*quantize.decode_dc(colors[:3]), opacity])
    yield functools.partial(_look_up, [*splats.rgb.T, splats.opacity], files.texels("sh0", 0, count), tables)
    if palette is not None:
        yield functools.partial(_fill_sh, splats, files.texels("shN", 1, count), palette)


def _look_up(columns: list[FloatArray], texels: Texels, tables: FloatArray, part: slice) -> None:
    """Fills each column, (N,), from a channel of the texels by a table of 256 values."""
    for channel, (column, table) in enumerate(zip(columns, tables, strict=True)):
        column[part] = table[texels[part, channel]]


def _tables(meta: Meta, name: str, version: int, channels: int) -> FloatArray:
    """(channels, 256) float32 values of each byte: one codebook in version 2, a range per channel in version 1."""
    if version == 2:
        return np.tile(_codebook(meta, name), (channels, 1))
    low, high = meta.numbers(channels, name, "mins"), meta.numbers(channels, name, "maxs")
    return quantize.range_table(low, high, 256).astype(np.float32)


def _codebook(meta: Meta, name: str) -> FloatArray:
    return meta.numbers(256, name, "codebook", first_may_be_null=True).astype(np.float32)


def _centers(splats: Splats, low: Texels, high: Texels, meta: Meta) -> Pass:
    """Decodes coordinates: 16 bits over two images, between the bounds of sign(x) * log(1 + abs(x))."""
    logs = quantize.range_table(meta.numbers(3, "means", "mins"), meta.numbers(3, "means", "maxs"), 1 << 16)
    with np.errstate(over="ignore"):
        tables = np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)

    def fill(part: slice) -> None:
        for axis, table in enumerate(tables):
            splats.center[part, axis] = table[low[part, axis] | high[part, axis].astype(np.uint16) << np.uint16(8)]

    return fill


def _fill_quats(splats: Splats, texels: Texels, part: slice) -> None:
    """Decodes rotations: three components in r g b. A texel without a tag gives NaN, an invalid splat."""
    others = [(texels[part, k].astype(np.float32) / np.float32(127.5) - 1) * np.float32(np.sqrt(0.5)) for k in range(3)]
    tag = texels[part, 3]
    quat = quantize.quat_of_others(tag.astype(np.int16) - FIRST_TAG, *others)[:, [1, 2, 3, 0]]
    quat[tag < FIRST_TAG] = np.nan
    splats.quat_xyzw[part] = quat


def _fill_sh(splats: Splats, texels: Texels, palette: FloatArray, part: slice) -> None:
    label = texels[part, 0] | texels[part, 1].astype(np.uint16) << np.uint16(8)
    if label.max(initial=0) >= len(palette):
        raise FormatError(f"SH label {label.max()} is beyond the {len(palette):,} entries of its palette")
    splats.sh[part] = palette[label]


def _read_palette(files: Files, version: int) -> FloatArray:
    """(entries, K, 3) SH coefficients of the palette."""
    image = files.image("shN", 0, MAX_PALETTE * COEFFICIENTS[3])
    width = image.shape[1]
    coefficients = width // PALETTE_WIDTH
    if coefficients not in COEFFICIENTS[1:4] or width % PALETTE_WIDTH:
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
