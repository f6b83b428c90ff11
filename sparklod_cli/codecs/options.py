"""`WriteOptions`, the choices of all formats that can be written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from ..system.setting_fields import CheckedSettings, Quantity, setting, whole
from .formats import (
    DEFAULT_COMPRESSION,
    DEFAULT_SPZ_VERSION,
    MAX_COMPRESSION,
    MAX_FRACTIONAL_BITS,
    MIN_COMPRESSION,
    SPZ_VERSIONS,
)

if TYPE_CHECKING:
    from .spark_codings import SplatEncoding

#: Entries of a palette of spherical harmonics: labels have 16 bits in RAD and in SOG.
MAX_SH_CODES = 65_536
SH_CODES = whole(2, MAX_SH_CODES)

#: Profiles of GLB: attributes as KHR_gaussian_splatting defines them, and SPZ as CesiumJS reads it.
KHRONOS, CESIUM = PROFILES = ("khronos", "cesium")


def _bits(text: str) -> int | None:
    if text != "auto" and not text.isdecimal():
        raise ValueError(f"{text!r} is neither auto nor a whole number")
    return None if text == "auto" else int(text)


#: The encodings that each property of RAD may be in, as Spark reads them; the first is the one that Spark writes.
RAD_ENCODINGS = {
    "center": ("f32_lebytes", "f32", "f16_lebytes", "f16"),
    "alpha": ("f16", "r8", "f32"),
    "rgb": ("r8_delta", "r8", "f16", "f32"),
    "scales": ("ln_0r8", "ln_f16", "f32"),
    "orientation": ("oct88r8", "f16", "f32"),
    "sh": ("s8", "s8_delta", "r8", "r8_delta", "f16", "f32"),
}

#: Leaves the choice of an encoding to the writer, which goes by the scene.
AUTO = "auto"

#: The values of their options.
RAD_CHOICES = {name: (AUTO, *encodings) for name, encodings in RAD_ENCODINGS.items()}


@dataclass(frozen=True)
class RadOptions(CheckedSettings):
    """Options of RAD files; encodings are explained in `rad.property_codings`.

    Attributes:
        chunked: write each chunk into a file of its own.
        ranges: of the codes; None for those that suit the scene.
    """

    HEADING: ClassVar[str] = "RAD"

    center: str = setting("Encoding of centres; auto suits the scene.", RAD_CHOICES["center"], AUTO, name="rad_center")
    alpha: str = setting("Encoding of opacities; auto suits the scene.", RAD_CHOICES["alpha"], AUTO, name="rad_alpha")
    rgb: str = setting("Encoding of colours; auto suits the scene.", RAD_CHOICES["rgb"], AUTO, name="rad_rgb")
    scales: str = setting("Encoding of scales; auto suits the scene.", RAD_CHOICES["scales"], AUTO, name="rad_scales")
    orientation: str = setting(
        "Encoding of rotations; auto suits the scene.", RAD_CHOICES["orientation"], AUTO, name="rad_orientation"
    )
    sh: str = setting("Encoding of spherical harmonics; auto suits the scene.", RAD_CHOICES["sh"], AUTO, name="rad_sh")
    chunked: bool = False
    sh_codes: int | None = setting(
        "Most entries of a palette of spherical harmonics, which a label for each splat points into; None for"
        " coefficients of each splat's own.",
        SH_CODES,
        only_api=True,
    )
    center_bits: int | None = setting(
        "Round centres to multiples of 2 ** -center_bits; None leaves them as they are, but where `center` is auto it"
        " is chosen, too.",
        whole(-149, 149),  # the smallest number of float32 has 149 binary digits after the point
        only_api=True,
    )
    ranges: SplatEncoding | None = None


@dataclass(frozen=True)
class SogOptions(CheckedSettings):
    """Options of SOG files."""

    sh_codes: int | None = setting(
        "Most entries of the palette of spherical harmonics, which a label for each splat points into; None for as many"
        " as suit the number of splats, see `sog.codes_for`.",
        SH_CODES,
        only_api=True,
    )


@dataclass(frozen=True)
class WriteOptions(CheckedSettings):
    """Options of splat files. PLY and .splat have none of these choices, and ignore all of them.

    Attributes:
        rad: of RAD.
        sog: of SOG.
        sh_bits: upper bits kept of each SH byte of SPZ, 4 to 8; None for as many as colours need (`statistics.enough`).
            Merged splats keep 4, and 5 of degree 1, as other writers do with all splats.
        covering: opacities make up for the rounding of scales, see `quantize.compensated`; False where splats of a tree
            are written in another format, so that they keep their opacities.
    """

    HEADING: ClassVar[str] = "File format"

    spz_version: int | None = setting(
        "SPZ version: 2 gives files 4 to 8 % smaller, 3 rotations ten times as exact. 4 is 3 in zstd, for files without"
        f" a tree (convert, simplify).  [default: {DEFAULT_SPZ_VERSION}]",
        SPZ_VERSIONS,
    )
    fractional_bits: int | None = setting(
        "Bits after the binary point of SPZ positions, 0 to 24; auto goes by the extent of the scene and its smallest"
        " splats.  [default: auto]",
        Quantity("auto|N", _bits, whole(0, MAX_FRACTIONAL_BITS)),
    )
    compression_level: int = setting(
        "Compression of SPZ and RAD, from 1 (fast) to 9 (small).",
        whole(MIN_COMPRESSION, MAX_COMPRESSION),
        DEFAULT_COMPRESSION,
    )
    rad: RadOptions = field(default_factory=RadOptions)
    sog: SogOptions = field(default_factory=SogOptions)
    sh_bits: int | None = None
    covering: bool = True
    glb_profile: str | None = setting(
        "GLB with 32-bit floats, as KHR_gaussian_splatting defines it, or with SPZ inside, as CesiumJS reads it."
        f"  [default: {KHRONOS}; {CESIUM} of 3D Tiles]",
        PROFILES,
    )


#: Options that leave every choice to the writer.
DEFAULTS = WriteOptions()
