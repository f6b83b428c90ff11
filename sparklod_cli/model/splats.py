"""`Splats`, the data model that all codecs, builders and renderers share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .sh import COEFFICIENTS

FloatArray = NDArray[np.floating[Any]]

#: Kinds of invalid splats, in the order in which they are checked, and how reports name them. They do not
#: describe a Gaussian. A splat of opacity 0 or scale 0 is valid, but invisible.
INVALID = {
    "non_finite": "not finite",
    "bad_rotation": "rotation not of length 1",
    "negative_scale": "negative scale",
    "negative_opacity": "negative opacity",
}

#: Largest difference between a rotation's squared length and 1. Codings with a byte per component are normalized when
#: they are read, so that only float32 rounding, about 1e-7, remains. Chosen.
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Splats:
    """N Gaussian splats as C-contiguous float32 columns.

    Attributes:
        center: (N, 3) world units, in the axes of the file they came from.
        scale: (N, 3) standard deviations along the local axes, linear, world units.
        quat_xyzw: (N, 4) unit quaternions, local to world.
        opacity: (N,) linear: 0..1 for an input splat, up to 1000 for a merged one (see `gaussian.lod_opacity`).
        rgb: (N, 3) display-referred colour, SH_C0 * f_dc + 0.5; may lie outside 0..1.
        sh: (N, K, 3) higher SH coefficients, K = 0, 3, 8 or 15, r g b innermost.
    """

    center: FloatArray
    scale: FloatArray
    quat_xyzw: FloatArray
    opacity: FloatArray
    rgb: FloatArray
    sh: FloatArray

    def __post_init__(self) -> None:
        n = len(self.center)
        shapes = {"center": (n, 3), "scale": (n, 3), "quat_xyzw": (n, 4), "opacity": (n,), "rgb": (n, 3)}
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else -1
        shapes["sh"] = (n, coefficients, 3)
        for name, shape in shapes.items():
            column = getattr(self, name)
            if column.shape != shape or column.dtype != np.float32 or not column.flags.c_contiguous:
                raise ValueError(
                    f"{name} is {column.dtype}{list(column.shape)}, expected C-contiguous float32{list(shape)}"
                )
        if coefficients not in COEFFICIENTS[:4]:
            raise ValueError(f"sh has {coefficients} coefficients, expected one of {COEFFICIENTS[:4]}")

    def __len__(self) -> int:
        return len(self.center)

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 3."""
        return COEFFICIENTS.index(self.sh.shape[1])

    @classmethod
    def empty(cls, count: int, sh_degree: int) -> Splats:
        """Return uninitialised columns for `count` splats, for a decoder or a kernel to fill."""
        shapes = {"opacity": (count,), "quat_xyzw": (count, 4), "sh": (count, COEFFICIENTS[sh_degree], 3)}
        return cls(**{name: np.empty(shapes.get(name, (count, 3)), np.float32) for name in COLUMNS})

    @classmethod
    def zeros(cls, count: int, sh_degree: int) -> Splats:
        """Return columns of zeros, which take no memory until they are written to."""
        shapes = {"opacity": (count,), "quat_xyzw": (count, 4), "sh": (count, COEFFICIENTS[sh_degree], 3)}
        return cls(**{name: np.zeros(shapes.get(name, (count, 3)), np.float32) for name in COLUMNS})

    @classmethod
    def concat(cls, parts: Sequence[Splats]) -> Splats:
        """Concatenate parts, which must have the same SH degree."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS})

    def frozen(self) -> Splats:
        """Return these splats with read-only columns: views, so that the arrays of other owners stay writable."""
        if not any(getattr(self, name).flags.writeable for name in COLUMNS):
            return self
        columns = {name: getattr(self, name).view() for name in COLUMNS}
        for column in columns.values():
            column.flags.writeable = False
        return Splats(**columns)

    def take(self, index: NDArray[Any] | slice) -> Splats:
        """Return the splats of an index array, a mask or a slice, of which consecutive rows are views."""
        return Splats(**{name: np.ascontiguousarray(getattr(self, name)[index]) for name in COLUMNS})

    def invalid(self) -> dict[str, NDArray[np.bool_]]:
        """Return (N,) masks of invalid splats, by the kinds of `INVALID` that occur; a splat is in at most one mask.

        This is the only definition of a valid splat. Readers return what a file contains; their callers reject or drop
        invalid splats.
        """
        finite = self._is_finite()
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.einsum("ij,ij->i", self.quat_xyzw, self.quat_xyzw)
            wrong = {
                "non_finite": ~finite,
                "bad_rotation": ~(np.abs(length - 1) <= UNIT_TOLERANCE),
                "negative_scale": np.minimum.reduce(self.scale.T) < 0,
                "negative_opacity": self.opacity < 0,
            }
        valid, found = np.ones(len(self), np.bool_), {}
        for kind in INVALID:
            if (mask := wrong[kind] & valid).any():
                found[kind] = mask
                valid &= ~mask
        return found

    def is_valid(self) -> NDArray[np.bool_]:
        """Return (N,) bool, false for invalid splats."""
        return ~np.logical_or.reduce([np.zeros(len(self), np.bool_), *self.invalid().values()])

    def _is_finite(self) -> NDArray[np.bool_]:
        finite = np.ones(len(self), np.bool_)
        for name in COLUMNS:
            column = getattr(self, name).reshape(len(self), math.prod(getattr(self, name).shape[1:]))
            # A finite sum has finite terms only; an infinite one may be an overflow. The whole column is summed first,
            # which is fast, then each row, and only rows whose sum is not finite are checked element by element.
            with np.errstate(over="ignore", invalid="ignore"):
                if np.isfinite(column.sum()):
                    continue
                suspect = np.flatnonzero(~np.isfinite(np.einsum("ij->i", column)))
            finite[suspect[~np.isfinite(column[suspect]).all(axis=1)]] = False
        return finite

    def with_max_sh(self, degree: int) -> Splats:
        """Return these splats without the SH coefficients above `degree`."""
        keep = COEFFICIENTS[degree]
        if keep >= self.sh.shape[1]:
            return self
        return dataclasses.replace(self, sh=np.ascontiguousarray(self.sh[:, :keep]))


COLUMNS = tuple(field.name for field in dataclasses.fields(Splats))


def same_rows(one: Splats, other: Splats) -> NDArray[np.bool_]:
    """Return (N,) which of as many splats have the same values, bit for bit."""
    same = np.ones(len(one), bool)
    for name in COLUMNS:
        a, b = (getattr(splats, name).reshape(len(one), -1).view(np.uint32) for splats in (one, other))
        same &= (a == b).all(axis=1)
    return same


def describe_invalid(invalid: dict[str, NDArray[np.bool_]]) -> str:
    """Return a message such as "3 of 50 splats are invalid (3 negative scale; the first is splat 7)"."""
    counts = {kind: int(np.count_nonzero(mask)) for kind, mask in invalid.items()}
    total = len(next(iter(invalid.values())))
    return describe_counts(counts, total, min(int(np.argmax(mask)) for mask in invalid.values()))


def describe_counts(counts: dict[str, int], total: int, first: int) -> str:
    """Return the message of `describe_invalid` for numbers of splats by kind, of `total`, and the first place."""
    if set(counts) == {"non_finite"}:
        what = "not finite (NaN, infinite, or a rotation of length 0"
    else:
        what = "invalid (" + ", ".join(f"{count:,} {INVALID[kind]}" for kind, count in counts.items())
    count = sum(counts.values())
    return f"{count:,} of {total:,} splats {'is' if count == 1 else 'are'} {what}; the first is splat {first:,})"
