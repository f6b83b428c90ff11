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

# Files of a scene: meta.json and images, in a zip or a folder. Sizes are checked before decoding.

#: Sides of images are multiples of this, as PlayCanvas makes them.
STEP = 4


def size_for(count: int) -> tuple[int, int]:
    """Return width and height of the image for a number of splats: about a square."""
    width = STEP * math.ceil(math.sqrt(count) / STEP)
    return width, STEP * math.ceil(count / width / STEP)


def image_of(texels: Texels, width: int, height: int) -> Texels:
    """Arrange (N, C) texels row by row as (height, width, C), with zeros behind them."""
    image = np.zeros((height * width, texels.shape[1]), np.uint8)
    image[: len(texels)] = texels
    return image.reshape(height, width, -1)


#: Largest meta.json, bytes; codebooks take 15,000.
MAX_META = 1 << 22

#: Permissions of the members of a zip that is written, and the system that has them, 3 for Unix.
MODE, UNIX = 0o100644 << 16, 3

#: Texels that an image may have: a multiple of the splats, and some more, since writers make images square or round
#: sides up to powers of two.
SPARE_FACTOR, SPARE_TEXELS = 4, 1 << 16


#: Largest magnitude of a number in meta.json, so that float32 holds what is computed from it.
LARGEST = 1e38


def parse_meta(data: bytes) -> Json:
    """Parse the meta.json of a SOG."""
    meta = Json.parse(data, Origin(META, FormatError), most=MAX_META)
    if not isinstance(meta.value, dict) or meta.value.keys().isdisjoint(("means", "quats")):
        raise NotSplatsError(f"its {META} is not that of a SOG")
    return meta


def has(meta: Json, key: str) -> bool:
    """Return True if a meta.json has a key with a value that is not null, false, "" or empty, as viewers test it."""
    value = meta.value.get(key)
    return bool(value) or type(value) is int


def image_names(meta: Json) -> list[str]:
    """Return the images of a scene that a meta.json names, texture by texture."""
    images = {texture: len(files) for texture, files in SOG_IMAGES.items() if texture != "shN" or has(meta, "shN")}
    return [meta.text(texture, "files", index) for texture, count in images.items() for index in range(count)]


def companion_names(data: bytes) -> list[str]:
    """Return all files that a meta.json names, images or not; none if it cannot be parsed."""
    try:
        root = parse_meta(data).value
    except FormatError:
        return []
    lists = (value.get("files") for value in root.values() if isinstance(value, dict))
    return [name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)]


