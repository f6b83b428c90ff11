"""Extension records of SPZ files, of which the coordinate system is read and written.

Version 4 has them between header and table of streams, versions 1 to 3 after the streams. A record has its type, the
bytes of its payload, and the payload.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

#: Type of a record, and bytes of its payload.
RECORD = struct.Struct("<II")

#: Record of the coordinate system in which the coordinates stand: a uint32, an index of `SYSTEMS` from 1 on.
COORDINATE_SYSTEM = 0xADBE0003

#: Names of the other types that are published.
TYPES = {0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}

#: The coordinate systems: where x, y and z point, of left or right, down or up, back or front.
SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}

#: Bytes of records that are read of a file.
MOST_BYTES = 1 << 20

#: Kinds of unknown records that are named.
MOST_NAMED = 8


def up_of(system: str) -> str:
    """Return the axis of a coordinate system that points up, one of `transforms.AXES`."""
    place = next(at for at, letter in enumerate(system) if letter in "UD")
    return "-" * (system[place] == "D") + "xyz"[place]


def is_right_handed(system: str) -> bool:
    """Return True if x, y and z of a coordinate system are right-handed."""
    return bool(np.linalg.det([_DIRECTIONS[letter] for letter in system]) > 0)


#: By the axis that points up, the right-handed system whose x points right. None has x pointing up.
SYSTEM_OF_UP = {up_of(name): name for name in SYSTEMS if name.startswith("R") and is_right_handed(name)}


@dataclass(frozen=True)
class Extensions:
    """Contents of the extension records of a file.

    Attributes:
        up: as in `Scene`, by the coordinate system.
        has_system: they name a coordinate system, be it an unknown one.
        notes: what is left out of them, as sentences for `Scene.notes`.
    """

    up: str | None = None
    notes: tuple[str, ...] = ()
    has_system: bool = False


def read_extensions(data: bytes, size: int) -> Extensions:
    """Parse extension records; unknown ones are skipped, and what is broken is noted.

    Args:
        data: the records, or their first `MOST_BYTES`.
        size: bytes of all of them.
    """
    at, up, notes, unknown, has_system = 0, None, list[str](), dict[str, int](), False
    while at + RECORD.size <= len(data):
        kind, length = RECORD.unpack_from(data, at)
        payload = at + RECORD.size
        if length > size - payload:
            break
        at = payload + length
        has_system |= kind == COORDINATE_SYSTEM
        if kind != COORDINATE_SYSTEM:
            name = TYPES.get(kind, f"{kind:#010x}")
            unknown[name] = unknown.get(name, 0) + length
        elif up is None:
            system = int.from_bytes(data[payload : payload + 4], "little") if length >= 4 else 0
            if 1 <= system <= len(SYSTEMS):
                name = SYSTEMS[system - 1]
                up = up_of(name)
                if not is_right_handed(name):
                    notes.append(f"its axes are left-handed ({name}) and stay as they are: viewers mirror the scene")
            elif not notes:
                notes.append(f"its coordinate system {system} is unknown, and ignored")
    names = list(unknown)
    notes += [f"extension {name} ({unknown[name]:,} bytes) is left out" for name in names[:MOST_NAMED]]
    if names[MOST_NAMED:]:
        notes.append(f"{len(names) - MOST_NAMED:,} more kinds of extensions are left out")
    if at < size:
        notes.append(f"the last {size - at:,} bytes of its extensions are no records that can be read")
    return Extensions(up, tuple(notes), has_system)


def extensions_of(up: str | None) -> bytes:
    """Return the extension records of a file in which this axis points up, one of `SYSTEM_OF_UP`; b"" for None."""
    if up is None:
        return b""
    number = SYSTEMS.index(SYSTEM_OF_UP[up]) + 1
    return RECORD.pack(COORDINATE_SYSTEM, 4) + number.to_bytes(4, "little")
