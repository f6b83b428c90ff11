"""COLMAP's camera models and their parameters: focal lengths and principal point come first."""

from __future__ import annotations

from dataclasses import dataclass

from ...support.errors import CameraPathError
from ..frame import Lens
from .source import side


@dataclass(frozen=True)
class Model:
    """A camera model.

    Attributes:
        name: in cameras.txt; cameras.bin has the index in `MODELS` instead.
        focals: number of focal lengths, 1 or 2; 0 for a model that a pinhole camera cannot replace.
        others: number of parameters after the principal point, all of the distortion.
    """

    name: str
    focals: int
    others: int

    @property
    def count(self) -> int:
        """Number of parameters of a camera."""
        return self.focals + 2 + self.others

    @property
    def distorts(self) -> bool:
        """Whether its images may differ from those of a pinhole camera."""
        return self.others > 0 or "FISHEYE" in self.name


MODELS = (
    Model("SIMPLE_PINHOLE", 1, 0),
    Model("PINHOLE", 2, 0),
    Model("SIMPLE_RADIAL", 1, 1),
    Model("RADIAL", 1, 2),
    Model("OPENCV", 2, 4),
    Model("OPENCV_FISHEYE", 2, 4),
    Model("FULL_OPENCV", 2, 8),
    Model("FOV", 2, 1),
    Model("SIMPLE_RADIAL_FISHEYE", 1, 1),
    Model("RADIAL_FISHEYE", 1, 2),
    Model("THIN_PRISM_FISHEYE", 2, 8),
    Model("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    Model("SIMPLE_DIVISION", 1, 1),
    Model("DIVISION", 2, 1),
    Model("SIMPLE_FISHEYE", 1, 0),
    Model("FISHEYE", 2, 0),
    Model("EUCM", 2, 2),
    Model("EQUIRECTANGULAR", 0, 0),
)


def lens_of(model: Model, width: float, height: float, numbers: list[float], way: str) -> Lens:
    """The lens of a camera, without its distortion.

    Raises:
        CameraPathError: the number of parameters or the size is wrong, or it is not a pinhole camera.
    """
    if not model.focals:
        raise CameraPathError(f"{way} is {model.name}, which is not a pinhole camera")
    if len(numbers) != model.count:
        raise CameraPathError(f"{way} has {len(numbers)} parameters, not the {model.count} of {model.name}")
    principal = numbers[model.focals], numbers[model.focals + 1]
    return Lens((side(width, way), side(height, way)), (numbers[0], numbers[model.focals - 1]), principal)
