"""The manifest of a Streamed SOG, its chunk files, and the promises that both break: what a report needs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import covariance
from ...model.morton import order_of_cells
from ...model.splats import FloatArray, Splats
from ...support.errors import FormatError
from ...support.parallel import blocks_of
from ...support.progress import Progress, silent
from ...support.units import count_of
from ...support.untrusted import quoted_value
from ..promises import Violation
from ..sog import codings
from .chunks import Beside, Chunk, filled, open_chunk
from .manifest import MAX_MANIFEST, Manifest, Run, parse
from .promises import broken, file_violations, is_box, leads_away, regions_of, violations

#: By how much a splat may lie outside of its bound: a share of its own extent, by which codes of 8 bits change it; of
#: its largest scale, since they turn it by up to 1.1 degrees; of the bound; and, for codes of logarithms of 16 bits, of
#: the distance from the origin plus 1, or half a step of these codes where that is more.
LOOSE_EXTENT, LOOSE_TURN, LOOSE_BOUND, LOOSE_CENTER = 0.25, 0.02, 1e-3, 2e-4

#: Cells along each axis in which the order of a run is looked at; writers sort by as many, or by more.
CELLS = 1 << 10

#: Share of a run's splats that may come after one that they precede, since codes move centres into the next cell: in
#: files of splat-transform it is up to 0.009, in no order at all 0.5. And the least number of them that is told of.
OUT_OF_ORDER, FEW = 0.05, 16


def survey_file(file: BinaryIO, beside: Beside) -> tuple[Manifest, dict[str, Chunk | str], list[Violation]]:
    """The manifest, each file that it names, or why that cannot be read, and the promises that they break.

    Args:
        file: the manifest.
        beside: opens the files that it names.

    Raises:
        FormatError: the manifest cannot be parsed.
    """
    manifest = parse(file.read(MAX_MANIFEST + 1))
    found = list(violations(manifest))
    files: dict[str, Chunk | str] = {}
    for name in manifest.names():
        if leads_away(name):
            continue  # a violation says so
        files[name] = _chunk_or_reason(beside, name)
    return manifest, files, [*found, *file_violations(manifest, files)]


def _chunk_or_reason(beside: Beside, name: str) -> Chunk | str:
    """What the meta.json of a file says, or why it cannot be read."""
    try:
        return open_chunk(beside, name, None)
    except FormatError as error:
        return str(error)


def survey_splats(
    beside: Beside,
    manifest: Manifest,
    files: Mapping[str, Chunk | str],
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> Iterator[Violation]:
    """The promises about splats that a file breaks; one chunk file at a time is decoded.

    Args:
        beside: opens the files.
        manifest: none of whose broken promises is fatal.
        files: of `survey_file`.
        threads: to decode with.
        progress: called after each chunk file.
    """
    total = sum(chunk.count for chunk in files.values() if isinstance(chunk, Chunk))
    done = 0
    runs: list[list[tuple[int, int, Run]]] = [[] for _ in manifest.filenames]
    for number, held, _ in regions_of(manifest):
        for level, run in held.items():
            runs[run.file].append((number, level, run))
    for name, here in zip(manifest.filenames, runs, strict=True):
        chunk = files.get(name)
        if not isinstance(chunk, Chunk):
            continue
        try:
            splats = filled(beside, [chunk], chunk.sh_degree, threads, silent)
        except FormatError as error:
            yield broken("chunk-files", str(error))
            continue
        if any(level for _, level, _ in here) and (invalid := splats.invalid()):
            count = int(np.count_nonzero(np.any(list(invalid.values()), axis=0)))
            text = f"{count_of(count, 'splat')} of {quoted_value(name)} have a number that is not finite"
            yield Violation("values.non-finite", text, fatal=False)
            continue
        steps = np.ptp(codings.sign_log(splats.center), axis=0) / codings.LAST_WORD if len(splats) else 0.0
        for number, level, run in here:
            part = splats.take(slice(run.offset, run.offset + run.count))
            what = f"{manifest.place(number)} at level {level}"
            bound = manifest.nodes[number].bound
            outside = _outside(part, np.array(bound), steps) if bound is not None and is_box(bound) else 0
            if outside:
                yield broken("extents", f"{count_of(outside, 'splat')} of {what} lie outside of its bound", fatal=False)
            descents = _descents(part.center)
            if descents > max(FEW, OUT_OF_ORDER * run.count):
                text = f"{descents:,} of {count_of(run.count, 'splat')} of {what} come after one that they precede"
                yield broken("order", text, fatal=False)
        done += chunk.count
        progress("checking", done, total, "splat")


def _outside(splats: Splats, bound: NDArray[np.float64], steps: NDArray[np.float64] | float) -> int:
    """Count the splats that lie outside of a bound with the ellipsoids of one standard deviation.

    Args:
        splats: of a run.
        bound: (2, 3) lowest and highest corner.
        steps: (3,) of the codes of centres, as shares of the distance from the origin plus 1.
    """
    loose, step = LOOSE_BOUND * np.abs(bound[1] - bound[0]), np.maximum(LOOSE_CENTER, np.expm1(steps) / 2)
    count = 0
    for block in blocks_of(len(splats)):
        center = splats.center[block].astype(np.float64)
        extent = np.sqrt(covariance(splats.scale[block], splats.quat_xyzw[block])[:, [0, 3, 5]])
        turned = LOOSE_TURN * np.maximum.reduce(splats.scale[block].T)[:, None]
        reach = (1 - LOOSE_EXTENT) * extent - turned - loose - step * (1 + np.abs(center))
        count += int(np.count_nonzero(np.any((center - reach < bound[0]) | (center + reach > bound[1]), axis=1)))
    return count


def _descents(center: FloatArray) -> int:
    """How many splats come after one that they precede on the Morton curve."""
    wide = center.astype(np.float64)
    low, extent = wide.min(axis=0, initial=np.inf), np.ptp(wide, axis=0) if len(wide) else 0
    scaled = (wide - low) / np.where(extent > 0, extent, 1) * CELLS
    order = order_of_cells(np.minimum(scaled, CELLS - 1).astype(np.uint32))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return int(np.count_nonzero(np.diff(rank) < 0))
