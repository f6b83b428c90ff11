"""What splats become before each column is coded by itself: the rounding of one is made up for in another."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from . import coverage, quantize


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
    opacity = splats.opacity
    if covering:
        rounded = quantize.decode_log_scale(quantize.encode_log_scale(splats.scale))
        opacity = coverage.kept(opacity, splats.scale, rounded, 2.0**-fractional_bits)
    sh = splats.sh
    if sh.shape[1] and len(sh):
        least = quantize.LEAST_SH_BITS
        codes = quantize.encode_sh(sh, sh_bits)
        if is_leaf is not None and sh_bits > least:
            codes[~is_leaf] = quantize.encode_sh(sh[~is_leaf], least)
        sh = quantize.decode_sh(codes)
    return dataclasses.replace(splats, opacity=opacity, sh=sh)
