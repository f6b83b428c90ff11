"""The 8-bit codes that Spark's PackedSplats and the RAD format share, and `SplatEncoding`, their ranges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from . import quantize
from .spark_codings import Words, to_code

#: Scales below this are encoded as 0: e ** -30.
SCALE_ZERO = np.float32(np.exp(-30))


#: Largest end of a range: float32 holds the width of a range from minus this to this.
LARGEST_END = float(quantize.LARGEST) / 2


@dataclass(frozen=True)
class SplatEncoding:
    """The ranges of the codes: Spark's `splatEncoding`, with its defaults.

    Attributes:
        rgb_min, rgb_max: colours of code 0 and 255.
        ln_scale_min, ln_scale_max: logarithms of the scales of code 1 and 255.
        sh1_max, sh2_max, sh3_max: largest SH coefficient of each degree.
        lod_opacity: alpha is 0..2, where 1..2 stands for D = 1..5, as Spark sets it for an LoD tree.
    """

    rgb_min: float = 0
    rgb_max: float = 1
    ln_scale_min: float = -12
    ln_scale_max: float = 9
    sh1_max: float = 1
    sh2_max: float = 1
    sh3_max: float = 1
    lod_opacity: bool = False

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "lod_opacity" and not isinstance(value, (int, float, np.integer, np.floating)):
                raise TypeError(f"{name} is {value!r}; give a number")
            if not abs(value) <= LARGEST_END:
                raise ValueError(f"{name} is {value}; give a number whose magnitude is at most {LARGEST_END:g}")
        for least, most in (("rgb_min", "rgb_max"), ("ln_scale_min", "ln_scale_max")):
            low, high = getattr(self, least), getattr(self, most)
            if not low < high:
                raise ValueError(f"{least} is {low:g}, which is not below {most}, {high:g}")
        for name in ("sh1_max", "sh2_max", "sh3_max"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name):g}; give a number above 0")

    @property
    def alpha_max(self) -> int:
        """The alpha of code 255."""
        return 2 if self.lod_opacity else 1

    def sh_max(self, degree: int) -> np.float32:
        """Return the largest coefficient of a degree."""
        return np.float32((self.sh1_max, self.sh2_max, self.sh3_max)[degree - 1])


#: That of Spark.
DEFAULT = SplatEncoding()


@np.errstate(over="ignore")
def encode_linear(values: FloatArray, low: float, high: float) -> Words:
    """Encode numbers as codes, low..high to 0..255; they are clamped to the range."""
    first, width = np.float32(low), np.float32(high) - np.float32(low)
    return to_code((values - first) / width * np.float32(255), 255)


def decode_linear(codes: NDArray[np.uint8], low: float, high: float) -> FloatArray:
    """Decode codes to low..high. Largest error: (high - low) / 510."""
    return quantize.of_range(codes.astype(np.float32) / np.float32(255), np.float32(low), np.float32(high))


def nearest_log(values: FloatArray) -> FloatArray:
    """Return natural logarithms, rounded once."""
    found: FloatArray = np.log(values.astype(np.float64)).astype(np.float32)
    return found


@np.errstate(over="ignore")  # a stranger's range may be any
def nearest_exp(values: FloatArray) -> FloatArray:
    """Return exponentials, rounded once."""
    found: FloatArray = np.exp(values.astype(np.float64)).astype(np.float32)
    return found


def encode_log_scale(
    scale: FloatArray,
    low: float,
    high: float,
    *,
    log: Callable[[FloatArray], FloatArray] = nearest_log,
    least: np.float32 = SCALE_ZERO,
) -> Words:
    """Encode linear scales: 0 for scales below e ** -30, 1..255 for logarithms from low to high.

    Args:
        log: of Spark's worker, `spark_codings.log`, or rounded once.
        least: scales below it are 0.
    """
    first = np.float32(low)
    width = np.float32(high) - first
    zero = scale < least
    logs = log(np.where(zero, np.float32(1), scale))
    codes = 1 + to_code(np.clip((logs - first) / width, 0, 1) * np.float32(254), 254)
    codes[zero] = 0
    return codes


@np.errstate(over="ignore")  # a stranger's range may be any
def log_scale_table(low: float, high: float, *, exp: Callable[[FloatArray], FloatArray] = nearest_exp) -> FloatArray:
    """Return (256,) linear scales of the codes. Largest error: a factor of e ** ((high - low) / 508); none for 0."""
    first = np.float32(low)
    logs = first + np.arange(-1, 255, dtype=np.float32) * ((np.float32(high) - first) / np.float32(254))
    table = exp(logs)
    table[0] = 0
    return table
