"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats/rad.md` describes both.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from ...model.lod_tree import CHUNK_NODES, LodTree
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import COLUMNS, FloatArray, Splats
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from ...system.threads import blocks_of
from .. import quantize, sh_palette, spark_codings
from ..encoder import CLAMPED, CodeRange, Encoded, Windows, results, tally, windows_of
from ..formats import AUTO, DEFAULTS, RAD_ENCODINGS, RadOptions, WriteOptions
from ..quantize import Bytes
from ..reader import OpenFile, Reader, comment_of
from ..spark_codings import LARGEST_END, SCALE_ZERO, SplatEncoding
from ..statistics import EXACT_BITS, LOWER, SMALL_QUANTILE, UPPER, Distribution, Statistics, fine_bits, tops
from .property_codings import BLOCK, BY_NAME, CODINGS, GZ, LARGEST_F16, PROPERTIES, Property, Row, encodings_of
from .rad_header import Files, RadChunkHeader, RadHeader, in_files, in_one_file, pack_chunk_header, padding
from .rad_reader import RadReader as RadReader
from .rad_reader import open_content as open_content

#: Encodings for "auto" if nothing in the scene demands others.
AUTOMATIC = RadOptions("f32_lebytes", "r8", "r8", "ln_0r8", "oct88r8", "s8")

#: Encodings of centres as float16.
HALF = ("f16", "f16_lebytes")

#: Ranges of logarithms of scales and of colours from which float16 is used: steps of a byte would be as coarse as SPZ's
#: scales, 6 %, or 4 steps of 8-bit colour.
WIDE_LOG_RANGE, WIDE_RGB_RANGE = 16.0, 4.0

#: Ratio of length and width from which a splat is long. If half of the splats are, rotations are float16: those of
#: oct88r8, off by up to 1.9 degrees, would move the ends of each by a quarter of its width.
LONG = 8.0

#: Least range of codes of SH in a file: their steps of 1 / 127 are below what colours of 8 bits show, and finer ones
#: take more room. The splatEncoding of the header still has the fitted range, by which viewers pack SH into 6 to 8
#: bits.
LEAST_SH_MAX = 1.0

#: Range of the logarithms of scales up to which none is clamped: 254 steps of 4.7 % at most. Beyond, the smallest
#: `SMALL_QUANTILE` of the scales, thicknesses of flat splats, may be clamped.
LOG_RANGE = 12.0

#: Ranges end at multiples of this, so that their numbers are short and exact.
GRID = 1 / 64

#: Cap on the error of a colour or a coefficient, whose colour is wrong anyway. Otherwise a single splat far from all
#: others would decide the steps of all.
WORST = 0.5

#: Shares of values beyond the ends of ranges that are tried.
BEYOND = np.array([0.0, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2])


def needed(options: WriteOptions) -> frozenset[str]:
    """Return the names of the statistics that `settled` needs for these options."""
    rad = options.rad
    names = {"rgb", "scale", "sh"} if rad.ranges is None else set[str]()
    names |= {"leaf_scale"} if rad.center == AUTO and rad.center_bits is None else set()
    names |= {"leaf_length"} if rad.orientation == AUTO else set()
    return frozenset(names | ({"reach"} if rad.center in HALF else set()))


def settled(scene: Scene | Statistics, options: WriteOptions) -> WriteOptions:
    """Return the options with nothing left open; `FormatError` if they or the format cannot hold the scene."""
    rad = options.rad
    statistics = scene if isinstance(scene, Statistics) else Statistics.of_scene(scene, needed(options))
    if statistics.count >= 1 << 32:
        raise FormatError(f"{statistics.count:,} splats; RAD numbers at most {(1 << 32) - 1:,}")
    if rad.center in HALF and np.float16(min(statistics.reach or 0, LARGEST_F16)) >= LARGEST_F16:
        text = f"coordinates reach {statistics.reach:.6g}, and {rad.center} holds less than {LARGEST_F16:.0f}"
        raise FormatError(f"{text}; choose another encoding of centres, such as f32")
    ranges = rad.ranges or fitted(statistics)
    encodings = {name: getattr(rad, name) for name in RAD_ENCODINGS}
    chosen = {name: getattr(AUTOMATIC, name) if value == AUTO else value for name, value in encodings.items()}
    if rad.scales == AUTO and ranges.ln_scale_max - ranges.ln_scale_min > WIDE_LOG_RANGE:
        chosen["scales"] = "ln_f16"
    if rad.rgb == AUTO and ranges.rgb_max - ranges.rgb_min > WIDE_RGB_RANGE:
        chosen["rgb"] = "f16"
    if rad.orientation == AUTO and statistics.values["leaf_length"].quantile(0.5) >= LONG:
        chosen["orientation"] = "f16"
    bits = rad.center_bits
    if rad.center == AUTO and bits is None:
        # The lowest bytes of rounded float32 are mostly zeros, which compress to nothing.
        bits = min(fine_bits(statistics.values["leaf_scale"]), EXACT_BITS)
    return dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, center_bits=bits, ranges=ranges))


