"""Writes SOG version 2: the images of a scene, and the meta.json that says what their bytes mean."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model import morton
from ...model.scene import Scene
from ...model.splats import FloatArray, Splats
from ...support.parallel import ordered_map
from ...support.progress import Progress, silent
from .. import quantize, sh_palette
from ..noted import note_of
from ..options import DEFAULTS, WriteOptions
from . import codings
from .archive import zipped
from .codebook import codebook, nearest
from .images import Texels, encode_webp, image_of, size_for
from .names import IMAGES, META
from .options import settled

#: Power of the weights of splats in the palette of SH. With 1, pictures are better still, but the error of coefficients
#: is larger than that of splat-transform's; docs/decisions has the measurements.
SEEN = 0.5

#: The tilt of the book of scales: large splats, which are few, make most of a picture. Measured: 34,902 merged splats
#: come 6.6 dB closer to their source with 1 than with 0, and scales are off by 1.6 % instead of 1.0 %.
LARGE = 1.0

Order = NDArray[np.intp]


@dataclass(frozen=True)
class Texture:
    """A texture: what meta.json says of it besides the names of its files, and the image of each of these."""

    facts: Mapping[str, Any]
    images: Sequence[Texels]


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """The bytes of a bundled SOG, piece by piece. The same scene and options give the same bytes for any threads.

    Splats are in Morton order.

    Args:
        scene: what is written.
        options: that may leave choices open.
        threads: to encode on.
        progress: told of the palette of SH, and of the images.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    yield from zipped(encode_files(scene, options, threads=threads, progress=progress))


def encode_files(
    scene: Scene,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    in_order: bool = False,
) -> Iterator[tuple[str, bytes]]:
    """The files of an unbundled SOG: the name of each, and its bytes; meta.json is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        in_order: splats keep their order; otherwise they are in Morton order.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    options = settled(scene, options)
    splats = scene.splats
    low, high = (codings.sign_log(end) for end in (splats.center.min(axis=0), splats.center.max(axis=0)))
    words = codings.encode_center(splats.center, low, high)
    # By what is written: the images get smaller than in the order of the centres, and a scene that is read from them
    # is written in the same order again.
    order = np.arange(len(splats)) if in_order else morton.order_of_cells(words)
    makers: dict[str, Callable[[], Texture]] = {
        "means": functools.partial(_means, words, low, high, order),
        "scales": functools.partial(_scales, splats.scale, order),
        "quats": functools.partial(_quats, splats.quat_xyzw, order),
        "sh0": functools.partial(_sh0, splats, order),
    }
    if splats.sh_degree:
        assert options.sog.sh_codes is not None
        weight = sh_palette.visible_weight(splats) ** SEEN
        palette = sh_palette.cluster(splats.sh, options.sog.sh_codes, weight=weight, threads=threads, progress=progress)
        makers["shN"] = functools.partial(_sh, palette, splats.sh_degree, order)

    meta: dict[str, Any] = {"version": 2, "asset": note_of(up=scene.up), "count": len(splats)}
    meta["antialias"] = scene.antialiased
    if scene.antialiased:
        meta["model"] = "antialiased"  # as PlayCanvas's tools have called it since 2026

    def work(name: str) -> tuple[str, Texture, list[bytes]]:
        texture = makers[name]()
        return name, texture, [encode_webp(image) for image in texture.images]

    for number, (name, texture, contents) in enumerate(ordered_map(work, makers, threads)):
        meta[name] = {**texture.facts, "files": list(IMAGES[name])}
        yield from zip(IMAGES[name], contents, strict=True)
        progress("encoding", number + 1, len(makers), "image")
    yield META, json.dumps(meta, separators=(",", ":")).encode()


def _per_splat(texels: Texels) -> Texels:
    """The image of (N, C) texels, one for each splat."""
    return image_of(texels, *size_for(len(texels)))


def _means(words: codings.Words, low: codings.Wide, high: codings.Wide, order: Order) -> Texture:
    ordered = words[order]
    images = [_per_splat(part.astype(np.uint8)) for part in (ordered & np.uint16(255), ordered >> np.uint16(8))]
    return Texture({"mins": low.tolist(), "maxs": high.tolist()}, images)


def _scales(scale: FloatArray, order: Order) -> Texture:
    logs = quantize.encode_log(scale)
    book = codebook(logs, LARGE)
    return Texture({"codebook": _numbers(book)}, [_per_splat(nearest(logs[order], book))])


def _quats(quat_xyzw: FloatArray, order: Order) -> Texture:
    return Texture({}, [_per_splat(codings.encode_quat(quat_xyzw[order]))])


def _sh0(splats: Splats, order: Order) -> Texture:
    dc = quantize.encode_dc(splats.rgb)
    book = codebook(dc)
    texels = np.column_stack([nearest(dc[order], book), quantize.encode_unorm8(splats.opacity[order])])
    return Texture({"codebook": _numbers(book)}, [_per_splat(texels)])


def _sh(palette: sh_palette.ShPalette, degree: int, order: Order) -> Texture:
    """The palette, whose codes are in the order in which splats have them first: those of neighbours are near."""
    labels = palette.labels[order]
    used, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    by_first = np.argsort(first)
    place = np.empty(len(used), np.uint16)
    place[by_first] = np.arange(len(used))
    words = place[inverse]
    codes = palette.codes[used[by_first]]
    book = codebook(codes)
    count, coefficients = codes.shape[:2]
    rows = -(-count // codings.PALETTE_WIDTH)
    centroids = image_of(nearest(codes, book).reshape(-1, 3), codings.PALETTE_WIDTH * coefficients, rows)
    texels = np.stack([words & np.uint16(255), words >> np.uint16(8), np.zeros_like(words)], axis=1)
    facts = {"count": count, "bands": degree, "codebook": _numbers(book)}
    return Texture(facts, [centroids, _per_splat(texels.astype(np.uint8))])


def _numbers(book: FloatArray) -> list[float]:
    """The numbers of a book with as many digits as tell float32 apart."""
    return [float(str(value)) for value in book]
