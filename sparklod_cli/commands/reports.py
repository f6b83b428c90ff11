"""What `sparklod build-lod` says of a file that it wrote."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .console import Console, count_of, size_of

if TYPE_CHECKING:
    from ..bake import Baked
    from ..unlod import Unbaked

#: What SPZ clamps, for people; see `spz.clamped`.
CLAMPED = {"scale": "scales (4.5e-5 to 380 units)", "rgb": "colours (-0.44 to 1.44)", "sh": "SH (-1 to 0.99)"}


def report_baked(console: Console, source: Path, target: Path, baked: Baked) -> None:
    """A line, and one for each thing that a person should know."""
    from ..selection import describe

    console.say(
        f"{source}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {target} "
        f" {count_of(baked.nodes, 'node')}, {count_of(baked.levels, 'level')},"
        f" {size_of(baked.bytes)}, {_total(baked.seconds)}"
    )
    if baked.dropped:
        console.say(f"  dropped {describe(baked.dropped)}")
    for note in baked.notes:
        console.say(f"  {note}")
    if baked.clamped:
        counts = ", ".join(f"{CLAMPED[name]} of {count_of(count, 'node')}" for name, count in baked.clamped.items())
        console.say(f"  clamped to what SPZ holds: {counts}")
    if baked.arrays:
        written = ", ".join(f"{name} uint32{list(shape)}" for name, shape in baked.arrays.items())
    else:
        written = f"SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits"
    console.detail(f"  {baked.format} -> {baked.method} tree -> {written}; {_stages(baked.seconds)}")


def report_unbaked(console: Console, source: Path, target: Path, unbaked: Unbaked) -> None:
    """A line."""
    console.say(
        f"{source}  {count_of(unbaked.nodes, 'node')}  ->  {target}  {count_of(unbaked.splats, 'splat')},"
        f" SH {unbaked.sh_degree}, {size_of(unbaked.bytes)}, {_total(unbaked.seconds)}"
    )
    console.detail(f"  {unbaked.format}; {_stages(unbaked.seconds)}")


def _total(seconds: dict[str, float]) -> str:
    return f"{sum(seconds.values()):.1f} s"


def _stages(seconds: dict[str, float]) -> str:
    return ", ".join(f"{stage} {value:.2f} s" for stage, value in seconds.items())
