"""Which encodings and ranges a RAD file is written with; docs/decisions has the measurements behind them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray
from ..support.errors import FormatError
from .clamps import Range
from .options import RadOptions, WriteOptions
from .rad_encodings import LARGEST_F16
from .rad_layout import AUTO, choices
from .splat_encoding import SCALE_ZERO, SplatEncoding
from .steps import SMALL_QUANTILE, fine_bits

#: What "auto" stands for, where the scene does not decide.
AUTOMATIC = RadOptions("f32_lebytes", "r8", "r8_delta", "ln_0r8", "oct88r8", "s8")

#: Range of the logarithms of scales up to which none is clamped: 254 steps of 4.7 % at most. Beyond, the smallest
#: `SMALL_QUANTILE` of the scales may be; those are flat splats' thicknesses.
LOG_RANGE = 12.0

#: Range from which float16 is used: as Spark does, which is also where its error of 2 ** -11 becomes the smaller one.
WIDE_LOG_RANGE = 25.0

#: Ranges end at multiples of this, so that their numbers are short and exact.
GRID = 1 / 64

#: Values that ranges are fitted to: more would not change them, but take longer.
SAMPLE = 1 << 18

#: Ends of ranges that are tried, as shares of the values that lie inside.
SHARES = 1 - np.array([0.0, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2])


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """These options with nothing left open: `encode` writes the scene with them.

    Raises:
        FormatError: there are more splats than the format can number.
        ValueError: an encoding is unknown.
    """
    rad = options.rad
    for name in ("center", "alpha", "rgb", "scales", "orientation", "sh"):
        if getattr(rad, name) not in choices(name):
            raise ValueError(f"{name} is {getattr(rad, name)!r}, not one of {', '.join(choices(name))}")
    if len(scene.splats) >= 1 << 32:
        raise FormatError(f"{len(scene.splats):,} splats; RAD numbers at most {(1 << 32) - 1:,}")
    ranges = rad.ranges or fitted(scene)
    given = {name: getattr(rad, name) for name in ("center", "alpha", "rgb", "scales", "orientation", "sh")}
    chosen = {name: getattr(AUTOMATIC, name) if value == AUTO else value for name, value in given.items()}
    if rad.scales == AUTO and ranges.ln_scale_max - ranges.ln_scale_min > WIDE_LOG_RANGE:
        chosen["scales"] = "ln_f16"
    bits = rad.center_bits
    if rad.center == AUTO and bits is None:
        # The lowest bytes of rounded float32 are mostly zeros, which take no room.
        bits = fine_bits(scene)
    return dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, center_bits=bits, ranges=ranges))


def fitted(scene: Scene) -> SplatEncoding:
    """The ranges that suit a scene."""
    splats = scene.splats
    rgb_min, rgb_max = _linear_range(splats.rgb)
    low, high = _log_range(splats.scale)
    tops = [1.0, 1.0, 1.0]
    for degree in range(1, splats.sh_degree + 1):
        tops[degree - 1] = _largest(splats.sh[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]])
    return SplatEncoding(rgb_min, rgb_max, low, high, tops[0], tops[1], tops[2], scene.tree is not None)


def held(options: WriteOptions, sh_degree: int) -> list[Range]:
    """The values that a file with these settled options holds without clamping them.

    Args:
        options: of `settled`.
        sh_degree: of the scene.
    """
    rad, found = options.rad, []
    ranges = rad.ranges or SplatEncoding()
    most = float(LARGEST_F16)
    if rad.center.startswith("f16"):
        found.append(Range("center", -most, most))
    if rad.scales == "ln_0r8":
        half = (ranges.ln_scale_max - ranges.ln_scale_min) / 508
        low, high = math.exp(ranges.ln_scale_min - half), math.exp(min(ranges.ln_scale_max + half, 88.0))
        found.append(Range("scale", low, high, zero=float(SCALE_ZERO)))
    if rad.rgb.startswith("r8"):
        half = (ranges.rgb_max - ranges.rgb_min) / 510
        found.append(Range("rgb", ranges.rgb_min - half, ranges.rgb_max + half))
    elif rad.rgb == "f16":
        found.append(Range("rgb", -most, most))
    for degree in range(1, sh_degree + 1):
        numbers = (3 * COEFFICIENTS[degree - 1], 3 * COEFFICIENTS[degree])
        top = most if rad.sh == "f16" else float(ranges.sh_max(degree)) * (1 + 1 / 254)
        if rad.sh != "f32":
            found.append(Range("sh", -top, top, numbers))
    return found


def _sampled(values: FloatArray) -> NDArray[np.float64]:
    flat = values.reshape(-1)
    return flat[:: max(1, flat.size // SAMPLE)].astype(np.float64)


def _outward(value: float, up: bool) -> float:
    return (math.ceil if up else math.floor)(value / GRID) * GRID


def _linear_range(values: FloatArray) -> tuple[float, float]:
    """The range of 255 steps with the least squared error, of rounding and of clamping together."""
    sample = np.sort(_sampled(values))
    if not sample.size:
        return 0.0, 1.0
    lows = np.unique(np.minimum(np.quantile(sample, 1 - SHARES), 0))
    highs = np.unique(np.maximum(np.quantile(sample, SHARES), 1))

    def error(low: float, high: float) -> float:
        beyond = np.maximum(low - sample, 0) + np.maximum(sample - high, 0)
        return float(np.mean(beyond**2)) + ((high - low) / 255) ** 2 / 12

    best = min((error(low, high), low, high) for low in lows for high in highs)
    return _outward(best[1], False), _outward(best[2], True)


def _largest(values: FloatArray) -> float:
    """The largest coefficient for 254 steps with the least squared error, of rounding and of clamping together."""
    sample = np.abs(_sampled(values))
    if not sample.size:
        return 1.0

    def error(top: float) -> float:
        return float(np.mean(np.maximum(sample - top, 0) ** 2)) + (top / 127) ** 2 / 12

    return max(GRID, _outward(min(np.quantile(sample, SHARES), key=error), True))


def _log_range(scale: FloatArray) -> tuple[float, float]:
    """From the logarithm of a small scale to that of the largest: the sizes of coarse splats must not be clamped."""
    visible = scale[scale > SCALE_ZERO]
    if not visible.size:
        return SplatEncoding.ln_scale_min, SplatEncoding.ln_scale_max
    least, most = (float(np.log(np.float64(end))) for end in (visible.min(), visible.max()))
    low = max(least, min(float(np.quantile(np.log(_sampled(visible)), SMALL_QUANTILE)), most - LOG_RANGE))
    low, high = _outward(low, False), _outward(most, True)
    return low, high if high > low else low + GRID
