"""The input of the shared laws: a way to write a format, and the precision with which it keeps a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats

Array = NDArray[np.float64]
Content = bytes | dict[str, bytes]


@dataclass(frozen=True)
class Precision:
    """By how much a way of writing may change each column at most, and the ranges that it clamps to."""

    center: float | Array = 0.0
    log_scale: float | Array = 2e-6
    degrees: float = 1e-3
    opacity: float = 1e-6
    blur: float | None = None  # of `coverage.compensated`, where the opacity makes up for the rounding of scales
    merged: float = 1e-6  # of an LoD opacity D above 1
    rgb: float | Array = 1e-6
    sh: tuple[float, float] = (0.0, 0.0)  # degree 1, degrees above
    scale_range: tuple[float, float] = (0.0, np.inf)
    rgb_range: tuple[float, float] = (-np.inf, np.inf)
    sh_range: tuple[float | Array, float | Array] = (-np.inf, np.inf)


def exact(source: Scene) -> Precision:
    return Precision()


def everything(splats: Splats) -> Splats:
    return splats


@dataclass(frozen=True)
class Case:
    """A way to write a format.

    Attributes:
        format: the name of the format that the reader must give.
        write: makes the file of a scene, or the files of a folder by their names.
        precision: by how much the columns of a scene may change.
        lod: whether the scene must have a tree.
        held: the splats that the file must hold, in its order.
        reach: the largest coordinate that the format can hold; scenes that go beyond are refused.
    """

    format: str
    write: Callable[[Scene], Content]
    precision: Callable[[Scene], Precision]
    lod: bool = False
    held: Callable[[Splats], Splats] = everything
    reach: float = np.inf


def put(content: Content, directory: Path, form: str) -> Path:
    """Writes a file under a name that says as little as possible of its format; returns its path."""
    if isinstance(content, bytes):
        path = directory / {"SPLAT": "scene.splat", "HIER": "scene.hier"}.get(form, "scene.bin")
        path.write_bytes(content)
        return path
    folder = directory / "scene"
    folder.mkdir()
    for name, data in content.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    return next((folder / name for name in content if name.endswith(".rad") or name == "scene.gltf"), folder)


def linear(source: Scene) -> dict[str, Array]:
    """Returns the splats as arguments of the writers in `fixtures`."""
    splats = source.splats
    columns = {name: getattr(splats, name).astype(np.float64) for name in ("center", "scale", "opacity", "rgb", "sh")}
    return columns | {"quat_wxyz": splats.quat_xyzw[:, [3, 0, 1, 2]].astype(np.float64) * 7}


def rounding(values: Array) -> float:
    """Bounds the error of one or two float32 operations on values like these."""
    return 4 * float(np.spacing(np.float32(np.abs(values).max())))


def largest_dropped_degrees(steps: int) -> float:
    """Bounds the error of rotations, in degrees, that hold all but the largest component in `steps` for +-sqrt(1 / 2).

    Each of the three is off by up to half a step; the largest, which follows from them, by up to sqrt(3) times their
    error together.
    """
    return float(np.degrees(2 * 2 * 3**0.5 * (2**0.5 / steps / 2))) * 1.001
