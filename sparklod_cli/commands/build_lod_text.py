"""Messages of `sparklod build-lod` about the files that it wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..system.addresses import Place
from ..system.stdio import DASH, name_of
from ..system.units import format_size, percent_of
from .console import Console, count_of

if TYPE_CHECKING:
    from ..bake.parts_output import WrittenDetail
    from ..bake.settings import Baked, Source
    from ..bake.simplifying import Extracted, Refined, WrittenSet
    from ..codecs.clamps import Clamp

#: What clamping does to a scene and what to do about it, by column of `Splats` and whether the upper end clamps.
CLAMPED_BY_SPZ = {
    ("scale", False): ("scales", "mostly how thick flat splats are; --format rad keeps them"),
    ("scale", True): ("scales", "such splats, of a sky perhaps, shrink; --format rad keeps them"),
    ("rgb", False): ("colours", "darker than black, so the loss is hardly visible"),
    ("rgb", True): ("colours", "brighter than white, so the loss is hardly visible"),
    ("sh", False): ("SH", "reflections get weaker; render --diff shows whether it matters"),
    ("sh", True): ("SH", "reflections get weaker; render --diff shows whether it matters"),
}
_THIN, _WIDE = "mostly how thick flat splats are; --rad-scales ln_f16 keeps them", "--rad-scales ln_f16 keeps them"
_FAR, _COLORS = "--rad-center f32_lebytes keeps them", "the loss is hardly visible; --rad-rgb {wide} keeps them"
#: What can be seen of clamped values, by the same.
CONSEQUENCES = {
    ("center", False): "splats are farther away",
    ("center", True): "splats are farther away",
    ("scale", False): "splats are smaller",
    ("scale", True): "splats are larger",
    ("rgb", False): "colours are darker",
    ("rgb", True): "colours are brighter",
    ("sh", False): "reflections are stronger",
    ("sh", True): "reflections are stronger",
}
#: "{wide}" is the encoding that holds the values.
CLAMPED_BY_RAD = {
    ("center", True): ("coordinates", _FAR),
    ("scale", False): ("scales", _THIN),
    ("scale", True): ("scales", _WIDE),
    ("rgb", False): ("colours", _COLORS),
    ("rgb", True): ("colours", _COLORS),
    ("sh", True): ("SH", "reflections get weaker; --rad-sh {wide} keeps them"),
}

#: Words for columns of which leaves have values that an output clamps, and the share of splats from which it is said.
COLUMNS = {"center": "centres", "scale": "scales", "rgb": "colours", "sh": "reflections (SH)"}
LEAST_SHARE = 0.001


def report_baked(console: Console, source: Place, target: Place, baked: Baked) -> None:
    """Print a line about the file, and one for each thing that a person should know."""
    console.say(
        f"{name_of(source)}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {_name(target)} "
        f" {_contents(baked)}, {format_size(baked.bytes)}, {sum(baked.seconds.values()):.1f} s"
    )
    if baked.detail is not None and len(baked.detail.levels) > 1:
        console.say(f"  {_levels(baked.detail)}")
    if baked.tiles is not None and baked.tiles.levels > 1:
        console.say(f"  splats level by level: {', '.join(f'{count:,}' for count in baked.tiles.splats)}")
    _report_tree(console, baked, baked.refine)
    if baked.clamps and (consequences := _consequences(baked)):
        console.say(f"  {consequences}")
    if not console.verbose:
        return
    for clamp in baked.clamps:
        console.say(f"  {_clamped(clamp, baked)}")
    tree = f"{baked.method} tree" if baked.method is not None else "the same tree"
    tree += ", refined" if baked.refine is not None else ""
    console.say(f"  {baked.format} -> {tree} -> {_written(baked)}; {_stages(baked.seconds)}")
    if baked.blocks is not None:
        written, read = (format_size(size or 0) for size in (baked.scratch_bytes_written, baked.scratch_bytes_read))
        console.say(f"  out of core in {count_of(baked.blocks, 'block')}; scratch: {written} written, {read} read")


def _report_tree(console: Console, baked: Baked, refine: Refined | None) -> None:
    from ..model.selection import describe

    if refine is not None:
        console.say(f"  {_refined(refine)}")
    if baked.dropped:
        console.say(f"  left out: {describe(baked.dropped)}")
    for note in baked.notes:
        console.say(f"  {note}")


def _contents(baked: Baked) -> str:
    detail, tiles = baked.detail, baked.tiles
    if tiles is not None:
        place = ", on the Earth" if tiles.georeferenced else ""
        return f"{count_of(tiles.tiles, 'tile')} of {count_of(tiles.levels, 'level')}{place}"
    if detail is None:
        chunks = f", {count_of(baked.chunks, 'chunk')}" if baked.chunks else ""
        return f"{count_of(baked.nodes, 'node')}, depth {baked.levels - 1}{chunks}"
    environment = f", environment of {count_of(detail.environment, 'splat')}" if detail.environment else ""
    return (
        f"{count_of(len(detail.levels), 'detail level')} of {count_of(detail.regions, 'region')},"
        f" {count_of(detail.chunks, 'chunk file')}{environment}"
    )


def _refined(refined: Refined) -> str:
    gains = [
        f"{percent_of(share)} {before:.2f} -> {refined.psnr_after[share]:.2f}"
        for share, before in refined.psnr_before.items()
    ]
    seen = f"held-out PSNR {', '.join(gains)} dB" if refined.psnr_before else "no held-out camera sees anything of it"
    early = "" if refined.is_complete else ", interrupted"
    return (
        f"refined in {count_of(refined.steps, 'step')}{early}: {seen};"
        f" {percent_of(refined.kept)} of the splats fitted have new values"
    )


def _levels(detail: WrittenDetail) -> str:
    levels = (
        f"{level.splats:,} splats ({percent_of(level.share)}, error at most {level.worst_error:.2g})"
        for level in detail.levels[1:]
    )
    return f"levels below full detail: {', '.join(levels)}"


def _written(baked: Baked) -> str:
    if baked.detail is not None:
        return "Streamed SOG"
    if baked.tiles is not None:
        return "3D Tiles"
    if baked.arrays:
        return ", ".join(f"{name} uint32{list(shape)}" for name, shape in baked.arrays.items())
    if baked.chunks is None:
        return f"SPZ {baked.version} LoD, {baked.fractional_bits} fractional bits"
    palette = f", a palette of {baked.sh_codes:,} SH" if baked.sh_codes else ""
    encodings = ", ".join(f"{name} {encoding}" for name, encoding in baked.encodings.items())
    return f"RAD LoD, {encodings}{palette}"


def _consequences(baked: Baked) -> str:
    """Return a line on the visible effect of clamping; empty where nothing of it can be seen."""
    from ..codecs.clamps import matters

    shares: dict[str, float] = {}
    for clamp in baked.clamps:
        if matters(clamp.column, above=clamp.above, visible=clamp.visible, leaves=baked.splats):
            text = CONSEQUENCES[clamp.column, clamp.above]
            shares[text] = max(shares.get(text, 0.0), clamp.visible / baked.splats)
    if not shares:
        return ""
    form, more = (
        ("SPZ", "--format rad keeps more of them") if baked.chunks is None else ("RAD", "-v says what keeps them")
    )
    losses = " and ".join(f"{percent_of(share, 2)} of {text}" for text, share in shares.items())
    return f"{losses} than {form} can hold; {more}"


def _clamped(clamp: Clamp, baked: Baked) -> str:
    """Return a line on clamped values: the number of nodes, the largest value, and the consequence."""
    from ..codecs.rad.property_codings import LARGEST_F16

    form, table = ("SPZ", CLAMPED_BY_SPZ) if baked.chunks is None else ("RAD", CLAMPED_BY_RAD)
    name, advice = table[clamp.column, clamp.above]
    share = f"{count_of(clamp.splats, 'node')} ({percent_of(clamp.splats / baked.nodes)})"
    name += f" of degree {clamp.degree}" if clamp.degree else ""
    where, way = ("above", "up") if clamp.above else ("below", "down")
    where = "beyond ±" if clamp.both else f"{where} "
    farthest = clamp.farthest or 0.0  # no -0
    advice = advice.format(wide="f16" if abs(farthest) <= LARGEST_F16 else "f32")
    return (
        f"{name} of {share} are {where}{clamp.end:.3g}, {way} to {farthest:.3g}, and are clamped to what {form} holds:"
        f" {advice}"
    )


def report_extracted(console: Console, source: Place, target: Place, extracted: Extracted) -> None:
    """Print a line about the file."""
    console.say(
        f"{name_of(source)}  {count_of(extracted.nodes, 'node')}  ->  {_name(target)} "
        f" {count_of(extracted.splats, 'splat')}, SH {extracted.sh_degree}, {format_size(extracted.bytes)},"
        f" {sum(extracted.seconds.values()):.1f} s"
    )
    _report_losses(console, extracted, extracted.splats, extracted.output_format)
    console.detail(f"  {extracted.format}; {_stages(extracted.seconds)}")


def report_simplified(console: Console, source: Source, target: Place, baked: Baked) -> None:
    """Print a line about the file of a simplified scene, and what it does not hold."""
    made = baked.simplified
    assert made is not None
    measured = "" if made.psnr is None else f", PSNR {made.psnr:.2f} dB"
    console.say(
        f"{name_of(source)}  {count_of(baked.splats, 'splat')}, SH {baked.sh_degree}  ->  {_name(target)} "
        f" {count_of(made.splats, 'splat')} ({percent_of(made.share)}){measured}, {format_size(baked.bytes)},"
        f" {sum(baked.seconds.values()):.1f} s"
    )
    _report_tree(console, baked, made.refine)
    if made.faint > LEAST_SHARE * made.splats:
        share = percent_of(made.faint / made.splats)
        console.say(f"  {share} of the splats, merged across wide gaps, are too faint to be drawn; keep more splats")
    _report_losses(console, made, made.splats, baked.output_format)
    console.detail(f"  {baked.format}; {_stages(baked.seconds)}")


def _report_losses(console: Console, losses: Extracted | WrittenSet, splats: int, form: str) -> None:
    lines = ["holds no reflections (SH)"] if losses.drops_sh else []
    lines += [
        f"clamps the {COLUMNS[column]} of {percent_of(count / splats)} of the splats"
        for column, count in losses.clamped.items()
        if count >= LEAST_SHARE * splats
    ]
    if lines:
        console.say(f"  {form} {', and '.join(lines)}")
    if losses.up_lost is not None:
        up = losses.up_lost
        console.say(f"  {up} is up, which this format cannot note; give --up={up} to render, traverse and view")


def _name(target: Place) -> str:
    return "standard output" if target == DASH else str(target)


def _stages(seconds: dict[str, float]) -> str:
    return ", ".join(f"{stage} {value:.2f} s" for stage, value in seconds.items())
