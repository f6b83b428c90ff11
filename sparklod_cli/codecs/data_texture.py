"""The data texture of antimatter15's viewer and its descendants: RGBA32UI, 2048 texels wide, 2 texels per splat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import covariance
from ..model.splats import Splats
from ..system.errors import FormatError
from ..system.threads import for_blocks
from . import quantize
from .spark_codings import Words

WIDTH = 2048
SPLATS_A_ROW = WIDTH // 2

SPLAT = np.dtype(
    [
        ("center", "<f4", 3),  # 0: world units, in x y z of texel 2i
        ("unused", "<u4"),  # 12: 0
        ("covariance", "<f2", 6),  # 16: 4 * (xx xy | xz yy | yz zz), in x y z of texel 2i + 1; world units squared
        ("rgba", "u1", 4),  # 28: 0..1 in 255 steps, in its w
    ]
)
assert SPLAT.itemsize == 32

#: Factor of the covariance in the texture, and the largest float16, which bounds the product.
GAIN, LARGEST = 4, 65504


def pack(splats: Splats, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats as the viewer uploads them: "texture" (H, 2048, 4) uint32, H = ceil(N / 1024), at least 1.

    The viewer multiplies M^T M with M = diag(scale) R. Its R, by rows, is the transpose of the matrix that turns local
    into world axes, so that M^T M is the covariance A diag(scale ** 2) A^T with A local to world, as here.

    Colour and opacity are clamped to 0..1; SH is left out. A splat wider than float16 can express, 127.97 standard
    deviations in world units along an axis, is shrunk to that without changing its shape; the viewer's own would be
    infinite. float16s are rounded to the nearest and rotations are not quantized, where the viewer truncates both.
    """
    height = max(1, -(-len(splats) // SPLATS_A_ROW))
    texture = np.zeros((height, WIDTH, 4), np.uint32)
    texels = texture.reshape(-1, 8).view(SPLAT)[:, 0]

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = texels[part]
        rows["center"] = splats.center[part]
        stored = GAIN * covariance(splats.scale[part], splats.quat_xyzw[part])  # the largest element is on the diagonal
        rows["covariance"] = stored * (LARGEST / np.maximum(stored.max(axis=1, keepdims=True), LARGEST))
        # 0..1 to a byte: ties to even, as the viewer's clamped array rounds.
        rows["rgba"][:, :3] = quantize.encode_unorm8(splats.rgb[part])
        rows["rgba"][:, 3] = quantize.encode_unorm8(splats.opacity[part])

    for_blocks(encode, len(splats), threads)
    return {"texture": texture}


def capacity(arrays: Mapping[str, NDArray[Any]]) -> int:
    """Return how many splats fit into a texture; raises `FormatError` if it is missing or has another shape or type."""
    texture = arrays.get("texture")
    if texture is None:
        raise FormatError(f"there is no array texture, only {', '.join(arrays) or 'none'}")
    if texture.dtype != np.uint32 or texture.ndim != 3 or texture.shape[1:] != (WIDTH, 4):
        raise FormatError(f"texture is {texture.dtype}{list(texture.shape)}, expected uint32[H, {WIDTH}, 4]")
    return len(texture) * SPLATS_A_ROW