class SogFiles:
    """Files of a SOG scene.

    Attributes:
        meta: its meta.json.
        size: bytes of all its files, which bound the sizes that images may announce.
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
        self._sizes = {} if self._archive else {name: self._companion_size(name) for name in image_names(self.meta)}
        self.size += sum(self._sizes.values())

    def _open_companion(self, name: str) -> BinaryIO:
        if self._companion is None:
            raise FormatError(f"{META} names {quoted_value(name)}, but other files cannot be opened here")
        return self._companion(name)

    def _companion_size(self, name: str) -> int:
        with self._open_companion(name) as file:
            return size_of(file)

    @contextlib.contextmanager
    def _opened(self, name: str, most: int) -> Iterator[tuple[WebPHeader, IO[bytes]]]:
        """Open an image that may have at most `most` texels, and read its header."""
        with self._archive.opened(name) if self._archive else self._open_companion(name) as file:
            header = read_header(file.read, name)
            if header.width * header.height > most:
                raise FormatError(f"{quoted_value(name)} has {header.width} x {header.height} texels, far too many")
            check_promise(4 * header.width * header.height, self.size)
            yield header, file

    def sides(self, texture: str, index: int, most: int) -> tuple[int, int]:
        """Return the width and height in the header of an image; `FormatError` if it has more than `most` texels."""
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
        """Return the names of the images that are compressed with losses."""
        return [name for name in image_names(self.meta) if self._is_lossy(name)]

    def _is_lossy(self, name: str) -> bool:
        try:
            with self._archive.opened(name, whole=False) if self._archive else self._open_companion(name) as file:
                return read_header(file.read, name).lossy
        except FormatError:  # which reading the splats reports
            return False

    def bytes_of(self, texture: str, index: int) -> int:
        """Return the stored size of an image."""
        name = self.meta.text(texture, "files", index)
        return self._archive.bytes_of(name) if self._archive else self._sizes[name]


def zipped(files: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    """Return the bytes of a zip, piece by piece: the same for the same files, as its members have no dates."""
    # A buffer that is emptied member by member could not be sought, and sizes would follow the members' contents.
    buffer, done = io.BytesIO(), 0
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files:
            member = zipfile.ZipInfo(name)  # of 1980, the earliest date
            member.create_system, member.external_attr = UNIX, MODE
            archive.writestr(member, content)
            yield buffer.getvalue()[done:]
            done = buffer.tell()
    yield buffer.getvalue()[done:]


# Reading.

#: Most splats: a WebP image has at most this many texels.
MAX_SPLATS = 1 << 28

#: Shifts of the channels in a pixel.
RED_GREEN_BLUE, ALPHA = np.array([16, 8, 0], np.uint32), np.array([24], np.uint32)


class Step(NamedTuple):
    """Decoding of an image, by its texture and number: `fill` fills rows by their pixels, and may return a problem."""

    texture: str
    number: int
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
        """Sort the steps, the largest first, so that no thread is left alone with it; SH labels need the palette."""
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
        """Put a byte of the codes of coordinates in the place of the coordinates; two threads do so at a time."""
        texels.place_bytes(pixels, splats.center.view(np.uint8), place)

    def color(splats: Splats, pixels: Pixels) -> None:
        texels.look_up(pixels, RED_GREEN_BLUE, rgb, splats.rgb)
        texels.look_up(pixels, ALPHA, opacity[None], splats.opacity[:, None])

    steps = [
        Step("means", 0, functools.partial(words, 0)),
        Step("means", 1, functools.partial(words, 1)),
        Step("quats", 0, lambda splats, pixels: texels.fill_quats(pixels, codings.quat_components(), splats.quat_xyzw)),
        Step("scales", 0, lambda splats, pixels: texels.look_up(pixels, RED_GREEN_BLUE, scales, splats.scale)),
        Step("sh0", 0, color),
    ]
    return steps if palette is None else [*steps, Step("shN", 1, functools.partial(_fill_sh, palette))]


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
    """Palette of SH, decoded when it is needed: K coefficients of each entry, and the number of entries."""

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


# Writing.

#: Power of the weights of splats in the palette of SH. With 1, pictures are better still, but the error of coefficients
#: is larger than that of splat-transform's; benchmarks/notes/file-sizes.md has the measurements.
SEEN = 0.5

#: The tilt of the book of scales: large splats, which are few, make most of a picture. Measured: 34,902 merged splats
#: come 6.6 dB closer to their source with 1 than with 0, and scales are off by 1.6 % instead of 1.0 %.
LARGE = 1.0

#: By how much codes may make a scale larger: a factor, a share of the splat's largest scale, and a length in world
#: units. The bounds of Streamed SOG's regions leave room for it. Scenes whose scales differ by 1e30 exceed it.
GROWTH, GROWTH_OF_LARGEST, GROWTH_OF_ALL = 4 / 3, 0.01, 1e-4

#: Default number of codes of the smallest palette, and of the steps in which it grows, as in PlayCanvas's writer.
LEAST_CODES = 1024

#: Largest colour and SH coefficient: float32 holds the squares of their differences. Chosen.
LARGEST_COLOR = 1e15

Order = NDArray[np.intp]


class Texture(NamedTuple):
    """Texture: its facts for meta.json, without the names of its files, and the image of each of these."""

    facts: Mapping[str, Any]
    images: Sequence[Texels]


def codes_for(count: int) -> int:
    """Return the default number of SH codes: one for one to two splats, from 1,024 to 65,536."""
    steps = 2 ** math.floor(math.log2(count / LEAST_CODES)) if count > LEAST_CODES else 1
    return min(LEAST_CODES * steps, MAX_SH_CODES)


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open.

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
    """Return the bytes of a bundled SOG, piece by piece: the same for any number of threads, in Morton order."""
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

    Splats are in Morton order, or `in_order` in their own.
    """
    options = settled(scene, options)
    splats = scene.splats
    low, high = (codings.sign_log(end) for end in (splats.center.min(axis=0), splats.center.max(axis=0)))
    words = codings.encode_center(splats.center, low, high)
    # The order of the codes: images get smaller than in the order of the centres, and a scene that was read from them
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
    """Return the numbers of a book with as many digits as distinguish float32."""
    return [float(str(value)) for value in book]
