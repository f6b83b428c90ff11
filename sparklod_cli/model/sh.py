"""Spherical harmonics (SH): normalisations, and the number of coefficients of each degree."""

from __future__ import annotations

from ..system.errors import FormatError
from . import MAX_SH_DEGREE

#: Y_00, the constant term of the real spherical harmonics: 1 / (2 * sqrt(pi)).
SH_C0 = 0.28209479177387814

#: Normalisations of the real spherical harmonics of degree 1 to 3, in the order and with the signs of 3D Gaussian
#: Splatting; `transforms.sh_basis` has the polynomials that they normalise.
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)

#: Coefficients per colour channel above the constant term, by degree: (degree + 1) ** 2 - 1.
COEFFICIENTS = (0, 3, 8, 15, 24)


def width_of(sh_degree: int) -> int:
    """Return the number of floats of a splat: 14 of centre, scale, rotation, opacity and colour, and its SH."""
    return 14 + 3 * COEFFICIENTS[sh_degree]


def degree_of(coefficients: int) -> int:
    """Return the degree of a number of coefficients per channel above the constant term.

    Raises:
        FormatError: no degree has this number of coefficients.
    """
    try:
        return COEFFICIENTS.index(coefficients)
    except ValueError:
        known = ", ".join(map(str, COEFFICIENTS))
        raise FormatError(f"{coefficients} SH coefficients per channel, expected one of {known}") from None


def notes_on_degree(degree: int) -> tuple[str, ...]:
    """Return the notes on a file of an SH degree: one if coefficients above MAX_SH_DEGREE are dropped."""
    return (f"SH degree {degree} is cut to {MAX_SH_DEGREE}",) if degree > MAX_SH_DEGREE else ()
