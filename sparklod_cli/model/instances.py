"""`Instance`: a scene, its position in the world, and its foveation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import TOTAL
from .foveation import Foveation
from .scene import DetailScene, Scene, TileScene
from .transforms import LARGEST, SKEW, Transform, scale_of

Source = Path | Scene | DetailScene | TileScene
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Instance:
    """A scene and its position in the world.

    Attributes:
        source: a splat file (a path, which may be a string), or a scene in memory.
        name: for messages and tables; unique among the instances of a run.
        object_to_world: (4, 4) rotation, uniform scale and translation.
        lod_scale: multiplies the pixel scales of its nodes, or the distances at which its detail levels begin; above 1
            it gets more of the budget than others.
        foveation: None for that of the viewer.

    Raises:
        TypeError: the source is neither.
        ValueError: the matrix has another shape, a number that is not finite, or a determinant of 0 or less.
    """

    source: Source
    name: str = ""
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Foveation | None = None

    def __post_init__(self) -> None:
        if isinstance(self.source, str):
            object.__setattr__(self, "source", Path(self.source))
        if not isinstance(self.source, (Path, Scene, DetailScene, TileScene)):
            raise TypeError(f"an instance is of a file or a scene, not of {type(self.source).__name__}")
        matrix = np.asarray(self.object_to_world, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"object_to_world has the shape {matrix.shape}; give (4, 4)")
        if scale_of(matrix, math.inf) is None:
            raise ValueError("object_to_world is no rotation, uniform scale and translation of finite numbers")
        object.__setattr__(self, "object_to_world", matrix)

    @property
    def file(self) -> Path | None:
        """The splat file; None for a scene in memory."""
        return self.source if isinstance(self.source, Path) else None

    @property
    def transform(self) -> Transform:
        """Similarity in `object_to_world`, with the nearest rotation if the axes are slightly skewed."""
        axes = self.object_to_world[:3, :3]
        scale = min(max(float(np.cbrt(np.linalg.det(axes))), 1 / LARGEST), LARGEST)
        rotation = axes / scale
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > SKEW:
            left, _, right = np.linalg.svd(rotation)
            rotation = left @ right
        return Transform(rotation, scale, self.object_to_world[:3, 3])


def names_of(files: Sequence[Path], taken: Collection[str] = ()) -> list[str]:
    """Return a name for each file, numbered where several have the same; none is `TOTAL` or in `taken`."""
    seen = {TOTAL, *taken}
    counts: dict[str, int] = {}
    names = []
    for file in files:
        stem = file.name if file.stem == TOTAL else file.stem
        for count in itertools.count(counts.get(stem, 0) + 1):
            name = stem if count == 1 else f"{stem} {count}"
            if name not in seen:
                break
        counts[stem] = count
        seen.add(name)
        names.append(name)
    return names


def instances_of(files: Sequence[Path]) -> list[Instance]:
    """Return one instance of each file, untransformed."""
    return [Instance(file, name) for file, name in zip(files, names_of(files), strict=True)]
