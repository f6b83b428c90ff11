"""`SplatEncoding`: the ranges of 8-bit codes, which Spark's PackedSplats and the RAD format share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
        if not (self.rgb_min < self.rgb_max and self.ln_scale_min < self.ln_scale_max):
            raise ValueError(f"a range is empty: {self}")
        if not min(self.sh1_max, self.sh2_max, self.sh3_max) > 0:
            raise ValueError(f"the largest SH coefficients must be positive: {self}")

    @property
    def alpha_max(self) -> int:
        """The alpha of code 255."""
        return 2 if self.lod_opacity else 1

    def sh_max(self, degree: int) -> np.float32:
        """The largest coefficient of a degree."""
        return np.float32((self.sh1_max, self.sh2_max, self.sh3_max)[degree - 1])


#: That of Spark.
DEFAULT = SplatEncoding()
