"""Places on the Earth: the transform from local axes, east, north and up, to the axes of the Earth.

The ellipsoid is that of WGS 84. The Earth's axes (ECEF) have their origin at its centre, x towards latitude 0 and
longitude 0, z towards the north pole. Formulas: B. Hofmann-Wellenhof et al., GNSS, 2008, section 8.
"""

from __future__ import annotations

import math

#: Equatorial radius in metres, and the flattening of WGS 84.
RADIUS, FLATTENING = 6_378_137.0, 1 / 298.257223563

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
