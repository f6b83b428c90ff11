"""Reads SOG, whole or as a stream."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...model.streams import SceneStream
from ...support.errors import FormatError, VersionError
from ...support.parallel import for_blocks, ordered_map
from ...support.progress import Progress, silent
from .. import quantize
from ..compression import check_promise
from ..content import Content, Scratch, rows_in
from ..kernels import texels
from ..noted import read_note
from ..stream import Positioned
from . import codings
from .files import Files, Meta
from .webp import Pixels

#: Most entries of the palette of SH: a label has 16 bits.
MAX_PALETTE = 1 << 16

#: Most splats: a WebP image has at most this many texels.
MAX_SPLATS = 1 << 28

#: Where the channels stand in a pixel.
RED_GREEN_BLUE, ALPHA = np.array([16, 8, 0], np.uint32), np.array([24], np.uint32)


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
    """What is decoded of an image.

    Attributes:
        texture, index: of the image.
        fill: called with rows of a scene and their pixels; returns what is wrong with their values, or None.
    """

    texture: str
    index: int
    fill: Callable[[Splats, Pixels], str | None]


#: Gives the pixels of a step that belong to some rows; called with the number of the step.
PixelsOf = Callable[[int, slice], Pixels]


def _content(
    file: BinaryIO,
    beside: Callable[[str], BinaryIO] | None,
    unpacked: Callable[[Files, list[Step], int], PixelsOf] | None,
) -> Content:
    """The content of a file; without `unpacked` it can only be read as a whole."""
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
    palette = Palette(files, version) if meta.has("shN") else None
    degree = COEFFICIENTS.index(palette.coefficients) if palette is not None else 0
    check_promise(count * 4 * (14 + 3 * COEFFICIENTS[degree]), files.size)
    steps = _steps(meta, version, palette)
    center_tables = _center_tables(meta)

    def in_order() -> list[Step]:
        """The steps in the order in which they are taken, so that both ways of reading find the same fault first.

        The largest first, so that no thread is left alone with it; but the labels of SH need the palette.
        """
        return sorted(steps, key=lambda step: (step.texture == "shN", -files.bytes_of(step.texture, step.index)))

    def fill_all(out: Splats, start: int, threads: int, progress: Progress) -> None:
        def work(step: Step) -> None:
            _refuse(step.fill(out, files.pixels(step.texture, step.index, count)))

        tasks: list[Callable[[], object]] = [] if palette is None else [palette.values]
        tasks += [functools.partial(work, step) for step in in_order()]
        for number, _ in enumerate(ordered_map(lambda task: task(), tasks, threads)):
            progress("reading", (number + 1) * count, len(tasks) * count, "texel")
        for_blocks(lambda part: _finish(center_tables, rows_in(out, part)), count, threads, lambda done: None)

    def fill_some(out: Splats, start: int, threads: int, progress: Progress) -> None:
        assert unpacked is not None
        if palette is not None:
            palette.values()
        ordered = in_order()
        pixels_of = unpacked(files, ordered, count)

        def work(part: slice) -> None:
            rows = rows_in(out, part)
            for number, step in enumerate(ordered):
                _refuse(step.fill(rows, pixels_of(number, slice(start + part.start, start + part.stop))))
            _finish(center_tables, rows)

        for_blocks(work, len(out), threads, lambda done: None)

    antialiased = version == 2 and (meta.is_true("antialias") or meta.is_text("model", "antialiased"))
    header = {"version": version, "palette": palette.entries if palette is not None else 0, "bytes": files.size}
    fill = fill_some if unpacked is not None else fill_all
    noted = read_note(meta.root.get("asset"))
    return Content(count, degree, fill, f"SOG {version}", antialiased, noted.problems, header, noted.up)


def _unpacked(scratch: Scratch, progress: Progress, files: Files, steps: list[Step], count: int) -> PixelsOf:
    """Pixels from a scratch file that has those of all images, one image after the other."""

    def pieces() -> Iterator[bytes]:
        for number, step in enumerate(steps):
            yield files.pixels(step.texture, step.index, count).tobytes()
            progress("reading", (number + 1) * count, len(steps) * count, "texel")

    source = Positioned(scratch(pieces))

    def pixels_of(number: int, part: slice) -> Pixels:
        return np.frombuffer(source.read(4 * (number * count + part.start), 4 * (part.stop - part.start)), np.uint32)

    return pixels_of


def _steps(meta: Meta, version: int, palette: Palette | None) -> list[Step]:
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
    """Puts a byte of the codes of coordinates where the coordinates will be; two threads do so at a time."""
    texels.place_bytes(pixels, splats.center.view(np.uint8), place)


def _finish(tables: FloatArray, splats: Splats) -> None:
    """Decodes coordinates, whose codes of 16 bits stand in their place."""
    texels.look_up_words(splats.center.view(np.uint32), tables, splats.center)


def _fill_scales(tables: FloatArray, splats: Splats, pixels: Pixels) -> None:
    texels.look_up(pixels, RED_GREEN_BLUE, tables, splats.scale)


def _fill_colors(tables: FloatArray, opacity: FloatArray, splats: Splats, pixels: Pixels) -> None:
    texels.look_up(pixels, RED_GREEN_BLUE, tables, splats.rgb)
    texels.look_up(pixels, ALPHA, opacity, splats.opacity[:, None])


def _fill_quats(splats: Splats, pixels: Pixels) -> None:
    texels.fill_quats(pixels, codings.quat_components(), splats.quat_xyzw)


def _fill_sh(palette: Palette, splats: Splats, pixels: Pixels) -> str | None:
    values = palette.values()
    rows = values.reshape(len(values), -1)
    largest = texels.gather_rows(pixels, rows, splats.sh.reshape(len(splats), -1))
    return f"an SH label is beyond the {len(rows):,} entries of its palette" if largest >= len(rows) else None


def _refuse(problem: str | None) -> None:
    """Raise a problem, if there is one."""
    if problem is not None:
        raise FormatError(problem)


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


class Palette:
    """The palette of SH, which is decoded when it is needed.

    Attributes:
        coefficients: K of each entry.
        entries: how many.

    Raises:
        FormatError: its header, or what meta.json says of it, is wrong.
    """

    def __init__(self, files: Files, version: int) -> None:
        width, height = files.sides("shN", 0, MAX_PALETTE * COEFFICIENTS[3])
        self.coefficients = width // codings.PALETTE_WIDTH
        if self.coefficients not in COEFFICIENTS[1:4] or width % codings.PALETTE_WIDTH:
            raise FormatError(f"its image of SH centroids is {width} texels wide, expected 64 times 3, 8 or 15")
        self.entries, self._texels = height * codings.PALETTE_WIDTH, width * height
        self._files, self._lock = files, threading.Lock()
        self._values: FloatArray | None = None
        if version == 1:
            low, high = files.meta.number("shN", "mins"), files.meta.number("shN", "maxs")
            self._book = quantize.range_table(low, high, 256).astype(np.float32)
            return
        bands, count = files.meta.integer("shN", "bands"), files.meta.integer("shN", "count")
        if bands not in (1, 2, 3) or COEFFICIENTS[bands] != self.coefficients:
            raise FormatError(
                f"its image of SH centroids has {self.coefficients} coefficients, not those of {bands} bands"
            )
        if not 0 < count <= self.entries:
            raise FormatError(f"its image of SH centroids has {self.entries:,} entries, not {count:,}")
        self.entries = count
        self._book = _codebook(files.meta, "shN")

    def values(self) -> FloatArray:
        """(entries, K, 3) SH coefficients; for any thread."""
        with self._lock:
            if self._values is None:
                values = np.empty((self._texels, 3), np.float32)
                pixels = self._files.pixels("shN", 0, self._texels)
                texels.look_up(pixels, RED_GREEN_BLUE, np.tile(self._book, (3, 1)), values)
                self._values = values.reshape(-1, self.coefficients, 3)[: self.entries]
            return self._values
