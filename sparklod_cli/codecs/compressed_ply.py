"""PlayCanvas's compressed PLY: four packed words a splat, relative to the bounds of its chunk of 256."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..model import MAX_SH_DEGREE
from ..model.sh import degree_of, notes_on_degree
from ..model.splats import FloatArray
from ..system.errors import FormatError
from ..system.progress import Progress
from ..system.threads import ordered_map
from ..system.units import count_of
from . import quantize
from .ply import PlyHeader, offset_of, read_header
from .reader import HARMLESS, OpenFile, Reader, Rows, Target, left_out, rows_of

#: Splats of a chunk, which share bounds.
CHUNK_SPLATS = 256

#: Properties of a splat, uint32 each.
VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

#: Properties of the bounds of a chunk, by what they bound; old files have no bounds of colours.
BOUNDS = {
    "position": ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"),
    "scale": ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"),  # logarithms
    "color": ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"),
}


def open_content(source: OpenFile) -> Reader:
    """Open a compressed PLY file, with or without bounds of colours and SH."""
    header = read_header(source.file)
    count, coefficients = _checked(header)
    trailing = header.check_size(source.size)
    degree, names = degree_of(coefficients), ("chunk", "vertex", "sh")[: 3 if coefficients else 2]
    offsets = {name: offset_of(source.file, header, name) for name in names}

    def read(name: str, start: int, stop: int) -> Iterator[Rows]:
        row_type = header.row_types[name]
        assert row_type is not None
        return rows_of(source.read_at, offsets[name], row_type, start, stop, header.counts[name])

    bounds = _bounds(read("chunk", 0, -(-count // CHUNK_SPLATS)))

    def fill(target: Target, threads: int, progress: Progress) -> None:
        @np.errstate(invalid="ignore", over="ignore")  # absurd bounds overflow
        def unpack(block: Rows) -> int:
            part, rows = block
            splats, words = target.rows(part), {name: rows[name].astype(np.uint32) for name in VERTEX}
            center = quantize.decode_unorm_11_10_11(words["packed_position"])
            splats.center[:] = _within(bounds["position"], part, center)
            log_scale = quantize.decode_unorm_11_10_11(words["packed_scale"])
            splats.scale[:] = quantize.decode_log(_within(bounds["scale"], part, log_scale))
            splats.quat_xyzw[:] = quantize.decode_quat_2_10_10_10(words["packed_rotation"])[:, [1, 2, 3, 0]]
            rgba = quantize.decode_unorm_8888(words["packed_color"])
            splats.rgb[:] = _within(bounds["color"], part, rgba[:, :3])
            splats.opacity[:] = rgba[:, 3]
            return part.stop

        def unpack_sh(block: Rows) -> int:
            part, rows = block
            codes = rows.view(np.uint8).reshape(len(rows), 3, coefficients)  # all of red come first
            sh = target.rows(part).sh
            sh[:] = quantize.decode_centred_8(codes[:, :, : sh.shape[1]].transpose(0, 2, 1))

            return part.stop

        steps = (("vertex", unpack), ("sh", unpack_sh)) if coefficients else (("vertex", unpack),)
        for name, step in steps:
            for done in ordered_map(step, read(name, target.start, target.stop), threads):
                progress("reading", done, count, "splat")

    facts = {"chunks": header.counts["chunk"], "color_bounds": int(bounds["color"] is not None)}
    facts["trailing_bytes"] = trailing
    kept, notes = min(degree, MAX_SH_DEGREE), notes_on_degree(degree) + _left_out(header)
    return Reader(count, kept, "compressed PLY", fill, header.mode == "mip", notes, facts, concurrent=True)


def _left_out(header: PlyHeader) -> tuple[str, ...]:
    read = {"vertex": {*VERTEX}, "chunk": {name for names in BOUNDS.values() for name in names}}
    properties = [
        each.name
        for name, names in read.items()
        for each in header.elements[name].properties
        if each.name not in names | HARMLESS
    ]
    elements = [name for name, count in header.counts.items() if count and name not in {*read, "sh"}]
    return left_out("property", "properties", properties) + left_out("element", "elements", elements)


def _within(bounds: FloatArray | None, part: slice, unit: FloatArray) -> FloatArray:
    """Scale (n, 3) values 0..1 of the splats in `part` to their chunks' bounds, (chunks, 6): low and high xyz."""
    if bounds is None:
        return unit
    of_chunks = bounds[part.start // CHUNK_SPLATS : -(-part.stop // CHUNK_SPLATS)]
    first = part.start % CHUNK_SPLATS
    low, high = np.split(np.repeat(of_chunks, CHUNK_SPLATS, axis=0)[first : first + len(unit)], 2, axis=1)
    return quantize.between(unit, low, high)


def _bounds(runs: Iterator[Rows]) -> dict[str, FloatArray | None]:
    rows = np.concatenate([rows for _, rows in runs] or [np.empty(0)])
    have = rows.dtype.names or ()
    return {
        what: np.stack([rows[name] for name in names], axis=1).astype(np.float32) if names[0] in have else None
        for what, names in BOUNDS.items()
    }


def _checked(header: PlyHeader) -> tuple[int, int]:
    """Check the elements, and return the number of splats and of SH coefficients per channel."""
    if header.text:
        raise FormatError("an ascii compressed PLY, but the format is binary")
    count = header.counts.get("vertex", 0)
    _check_types(header, "vertex", VERTEX, np.uint32)
    chunk_names = {*BOUNDS["position"], *BOUNDS["scale"]}
    have = set(_check_types(header, "chunk", tuple(chunk_names), np.float32))
    if have & {*BOUNDS["color"]}:
        _check_types(header, "chunk", BOUNDS["color"], np.float32)
    if header.counts["chunk"] * CHUNK_SPLATS < count:
        chunks = count_of(header.counts["chunk"], "chunk")
        raise FormatError(f"{chunks} of {CHUNK_SPLATS} cannot hold {count_of(count, 'splat')}")
    if "sh" not in header.elements:
        return count, 0
    row_type = header.row_types["sh"]
    names = tuple(f"f_rest_{index}" for index in range(len(row_type.names or ()) if row_type else 1))
    if _check_types(header, "sh", names, np.uint8) != names:
        raise FormatError("the properties of its element sh are not f_rest_0, f_rest_1 and so on")
    if len(names) % 3 or header.counts["sh"] != count:
        rows, splats = count_of(header.counts["sh"], "row"), count_of(count, "splat")
        raise FormatError(f"its element sh has {rows} of {len(names)} values for {splats}")
    return count, len(names) // 3


def _check_types(header: PlyHeader, element: str, names: tuple[str, ...], kind: type[np.generic]) -> tuple[str, ...]:
    """Return the names of an element's properties, after a check that `names` are among them and of a type."""
    row_type = header.row_types.get(element)
    have: tuple[str, ...] = (row_type.names or ()) if row_type else ()
    bad = [name for name in names if row_type is None or name not in have or row_type[name].newbyteorder("=") != kind]
    if bad:
        raise FormatError(f"its element {element} has no {', '.join(sorted(bad))} of type {np.dtype(kind)}")
    return have
