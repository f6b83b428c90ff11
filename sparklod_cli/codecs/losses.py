"""Losses of splats: values that files clamp, rounding by an encoding, and the choice between Spark's two layouts.

ExtSplats clip SH: a coefficient keeps between half and all of its largest channel. PackedSplats have centres of float16
and clamp base colours to 0..1 and SH to -1..1. So strong SH look better as PackedSplats, colours beyond 0..1 and
places far from the origin as ExtSplats; `LayoutLoss` says which layout loses less.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import Splats, describe_invalid
from ..model.transforms import sh_basis
from ..system.errors import FormatError
from ..system.threads import blocks_of, ordered_map
from .encoder import SPZ_RANGES, CodeRange, Tally, tally
from .formats import WRITABLE, Format, WriteOptions
from .reader import decode_file
from .spark_codings import SplatEncoding

#: Share of leaves with a visible loss that users are told of, by column. Measured: with 0.36 % of colours clamped,
#: pictures of meadow change by up to 36 steps of 255 (61 dB); with 2.4 % of SH, those of playbot by up to 7 (71 dB).
MANY = {"scale": 0.001, "rgb": 0.001, "sh": 0.05}


@dataclass(frozen=True)
class Clamp:
    """Values of a column beyond one end of the range of their code, or beyond both ends of a range around 0.

    Attributes:
        column: column of `Splats`: center, scale, rgb or sh.
        above: the values lie above the upper end; otherwise below the lower one.
        splats: number of splats with such values.
        end: end of the range.
        farthest: value farthest beyond the end.
        degree: see `CodeRange`.
        both: the range is -end..end, the values lie beyond either end, and `farthest` is a magnitude.
        visible: number of leaves with a visible loss, see `tally`.
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float
    degree: int = 0
    both: bool = False
    visible: int = 0


#: Values that writing clamps: number of splats by column of `Splats`, and the clamps.
Clamps = tuple[dict[str, int], tuple[Clamp, ...]]


def clamp_matters(column: str, *, above: bool, visible: int, leaves: int) -> bool:
    """Return whether to report clamped values to users.

    A single splat that moves or shrinks may be large in a picture; other losses matter from a share of `MANY` on.
    """
    return visible > (0 if column == "center" or (column == "scale" and above) else MANY[column] * leaves)


def clamps_of(tallies: Sequence[Tally], ranges: Sequence[CodeRange]) -> Clamps:
    """Merge the tallies of all parts of a scene; the clamps are in the order of the ranges."""
    if not tallies:
        return {}, ()
    parts = np.stack(tallies)
    ends = parts[:, :, 4].min(axis=0), parts[:, :, 5].max(axis=0)
    merged = np.column_stack([parts[:, :, :4].sum(axis=0), *ends, parts[:, :, 6:].sum(axis=0)])
    counts, clamps = dict[str, int](), list[Clamp]()
    for each, row in zip(ranges, merged.tolist(), strict=True):
        below, above, beyond, either, least, most, *visible = row
        if either:
            counts[each.column] = int(either)
        sides = [(False, below, each.low, least, False, visible[0]), (True, above, each.high, most, False, visible[1])]
        if each.low == -each.high:
            sides = [(True, beyond, each.high, max(-least, most), True, visible[2])]
        for is_above, splats, end, farthest, both, seen in sides:
            if splats:
                clamps.append(Clamp(each.column, is_above, int(splats), end, farthest, each.degree, both, int(seen)))
    return counts, tuple(clamps)


def clamps_in(
    splats: Splats, threads: int = 1, ranges: Sequence[CodeRange] = SPZ_RANGES, tree: LodTree | None = None
) -> Clamps:
    """Return the values of splats, or of the nodes of a tree, that lie beyond ranges, in the order of the ranges."""

    def counted(part: slice) -> Tally:
        return tally(splats.take(part), ranges, None if tree is None else tree.rows(part).is_leaf)

    return clamps_of(list(ordered_map(counted, blocks_of(len(splats)), threads)), ranges)


#: Most splats of a sample, since losses are means. Chosen; takes about 0.2 s.
SAMPLE = 1 << 15

#: Directions in which colours are compared: the corners of a cube.
_DIRECTIONS = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T / np.sqrt(3)

#: Squared change of colour that a displacement by the size of a splat counts as: a third of its opacity, since
#: neighbours have similar colours. Chosen.
_DISPLACED = 0.1

#: Highest SH degree of pages of ExtSplats: Spark 2.2.0 has no texture for the second array of degree 3.
MOST_PAGED_DEGREE = 2


