"""What `sparklod build-lod` says of a file that it wrote."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .console import Console, count_of, size_of

if TYPE_CHECKING:
    from ..bake import Baked
    from ..codecs.clamps import Clamp
    from ..extract_leaves import Unbaked

#: What SPZ clamps, by column and whether it is above the upper end: what it is called, what comes of it, what to do.
CLAMPED = {
    ("scale", False): (
        "scales",
        "too small to be seen from farther away than 0.1 units; if the whole scene is that small, scale it up first",
    ),
    ("scale", True): (
        "scales",
        "such splats, of a sky perhaps, shrink; scale the scene down first, or leave them out (--within, --max-box)",
    ),
    ("rgb", False): ("colours", "darker than black, so little is seen of it; nothing need be done"),
    ("rgb", True): ("colours", "brighter than white, so little is seen of it; nothing need be done"),
    ("sh", False): ("SH", "reflections get weaker; nothing need be done unless render --diff shows it"),
    ("sh", True): ("SH", "reflections get weaker; nothing need be done unless render --diff shows it"),
}


def report_baked(console: Console, source: Path, target: Path, baked: Baked) -> None:
    """A line, and one for each thing that a person should know."""
    from ..model.selection import describe

    console.say(
        f"{source}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {target} "
        f" {count_of(baked.nodes, 'node')}, {count_of(baked.levels, 'level')},"
        f" {size_of(baked.bytes)}, {_total(baked.seconds)}"
    )
    if baked.dropped:
        console.say(f"  dropped {describe(baked.dropped)}")
    for note in baked.notes:
        console.say(f"  {note}")
    for clamp in baked.clamps:
        console.say(f"  {_clamped(clamp, baked.nodes)}")
    if baked.arrays:
        written = ", ".join(f"{name} uint32{list(shape)}" for name, shape in baked.arrays.items())
    else:
        written = f"SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits"
    console.detail(f"  {baked.format} -> {baked.method} tree -> {written}; {_stages(baked.seconds)}")


def _clamped(clamp: Clamp, nodes: int) -> str:
    """Which end of what SPZ holds values are clamped to, how many, how far they were beyond, and what that means."""
    name, advice = CLAMPED[clamp.column, clamp.above]
    share = f"{count_of(clamp.splats, 'node')} ({100 * clamp.splats / nodes:.3g} %)"
    where = f"{'above' if clamp.above else 'below'} {clamp.end:.3g}, {'up' if clamp.above else 'down'} to"
    return f"{name} of {share} are {where} {clamp.farthest:.3g}, and are clamped to what SPZ holds: {advice}"


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
