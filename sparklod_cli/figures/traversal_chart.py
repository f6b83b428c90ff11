"""The figure of `traverse --plot`: charts of a path and, below them, the path in the scene, as one PNG."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..cameras.camera import Camera
from ..images.text import BACKGROUND, FAINT, write_title
from ..model.splats import Splats
from ..support.errors import SparklodError
from ..tables.columns import Row
from ..tables.statistics import numbers, totals
from . import charts
from .camera_path import picture_of_path
from .series import PINK

#: Labels of the reasons for marking a frame (`simulation.summary.MOMENTS`).
CALLED = {
    "churn": "most churn",
    "bytes": "most bytes fetched",
    "coarsest": "coarsest",
    "missing": "most missing",
    "incomplete": "longest until resident",
    "overdraw": "most overdraw",
}


@dataclass(frozen=True)
class PathScene:
    """What the picture of the path shows.

    Attributes:
        cameras: of the path.
        splats: N splats of the cut of one frame.
        depth: (N,) edges from the root to each node of the cut, or the detail level of each splat.
        frame: index of the camera whose cut it is; that camera is marked. None for none.
        title: which of both the depths are, for display.
    """

    cameras: Sequence[Camera]
    splats: Splats
    depth: NDArray[Any]
    frame: int | None = None
    title: str = "tree depth"


@dataclass(frozen=True)
class Plot:
    """The bytes of a PNG, and why it has no picture of the path; None if it has one or none was asked for."""

    png: bytes
    note: str | None


def plot(rows: Iterable[Row], marked: Mapping[str, int], title: str, scene: PathScene | None = None) -> Plot:
    """Draws charts of all columns that are not empty and, if it can be drawn, the path in the scene.

    Args:
        rows: of all frames; those of single instances are left out.
        marked: numbers of frames worth a look, by the reason, a key of `CALLED`.
        title: the name of the scene.
        scene: what the picture of the path shows; None for charts alone.

    Raises:
        SparklodError: matplotlib is not installed, or there is no frame.
    """
    frames = totals(rows)
    if not frames:
        raise SparklodError("there is nothing to draw: the path has no frames")
    images, note = [_head(title, frames, marked), Image.fromarray(charts.draw(frames, marked))], None
    if scene is not None:
        try:
            picture = picture_of_path(scene.cameras, scene.splats, scene.depth, title=scene.title, frame=scene.frame)
            images.append(Image.open(io.BytesIO(picture)).convert("RGB"))
        except SparklodError as error:
            note = f"drawn without the picture of the path: {error}"
    return Plot(_stacked(images), note)


def _head(title: str, frames: Sequence[Row], marked: Mapping[str, int]) -> Image.Image:
    """Title, summary and marked frames, above the charts."""
    lines = [(_about(frames), FAINT)]
    said = ", ".join(f"{CALLED[reason]}: frame {number:,}" for reason, number in marked.items())
    if said:
        lines.append((said, PINK))
    image = Image.new("RGB", (charts.WIDTH, 96 + 26 * len(lines)), BACKGROUND)
    write_title(ImageDraw.Draw(image), 1.0, _one_line(title), lines)
    return image


def _about(frames: Sequence[Row]) -> str:
    """Frames, duration, image size and budget of the path, in a line."""
    said = [f"{len(frames):,} frame" + ("" if len(frames) == 1 else "s")]
    times = numbers(frames, "time_s")
    if len(set(times)) > 1:
        said.append(f"{times[-1] - times[0]:.3f} s")
    sizes = list(dict.fromkeys((row["width"], row["height"]) for row in frames if row["width"] and row["height"]))
    if sizes:
        said.append(f"{sizes[0][0]} x {sizes[0][1]} pixels" + (" and other sizes" if len(sizes) > 1 else ""))
    budgets = sorted(set(numbers(frames, "budget")))
    if budgets:
        said.append(
            f"a budget of {' to '.join(f'{each:,}' for each in dict.fromkeys([budgets[0], budgets[-1]]))} splats"
        )
    return ", ".join(said)


def _one_line(text: str) -> str:
    plain = "".join(mark if mark.isprintable() else "\N{REPLACEMENT CHARACTER}" for mark in text)
    return plain if len(plain) <= 100 else f"{plain[:99]}…"


def _stacked(images: Sequence[Image.Image]) -> bytes:
    """The PNG of images of the same width, stacked from top to bottom."""
    pixels = np.concatenate([np.asarray(image) for image in images])
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", optimize=True)
    return out.getvalue()
