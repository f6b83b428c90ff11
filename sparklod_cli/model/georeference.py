"""Places on the Earth: the transform from local axes, east, north and up, to the axes of the Earth.

The ellipsoid is that of WGS 84. The Earth's axes (ECEF) have their origin at its centre, x towards latitude 0 and
longitude 0, z towards the north pole. Formulas: B. Hofmann-Wellenhof et al., GNSS, 2008, section 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Equatorial radius in metres, and the flattening of WGS 84.
RADIUS, FLATTENING = 6_378_137.0, 1 / 298.257223563

#: Steps by which a latitude is found: each leaves a hundredth of the error near the surface.
ROUNDS = 8

#: A (4, 4) matrix for column vectors, column by column, as 3D Tiles and glTF write it.
Matrix16 = tuple[float, ...]

IDENTITY: Matrix16 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def placed(latitude: float, longitude: float, height: float = 0.0, heading: float = 0.0) -> Matrix16:
    """Return the matrix that puts the origin of local axes at a place, z up.

    Args:
        latitude, longitude: degrees, north and east positive; geodetic.
        height: metres above the ellipsoid.
        heading: degrees clockwise from north, seen from above, of the local y axis; x is right of it.
    """
    phi, lam, turn = map(math.radians, (latitude, longitude, heading))
    sin_phi, cos_phi, sin_lam, cos_lam = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    squared = FLATTENING * (2 - FLATTENING)
    normal = RADIUS / math.sqrt(1 - squared * sin_phi * sin_phi)
    east = (-sin_lam, cos_lam, 0.0)
    north = (-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi)
    up = (cos_phi * cos_lam, cos_phi * sin_lam, sin_phi)
    cosine, sine = math.cos(turn), math.sin(turn)
    right = (cosine * e - sine * n for e, n in zip(east, north, strict=True))
    ahead = (sine * e + cosine * n for e, n in zip(east, north, strict=True))
    origin = (
        (normal + height) * cos_phi * cos_lam,
        (normal + height) * cos_phi * sin_lam,
        (normal * (1 - squared) + height) * sin_phi,
    )
    return (*right, 0.0, *ahead, 0.0, *up, 0.0, *origin, 1.0)


@dataclass(frozen=True)
class EarthPlace:
    """Place of the origin of a matrix and heading of its y axis, as for `placed`; degrees and metres."""

    latitude: float
    longitude: float
    height: float
    heading: float


def place_of(matrix: Matrix16) -> EarthPlace:
    """Return the place of the origin of a matrix that is not at the centre of the Earth; the inverse of `placed`."""
    x, y, z = matrix[12:15]
    ahead = matrix[4:7]
    lam, across, squared = math.atan2(y, x), math.hypot(x, y), FLATTENING * (2 - FLATTENING)
    phi = math.atan2(z, across * (1 - squared))
    for _ in range(ROUNDS):
        normal = RADIUS / math.sqrt(1 - squared * math.sin(phi) ** 2)
        phi = math.atan2(z + squared * normal * math.sin(phi), across)
    sin_phi, cos_phi, sin_lam, cos_lam = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    height = across * cos_phi + z * sin_phi - RADIUS * math.sqrt(1 - squared * sin_phi**2)
    east = -sin_lam * ahead[0] + cos_lam * ahead[1]
    north = -sin_phi * (cos_lam * ahead[0] + sin_lam * ahead[1]) + cos_phi * ahead[2]
    return EarthPlace(math.degrees(phi), math.degrees(lam), height, math.degrees(math.atan2(east, north)) % 360)
