"""cameras.json, which Inria's trainer and others write beside the splats."""

from __future__ import annotations

import numpy as np

from ..frame import Frame, Intrinsics, Settings
from ..pose import pose
from .source import Files, Json, Parsed


def recognises(files: Files) -> bool:
    """Return whether it is a list of positions and rotations."""
    items = files.json.value if files.json else None
    return isinstance(items, list) and bool(items) and Json(items[0]).has("position", "rotation")


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its cameras in the order of the file: test cameras come first."""
    return Parsed([_frame(item) for item in files.object().items()])


def _frame(item: Json) -> Frame:
    rotation = np.array(item.get("rotation").matrix(3, columns=3)).reshape(3, 3)
    lens = Intrinsics()
    if item.has("width", "height"):
        size = item.get("width").side(), item.get("height").side()
        focal = (item.get("fx").number(), item.get("fy").number()) if item.has("fx", "fy") else None
        lens = Intrinsics(size, focal)
    return Frame(pose(rotation, item.get("position").numbers(3)), lens, name=item.label("img_name"))
