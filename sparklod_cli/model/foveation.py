"""Foveation: how much nodes count by their direction, which a viewer or a single instance may set."""

from __future__ import annotations

from dataclasses import dataclass

#: Spark 2's foveation: full angles of its cones in degrees, weights at the outer one and behind the camera.
CONE_FOV0, CONE_FOV, CONE_FOVEATE, BEHIND_FOVEATE = 90.0, 120.0, 0.4, 0.2


@dataclass(frozen=True)
class Cones:
    """Foveation by the angle to the optical axis, Spark 2's.

    Attributes:
        fov0: full angle of the inner cone, in degrees; inside it everything has weight 1. 0 for no inner cone.
        fov: full angle of the outer cone, in degrees; between the cones the weight falls linearly in the cosine.
        foveate: weight at the outer cone; from there it goes on to `behind` at 90 degrees off the axis.
        behind: weight behind the camera.
    """

    fov0: float = 0.0
    fov: float = 0.0
    foveate: float = 1.0
    behind: float = 1.0


@dataclass(frozen=True)
class Frustum:
    """Foveation by the edges of the picture, as in Spark's LoD design.

    Attributes:
        outside: weight in front of the camera but outside the frustum.
        behind: weight behind the camera.
    """

    outside: float = 1.0
    behind: float = 1.0


Foveation = Cones | Frustum

#: Spark 2's.
SPARK = Cones(CONE_FOV0, CONE_FOV, CONE_FOVEATE, BEHIND_FOVEATE)