@dataclass(frozen=True)
class LayoutLoss:
    """Sums over splats: of weights, which are opacity times size, and of weighted losses in each layout.

    A loss is the squared change of the displayed colour, 0..1.
    """

    weight: float = 0.0
    ext: float = 0.0
    packed: float = 0.0

    @classmethod
    @np.errstate(over="ignore", invalid="ignore")  # of numbers near the end of float32
    def of(cls, splats: Splats) -> LayoutLoss:
        """Return the sums over valid, visible splats whose losses are finite."""
        from . import layouts

        bad = np.logical_or.reduce([splats.scale.max(axis=1, initial=0) <= 0, *splats.invalid().values()])
        splats = splats.take(np.flatnonzero(~bad))
        opacity = np.minimum(splats.opacity, 1).astype(np.float64)
        size = splats.scale.mean(axis=1, dtype=np.float64)
        seen = _colors(splats)

        def losses(rounded: Splats) -> NDArray[np.float64]:
            changes = np.square(_colors(rounded) - seen).mean(axis=(1, 2))
            moved = np.linalg.norm(rounded.center.astype(np.float64) - splats.center, axis=1)
            return np.square(opacity) * (changes + _DISPLACED * np.square(np.minimum(1, moved / size)))

        ext = losses(layouts.unpack_ext(layouts.pack_ext(splats)))
        packed = losses(layouts.unpack_packed(layouts.pack_packed(splats)))
        weight = np.where(np.isfinite(ext + packed), opacity * size, 0)
        return cls(float(weight.sum()), float(np.nan_to_num(ext) @ weight), float(np.nan_to_num(packed) @ weight))

    @classmethod
    def total(cls, parts: Iterable[LayoutLoss]) -> LayoutLoss:
        """Add up the sums of parts of a scene."""
        every = list(parts)
        return cls(*(sum(getattr(part, name) for part in every) for name in ("weight", "ext", "packed")))

    @property
    def better(self) -> str:
        """Layout that loses less, "ext" or "packed"; "ext", which has the finer codes, if both lose the same."""
        return "packed" if self.packed < self.ext else "ext"

    def psnr(self, layout: str) -> float:
        """Return the loss in a layout as a PSNR of the colours of splats, dB; infinity without loss."""
        loss = getattr(self, layout)
        return float(10 * np.log10(self.weight / loss)) if loss else np.inf


def sample_loss(splats: Splats, most: int = SAMPLE) -> LayoutLoss:
    """Return the loss of an evenly spaced sample of at most `most` splats."""
    return LayoutLoss.of(splats.take(slice(0, None, max(1, -(-len(splats) // most)))))


def _colors(splats: Splats) -> NDArray[np.float64]:
    """Return (N, directions, 3) displayed colours, 0 or more."""
    colors = np.repeat(splats.rgb[:, None].astype(np.float64), len(_DIRECTIONS), axis=1)
    if splats.sh_degree:
        colors += np.einsum("dk,nkc->ndc", sh_basis(_DIRECTIONS, splats.sh_degree), splats.sh)
    return np.maximum(colors, 0)


@dataclass(frozen=True)
class Losses:
    """Losses of a scene without a tree in a format.

    Attributes:
        clamped: number of splats with clamped values, by column of `Splats`.
        drops_sh: the splats have SH, and the output has not.
        up_lost: the axis that points up, if it is known and the format cannot store it; else None.
    """

    clamped: dict[str, int]
    drops_sh: bool
    up_lost: str | None


def settled_with_losses(scene: Scene, form: Format, options: WriteOptions, threads: int) -> tuple[WriteOptions, Losses]:
    """Settle the options and find the losses of a scene in a format; raises the errors of the codec's `settled`."""
    codec = form.codec()
    settled: WriteOptions = codec.settled(scene, options)
    ranges = codec.held(settled, scene.splats.sh_degree) if hasattr(codec, "held") else ()
    counts, clamps = clamps_in(scene.splats, threads, ranges)
    drops_sh = any(clamp.column == "sh" and clamp.end == 0 for clamp in clamps)
    clamped = {column: count for column, count in counts.items() if column != "sh" or not drops_sh}
    return settled, Losses(clamped, drops_sh, scene.up if form.bare else None)


def after(through: str, file: Path, scene: Scene, threads: int = 1) -> Splats:
    """Encode and decode the splats of a scene in one of `formats.ROUND_TRIPS`.

    Raises `FormatError`, which names the file, if splats are invalid or SPZ cannot store them.
    """
    from . import layouts

    invalid = scene.splats.invalid()
    if invalid:  # nodes of a tree: invalid splats of plain files were left out
        raise FormatError(f"{file}: {describe_invalid(invalid)}; no encoding can store such splats")
    try:
        if through == "packed":
            encoding = SplatEncoding(lod_opacity=scene.tree is not None)
            arrays = layouts.pack_packed(scene.splats, encoding, threads=threads)
            return layouts.unpack_packed(arrays, encoding, threads=threads)
        if through == "ext":
            return layouts.unpack_ext(layouts.pack_ext(scene.splats, threads=threads), threads=threads)
        codec = WRITABLE[f".{through}"].codec()
        options = WriteOptions(compression_level=1)  # the bytes are discarded, so they need not be small
        data = b"".join(codec.encode(scene, options, threads=threads))
        return decode_file(codec, io.BytesIO(data), threads=threads).splats
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from None
