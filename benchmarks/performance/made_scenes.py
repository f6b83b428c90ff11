"""Scenes that several sections measure."""

from __future__ import annotations

from pathlib import Path

from scenes import load, tiled, write_ply

from performance.context import Context

#: Which scene is tiled; it has SH of degree 2.
TILED = "playbot-125k.ply"

#: A real scene of 500,000 splats of SH 2, and its name as a PLY.
HALF_MILLION, AS_PLY = "playbot.sog", "playbot-500k.ply"


def tiled_ply(context: Context, millions: float) -> Path:
    """A PLY of so many million splats of copies of `TILED`."""
    source = context.scene(TILED)
    return context.made(
        f"tiled-{millions:g}M.ply", lambda path: write_ply(path, tiled(load(source), round(millions * 1e6)))
    )


def half_million(context: Context) -> Path:
    """A PLY of `HALF_MILLION`."""
    source = context.scene(HALF_MILLION)
    return context.made(AS_PLY, lambda path: write_ply(path, load(source)))
