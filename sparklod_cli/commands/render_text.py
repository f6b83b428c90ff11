"""The report of `sparklod render` on its pictures."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from .console import Console, count_of, size_of

if TYPE_CHECKING:
    from ..api.jobs import Drawn
    from ..images.sequence import Pictures


def report(console: Console, drawn: Drawn, seconds: float, *, as_json: bool) -> None:
    """Prints a line on the pictures, with `as_json` an object too, and a warning if nothing is visible.

    Args:
        console: prints the line.
        drawn: the pictures.
        seconds: duration of the whole command.
        as_json: print one JSON object on standard output.
    """
    written, output, settings = drawn.pictures, drawn.output, drawn.render
    if not any(frame["splats"] for frame in written.frames):
        console.say("warning: the picture is empty, for the first chunk has not arrived yet (--after)")
    elif written.empty:
        console.say(
            "warning: nothing is in view; cameras and scene may not share their axes (--camera-axes,"
            " --world-transform, --up), or nothing lies between --near and --far"
        )
    if as_json:
        whole = {
            "output": str(output.name),
            "format": output.form,
            "kind": output.kind,
            "bytes": written.bytes,
            "frames": written.frames,
            "seconds": round(seconds, 3),
        }
        click.echo(json.dumps(whole if written.gain is None else whole | {"gain": written.gain}, allow_nan=False))
    name = "standard output" if output.name is None else output.name
    console.say(f"{name}  {_told(written)}, {seconds:.2f} s")
    console.detail(
        f"  {drawn.path.format}, {size_of(written.bytes)} of {output.form}; {settings.style} by {settings.backend},"
        f" from {settings.raster.near:g} to {settings.raster.far:g} units away"
    )


def _told(written: Pictures) -> str:
    """ "60 frames, 1280 x 720, 499,102 to 500,000 splats"."""
    frames = written.frames
    sizes = dict.fromkeys(f"{frame['width']} x {frame['height']}" for frame in frames)
    splats = sorted({frame["splats"] for frame in frames})
    told = [count_of(len(frames), "frame")] if len(frames) > 1 else []
    told.append(next(iter(sizes)) + (" and others" if len(sizes) > 1 else ""))
    least = "" if splats[0] == splats[-1] else f"{splats[0]:,} to "
    told.append(least + count_of(splats[-1], "splat"))
    if written.gain is not None:
        worst = min(frame["psnr_db"] for frame in frames)
        told.append(f"PSNR {worst:.2f} dB" + (" or more" if len(frames) > 1 else ""))
        told.append(f"differences times {written.gain:g}" if written.gain != 1 else "differences as they are")
    return ", ".join(told)
