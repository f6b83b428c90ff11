"""Training and held-out cameras: around a scene and inside it, or of a camera path."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.framing import framing
from ..cameras.sources import CameraPath

Vector = NDArray[np.float64]

#: Pixels of a picture. Larger ones gain less in the same time. Measured (benchmarks/notes/refining.md).
SIZE = (480, 270)

#: Cameras around the scene: their distances in radii, and the share of them that stand near the horizon.
DISTANCES, NEAR_HORIZON = (0.5, 5.0), 0.5

#: Largest sine of the elevation of those near the horizon.
HORIZON = 0.5

#: Share of the cameras that stand among the splats.
INSIDE = 0.25

#: Vertical fields of view, degrees.
FOVS = (35.0, 75.0)

#: Cameras look at a point this far from the middle at most, in radii, and in distances.
ASIDE_RADII, ASIDE_DISTANCES = 0.4, 0.25

#: Training cameras at most. Their pictures, 1 MB each, are drawn once. Measured (benchmarks/notes/refining.md).
TRAINING = 300

#: Held-out cameras; of a path, one in so many, and at most so many.
HELD_OUT, OF_PATH = 16, 8

#: Longest side of a picture of a path's camera, pixels.
LONGEST = 640

#: Which way is up, in the axes of scenes as training leaves them.
UP = np.array([0.0, -1.0, 0.0])

#: Steps of the R2 sequence (Roberts 2018): the generalized golden ratio in three dimensions.
_PLASTIC = 1.22074408460575947536
R3 = np.array([1 / _PLASTIC, 1 / _PLASTIC**2, 1 / _PLASTIC**3])


@dataclass(frozen=True)
class Place:
    """Extent of a scene: (N, 3) centres of splats, world units, and the middle and radius of a ball around most."""

    center: NDArray[np.floating]
    middle: Vector
    radius: float

    @classmethod
    def of(cls, center: NDArray[np.floating]) -> Place:
        """Return the extent of a scene with (N, 3) centres."""
        return cls(center, *framing(center))


def placed(place: Place, seed: np.random.SeedSequence) -> Iterator[Camera]:
    """Yield cameras around a scene and inside it, without end; directions of those around it spread evenly."""
    random = np.random.Generator(np.random.PCG64(seed))
    start = random.random(3)
    number = 0
    while True:
        if random.random() < INSIDE:
            yield _inside(place, random)
        else:
            number += 1
            yield _around(place, (start + number * R3) % 1, random)


def _around(place: Place, spread: Vector, random: np.random.Generator) -> Camera:
    """Return a camera outside, by three numbers 0..1 for its direction and distance."""
    near, far = np.log(DISTANCES)
    distance = float(np.exp(near + (far - near) * spread[2])) * place.radius
    sine = 2 * spread[1] - 1
    if random.random() < NEAR_HORIZON:
        sine *= HORIZON
    turn, cosine = 2 * np.pi * spread[0], np.sqrt(1 - sine * sine)
    direction = np.array([cosine * np.cos(turn), sine, cosine * np.sin(turn)])
    aside = min(ASIDE_RADII * place.radius, ASIDE_DISTANCES * distance) * random.uniform(-1, 1, 3)
    return _looking(place.middle + distance * direction, place.middle + aside, random)


def _inside(place: Place, random: np.random.Generator) -> Camera:
    """Return a camera between two splats that looks at a third one, all of them in the ball."""
    target = _some(place, random)
    eye = (_some(place, random) + _some(place, random)) / 2
    if np.linalg.norm(target - eye) < 1e-3 * place.radius:
        return _around(place, random.random(3), random)
    return _looking(eye, target, random)


def _some(place: Place, random: np.random.Generator) -> Vector:
    """Return the (3,) centre of a random splat, pulled into the ball."""
    away: Vector = place.center[random.integers(len(place.center))] - place.middle
    return place.middle + away * min(1.0, place.radius / max(float(np.linalg.norm(away)), 1e-30))


def _looking(eye: Vector, target: Vector, random: np.random.Generator) -> Camera:
    up = UP
    ahead = (target - eye) / np.linalg.norm(target - eye)
    if abs(ahead @ UP) > 0.99:  # straight up or down
        up = np.array([0.0, 0.0, 1.0])
    return Camera.look_at(eye.tolist(), target.tolist(), up=up.tolist(), fov_y=random.uniform(*FOVS), size=SIZE)


def split_path(path: CameraPath) -> tuple[tuple[Camera, ...], tuple[Camera, ...]]:
    """Return the training and the held-out cameras of a path, at most `LONGEST` pixels a side; one camera is both."""
    cameras = tuple(map(smaller, path.cameras))
    every = max(OF_PATH, -(-len(cameras) // HELD_OUT))
    held_out = cameras[every // 2 :: every] or cameras[-1:]
    chosen = set(map(id, held_out))
    training = tuple(camera for camera in cameras if id(camera) not in chosen)
    return training[:: max(1, -(-len(training) // TRAINING))] or cameras, held_out


def smaller(camera: Camera) -> Camera:
    """Return the same camera with a picture of at most `LONGEST` pixels a side."""
    share = LONGEST / max(camera.width, camera.height)
    if share >= 1:
        return camera
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    across, down = width / camera.width, height / camera.height
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    return dataclasses.replace(
        camera, width=width, height=height, focal=(fx * across, fy * down), principal=(cx * across, cy * down)
    )