def code_range(row: Row, ranges: SplatEncoding) -> tuple[float, float]:
    """Return the range of the codes of a property; (0, 0) if they have none."""
    if row.degree:
        most = max(LEAST_SH_MAX, float(ranges.sh_max(row.degree)))
        return -most, most
    ends = {
        "rgb": (ranges.rgb_min, ranges.rgb_max),
        "scale": (ranges.ln_scale_min, ranges.ln_scale_max),
        "opacity": (0.0, float(ranges.alpha_max)),
    }
    return ends.get(row.column, (0.0, 0.0))


def held(options: WriteOptions, sh_degree: int) -> list[CodeRange]:
    """Return the ranges beyond which a file of this SH degree clamps values, by its settled options."""
    rad, ranges, most = options.rad, [], float(LARGEST_F16)
    for row in PROPERTIES:
        encoding = getattr(rad, row.option) if row.option else ""
        if row.codes or row.degree > sh_degree or row.column == "opacity" or rad.ranges is None:
            continue
        numbers = (3 * COEFFICIENTS[row.degree - 1], 3 * COEFFICIENTS[row.degree]) if row.degree else (0, None)
        low, high = code_range(row, rad.ranges)
        if encoding == "ln_0r8":
            half = (high - low) / 508
            ends = math.exp(low - half), math.exp(min(high + half, 88.0))
            ranges.append(CodeRange(row.column, *ends, zero=float(SCALE_ZERO)))
        elif encoding and CODINGS[encoding].ends:
            half = (high - low) / (508 if encoding.startswith("s8") else 510)
            ranges.append(CodeRange(row.column, low - half, high + half, numbers, degree=row.degree))
        elif encoding in HALF:
            ranges.append(CodeRange(row.column, -most, most, numbers, degree=row.degree))
    return ranges


def fitted(statistics: Statistics) -> SplatEncoding:
    """Return the ranges with the least error of clamping and rounding together, whatever the order of splats."""
    rgb_min, rgb_max = _linear_range(statistics.values["rgb"])
    low, high = _log_range(statistics.values["scale"])
    sh_max = dict.fromkeys(("sh1_max", "sh2_max", "sh3_max"), 1.0)
    for degree in range(1, statistics.sh_degree + 1):
        sh_max[f"sh{degree}_max"] = _largest(statistics.values[f"sh{degree}"])
    return SplatEncoding(rgb_min, rgb_max, low, high, **sh_max, lod_opacity=statistics.tree)


def _outward(value: float, up: bool) -> float:
    return (math.ceil if up else math.floor)(value / GRID) * GRID


def _clamping(counts: NDArray[np.int64], top: float) -> float:
    """Return the summed squared error of magnitudes that are clamped to `top`."""
    bins = np.flatnonzero(counts[:-1])
    beyond = np.clip(UPPER[bins] - top, 0, WORST)
    return float(np.sum(counts[bins] * beyond**2))


def _linear_range(values: Distribution) -> tuple[float, float]:
    """Return the range of 255 steps with the least squared error of rounding and clamping."""
    total, negative, positive = max(values.count, 1), values.magnitudes(-1), values.magnitudes(1)
    below = tops(negative, total, -values.lowest, BEYOND)
    above = np.maximum(tops(positive, total, values.highest, BEYOND), 1)
    lows = {-low: _clamping(negative, low) for low in below}
    highs = {high: _clamping(positive, high) for high in above}

    def error(ends: tuple[float, float]) -> float:
        low, high = ends
        return (lows[low] + highs[high]) / total + ((high - low) / 255) ** 2 / 12

    low, high = min(itertools.product(sorted(lows), sorted(highs)), key=error)
    return _outward(max(low, -LARGEST_END), False), _outward(min(high, LARGEST_END), True)


