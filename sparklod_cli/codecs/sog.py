"""SOG, PlayCanvas's splats as WebP images with a texel per splat, and a meta.json that defines their values.

A scene is a zip (.sog) or an unpacked folder. Version 2 maps bytes to values by codebooks, version 1 by ranges; both
are read, and version 2 is written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import math
import threading
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import IO, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model import morton
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS, width_of
from ..model.splats import FloatArray, Splats
from ..system.errors import FormatError, NotSplatsError, VersionError
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, for_blocks, ordered_map
from ..system.units import count_of
from ..system.untrusted import Json, Origin, quoted_value
from . import quantize, sh_palette
from . import sog_images as codings
from .compression import check_promise
from .formats import DEFAULTS, MAX_SH_CODES, META, SOG_IMAGES, WriteOptions
from .kernels import texels
from .merging import ZipFolder
from .reader import Note, OpenCompanion, OpenFile, Reader, RowBuffer, note_of, read_note, size_of
from .sog_images import (
    MAX_SIDE,
    Pixels,
    Texels,
    WebPHeader,
    codebook,
    encode_webp,
    even_codebook,
    nearest,
    pixels_of,
    read_header,
)

#: Largest meta.json in bytes; codebooks take 15,000.
MAX_META = 1 << 22

#: Allowed number of texels of an image, as a multiple of the splats and a constant: writers make images square or round
#: sides up to powers of two.
SPARE_FACTOR, SPARE_TEXELS = 4, 1 << 16

#: Largest magnitude of a number in meta.json, so that float32 holds the values computed from it.
LARGEST = 1e38


def parse_meta(data: bytes) -> Json:
    """Parse the meta.json of a SOG."""
    meta = Json.parse(data, Origin(META, FormatError), most=MAX_META)
    if not isinstance(meta.value, dict) or meta.value.keys().isdisjoint(("means", "quats")):
        raise NotSplatsError(f"its {META} is not that of a SOG")
    return meta


def has(meta: Json, key: str) -> bool:
    """Return whether a meta.json has a key whose value is not null, false, "" or empty, as viewers test it."""
    value = meta.value.get(key)
    return bool(value) or type(value) is int


def image_names(meta: Json) -> list[str]:
    """Return the names of the images of a scene, texture by texture."""
    images = {texture: len(files) for texture, files in SOG_IMAGES.items() if texture != "shN" or has(meta, "shN")}
    return [meta.text(texture, "files", index) for texture, count in images.items() for index in range(count)]


def companion_names(data: bytes) -> list[str]:
    """Return all files that a meta.json names, images or not; an empty list if it is invalid."""
    try:
        root = parse_meta(data).value
    except FormatError:
        return []
    lists = (value.get("files") for value in root.values() if isinstance(value, dict))
    return [name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)]


class SogFiles:
    """Files of a SOG scene, in a zip or a folder.

    Attributes:
        meta: parsed meta.json.
        size: size of all files in bytes, which limits the sizes that images may announce.
    """

    def __init__(self, file: BinaryIO, open_companion: OpenCompanion | None) -> None:
        self.size = size_of(file)
        zipped = file.read(2) == b"PK"
        file.seek(0)
        self._archive = ZipFolder(file) if zipped else None
        if self._archive is not None and self._archive.first != META:
            raise NotSplatsError(f"a zip archive with {self._archive.first}, not a SOG")
        self._companion = open_companion
        self.meta = parse_meta((self._archive.open(META) if self._archive else file).read(MAX_META + 1))
        self._sizes = dict[str, int]()
        for name in [] if self._archive else image_names(self.meta):
            with self._file(name) as image:
                self._sizes[name] = image.seek(0, io.SEEK_END)
        self.size += sum(self._sizes.values())

    def _file(self, name: str, *, whole: bool = True) -> contextlib.AbstractContextManager[IO[bytes]]:
        """Open an image; `whole` is that of `ZipFolder.opened`."""
        if self._archive is not None:
            return self._archive.opened(name, whole=whole)
        if self._companion is None:
            raise FormatError(f"{META} names {quoted_value(name)}, but other files cannot be opened here")
        return self._companion(name)

    @contextlib.contextmanager
    def _opened(self, name: str, most: int) -> Iterator[tuple[WebPHeader, IO[bytes]]]:
        """Open an image of at most `most` texels, and read its header."""
        with self._file(name) as file:
            header = read_header(file.read, name)
            if header.width * header.height > most:
                raise FormatError(f"{quoted_value(name)} has {header.width} x {header.height} texels, far too many")
            check_promise(4 * header.width * header.height, self.size)
            yield header, file

    def sides(self, texture: str, index: int, most: int) -> tuple[int, int]:
        """Read the width and height of an image; `FormatError` if it has more than `most` texels."""
        with self._opened(self.meta.text(texture, "files", index), most) as (header, _):
            return header.width, header.height

    def pixels(self, texture: str, index: int, count: int) -> Pixels:
        """Decode the first `count` pixels of an image, row by row; `FormatError` if it has fewer, or far more."""
        name = self.meta.text(texture, "files", index)
        with self._opened(name, SPARE_FACTOR * count + SPARE_TEXELS) as (header, file):
            total = header.width * header.height
            if total < count:
                raise FormatError(f"{quoted_value(name)} has {count_of(total, 'texel')} for {count_of(count, 'splat')}")
            return pixels_of(header, file.read, name)[:count]

    def lossy(self) -> list[str]:
        """Return the names of the images with lossy compression."""
        found = list[str]()
        for name in image_names(self.meta):
            with contextlib.suppress(FormatError), self._file(name, whole=False) as file:  # reading reports errors
                found += [name] if read_header(file.read, name).lossy else []
        return found

    def bytes_of(self, texture: str, index: int) -> int:
        """Return the stored size of an image in bytes."""
        name = self.meta.text(texture, "files", index)
        return self._archive.bytes_of(name) if self._archive else self._sizes[name]


def zipped(files: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    """Encode a zip piece by piece: the same bytes for the same files, since its members have no dates."""
    # The buffer is not emptied: a zip that cannot seek has sizes after the members' contents.
    buffer, done = io.BytesIO(), 0
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files:
            member = zipfile.ZipInfo(name)  # of 1980, the earliest date
            member.create_system, member.external_attr = 3, 0o100644 << 16  # Unix, and permissions there
            archive.writestr(member, content)
            yield buffer.getvalue()[done:]
            done = buffer.tell()
    yield buffer.getvalue()[done:]


# Reading.

#: Most splats, the texels of the largest WebP image.
MAX_SPLATS = 1 << 28

#: Shifts of the channels in a pixel.
RED_GREEN_BLUE, ALPHA = np.array([16, 8, 0], np.uint32), np.array([24], np.uint32)


class Step(NamedTuple):
    """Decoding of an image of a texture: `fill` fills rows from their pixels, and may return a problem."""

    texture: str
    number: int
    fill: Callable[[Splats, Pixels], str | None]


def open_content(source: OpenFile) -> Reader:
    """Open a .sog archive, or the meta.json of an unpacked one; `FormatError` if it is no complete SOG 1 or 2."""
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
        """Sort the steps by size, so that no thread ends with the largest; SH labels, which need the palette, last."""
        return sorted(steps, key=lambda step: (step.texture == "shN", -files.bytes_of(step.texture, step.number)))

    def unpacked() -> Iterator[bytes]:
        for step in in_order():
            yield files.pixels(step.texture, step.number, count).tobytes()

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        if palette is not None:
            palette.values()
        scratch = None if source.scratch is None or target.once else source.scratch(unpacked)

        def work(item: tuple[int, Step]) -> None:
            number, step = item
            if scratch is None:
                pixels = files.pixels(step.texture, step.number, count)
            else:
                data = scratch.read_at(4 * (number * count + target.start), 4 * len(target.splats))
                pixels = np.frombuffer(data, np.uint32)
            problem = step.fill(target.splats, pixels)
            if problem is not None:
                raise FormatError("; ".join((problem, *losses)))

        for number, _ in enumerate(ordered_map(work, enumerate(in_order()), threads), 1):
            progress("reading", number * count, len(steps) * count, "texel")

        def finish(part: slice) -> None:
            center = target.splats.center[part]
            texels.look_up_words(center.view(np.uint32), center_tables, center)

        for_blocks(finish, len(target.splats), threads)

    antialiased = version == 2 and (meta.value.get("antialias") is True or meta.value.get("model") == "antialiased")
    header = {"version": version, "palette": palette.entries if palette is not None else 0, "bytes": files.size}
    note = read_note(meta.value.get("asset"))
    form, notes = f"SOG {version}", note.problems + losses
    return Reader(count, degree, form, fill, antialiased, notes, header, note.up, concurrent=True)


def _steps(meta: Json, version: int, palette: SogPalette | None) -> list[Step]:
    scales = quantize.decode_log(_tables(meta, "scales", version, 3))
    colors = _tables(meta, "sh0", version, 4 if version == 1 else 3)
    rgb, byte = quantize.decode_dc(colors[:3]), np.arange(256, dtype=np.uint8)
    opacity = quantize.decode_logit(colors[3]) if version == 1 else quantize.decode_unorm8(byte)

    def words(place: int, splats: Splats, pixels: Pixels) -> None:
        """Store a byte of the codes of coordinates in the memory of the coordinates, where `finish` decodes them."""
        texels.place_bytes(pixels, splats.center.view(np.uint8), place)

    def color(splats: Splats, pixels: Pixels) -> None:
        texels.look_up(pixels, RED_GREEN_BLUE, rgb, splats.rgb)
        texels.look_up(pixels, ALPHA, opacity[None], splats.opacity[:, None])

    def sh(splats: Splats, pixels: Pixels) -> str | None:
        assert palette is not None
        rows = palette.values().reshape(palette.entries, -1)
        largest = texels.gather_rows(pixels, rows, splats.sh.reshape(len(splats), -1))
        return f"an SH label is beyond the {len(rows):,} entries of its palette" if largest >= len(rows) else None

    steps = [
        Step("means", 0, functools.partial(words, 0)),
        Step("means", 1, functools.partial(words, 1)),
        Step("quats", 0, lambda splats, pixels: texels.fill_quats(pixels, codings.quat_components(), splats.quat_xyzw)),
        Step("scales", 0, lambda splats, pixels: texels.look_up(pixels, RED_GREEN_BLUE, scales, splats.scale)),
        Step("sh0", 0, color),
    ]
    return steps if palette is None else [*steps, Step("shN", 1, sh)]


def _tables(meta: Json, name: str, version: int, channels: int) -> FloatArray:
    """Return the (channels, 256) float32 values of bytes, by a codebook in version 2, by ranges in version 1."""
    if version == 2:
        return np.tile(_codebook(meta, name), (channels, 1))
    return quantize.range_table(*_ends(meta, name, channels), 256).astype(np.float32)


def _ends(meta: Json, name: str, channels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = (meta.get(name, end).numbers(channels, most=LARGEST) for end in ("mins", "maxs"))
    return np.array(low), np.array(high)


def _codebook(meta: Json, name: str) -> FloatArray:
    """Return (256,) values; a first value of null, of an old writer, is extrapolated by the mean step."""
    book = meta.get(name, "codebook")
    if isinstance(book.value, list) and len(book.value) == 256 and book.value[0] is None:
        rest = [each.number(most=LARGEST) for each in list(book.items())[1:]]
        return np.array([rest[0] + (rest[0] - rest[-1]) / 255, *rest], np.float32)
    return np.array(book.numbers(256, most=LARGEST), np.float32)


class SogPalette:
    """Palette of SH, decoded on demand: number of coefficients of an entry, and number of entries."""

    def __init__(self, files: SogFiles, version: int) -> None:
        width, height = files.sides("shN", 0, MAX_SH_CODES * COEFFICIENTS[3])
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
            text = f"its image of SH centroids has {self.coefficients} coefficients"
            raise FormatError(f"{text}, not those of {bands} bands")
        if not 0 < count <= self.entries:
            raise FormatError(f"its image of SH centroids has {self.entries:,} entries, not {count:,}")
        self.entries = count
        self._book = _codebook(files.meta, "shN")

    def values(self) -> FloatArray:
        """Return (entries, K, 3) SH coefficients; several threads may call this."""
        with self._lock:
            if self._values is None:
                values = np.empty((self._texels, 3), np.float32)
                pixels = self._files.pixels("shN", 0, self._texels)
                texels.look_up(pixels, RED_GREEN_BLUE, np.tile(self._book, (3, 1)), values)
                self._values = values.reshape(-1, self.coefficients, 3)[: self.entries]
            return self._values


# Writing.

#: Sides of images are multiples of this, as in PlayCanvas's files.
STEP = 4

#: Power of the weights of splats in the palette of SH. With 1, pictures are better still, but the error of coefficients
#: is larger than that of splat-transform's; benchmarks/notes/file-sizes.md has the measurements.
SEEN = 0.5

#: Tilt of the book of scales: large splats, which are few, make most of a picture. Measured: 34,902 merged splats come
#: 6.6 dB closer to their source with 1 than with 0, and scales are off by 1.6 % instead of 1.0 %.
LARGE = 1.0

#: Largest growth of a scale by its code: a factor, a share of the splat's largest scale, and a length in world units,
#: for which the bounds of Streamed SOG's regions leave room. Scenes whose scales differ by 1e30 exceed it.
GROWTH, GROWTH_OF_LARGEST, GROWTH_OF_ALL = 4 / 3, 0.01, 1e-4

#: Default number of codes of the smallest palette, and unit of larger ones, as in PlayCanvas's writer.
LEAST_CODES = 1024

#: Largest colour and SH coefficient: float32 holds the squares of their differences. Chosen.
LARGEST_COLOR = 1e15

Order = NDArray[np.intp]

#: Facts of a texture for meta.json, without the names of its files, and its images.
Texture = tuple[Mapping[str, Any], Sequence[Texels]]


def size_for(count: int) -> tuple[int, int]:
    """Return width and height of the image for a number of splats: about a square."""
    width = STEP * math.ceil(math.sqrt(count) / STEP)
    return width, STEP * math.ceil(count / width / STEP)


def _image_of(texels: Texels, width: int, height: int) -> Texels:
    """Arrange (N, C) texels row by row as (height, width, C), with zeros behind them."""
    image = np.zeros((height * width, texels.shape[1]), np.uint8)
    image[: len(texels)] = texels
    return image.reshape(height, width, -1)


def codes_for(count: int) -> int:
    """Return the default number of SH codes, one for one to two splats, from 1,024 to 65,536."""
    steps = 2 ** math.floor(math.log2(count / LEAST_CODES)) if count > LEAST_CODES else 1
    return min(LEAST_CODES * steps, MAX_SH_CODES)


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open; `FormatError` if SOG cannot hold the scene."""
    codes, splats = options.sog.sh_codes, scene.splats
    if scene.tree is not None:
        raise FormatError("SOG holds no Level-of-Detail tree")
    count = len(scene)
    if not count:
        raise FormatError("SOG holds at least one splat, and the scene has none")
    if max(size_for(count)) > MAX_SIDE:
        most = MAX_SIDE // 4 * 4
        raise FormatError(f"{count_of(count, 'splat')}; a SOG holds at most {most * most:,}")
    opacity = float(splats.opacity.max())
    if opacity > 1:
        raise FormatError(f"opacities reach {opacity:.6g}, and SOG holds 0 to 1; clip them first")
    for name, column in (("colours", splats.rgb), ("spherical harmonics", splats.sh)):
        largest = float(max(column.max(initial=0), -column.min(initial=np.float32(0))))
        if largest > LARGEST_COLOR:
            raise FormatError(f"{name} reach {largest:.3g}, and SOG is written with at most {LARGEST_COLOR:g}")
    sog = dataclasses.replace(options.sog, sh_codes=codes_for(count) if codes is None else codes)
    return dataclasses.replace(options, sog=sog)


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Encode a bundled SOG in Morton order, piece by piece; the bytes are the same for any number of threads."""
    yield from zipped(encode_files(scene, options, threads=threads, progress=progress))


def encode_files(
    scene: Scene,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    in_order: bool = False,
) -> Iterator[tuple[str, bytes]]:
    """Yield the name and bytes of each file of an unpacked SOG, meta.json last; in Morton order unless `in_order`."""
    options = settled(scene, options)
    splats = scene.splats
    low, high = (codings.sign_log(end) for end in (splats.center.min(axis=0), splats.center.max(axis=0)))
    words = codings.encode_center(splats.center, low, high)
    # By the order of codes, images are smaller than by that of centres, and a scene that was read from them keeps it.
    order = np.arange(len(splats)) if in_order else morton.order_of_cells(words)
    makers: dict[str, Callable[[], Texture]] = {
        "means": functools.partial(_means, words, low, high, order),
        "scales": functools.partial(_scales, splats.scale, order),
        "quats": lambda: ({}, [_per_splat(codings.encode_quat(splats.quat_xyzw[order]))]),
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

    def work(name: str) -> tuple[str, Mapping[str, Any], list[bytes]]:
        facts, images = makers[name]()
        return name, facts, [encode_webp(image) for image in images]

    for number, (name, facts, contents) in enumerate(ordered_map(work, makers, threads)):
        meta[name] = {**facts, "files": list(SOG_IMAGES[name])}
        yield from zip(SOG_IMAGES[name], contents, strict=True)
        progress("encoding", number + 1, len(makers), "image")
    yield META, json.dumps(meta, separators=(",", ":")).encode()


def _per_splat(texels: Texels) -> Texels:
    return _image_of(texels, *size_for(len(texels)))


def _means(words: codings.Words, low: codings.Wide, high: codings.Wide, order: Order) -> Texture:
    ordered = words[order]
    images = [_per_splat(part.astype(np.uint8)) for part in (ordered & np.uint16(255), ordered >> np.uint16(8))]
    return {"mins": low.tolist(), "maxs": high.tolist()}, images


def _scales(scale: FloatArray, order: Order) -> Texture:
    logs = quantize.encode_log(scale)
    book = codebook(logs, LARGE)
    codes = nearest(logs, book)
    if _grows(scale, codes, book):
        book = even_codebook(logs)
        codes = nearest(logs, book)
    return {"codebook": _numbers(book)}, [_per_splat(codes[order])]


@np.errstate(over="ignore")  # the largest scales have no room above them
def _grows(scale: FloatArray, codes: NDArray[np.uint8], book: FloatArray) -> bool:
    """Return whether the codes of a book make a splat grow so much that it may leave the bound of its region."""
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
    return {"codebook": _numbers(book)}, [_per_splat(texels)]


def _sh(palette: sh_palette.ShPalette, degree: int, order: Order) -> Texture:
    """Return the palette with its codes in the order of their first splats, so that neighbours have near codes."""
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
    centroids = _image_of(nearest(codes, book).reshape(-1, 3), codings.PALETTE_WIDTH * coefficients, rows)
    texels = np.stack([words & np.uint16(255), words >> np.uint16(8), np.zeros_like(words)], axis=1)
    facts = {"count": count, "bands": degree, "codebook": _numbers(book)}
    return facts, [centroids, _per_splat(texels.astype(np.uint8))]


def _numbers(book: FloatArray) -> list[float]:
    """Return the numbers of a book with the fewest digits that identify a float32."""
    return [float(str(value)) for value in book]
