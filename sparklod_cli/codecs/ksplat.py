"""mkkellogg's .ksplat: sections of splats in rows of fixed size, with centres relative to buckets.

Compression level 0 uses floats; level 1 half floats and 16-bit centres; level 2 bytes of SH as well.
"""

from __future__ import annotations

import functools
from bisect import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import normalized_quat
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray
from ..system.errors import FormatError, TruncatedError, VersionError
from ..system.progress import Progress
from ..system.threads import ordered_map
from ..system.units import count_of
from . import quantize
from .reader import OpenFile, Reader, RowBuffer, Rows, rows_of

HEADER = np.dtype(
    {
        "itemsize": 4096,
        "names": ["major", "minor", "sections", "splats", "level", "least_sh", "most_sh"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],  # in between: counts for progressive loading, and the centre of the scene
    }
)
SECTION = np.dtype(
    {
        "itemsize": 1024,
        "names": [
            *("splats", "room", "bucket_splats", "buckets", "bucket_width", "bucket_bytes"),
            *("steps", "full_buckets", "partial_buckets", "sh_degree"),
        ],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
    }
)

#: By compression level: types of centres, of scales and rotations, and of SH; steps from the middle of a bucket to its
#: side.
LEVELS = (("<f4", "<f4", "<f4", 1), ("<u2", "<f2", "<f2", 32767), ("<u2", "<f2", "u1", 32767))

#: Highest SH degree, that of Spark's and splat-transform's readers; mkkellogg's own viewer writes up to 2.
MAX_DEGREE = 3

#: Bytes of SH stand for -1.5..1.5 if the header has no range.
DEFAULT_SH = 1.5

#: Index of coefficient k of channel c in the SH of a splat, in which all of red come first within a degree.
SH_PLACES = np.array(
    [
        3 * COEFFICIENTS[degree - 1] + c * (2 * degree + 1) + k
        for degree in range(1, MAX_DEGREE + 1)
        for k in range(2 * degree + 1)
        for c in range(3)
    ]
)


def row_type(level: int, sh_degree: int) -> np.dtype[Any]:
    """Return the type of the row of a splat."""
    center, real, sh, _ = LEVELS[level]
    return np.dtype(
        [
            ("center", center, 3),  # level 0: as it is; above: steps from the bucket's low corner
            ("scale", real, 3),  # linear
            ("quat_wxyz", real, 4),
            ("rgb", "u1", 3),  # display-referred, 0..255 for 0..1
            ("opacity", "u1"),  # 0..255 for 0..1
            ("sh", sh, 3 * COEFFICIENTS[sh_degree]),  # bytes: 0..255 for the range in the header
        ]
    )


@dataclass(frozen=True)
class KsplatSection:
    """Position of a section, and coding of its centres.

    Attributes:
        first: index of the first splat in the scene.
        offset, end: positions in the file of the first row and of the byte after the last row.
        middles: (buckets, 3) centres of the buckets, world units.
        ends: (buckets,) number of splats up to the end of each bucket.
        step: width of a step, world units; there are `steps` steps from the low corner of a bucket to its middle.
    """

    first: int
    count: int
    row_type: np.dtype[Any]
    offset: int
    end: int
    middles: FloatArray
    ends: NDArray[np.int64]
    step: np.float32
    steps: int


