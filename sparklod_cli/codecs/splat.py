"""antimatter15's .splat: 32 bytes per splat without a header, the most important splats first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.splats import Splats
from ..system.errors import FormatError, TruncatedError
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from . import quantize
from .encoder import CodeRange
from .formats import DEFAULTS, WriteOptions
from .reader import OpenFile, Reader, RowBuffer, Rows, encode_rows, rows_of

ROW = np.dtype(
    [
        ("center", "<f4", 3),  # 0
        ("scale", "<f4", 3),  # 12: linear
        ("rgb", "u1", 3),  # 24: display-referred, 0..255 for 0..1
        ("opacity", "u1"),  # 27: 0..255 for 0..1
        ("quat_wxyz", "u1", 4),  # 28: round(128 * q + 128)
    ]
)
assert ROW.itemsize == 32

#: Values that are stored without clamping: colours that round to a code, and no SH.
HELD = (CodeRange("rgb", -0.5 / 255, 255.5 / 255), CodeRange("sh", 0, 0))


def open_content(source: OpenFile) -> Reader:
    """Open a .splat file. The format has no header: any file whose size is a multiple of 32 is accepted."""
    size, count = source.size, source.size // ROW.itemsize
    if size % ROW.itemsize:
        raise TruncatedError(f"cut short, or not .splat: its {size:,} bytes are not a multiple of {ROW.itemsize}")

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        def decode_block(block: Rows) -> int:
            part, rows = block
            splats = target.rows(part)
            splats.center[:] = rows["center"]
            splats.scale[:] = rows["scale"]
            splats.rgb[:] = quantize.decode_unorm8(rows["rgb"])
            splats.opacity[:] = quantize.decode_unorm8(rows["opacity"])
            splats.quat_xyzw[:] = quantize.decode_quat_bytes(rows["quat_wxyz"])[:, [1, 2, 3, 0]]
            return part.stop

        blocks = rows_of(source.read_at, 0, ROW, target.start, target.stop, count)
        for done in ordered_map(decode_block, blocks, threads):
            progress("reading", done, count, "splat")

    return Reader(count, 0, "SPLAT", fill, concurrent=True)


def importance_order(splats: Splats) -> NDArray[np.intp]:
    """Return (N,) indices in the order of antimatter15's converter: by descending product of scales and opacity."""
    importance = splats.scale.astype(np.float64).prod(axis=1) * splats.opacity
    return np.argsort(-importance, kind="stable")


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options unchanged, since .splat has none; raises `FormatError` for a tree, which it cannot store."""
    if scene.tree is not None:
        raise FormatError("SPLAT holds no Level-of-Detail tree")
    return options


def held(options: WriteOptions, sh_degree: int) -> Sequence[CodeRange]:
    """Return the ranges of values that .splat stores without clamping."""
    return HELD


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Yield the bytes of a .splat file, with splats in order of importance and without SH."""
    settled(scene, options)
    order, plain = importance_order(scene.splats), scene.splats.with_max_sh(0)

    def rows(part: slice) -> bytes:
        splats = plain.take(order[part])
        out = np.empty(len(splats), ROW)
        out["center"] = splats.center
        out["scale"] = splats.scale
        out["rgb"] = quantize.encode_unorm8(splats.rgb)
        out["opacity"] = quantize.encode_unorm8(splats.opacity)
        out["quat_wxyz"] = quantize.encode_quat_bytes(splats.quat_xyzw[:, [3, 0, 1, 2]])
        return out.tobytes()

    yield from encode_rows(rows, len(order), threads, progress)
