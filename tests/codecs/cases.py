"""What the tests of codecs share: ways to write a format, the precision of each, comparisons, and hard values."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs.formats import DEFAULTS, WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.scenes import random_splats

Array = NDArray[np.float64]
Content = bytes | dict[str, bytes]

# --- Decoding, encoding, and comparisons ------------------------------------------------------------------------------


def decode(codec: Any, data: bytes, **more: Any) -> Scene:
    scene: Scene = decode_file(codec, io.BytesIO(data), **more)
    return scene


def encode(codec: Any, scene: Scene | Splats, options: WriteOptions = DEFAULTS, **more: Any) -> bytes:
    return b"".join(codec.encode(scene if isinstance(scene, Scene) else Scene(scene), options, **more))


def assert_same(found: Splats, expected: Splats, *, but: str = "") -> None:
    """Assert that all columns are equal but one."""
    for column in COLUMNS:
        if column != but:
            np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), column)


def rotation_degrees(one: NDArray[Any], other: NDArray[Any]) -> Array:
    """(N,) angle of the rotation between two rotations; by the chord, which is exact for small angles."""
    one, other = (quat / np.linalg.norm(quat, axis=1, keepdims=True) for quat in (one.astype(np.float64), other))
    chord = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return np.degrees(4 * np.arcsin(chord / 2))


def stated_degrees(decode: Callable[..., object]) -> float:
    """What the docstring promises; so it cannot be wrong for long."""
    match = re.search(r"Largest error: ([\d.]+) degrees", decode.__doc__ or "")
    assert match
    return float(match[1])


def half_float(values: Array) -> Array:
    """Half a step of float16: relative, or that of its smallest numbers."""
    return np.maximum(2.0**-11 * np.abs(values), 2.0**-25)


# --- Splats and trees -------------------------------------------------------------------------------------------------


def splats_with(count: int = 1, sh_degree: int = 0, **columns: Any) -> Splats:
    splats = random_splats(count, sh_degree=sh_degree)
    for name, values in columns.items():
        getattr(splats, name)[:] = values
    return splats


def random_quats(count: int) -> NDArray[np.float32]:
    """A quarter of them near half a turn, where an error of the axis counts most, and a quarter near no turn."""
    quats = np.random.default_rng(5).normal(size=(count, 4))
    quats[: count // 4, 3] *= 0.01
    quats[-count // 4 :, :3] *= np.exp(np.linspace(-18, 0, count // 4))[:, None]
    return np.ascontiguousarray(normalized_quat(quats.astype(np.float32)))


def star(count: int) -> LodTree:
    """The first node as the parent of all others."""
    child_count, child_start = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    if count > 1:
        child_count[0], child_start[0] = count - 1, 1
    return LodTree(child_count, child_start)


# --- Ways to write a format -------------------------------------------------------------------------------------------


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
