"""How many SH codes a SOG is written with, and which scenes it can hold."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ...model.scene import Scene
from ...model.splats import Splats
from ...support.defaults import MAX_SH_CODES
from ...support.errors import FormatError
from ...support.units import count_of
from ..clamps import Range
from ..options import WriteOptions
from ..sound import check_valid
from .images import MAX_SIDE, size_for

#: Fewest codes of a palette where nobody chooses, and the steps in which it grows, as PlayCanvas's writer has them.
LEAST_CODES = 1024

#: Largest colour and SH coefficient: float32 holds the squares of their differences. Chosen.
LARGEST_COLOR = 1e15


def codes_for(count: int) -> int:
    """The most SH codes of so many splats, where nobody chooses: one for one to two splats, from 1,024 to 65,536."""
    steps = 2 ** math.floor(math.log2(count / LEAST_CODES)) if count > LEAST_CODES else 1
    return min(LEAST_CODES * steps, MAX_SH_CODES)


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """These options with nothing left open: `encode` writes the scene with them.

    Raises:
        FormatError: the scene has a tree or no splats, or values that SOG cannot hold: opacities above 1, more splats
            than an image has texels.
        InvalidSplatsError: a splat is invalid.
    """
    codes = options.sog.sh_codes
    if scene.tree is not None:
        raise FormatError("SOG holds no Level-of-Detail tree")
    count = len(scene)
    if not count:
        raise FormatError("SOG holds at least one splat, and the scene has none")
    if max(size_for(count)) > MAX_SIDE:
        most = MAX_SIDE // 4 * 4
        raise FormatError(f"{count_of(count, 'splat')}; a SOG holds at most {most * most:,}")
    _check(scene.splats)
    sog = dataclasses.replace(options.sog, sh_codes=codes_for(count) if codes is None else codes)
    return dataclasses.replace(options, sog=sog)


def held(options: WriteOptions, sh_degree: int) -> tuple[Range, ...]:
    """Return the values that SOG holds without clamping them: its codebooks suit any."""
    return ()


def _check(splats: Splats) -> None:
    """Raises a `FormatError` where splats have values that SOG cannot hold."""
    check_valid(splats, threads=1)
    most = float(splats.opacity.max())
    if most > 1:
        raise FormatError(f"opacities reach {most:.6g}, and SOG holds 0 to 1; clip them first")
    for name, column in (("colours", splats.rgb), ("spherical harmonics", splats.sh)):
        largest = float(max(column.max(initial=0), -column.min(initial=np.float32(0))))
        if largest > LARGEST_COLOR:
            raise FormatError(f"{name} reach {largest:.3g}, and SOG is written with at most {LARGEST_COLOR:g}")
