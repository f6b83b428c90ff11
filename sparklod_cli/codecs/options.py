"""`WriteOptions`, the choices of all formats that can be written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..support.defaults import DEFAULT_COMPRESSION

if TYPE_CHECKING:
    from .splat_encoding import SplatEncoding


@dataclass(frozen=True)
class RadOptions:
    """How to write RAD. Encodings are those of `rad_layout.choices`; "auto" suits the scene, see `rad_options`.

    Attributes:
        center, alpha, rgb, scales, orientation, sh: the encoding of each property.
        chunked: write each chunk into a file of its own.
        sh_codes: the most entries of a palette of spherical harmonics, which a label for each splat points into; None
            for coefficients of each splat's own.
        center_bits: centres are rounded to multiples of 2 ** -center_bits; None leaves them as they are, but where
            `center` is "auto" it is chosen, too.
        ranges: of the codes; None for those that suit the scene.
    """

    center: str = "auto"
    alpha: str = "auto"
    rgb: str = "auto"
    scales: str = "auto"
    orientation: str = "auto"
    sh: str = "auto"
    chunked: bool = False
    sh_codes: int | None = None
    center_bits: int | None = None
    ranges: SplatEncoding | None = None


@dataclass(frozen=True)
class SogOptions:
    """How to write SOG.

    Attributes:
        sh_codes: the most entries of the palette of spherical harmonics, which a label for each splat points into; None
            for as many as suit the number of splats, see `sog_writer`.
    """

    sh_codes: int | None = None


@dataclass(frozen=True)
class WriteOptions:
    """How to write a splat file. PLY and .splat leave no such choice, and ignore all of them.

    Attributes:
        spz_version: 2 (rotations in 3 bytes, off by 13.4 degrees at most) or 3 (in 4 bytes, by 0.35); None for 3.
        fractional_bits: of SPZ positions, 0 to 24; None for as many as suit the scene, see `spz_encoder`.
        compression_level: of SPZ and RAD, 1 (fast) to 9 (small).
        rad: of RAD.
        sog: of SOG.
        sh_bits: upper bits kept of each SH byte of SPZ, 4 to 8; None for as many as colours need (`statistics.enough`).
            Merged splats keep 4, and 5 of degree 1, as other writers do with all splats.
        covering: opacities make up for the rounding of scales, see `coverage`; False where splats of a tree are written
            in another format, so that they keep their opacities.
    """

    spz_version: int | None = None
    fractional_bits: int | None = None
    compression_level: int = DEFAULT_COMPRESSION
    rad: RadOptions = RadOptions()
    sog: SogOptions = SogOptions()
    sh_bits: int | None = None
    covering: bool = True


#: What is written where nobody chooses.
DEFAULTS = WriteOptions()
