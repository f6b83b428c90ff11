"""Checks of arguments of public functions, before a loop or a kernel gets them: errors say the value and a remedy."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..cameras.sources import CameraPath
from ..lod.budget import LARGEST, Budget, parse_budget
from ..model.scene import Scene
from ..system.errors import OutputError
from ..system.progress import Progress, silent


def scene_like(value: Any) -> Scene:
    """Check that an argument is a scene, and validate its tree."""
    if not isinstance(value, Scene):
        raise TypeError(f"it takes a scene or a tree, not {_kind(value)}; {_SCENES}")
    value.check_tree()
    return value


def camera_like(value: Any) -> Camera:
    """Check that an argument is a camera of finite numbers."""
    if not isinstance(value, Camera):
        raise TypeError(f"a camera is a Camera, not {_kind(value)}; Camera.look_at makes one, read_cameras reads paths")
    for name in ("camera_to_world", "width", "height", "focal", "principal", "time"):
        numbers = getattr(value, name)
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name} of a camera is {np.asarray(numbers).tolist()}; give finite numbers")
    return value


def path_like(cameras: CameraPath | Iterable[Camera]) -> CameraPath:
    """Return the camera path of an argument; raise `ValueError` unless cameras are in the order of their times."""
    if isinstance(cameras, CameraPath):
        for each in cameras.cameras:
            camera_like(each)
        return cameras
    if isinstance(cameras, str):
        camera_like(cameras)
    every = tuple(map(camera_like, [cameras] if isinstance(cameras, Camera) else cameras))
    if not every:
        raise ValueError("there are no cameras; give at least one")
    if any(later.time < earlier.time for earlier, later in itertools.pairwise(every)):
        raise ValueError("the cameras are not in the order of their times")
    return CameraPath(every, "cameras", (), tuple(range(len(every))))


#: A count of splats, a share of full detail (a float, 0 to 1), or either as text: "500k", "5%".
BudgetLike = int | float | str | np.integer[Any] | np.floating[Any]


def budget_like(budget: BudgetLike) -> Budget:
    """Return the budget of an argument; raise an error for one that is out of range."""
    if isinstance(budget, str):
        return parse_budget(budget)
    if isinstance(budget, bool) or not isinstance(budget, (int, float, np.integer, np.floating)):
        raise TypeError(f"the budget is {budget!r}; give a count, a share as a float, or a text such as '5%'")
    share = isinstance(budget, (float, np.floating))
    if not 0 < budget <= (1 if share else LARGEST):
        raise ValueError(f"the budget is {budget}; give a count from 1 to 2^53, or a share of full detail up to 1.0")
    if share:
        return Budget(f"{100 * budget:g}%", Fraction(str(budget)), None)
    return Budget.of_count(int(budget))


def file_path(path: Path | str) -> Path:
    """Return the path of an output file; raise an `OutputError` for a folder."""
    if os.fspath(path).endswith(("/", os.sep)) or Path(path).is_dir():
        raise OutputError(f"{path} is a folder; name a file in it")
    return Path(path)


def viewed_like(value: Any) -> None:
    """Raise `TypeError` for anything but a scene or an iterable of scenes; a text is neither."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
        raise TypeError(f"it takes scenes, trees or instances, not {_kind(value)}; {_SCENES}")


#: Ways to get a scene, for messages.
_SCENES = "read reads a file, Scene.from_arrays takes arrays"


def _kind(value: Any) -> str:
    return repr(value) if isinstance(value, str) else f"a {type(value).__name__}" if value is not None else "None"


#: A callback `(stage, done, total, unit)`, a class of progress bars such as `tqdm.tqdm`, or None.
ProgressLike = Progress | type[Any] | None


@contextlib.contextmanager
def progress_callback(progress: ProgressLike) -> Iterator[Progress]:
    """Yield the callback of a `ProgressLike`: of a class of bars, one that shows a bar for each stage."""
    if not isinstance(progress, type):
        yield progress or silent
        return
    kind: type[Any] = progress
    bars: dict[str, Any] = {}

    def show(stage: str, done: int, total: int, unit: str) -> None:
        if stage not in bars:
            close()
            bars[stage] = kind(total=total, desc=stage, unit=f" {unit}s", leave=False)
        bars[stage].update(done - bars[stage].n)

    def close() -> None:
        while bars:
            bars.popitem()[1].close()

    try:
        yield show
    finally:
        close()
