"""Arguments of the API, checked before they reach a loop or a kernel: errors say the value, and what to give."""

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
    """Return a scene, or a tree, which is validated."""
    if not isinstance(value, Scene):
        raise TypeError(f"it takes a scene or a tree, not {_kind(value)}; {_SCENES}")
    value.check_tree()
    return value


def camera_like(value: Any) -> Camera:
    """Return a camera; raise an error for anything else, and for numbers that are not finite."""
    if not isinstance(value, Camera):
        raise TypeError(f"a camera is a Camera, not {_kind(value)}; Camera.look_at makes one, read_cameras reads paths")
    for name in ("camera_to_world", "width", "height", "focal", "principal", "time"):
        numbers = getattr(value, name)
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name} of a camera is {np.asarray(numbers).tolist()}; give finite numbers")
    return value


def path_like(cameras: CameraPath | Iterable[Camera]) -> CameraPath:
    """Return cameras one after the other; raise a ValueError unless they are in the order of their times."""
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
    """Return a budget of splats; raise an error for one that is out of range."""
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
    """Return the path of a file that will be written; raise an `OutputError` for a folder."""
    if os.fspath(path).endswith(("/", os.sep)) or Path(path).is_dir():
        raise OutputError(f"{path} is a folder; name a file in it")
    return Path(path)


def viewed_like(value: Any) -> None:
    """Raise TypeError for a value that is no scene, though Python could iterate over it."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
        raise TypeError(f"it takes scenes, trees or instances, not {_kind(value)}; {_SCENES}")


#: Ways to get a scene, for messages.
_SCENES = "read reads a file, Scene.from_arrays takes arrays"


def _kind(value: Any) -> str:
    return repr(value) if isinstance(value, str) else f"a {type(value).__name__}" if value is not None else "None"


#: A callback `(stage, done, total, unit)`, a class of bars that is called as `tqdm.tqdm` is, or None.
ProgressLike = Progress | type[Any] | None


class _Bars:
    """One bar for each stage, of a class that makes bars."""

    def __init__(self, kind: type[Any]) -> None:
        self._kind, self._stage = kind, ""
        self._bar: Any = None

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        if self._bar is None or stage != self._stage:
            self.close()
            self._stage, self._bar = stage, self._kind(total=total, desc=stage, unit=f" {unit}s", leave=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


@contextlib.contextmanager
def progress_callback(progress: ProgressLike) -> Iterator[Progress]:
    """Yield the callback for work inside; bars are closed at its end."""
    if progress is None:
        yield silent
    elif isinstance(progress, type):
        bars = _Bars(progress)
        try:
            yield bars
        finally:
            bars.close()
    else:
        yield progress
