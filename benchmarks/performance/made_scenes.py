"""Scenes that several sections measure."""

from __future__ import annotations

from pathlib import Path

from scenes import load, tiled, write_ply

from performance.context import Context

#: Which scene is tiled; it has SH of degree 2.
TILED = "playbot-125k.ply"

#: A real scene of 500,000 splats of SH 2, and its name as a PLY.
HALF_MILLION, AS_PLY = "playbot.sog", "playbot-500k.ply"


def tiled_ply(context: Context, millions: float, degree: int = 2) -> Path:
    """A PLY of so many million splats of copies of `TILED`, with SH of a degree up to 2."""
    source = context.scene(TILED)
    name = f"tiled-{millions:g}M" + ("" if degree == 2 else f"-sh{degree}")
    return context.made(
        f"{name}.ply",
        lambda path: write_ply(path, tiled(load(source).with_max_sh(degree), round(millions * 1e6))),
    )


def half_million(context: Context) -> Path:
    """A PLY of `HALF_MILLION`."""
    source = context.scene(HALF_MILLION)
    return context.made(AS_PLY, lambda path: write_ply(path, load(source)))