def _largest(values: Distribution) -> float:
    """Return the largest coefficient for 254 steps with the least squared error of rounding and clamping."""
    total, counts = values.count, values.magnitudes(1) + values.magnitudes(-1)
    most = max(values.highest, -values.lowest)
    if not total:
        return 1.0

    def error(top: float) -> float:
        return _clamping(counts, top) / total + (top / 127) ** 2 / 12

    return max(GRID, _outward(min(*tops(counts, total, most, BEYOND), LARGEST_END, key=error), True))


def _log_range(scale: Distribution) -> tuple[float, float]:
    """Return the range of logarithms of scales, up to the largest: sizes of coarse splats must not be clamped."""
    counts = scale.magnitudes(1)
    counts[(UPPER <= SCALE_ZERO) | ~np.isfinite(LOWER)] = 0
    bins = np.flatnonzero(counts)
    if not bins.size:
        return SplatEncoding.ln_scale_min, SplatEncoding.ln_scale_max
    small = bins[np.searchsorted(np.cumsum(counts[bins]), SMALL_QUANTILE * counts.sum())]
    largest = min(UPPER[bins[-1]], float(np.finfo(np.float32).max))
    least, small_log, most = np.log([LOWER[bins[0]], LOWER[small], largest])
    end = _outward(math.log(np.finfo(np.float32).max), False)  # the last code must not become infinite
    low = max(least, math.log(SCALE_ZERO), min(small_log, most - LOG_RANGE))
    low, high = _outward(min(low, end - GRID), False), min(_outward(most, True), end)
    return low, high if high > low else low + GRID


#: Largest size of chunks in bytes that wait in memory for their header; larger ones wait on disk.
SPOOLED = 1 << 26

#: Names of the arrays of a window's result: the bytes of a chunk, and their number.
CHUNK, SIZE = "chunk", "size"

#: Largest number of nodes that the palette of a tree on disk is made of, 16 times as many as codes; and number of
#: consecutive ones among them, so that reading them takes few reads. Chosen.
SAMPLE, RUN = 1 << 20, 1 << 8


