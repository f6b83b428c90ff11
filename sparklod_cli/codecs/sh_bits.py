"""How many bits of each SH byte an SPZ file keeps: `ShBytes` counts, `enough` decides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray
from ..support.defaults import MAX_SH_DEGREE
from . import quantize

#: All bits of a byte.
ALL_BITS = 8

#: Largest root mean square, over splats and directions, of what dropping bits changes of a splat's colour: with
#: it, SH alone cost what 58 dB and more are, see docs/decisions/2026-11-22-rounding.md.
LARGEST_ERROR = 0.009

#: Splats that are counted at a time: they and their codes stay in the processor's cache.
_ROWS = 1 << 13


@dataclass(frozen=True, eq=False)
class ShBytes:
    """Counts of SH as bytes of SPZ with all their bits.

    Attributes:
        count: (degrees, 256) int64, how many coefficients of each degree have each code.
        between: how many coefficients have none exactly.
    """

    count: NDArray[np.int64]
    between: int

    @classmethod
    def of(cls, sh: FloatArray) -> ShBytes:
        """Counts (N, K, 3) coefficients."""
        count, between = np.zeros((MAX_SH_DEGREE, 256), np.int64), 0
        for start in range(0, len(sh), _ROWS):
            part = sh[start : start + _ROWS]
            codes = quantize.encode_sh(part, ALL_BITS)
            between += int(np.count_nonzero(quantize.decode_sh(codes) != part))
            for degree in range(MAX_SH_DEGREE):
                own = codes[:, COEFFICIENTS[degree] : COEFFICIENTS[degree + 1]]
                count[degree] += np.bincount(own.reshape(-1), minlength=256)
        return cls(count, between)

    @classmethod
    def merged(cls, parts: Sequence[ShBytes]) -> ShBytes:
        """Those of all coefficients of one part or more, in any order."""
        return cls(np.sum([part.count for part in parts], axis=0), sum(part.between for part in parts))

    def error(self, bits: int) -> float:
        """Root mean square of what keeping so many bits of the codes changes of a colour, over splats and directions.

        The mean square of a basis function over all directions is 1 / (4 * pi).
        """
        codes = np.broadcast_to(np.arange(256, dtype=np.uint8)[:, None, None], (256, COEFFICIENTS[MAX_SH_DEGREE], 3))
        whole = quantize.decode_sh(np.ascontiguousarray(codes))
        square = np.square(quantize.decode_sh(quantize.encode_sh(whole, bits)) - whole, dtype=np.float64)[:, :, 0]
        total = 0.0
        for degree, count in enumerate(self.count):
            if count.any():
                coefficients = 2 * degree + 3
                total += coefficients * float(count @ square[:, COEFFICIENTS[degree]]) / float(count.sum())
        return math.sqrt(total / (4 * math.pi))


def enough(found: ShBytes) -> int:
    """The fewest bits of which `LARGEST_ERROR` is true; all that there are of SH that are such codes already.

    Those come from SPZ, and stay as they are, however often they are written.

    Args:
        found: of the SH of full detail.
    """
    most = LARGEST_ERROR if found.between else 0.0
    every = range(quantize.LEAST_SH_BITS, ALL_BITS)
    return next((bits for bits in every if found.error(bits) <= most), ALL_BITS)
