"""Rows such as a simulation makes, without one: a flight through a town of houses."""

from __future__ import annotations

import math

from sparklod_cli.simulation.results import COLUMNS
from sparklod_cli.tables.columns import Cell, Row


def row(frame: int = 0, **cells: Cell) -> Row:
    """The row of a frame, empty but for what is given."""
    values: Row = {column.name: None for column in COLUMNS}
    values |= {"frame": frame, "time_s": frame / 30, "instance": "total"} | cells
    return {column.name: column.rounded(values[column.name]) for column in COLUMNS}


def flight(count: int = 300, *, budget: int = 500_000, bandwidth: bool = True, timing: bool = True) -> list[Row]:
    """The rows of a path of `count` frames: out of a square, past a house, and back."""
    rows = []
    fetched = 0
    for frame in range(count):
        at = frame / max(1, count - 1)
        near = math.exp(-(((at - 0.6) / 0.12) ** 2))  # how near the house is
        selected = int(min(budget - frame % 7, budget * (0.55 + 0.7 * at + 0.2 * math.sin(9 * at))))
        limit = 0.0017
        scale = limit * (1 + 3 * near * (selected > 0.98 * budget))
        interior = int(selected * (0.35 + 0.3 * math.cos(5 * at)))
        behind = int(selected * 0.1 * (1 + math.sin(7 * at)))
        inside = int((selected - behind) * (0.75 + 0.2 * math.cos(11 * at)))
        jump = frame == int(0.73 * count)
        chunks = 14 if frame == 0 else 9 if jump else int(frame % 17 == 0) + 2 * int(near > 0.9 and frame % 3 == 0)
        fetched += chunks
        added = int(selected * (0.42 if jump else 0.01 + 0.05 * near))
        first = frame == 0
        rows.append(
            row(
                frame,
                name=f"door, {frame}" if frame % 50 == 0 else None,
                position_x=10 * math.cos(4 * at),
                position_y=-1.6 - at,
                position_z=10 * math.sin(4 * at),
                forward_x=-math.cos(4 * at),
                forward_y=0.0,
                forward_z=-math.sin(4 * at),
                fov_y_deg=60.0,
                width=1920,
                height=1080,
                budget=budget,
                pixel_scale_limit=limit,
                selected=selected,
                leaves=selected - interior,
                interior=interior,
                budget_used=selected / budget,
                stop_reason="budget" if scale > limit else "pixel",
                pixel_scale_min=scale,
                frontier=interior // 2,
                level_min=3,
                level_mean=9.5 + at,
                level_max=17,
                in_frustum=inside,
                outside=selected - behind - inside,
                behind=behind,
                projected_px_p50=1.9 + near,
                projected_px_p95=8 + 20 * near,
                overdraw_estimate=12 + 30 * near,
                chunks_touched=min(60, 14 + frame // 6),
                chunks_new=chunks,
                bytes_new=chunks * 812_345,
                chunks_resident=min(40, fetched),
                missing=chunks * 1500 if not first else 0,
                complete_in_s=chunks * 0.13 if bandwidth else None,
                added=None if first else added,
                removed=None if first else int(added * 0.9),
                churn=None if first else 1.9 * added / (2 * selected),
                traverse_ms=6 + 4 * near + (frame % 5) * 0.3 if timing else None,
            )
        )
    return rows