@dataclass(frozen=True, eq=False)
class Palette:
    """Spherical harmonics that splats share.

    Attributes:
        codes: (codes, K, 3) coefficients, as many codes as the first chunk has splats: Spark reads no other number.
        used: number of codes in use; the rest are 0.
        labels: (N,) code of each splat; None to search for the codes of each chunk.
    """

    codes: FloatArray
    used: int
    labels: NDArray[np.uint32] | None

    @classmethod
    def of(cls, scene: Scene | Reader, most: int, threads: int, progress: Progress) -> Palette:
        """Cluster the SH of a scene to at most `most` codes, padded with zeros to the number that Spark reads."""
        if isinstance(scene, Scene):
            splats, count = scene.splats, len(scene)
        else:
            count, runs = scene.count, [0]
            step = count if count <= SAMPLE else RUN
            if count > SAMPLE:
                runs = np.linspace(0, count - RUN, SAMPLE // RUN).astype(np.int64).tolist()
            splats = Splats.concat([scene.read(start, start + step)[0] for start in runs])
        room = min(count, CHUNK_NODES)
        weight = sh_palette.visible_weight(splats)
        found = sh_palette.cluster(splats.sh, min(most, room), weight=weight, threads=threads, progress=progress)
        padded = np.zeros((room, *found.codes.shape[1:]), np.float32)
        padded[: len(found.codes)] = found.codes
        return cls(padded, len(found.codes), found.labels if len(splats) == count else None)

    def labels_of(self, splats: Splats, start: int) -> NDArray[np.uint32]:
        """Return (n,) codes of the splats of the file from number `start` on."""
        if self.labels is not None:
            return self.labels[start : start + len(splats)]
        return sh_palette.labels_of(splats.sh, self.codes[: self.used])


@dataclass(frozen=True, eq=False)
class RadEncoder:
    """`encoder.Encoder` of a file: the result of a window is a chunk.

    Attributes:
        header: header of the file, without chunks.
        codes: ranges of codes.
        palette: SH palette; None to store the coefficients of each splat.
        stored: chunks of an earlier file.
        unchanged: (N,) nodes that keep their codes in `stored` if the encoding is the same; None for no node.
    """

    header: RadHeader
    codes: SplatEncoding
    options: WriteOptions
    ranges: tuple[CodeRange, ...]
    palette: Palette | None = None
    stored: Sequence[StoredChunk] = ()
    unchanged: NDArray[np.bool_] | None = None

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        chunk = np.frombuffer(self._chunk(splats, tree, start), np.uint8)
        encoded = {CHUNK: chunk, SIZE: np.array([len(chunk)])}
        if self.ranges:
            encoded[CLAMPED] = tally(splats, self.ranges, None if tree is None else tree.is_leaf)
        return encoded

    def pieces(self, windows: Windows, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """Yield the bytes of one file from the results of all windows."""
        numbers = range(len(windows_of(self.header.count)))
        sizes = [int(windows(number, SIZE)[0]) for number in numbers]
        yield from self.one_file(sizes, (windows(number, CHUNK).tobytes() for number in numbers), progress)

    def one_file(self, sizes: Sequence[int], chunks: Iterable[bytes], progress: Progress) -> Iterator[bytes]:
        """Yield the bytes of one file from the sizes and the bytes of its chunks."""
        return in_one_file(self.header, sizes, self._counted(chunks, progress))

    def files(self, chunks: Iterable[bytes], stem: str, *, progress: Progress = silent) -> Files:
        """Yield the name and the bytes of a file for each chunk, and of the header; see `rad_header.in_files`."""
        return in_files(self.header, self._counted(chunks, progress), stem)

    def _counted(self, chunks: Iterable[bytes], progress: Progress) -> Iterator[bytes]:
        for part, chunk in zip(windows_of(self.header.count), chunks, strict=True):
            yield chunk
            progress("writing", part.stop, self.header.count, "splat")

    def _chunk(self, splats: Splats, tree: LodTree | None, start: int) -> bytes:
        payload, properties, at = [], [], 0
        labels = None if self.palette is None else self.palette.labels_of(splats, start)
        for row in self._rows(first=start == 0):
            encoding, codes, low, high = self._coded(row, splats, tree, labels, start)
            data = self._deflated(codes, encoding)
            properties.append(Property(at, len(data), row.name, encoding, GZ, low, high))
            payload += [data, bytes(padding(len(data)))]
            at += len(data) + padding(len(data))
        sh_degree, has_tree = self.header.max_sh, self.header.lod_tree
        header = RadChunkHeader(start, len(splats), at, sh_degree, has_tree, tuple(properties), self.codes)
        return b"".join([pack_chunk_header(header), *payload])

    def keeping(self, stored: Sequence[StoredChunk], unchanged: NDArray[np.bool_]) -> RadEncoder:
        """Return an encoder that copies the codes of (N,) `unchanged` nodes from `stored` chunks.

        Properties that `stored` has in another encoding are encoded again.
        """
        return dataclasses.replace(self, stored=stored, unchanged=unchanged)

    def _coded(
        self, row: Row, splats: Splats, tree: LodTree | None, labels: NDArray[np.uint32] | None, start: int
    ) -> tuple[str, NDArray[Any], float | None, float | None]:
        """Encode a property from node `start` on; return encoding, codes, and the ends of their range or None."""
        encoding = getattr(self.options.rad, row.option) if row.option else row.encodings[0]
        coding, stop = CODINGS[encoding], start + len(splats)
        values = self.values(row, encoding, splats, tree, labels)
        former = None if self.unchanged is None else self._former(row.name, start, stop)
        if self.unchanged is None or former is None or former[0].encoding != encoding:
            low, high = code_range(row, self.codes)
            return encoding, coding.encode(values, low, high), *((low, high) if coding.ends else (None, None))
        each, before = former
        flat = _flat(coding.encode(values, each.min or 0.0, each.max or 0.0), encoding, len(splats))
        unchanged = self.unchanged[start:stop]
        _by_splat(flat, row, encoding)[unchanged] = before[unchanged]
        if _differs(encoding):
            planes = flat.reshape(-1, len(splats))
            flat = np.diff(planes, axis=1, prepend=np.zeros((len(planes), 1), np.uint8))
        return encoding, flat, each.min, each.max

    def _former(self, name: str, start: int, stop: int) -> tuple[Property, Bytes] | None:
        """Return the stored coding of a property of nodes and their (n, ...) codes; None if chunks differ in coding."""
        found, codes = [], []
        for chunk in self.stored:
            own = chunk.codes.get(name)
            part = slice(max(start - chunk.start, 0), max(stop - chunk.start, 0))
            if own is None:
                return None
            if len(own[part]):
                found.append(chunk.properties[name])
                codes.append(own[part])
        if len({(each.encoding, each.min, each.max) for each in found}) != 1:
            return None
        return found[0], np.concatenate(codes)

    def _rows(self, *, first: bool) -> Iterator[Row]:
        for row in PROPERTIES:
            if row.degree:
                own = row.codes and first if self.palette is not None else not row.codes
                present = row.degree <= self.header.max_sh and own
            elif row.column == "labels":
                present = self.palette is not None
            else:
                present = row.column in COLUMNS or self.header.lod_tree
            if present:
                yield row

    def values(
        self, row: Row, encoding: str, splats: Splats, tree: LodTree | None, labels: NDArray[np.uint32] | None
    ) -> NDArray[Any]:
        """Return the (n, numbers) values of a property for its encoding."""
        if row.degree:
            source = splats.sh if self.palette is None else self.palette.codes
            flat = source.reshape(len(source), 3 * source.shape[1])
            return flat[:, 3 * COEFFICIENTS[row.degree - 1] : 3 * COEFFICIENTS[row.degree]]
        if row.column == "labels":
            assert labels is not None
            return labels[:, None]
        column: NDArray[Any] = getattr(splats if row.column in COLUMNS else tree, row.column)
        if row.column == "opacity":
            alpha = spark_codings.encode_lod_alpha(self._opacity(splats))
            if encoding == "r8" and self.codes.lod_opacity:
                # 1 of 0..2 lies between two codes, and must not become the upper one, that of a merged splat.
                alpha = np.where(alpha == 1, np.nextafter(np.float32(1), np.float32(0)), alpha)
            return alpha[:, None]
        if row.column == "quat_xyzw" and encoding != "oct88r8":
            return column[:, :3] * np.where(column[:, 3:] < 0, np.float32(-1), np.float32(1))
        if row.column == "center" and self.options.rad.center_bits is not None:
            return rounded(column, self.options.rad.center_bits)
        return column if column.ndim == 2 else column[:, None]

    def _opacity(self, splats: Splats) -> FloatArray:
        """Return (n,) opacities that compensate for the rounding of scales."""
        if not self.options.covering:
            return splats.opacity
        ends = code_range(BY_NAME["scales"], self.codes)
        bits = self.options.rad.center_bits
        blur, kept = 0.0 if bits is None else 2.0**-bits, np.empty_like(splats.opacity)
        for part in blocks_of(len(splats), BLOCK):
            scale = splats.scale[part]
            rounded = CODINGS[self.options.rad.scales].rounded(scale, *ends)
            kept[part] = quantize.compensated(splats.opacity[part], scale, rounded, blur)
        return kept

    def _deflated(self, codes: NDArray[Any], encoding: str) -> bytes:
        # Codes of one byte have runs only: longer matches are chance, and make streams longer and slower.
        strategy = zlib_ng.Z_RLE if CODINGS[encoding].size == 1 else zlib_ng.Z_DEFAULT_STRATEGY
        level, raw = self.options.compression_level, -zlib_ng.MAX_WBITS
        packer = zlib_ng.compressobj(level, zlib_ng.DEFLATED, raw, zlib_ng.DEF_MEM_LEVEL, strategy)
        return packer.compress(codes.data.cast("B")) + packer.flush()


def encoder(
    scene: Scene | Reader,
    options: WriteOptions,
    *,
    counting: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> RadEncoder:
    """Return the encoder of a scene, by reading only the splats for a palette; `counting` counts clamped values."""
    codes, most, palette = options.rad.ranges, options.rad.sh_codes, None
    if codes is None:
        raise ValueError("the options leave choices open; `settled` makes them")
    if isinstance(scene, Scene):
        count, sh_degree, has_tree = len(scene), scene.splats.sh_degree, scene.tree is not None
    else:
        count, sh_degree, has_tree = scene.count, scene.sh_degree, scene.has_tree
    if most is not None and sh_degree and count:
        palette = Palette.of(scene, most, threads, progress)
    entries = None if palette is None else len(palette.codes)
    comment = comment_of(antialiased=scene.antialiased, up=scene.up)
    header = RadHeader(count, sh_degree, has_tree, CHUNK_NODES, 0, (), codes, entries, comment)
    return RadEncoder(header, codes, options, tuple(held(options, sh_degree)) if counting else (), palette)


def rounded(center: FloatArray, bits: int) -> FloatArray:
    """Round centres to multiples of 2 ** -bits that float32 holds."""
    # A float, since numpy 1 makes objects of large integers.
    most = float(math.floor(math.ldexp(float(np.finfo(np.float32).max), bits)))
    multiples = np.rint(np.ldexp(center.astype(np.float64), bits)).clip(-most, most)
    return np.ldexp(multiples, -bits).astype(np.float32)


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Encode one file piece by piece; chunks wait in a temporary file for the header, which has their sizes.

    The same scene and options give the same bytes for any number of threads. Nodes keep their order.
    """
    of_scene = encoder(scene, settled(scene, options), threads=threads, progress=progress)
    with tempfile.SpooledTemporaryFile(SPOOLED) as file:
        sizes = [file.write(window[CHUNK].data) for window in results(of_scene, scene, threads, progress, "encoding")]
        file.seek(0)
        yield from of_scene.one_file(sizes, map(file.read, sizes), progress)


def encode_chunked(
    scene: Scene, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Files:
    """Return the name and the bytes of each file of a scene with a file a chunk, see `RadEncoder.files`."""
    of_scene = encoder(scene, settled(scene, options), threads=threads, progress=progress)
    windows = results(of_scene, scene, threads, progress, "writing")
    yield from of_scene.files((window[CHUNK].tobytes() for window in windows), stem)


@dataclass(frozen=True, eq=False)
class StoredChunk:
    """Codes of a chunk whose first node is `start`.

    Attributes:
        codes: (n, ...) bytes of each splat by the name of the property, after summing up differences.
    """

    start: int
    properties: Mapping[str, Property]
    codes: Mapping[str, Bytes]


def stored(source: OpenFile, options: WriteOptions) -> tuple[list[StoredChunk], WriteOptions]:
    """Read the codes of a file; return them and the options with open choices set as in the file."""
    reader, chunks = RadReader.open(source.file, source.open_companion), []
    for packed in map(reader.packed, range(len(reader.header.chunks))):
        count, properties = packed.header.count, {each.name: each for each in packed.header.properties}
        codes = {}
        for row in PROPERTIES:
            if row.name in properties and row.column in COLUMNS and not row.codes:
                each = properties[row.name]
                flat = _flat(packed.unpacked(each, row, count), each.encoding, count)
                codes[row.name] = np.ascontiguousarray(_by_splat(flat, row, each.encoding))
        chunks.append(StoredChunk(packed.header.base, properties, codes))
    rad, first = options.rad, chunks[0].properties
    found = encodings_of(first.values())
    if found.get("center") == AUTOMATIC.center:
        found["center"] = AUTO  # its rounding stays open: it matters for merged splats
    chosen: dict[str, Any] = {name: found.get(name, AUTO) for name in RAD_ENCODINGS if getattr(rad, name) == AUTO}
    ranges = rad.ranges or reader.header.encoding or SplatEncoding(lod_opacity=True)
    for name, low, high in (("rgb", "rgb_min", "rgb_max"), ("scales", "ln_scale_min", "ln_scale_max")):
        own = first.get(name) if rad.ranges is None else None
        if own is not None and CODINGS[own.encoding].ends and own.min is not None and own.max is not None:
            ends: dict[str, Any] = {low: own.min, high: own.max}
            ranges = dataclasses.replace(ranges, **ends)
    return chunks, dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, ranges=ranges))


def _flat(codes: NDArray[Any], encoding: str, count: int) -> Bytes:
    """Return a copy of the bytes of a property, after summing up differences."""
    flat = np.array(codes).reshape(-1).view(np.uint8)
    return np.cumsum(flat.reshape(-1, count), axis=1, dtype=np.uint8).reshape(-1) if _differs(encoding) else flat


def _differs(encoding: str) -> bool:
    return encoding.endswith("_delta")


def _by_splat(flat: Bytes, row: Row, encoding: str) -> Bytes:
    """Return an (N, ...) view of the bytes of a property, splat by splat."""
    size, numbers = CODINGS[encoding].size, row.numbers
    if encoding == "oct88r8":
        return flat.reshape(-1, numbers)
    if encoding.endswith("_lebytes"):
        return flat.reshape(size, numbers, -1).transpose(2, 1, 0)
    return flat.reshape(numbers, -1, size).transpose(1, 0, 2)
