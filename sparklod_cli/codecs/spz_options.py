"""Which version and how many fractional bits an SPZ file is written with."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..model.scene import Scene
from ..support.defaults import DEFAULT_SPZ_VERSION, MAX_FRACTIONAL_BITS, SPZ_VERSIONS
from ..support.errors import FormatError
from . import quantize
from .options import WriteOptions
from .sh_bits import ALL_BITS, enough
from .statistics import Statistics
from .steps import fine_bits

#: The largest code that a coordinate is given, 2 ** 23 - 2. Writers clamp what does not fit to the code after it, of
#: either sign, so `inspect` takes a coordinate that has that one for clamped.
LAST_CODE = quantize.FIXED24_MAX - 1


def largest_fractional_bits(largest: float) -> int:
    """The most fractional bits, 0 to 24, with which every coordinate fits 24-bit fixed point.

    Args:
        largest: magnitude of a coordinate.

    Raises:
        FormatError: not even whole units fit.
    """
    if np.rint(largest) > LAST_CODE:
        reach = f"{largest:.0f}" if largest < 1e7 else f"{largest:.3g}"
        raise FormatError(f"coordinates reach {reach}, SPZ holds at most {LAST_CODE}: scale the scene down")
    bits = MAX_FRACTIONAL_BITS
    while bits and np.rint(largest * 2.0**bits) > LAST_CODE:
        bits -= 1
    return bits


def needed(options: WriteOptions) -> frozenset[str]:
    """The statistics by which `settled` settles these options."""
    needed = {"reach"}
    if options.fractional_bits is None:
        needed.add("leaf_scale")
    if options.sh_bits is None:
        needed.add("leaf_sh")
    return frozenset(needed)


def settled(scene: Scene | Statistics, options: WriteOptions) -> WriteOptions:
    """These options with nothing left open: `encode` writes the scene with them.

    Positions get as many fractional bits as all nodes allow, up to where a step is far below the smallest splats of
    full detail (`steps.STEPS_A_SPLAT`): merged splats are larger. SH get as many bits as colours need, see `sh_bits`.

    Args:
        scene: or the statistics of one that are `needed`.
        options: that may leave choices open.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
        ValueError: there are no such bits.
    """
    version = DEFAULT_SPZ_VERSION if options.spz_version is None else options.spz_version
    found = scene if isinstance(scene, Statistics) else Statistics.of_scene(scene, needed(options))
    assert found.reach is not None
    bits, most = options.fractional_bits, largest_fractional_bits(found.reach)
    if bits is None:
        assert found.leaf_scale is not None
        bits = max(0, min(most, fine_bits(found.leaf_scale)))
    if bits > most:
        raise FormatError(f"a coordinate does not fit {bits} fractional bits; use at most {most}")
    sh_bits = options.sh_bits
    if sh_bits is None:
        sh_bits = quantize.LEAST_SH_BITS if found.leaf_sh is None else enough(found.leaf_sh)
    if not quantize.LEAST_SH_BITS <= sh_bits <= ALL_BITS:
        raise ValueError(f"sh_bits is {sh_bits}, not {quantize.LEAST_SH_BITS} to {ALL_BITS}")
    return dataclasses.replace(options, spz_version=version, fractional_bits=bits, sh_bits=sh_bits)


def like(header: Mapping[str, int], options: WriteOptions) -> WriteOptions:
    """These options, and where they leave a choice open, that of the SPZ file which a scene was read from.

    Its values then stay as they are. A version that is not written becomes the newest one that is; a scene from
    another format leaves the choice open.

    Args:
        header: of the scene, see `Scene`.
        options: that may leave choices open.
    """
    version, bits = options.spz_version, options.fractional_bits
    if "fractional_bits" not in header:
        return options
    if version is None:
        version = int(header["version"])
        version = version if version in SPZ_VERSIONS else max(SPZ_VERSIONS)
    bits = int(header["fractional_bits"]) if bits is None else bits
    return dataclasses.replace(options, spz_version=version, fractional_bits=bits)
