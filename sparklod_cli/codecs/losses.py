"""Losses of splats without a tree in a format: what is clamped, left out, or cannot be noted."""

from __future__ import annotations

from dataclasses import dataclass

from ..model.scene import Scene
from . import clamps
from .formats import Format
from .options import WriteOptions


@dataclass(frozen=True)
class Losses:
    """Losses of a scene without a tree in a format.

    Attributes:
        clamped: by the column of `Splats`, the number of splats with a value that the output cannot hold.
        drops_sh: the output has no SH, and some splats do.
        up_lost: the axis that points up, which the format cannot note; None where nothing is lost.
    """

    clamped: dict[str, int]
    drops_sh: bool
    up_lost: str | None


def settled_with_losses(scene: Scene, form: Format, options: WriteOptions, threads: int) -> tuple[WriteOptions, Losses]:
    """Return the options with nothing left open, and what a format loses of a scene; see `formats.Format.writable`.

    Raises:
        FormatError: the scene cannot be written.
    """
    codec = form.codec()
    settled: WriteOptions = codec.settled(scene, options)
    beyond = clamps.find(scene.splats, threads, codec.held(settled, scene.splats.sh_degree))
    drops_sh = any(clamp.column == "sh" and clamp.end == 0 for clamp in beyond.ends)
    clamped = {column: count for column, count in beyond.splats.items() if column != "sh" or not drops_sh}
    return settled, Losses(clamped, drops_sh, scene.up if form.bare else None)
