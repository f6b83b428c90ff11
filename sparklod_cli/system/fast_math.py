"""exp2 and log2 of float32 as branch-free polynomials, which LLVM vectorizes, unlike calls of libm."""

from __future__ import annotations

import numpy as np

from .jit import kernel

f32 = np.float32

#: The bits of the float32 sqrt(1 / 2): mantissas are reduced to sqrt(1 / 2) .. sqrt(2).
ROOT_HALF = np.int32(0x3F3504F3)


@kernel(inline=True)
def exp2(t):
    """Return 2 ** t of a float32 t from -126 to 0, with a relative error of at most 2e-7."""
    whole = np.int32(np.int32(t) - np.int32(1))
    part = t - f32(whole)  # above 0, at most 1
    p = f32(0.0018775767)
    p = p * part + f32(0.0089893397)
    p = p * part + f32(0.055826318)
    p = p * part + f32(0.24015361)
    p = p * part + f32(0.69315308)
    p = p * part + f32(0.99999994)
    return p * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@kernel(inline=True)
def log2(v):
    """Return log2 of a positive normal float32, with a relative error of at most 4e-7, near 1 as well."""
    bits = np.float32(v).view(np.int32)
    whole = np.int32((bits - ROOT_HALF) >> np.int32(23))
    m = np.int32(bits - np.int32(whole << np.int32(23))).view(np.float32)  # from sqrt(1 / 2) to sqrt(2)
    # atanh series of (m - 1) / (m + 1), which is at most 0.1716
    s = (m - f32(1)) / (m + f32(1))
    q = s * s
    p = f32(0.41219858)
    p = p * q + f32(0.57707802)
    p = p * q + f32(0.96179669)
    p = p * q + f32(2.8853901)
    return f32(whole) + s * p