def open_content(source: OpenFile) -> Reader:
    """Open a .ksplat file of any compression level."""
    file = source.file
    header = _read(file, HEADER, 1, "the header")[0]
    level, count = int(header["level"]), int(header["splats"])
    if header["major"] != 0 or header["minor"] < 1:
        raise VersionError(f"KSPLAT version {header['major']}.{header['minor']} is unknown, only 0.1 is read")
    if level >= len(LEVELS):
        raise VersionError(f"KSPLAT compression level {level} is unknown, only 0 to {len(LEVELS) - 1} are read")
    sections = list(_read_sections(file, source.size, int(header["sections"]), level))
    end = sections[-1].end if sections else HEADER.itemsize
    sections = [section for section in sections if section.count]
    firsts = [section.first for section in sections]
    found = sum(section.count for section in sections)
    if found != count:
        raise FormatError(f"its header announces {count_of(count, 'splat')}, its sections have {found:,}")
    degrees = [COEFFICIENTS.index(section.row_type["sh"].shape[0] // 3) for section in sections]
    low, high = header["least_sh"] or np.float32(-DEFAULT_SH), header["most_sh"] or np.float32(DEFAULT_SH)

    def rows(start: int, stop: int) -> Iterator[Rows]:
        for section in sections:
            first, last = max(start - section.first, 0), min(stop - section.first, section.count)
            for part, block in rows_of(source.read_at, section.offset, section.row_type, first, last, section.count):
                yield slice(section.first + part.start, section.first + part.stop), block

    @np.errstate(invalid="ignore", over="ignore")  # absurd numbers overflow
    def unpack(target: RowBuffer, block: Rows) -> int:
        part, stored = block
        splats = target.rows(part)
        section = sections[bisect(firsts, part.start) - 1]
        splats.center[:] = stored["center"]
        if level:  # steps from the low corner of a bucket
            number = np.arange(part.start - section.first, part.stop - section.first)
            middles = section.middles[np.searchsorted(section.ends, number, side="right")]
            splats.center[:] = (splats.center - np.float32(section.steps)) * section.step + middles
        splats.scale[:] = stored["scale"]
        splats.quat_xyzw[:] = normalized_quat(stored["quat_wxyz"].astype(np.float32))[:, [1, 2, 3, 0]]
        splats.rgb[:] = quantize.decode_unorm8(stored["rgb"])
        splats.opacity[:] = quantize.decode_unorm8(stored["opacity"])
        values = stored["sh"][:, SH_PLACES[: stored["sh"].shape[1]]].astype(np.float32)
        if level == 2:
            values = quantize.of_range(values / np.float32(255), low, high)
        coefficients = values.shape[1] // 3
        splats.sh[:, :coefficients] = values.reshape(len(stored), coefficients, 3)
        splats.sh[:, coefficients:] = 0  # the degree of other sections may be higher
        return part.stop

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        for done in ordered_map(functools.partial(unpack, target), rows(target.start, target.stop), threads):
            progress("reading", done, count, "splat")

    facts = {"level": level, "sections": len(sections), "trailing_bytes": source.size - end}
    return Reader(count, max(degrees, default=0), "KSPLAT", fill, header=facts, concurrent=True)


def _read(file: BinaryIO, kind: np.dtype[Any], count: int, subject: str) -> NDArray[Any]:
    data = file.read(kind.itemsize * count)
    if len(data) < kind.itemsize * count:
        raise TruncatedError(f"cut short inside {subject}")
    return np.frombuffer(data, kind)


def _read_sections(file: BinaryIO, size: int, count: int, level: int) -> Iterator[KsplatSection]:
    """Read the headers and buckets of all sections; checks that a file of `size` bytes can hold their rows."""
    at = HEADER.itemsize + count * SECTION.itemsize
    if at > size:
        raise TruncatedError(f"cut short: its header announces {count:,} sections")
    first = 0
    for header in _read(file, SECTION, count, "the sections' headers"):
        of = {name: header[name].item() for name in SECTION.names or ()}
        if of["sh_degree"] > MAX_DEGREE:
            raise VersionError(f"KSPLAT has no SH degree {of['sh_degree']}")
        rows = row_type(level, of["sh_degree"])
        buckets, partial = of["buckets"], of["partial_buckets"]
        offset = at + 4 * partial + of["bucket_bytes"] * buckets
        end = offset + of["room"] * rows.itemsize
        if end > size or of["splats"] > of["room"]:
            raise TruncatedError(f"cut short: a section announces {count_of(int(of['splats']), 'splat')}")
        middles, ends = np.empty((0, 3), np.float32), np.empty(0, np.int64)
        steps = of["steps"] or LEVELS[level][3]
        if level and of["splats"]:
            if of["bucket_bytes"] != 12 or of["full_buckets"] + partial > buckets:
                raise FormatError("the buckets of a section do not follow KSPLAT")
            file.seek(at)
            part_sizes = _read(file, np.dtype("<u4"), partial, "the buckets")
            middles = _read(file, np.dtype(("<f4", (3,))), buckets, "the buckets")
            sizes = np.concatenate([np.full(of["full_buckets"], of["bucket_splats"], np.int64), part_sizes])
            ends = np.cumsum(sizes)
            if of["splats"] > (ends[-1] if len(ends) else 0):
                raise FormatError(f"the buckets of a section are too small for its {of['splats']:,} splats")
        step = np.float32(of["bucket_width"] / 2 / steps)
        yield KsplatSection(first, of["splats"], rows, offset, end, middles, ends, step, steps)
        first += of["splats"]
        at = end
