"""What splats become before each column is coded by itself: the rounding of one is made up for in another."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from . import coverage, quantize
from .quantize import Bytes


def to_code(
    splats: Splats, is_leaf: NDArray[np.bool_] | None, fractional_bits: int, sh_bits: int, *, covering: bool
) -> Splats:
    """The values that the streams of a file are coded from, of each splat by itself; those of a file stay as they are.

    Args:
        splats: N splats or nodes.
        is_leaf: (N,) which of them are leaves; None for splats without a tree.
        fractional_bits: of the positions, a step of which is too thin to matter.
        sh_bits: bits kept of the SH bytes of leaves; merged splats keep `quantize.LEAST_SH_BITS`.
        covering: opacities make up for the rounding of scales.
    """
    sh = splats.sh
    if sh.shape[1] and len(sh):
        sh = quantize.decode_sh(sh_codes(sh, is_leaf, sh_bits))
    return dataclasses.replace(splats, opacity=opacities(splats, fractional_bits, covering=covering), sh=sh)


def opacities(splats: Splats, fractional_bits: int, *, covering: bool) -> FloatArray:
    """(N,) linear opacities of `to_code`."""
    if not covering:
        return splats.opacity
    rounded = quantize.decode_log_scale(quantize.encode_log_scale(splats.scale))
    return coverage.kept(splats.opacity, splats.scale, rounded, 2.0**-fractional_bits)


def sh_codes(sh: FloatArray, is_leaf: NDArray[np.bool_] | None, sh_bits: int) -> Bytes:
    """(N, K, 3) the bytes that the SH of `to_code` are coded as."""
    codes = quantize.encode_sh(sh, sh_bits)
    if is_leaf is not None and sh_bits > quantize.LEAST_SH_BITS:
        codes[~is_leaf] = quantize.encode_sh(sh[~is_leaf], quantize.LEAST_SH_BITS)
    return codes
