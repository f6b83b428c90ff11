"""SOG, PlayCanvas's splats as WebP images with a texel per splat, and a meta.json that defines their values.

A scene is a zip (.sog) or an unpacked folder. Version 2 maps bytes to values by codebooks, version 1 by ranges; both
are read, and version 2 is written (`sog_writer`).
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.sh import COEFFICIENTS, width_of
from ...model.splats import FloatArray, Splats
from ...system.errors import FormatError, VersionError
from ...system.progress import Progress
from ...system.threads import for_blocks, ordered_map
from ...system.untrusted import Json, quoted_value
from .. import quantize
from ..compression import check_promise
from ..file_notes import read_note
from ..kernels import texels
from ..left_out import Note
from ..reader import OpenFile, Positioned, Reader, Target
from . import texel_codings as codings
from .sog_container import LARGEST, Pixels, SogFiles, has
from .sog_writer import encode as encode
from .sog_writer import encode_files as encode_files
from .sog_writer import held as held
from .sog_writer import settled as settled

#: Most entries of the palette of SH: a label has 16 bits.
MAX_PALETTE = 1 << 16

#: Most splats: a WebP image has at most this many texels.
MAX_SPLATS = 1 << 28

#: Where the channels stand in a pixel.
RED_GREEN_BLUE, ALPHA = np.array([16, 8, 0], np.uint32), np.array([24], np.uint32)


@dataclass(frozen=True)
class Step:
    """Decoding of an image.

    Attributes:
        texture, index: of the image.
        fill: called with rows of a scene and their pixels; returns what is wrong with their values, or None.
    """

    texture: str
    index: int
    fill: Callable[[Splats, Pixels], str | None]


def open_content(source: OpenFile) -> Reader:
    """Open a .sog archive, or the meta.json of an unpacked one. With `scratch`, the images are unpacked to that.

    Raises:
        FormatError: the file is not SOG, not of version 1 or 2, corrupt, or lacks an image.
    """
    files = SogFiles(source.file, source.open_companion)
    meta = files.meta
    version = meta.whole("version") if has(meta, "version") else 1
    if version not in (1, 2):
        raise VersionError(f"SOG version {version} is unknown, only 1 and 2 are read")
    if version == 1 and has(meta, "opacities"):
        raise VersionError("SOG from before version 1, with separate opacities; only versions 1 and 2 are read")
    count = meta.whole("count") if version == 2 else meta.whole("means", "shape", 0)
    if not 0 < count <= MAX_SPLATS:
        raise FormatError(f"{count:,} splats, but a SOG holds 1 to {MAX_SPLATS:,}")
    palette = SogPalette(files, version) if has(meta, "shN") else None
    degree = COEFFICIENTS.index(palette.coefficients) if palette is not None else 0
    check_promise(count * 4 * width_of(degree), files.size)
    steps = _steps(meta, version, palette)
    lossy = ", ".join(map(quoted_value, files.lossy()))
    text = f"its images are lossy WebP ({lossy}), so that values are not those written; encode them without losses"
    losses = (Note(text, "container.lossy"),) if lossy else ()
    center_tables = codings.center_table(*_ends(meta, "means", 3))

    def in_order() -> list[Step]:
        """Return the steps, the largest first, so that no thread is left alone with it; SH labels need the palette."""
        return sorted(steps, key=lambda step: (step.texture == "shN", -files.bytes_of(step.texture, step.index)))

    def unpacked() -> Iterator[bytes]:
        for step in in_order():
            yield files.pixels(step.texture, step.index, count).tobytes()

    def fill(target: Target, threads: int, progress: Progress) -> None:
        if palette is not None:
            palette.values()
        positioned = None if source.scratch is None or target.once else Positioned(source.scratch(unpacked))

        def work(item: tuple[int, Step]) -> None:
            number, step = item
            if positioned is None:
                pixels = files.pixels(step.texture, step.index, count)
            else:
                data = positioned.read(4 * (number * count + target.start), 4 * len(target.splats))
                pixels = np.frombuffer(data, np.uint32)
            problem = step.fill(target.splats, pixels)
            if problem is not None:
                raise FormatError("; ".join((problem, *losses)))

        for number, _ in enumerate(ordered_map(work, enumerate(in_order()), threads), 1):
            progress("reading", number * count, len(steps) * count, "texel")
        rows = Target(target.splats)
        for_blocks(lambda part: _finish(center_tables, rows.rows(part)), len(target.splats), threads)

    antialiased = version == 2 and (meta.value.get("antialias") is True or meta.value.get("model") == "antialiased")
    header = {"version": version, "palette": palette.entries if palette is not None else 0, "bytes": files.size}
    note = read_note(meta.value.get("asset"))
    form, notes = f"SOG {version}", note.problems + losses
    return Reader(count, degree, form, fill, antialiased, notes, header, note.up, concurrent=True)


def _steps(meta: Json, version: int, palette: SogPalette | None) -> list[Step]:
    scales = quantize.decode_log(_tables(meta, "scales", version, 3))
    colors = _tables(meta, "sh0", version, 4 if version == 1 else 3)
    byte = np.arange(256, dtype=np.uint8)
    opacity = quantize.decode_logit(colors[3]) if version == 1 else quantize.decode_unorm8(byte)
    steps = [
        Step("means", 0, functools.partial(_fill_words, 0)),
        Step("means", 1, functools.partial(_fill_words, 1)),
        Step("quats", 0, _fill_quats),
        Step("scales", 0, functools.partial(_fill_scales, scales)),
        Step("sh0", 0, functools.partial(_fill_colors, quantize.decode_dc(colors[:3]), opacity[None])),
    ]
    return steps if palette is None else [*steps, Step("shN", 1, functools.partial(_fill_sh, palette))]


def _fill_words(place: int, splats: Splats, pixels: Pixels) -> None:
    """Put a byte of the codes of coordinates where the coordinates will be; two threads do so at a time."""
    texels.place_bytes(pixels, splats.center.view(np.uint8), place)


def _finish(tables: FloatArray, splats: Splats) -> None:
    """Decode coordinates, whose codes of 16 bits stand in their place."""
    texels.look_up_words(splats.center.view(np.uint32), tables, splats.center)


def _fill_scales(tables: FloatArray, splats: Splats, pixels: Pixels) -> None:
    texels.look_up(pixels, RED_GREEN_BLUE, tables, splats.scale)


def _fill_colors(tables: FloatArray, opacity: FloatArray, splats: Splats, pixels: Pixels) -> None:
    texels.look_up(pixels, RED_GREEN_BLUE, tables, splats.rgb)
    texels.look_up(pixels, ALPHA, opacity, splats.opacity[:, None])


def _fill_quats(splats: Splats, pixels: Pixels) -> None:
    texels.fill_quats(pixels, codings.quat_components(), splats.quat_xyzw)


def _fill_sh(palette: SogPalette, splats: Splats, pixels: Pixels) -> str | None:
    values = palette.values()
    rows = values.reshape(len(values), -1)
    largest = texels.gather_rows(pixels, rows, splats.sh.reshape(len(splats), -1))
    return f"an SH label is beyond the {len(rows):,} entries of its palette" if largest >= len(rows) else None


def _tables(meta: Json, name: str, version: int, channels: int) -> FloatArray:
    """Return (channels, 256) float32 values of bytes: of a codebook in version 2, of ranges in version 1."""
    if version == 2:
        return np.tile(_codebook(meta, name), (channels, 1))
    return quantize.range_table(*_ends(meta, name, channels), 256).astype(np.float32)


def _ends(meta: Json, name: str, channels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = (meta.get(name, end).numbers(channels, most=LARGEST) for end in ("mins", "maxs"))
    return np.array(low), np.array(high)


def _codebook(meta: Json, name: str) -> FloatArray:
    """Return (256,) values. An old writer left null for the first one, which the mean step extrapolates."""
    book = meta.get(name, "codebook")
    if isinstance(book.value, list) and len(book.value) == 256 and book.value[0] is None:
        rest = [each.number(most=LARGEST) for each in list(book.items())[1:]]
        return np.array([rest[0] + (rest[0] - rest[-1]) / 255, *rest], np.float32)
    return np.array(book.numbers(256, most=LARGEST), np.float32)


class SogPalette:
    """Palette of SH, decoded when it is needed: K coefficients of each entry, and the number of entries.

    Raises:
        FormatError: its header, or what meta.json says of it, is wrong.
    """

    def __init__(self, files: SogFiles, version: int) -> None:
        width, height = files.sides("shN", 0, MAX_PALETTE * COEFFICIENTS[3])
        self.coefficients = width // codings.PALETTE_WIDTH
        if self.coefficients not in COEFFICIENTS[1:4] or width % codings.PALETTE_WIDTH:
            raise FormatError(f"its image of SH centroids is {width} texels wide, expected 64 times 3, 8 or 15")
        self.entries, self._texels = height * codings.PALETTE_WIDTH, width * height
        self._files, self._lock = files, threading.Lock()
        self._values: FloatArray | None = None
        if version == 1:
            low, high = (files.meta.number("shN", end, most=LARGEST) for end in ("mins", "maxs"))
            self._book = quantize.range_table(low, high, 256).astype(np.float32)
            return
        bands, count = files.meta.whole("shN", "bands"), files.meta.whole("shN", "count")
        if bands not in (1, 2, 3) or COEFFICIENTS[bands] != self.coefficients:
            raise FormatError(
                f"its image of SH centroids has {self.coefficients} coefficients, not those of {bands} bands"
            )
        if not 0 < count <= self.entries:
            raise FormatError(f"its image of SH centroids has {self.entries:,} entries, not {count:,}")
        self.entries = count
        self._book = _codebook(files.meta, "shN")

    def values(self) -> FloatArray:
        """Return (entries, K, 3) SH coefficients, on any thread."""
        with self._lock:
            if self._values is None:
                values = np.empty((self._texels, 3), np.float32)
                pixels = self._files.pixels("shN", 0, self._texels)
                texels.look_up(pixels, RED_GREEN_BLUE, np.tile(self._book, (3, 1)), values)
                self._values = values.reshape(-1, self.coefficients, 3)[: self.entries]
            return self._values
