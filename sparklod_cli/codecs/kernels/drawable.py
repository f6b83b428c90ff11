"""Whether splats are beyond doubt valid, and visible, in one pass over their columns."""

from __future__ import annotations

import numpy as np

from ...system.jit import f4, i8, kernel

#: The largest finite float32.
LARGEST = np.finfo(np.float32).max


@kernel(f4[:], f4[:], f4[:], f4[:], f4[:], f4[:], f4, returns=(i8, i8))
def count_doubtful(center, scale, quat, opacity, rgb, sh, tolerance):
    """Count the tests of validity that splats fail, and the splats without opacity or scale.

    No test fails only if all splats are valid. Comparisons are written so that a NaN fails them; sums of their results
    are vectorized by LLVM. Columns are those of `Splats`, each in one dimension; `tolerance` is of a rotation's squared
    length.
    """
    doubtful = invisible = 0
    for column in (center, rgb, sh):
        for i in range(len(column)):
            doubtful += not abs(column[i]) <= LARGEST
    for i in range(len(opacity)):
        x, y, z, w = quat[4 * i], quat[4 * i + 1], quat[4 * i + 2], quat[4 * i + 3]
        doubtful += not abs(x * x + y * y + z * z + w * w - np.float32(1)) <= tolerance
        a, b, c = scale[3 * i], scale[3 * i + 1], scale[3 * i + 2]
        doubtful += not ((a >= 0) & (b >= 0) & (c >= 0) & (max(a, b, c) <= LARGEST))
        doubtful += not ((opacity[i] >= 0) & (opacity[i] <= LARGEST))
        invisible += (max(a, b, c) == 0) | (opacity[i] == 0)
    return doubtful, invisible
