"""Writes SOG version 2: the images of a scene, and the meta.json that says what their bytes mean."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model import morton
from ...model.scene import Scene
from ...model.splats import FloatArray, Splats
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from ...system.threads import blocks_of, ordered_map
from ...system.units import count_of
from .. import quantize, sh_palette
from ..clamps import CodeRange
from ..file_names import META, SOG_IMAGES
from ..file_notes import note_of
from ..options import DEFAULTS, MAX_SH_CODES, WriteOptions
from . import texel_codings as codings
from .sog_container import MAX_SIDE, Texels, encode_webp, image_of, size_for, zipped
from .texel_codings import codebook, even_codebook, nearest

#: Power of the weights of splats in the palette of SH. With 1, pictures are better still, but the error of coefficients
#: is larger than that of splat-transform's; benchmarks/notes/file-sizes.md has the measurements.
SEEN = 0.5

#: The tilt of the book of scales: large splats, which are few, make most of a picture. Measured: 34,902 merged splats
#: come 6.6 dB closer to their source with 1 than with 0, and scales are off by 1.6 % instead of 1.0 %.
LARGE = 1.0

#: By how much codes may make a scale larger: a factor, a share of the splat's largest scale, and a length in world
#: units. The bounds of Streamed SOG's regions leave room for it. Scenes whose scales differ by 1e30 exceed it.
GROWTH, GROWTH_OF_LARGEST, GROWTH_OF_ALL = 4 / 3, 0.01, 1e-4

#: Fewest codes of a palette where nobody chooses, and the steps in which it grows, as PlayCanvas's writer has them.
LEAST_CODES = 1024

#: Largest colour and SH coefficient: float32 holds the squares of their differences. Chosen.
LARGEST_COLOR = 1e15

Order = NDArray[np.intp]


@dataclass(frozen=True)
class Texture:
    """Texture: what meta.json says of it besides the names of its files, and the image of each of these."""

    facts: Mapping[str, Any]
    images: Sequence[Texels]


def codes_for(count: int) -> int:
    """Return the default number of SH codes: one for one to two splats, from 1,024 to 65,536."""
    steps = 2 ** math.floor(math.log2(count / LEAST_CODES)) if count > LEAST_CODES else 1
    return min(LEAST_CODES * steps, MAX_SH_CODES)


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open: `encode` writes the scene with them.

    Raises:
        FormatError: the scene has a tree or no splats, or values that SOG cannot hold: opacities above 1, more splats
            than an image has texels.
    """
    codes = options.sog.sh_codes
    if scene.tree is not None:
        raise FormatError("SOG holds no Level-of-Detail tree")
    count = len(scene)
    if not count:
        raise FormatError("SOG holds at least one splat, and the scene has none")
    if max(size_for(count)) > MAX_SIDE:
        most = MAX_SIDE // 4 * 4
        raise FormatError(f"{count_of(count, 'splat')}; a SOG holds at most {most * most:,}")
    _check(scene.splats)
    sog = dataclasses.replace(options.sog, sh_codes=codes_for(count) if codes is None else codes)
    return dataclasses.replace(options, sog=sog)


def held(options: WriteOptions, sh_degree: int) -> tuple[CodeRange, ...]:
    """Return the values that SOG holds without clamping them: its codebooks suit any."""
    return ()


def _check(splats: Splats) -> None:
    """Raise a `FormatError` where splats have values that SOG cannot hold."""
    most = float(splats.opacity.max())
    if most > 1:
        raise FormatError(f"opacities reach {most:.6g}, and SOG holds 0 to 1; clip them first")
    for name, column in (("colours", splats.rgb), ("spherical harmonics", splats.sh)):
        largest = float(max(column.max(initial=0), -column.min(initial=np.float32(0))))
        if largest > LARGEST_COLOR:
            raise FormatError(f"{name} reach {largest:.3g}, and SOG is written with at most {LARGEST_COLOR:g}")


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Return the bytes of a bundled SOG, piece by piece: the same for any number of threads.

    Splats are in Morton order.

    Raises:
        FormatError, ValueError: see `settled`.
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
    """Return the files of an unbundled SOG: the name of each, and its bytes; meta.json is last.

    Splats are in Morton order, or `in_order` in their own; other arguments and errors are those of `encode`.
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
        "quats": lambda: Texture({}, [_per_splat(codings.encode_quat(splats.quat_xyzw[order]))]),
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
        meta[name] = {**texture.facts, "files": list(SOG_IMAGES[name])}
        yield from zip(SOG_IMAGES[name], contents, strict=True)
        progress("encoding", number + 1, len(makers), "image")
    yield META, json.dumps(meta, separators=(",", ":")).encode()


def _per_splat(texels: Texels) -> Texels:
    """Return the image of (N, C) texels, one for each splat."""
    return image_of(texels, *size_for(len(texels)))


def _means(words: codings.Words, low: codings.Wide, high: codings.Wide, order: Order) -> Texture:
    ordered = words[order]
    images = [_per_splat(part.astype(np.uint8)) for part in (ordered & np.uint16(255), ordered >> np.uint16(8))]
    return Texture({"mins": low.tolist(), "maxs": high.tolist()}, images)


def _scales(scale: FloatArray, order: Order) -> Texture:
    logs = quantize.encode_log(scale)
    book = codebook(logs, LARGE)
    codes = nearest(logs, book)
    if _grows(scale, codes, book):
        book = even_codebook(logs)
        codes = nearest(logs, book)
    return Texture({"codebook": _numbers(book)}, [_per_splat(codes[order])])


@np.errstate(over="ignore")  # the largest scales have no room above them
def _grows(scale: FloatArray, codes: NDArray[np.uint8], book: FloatArray) -> bool:
    """Return True if codes of a book make a splat so much larger that it may leave the bound of its region."""
    values = np.exp(book)
    for block in blocks_of(len(scale)):
        largest = np.max(scale[block], axis=1, keepdims=True)
        most = GROWTH * scale[block] + GROWTH_OF_LARGEST * largest + GROWTH_OF_ALL
        if np.any(values[codes[block]] > most):
            return True
    return False


def _sh0(splats: Splats, order: Order) -> Texture:
    dc = quantize.encode_dc(splats.rgb)
    book = codebook(dc)
    texels = np.column_stack([nearest(dc[order], book), quantize.encode_unorm8(splats.opacity[order])])
    return Texture({"codebook": _numbers(book)}, [_per_splat(texels)])


def _sh(palette: sh_palette.ShPalette, degree: int, order: Order) -> Texture:
    """Return the palette, its codes in the order in which splats have them first: those of neighbours are near."""
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
    """Return the numbers of a book with as many digits as tell float32 apart."""
    return [float(str(value)) for value in book]
