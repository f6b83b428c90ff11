"""Notes of sparklod in files of formats that have no field for them.

A note is a JSON object with "generator". It is the comment of a RAD, PLY or SPZ file, and "asset" of a SOG or a
Streamed SOG, which may have more keys.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from .. import __version__
from ..model.scene import AXES, SPECIFIED
from ..system.untrusted import parse_json, quoted_value

#: How the "generator" of a note of sparklod begins; its version follows.
GENERATOR = "sparklod "


@dataclass(frozen=True)
class FileNote:
    """Contents of the note in a file.

    Attributes:
        antialiased, up: as in `Scene`.
        problems: what is ignored of it, as sentences for `Scene.notes`.
        is_ours: sparklod wrote the file.
    """

    antialiased: bool = False
    up: str | None = None
    problems: tuple[str, ...] = ()
    is_ours: bool = False

    def axis_of(self, form: str) -> tuple[str | None, str]:
        """Return `up` and `up_by` of a file: its note, or what `SPECIFIED` says if another program wrote it."""
        if self.up is None and not self.is_ours:
            return SPECIFIED[form], form
        return self.up, ""


def note_of(*, antialiased: bool = False, up: str | None = None) -> dict[str, Any]:
    """Return the note of a file: "generator", "antialiased" where that is true, and "up" where it is known."""
    note: dict[str, Any] = {"generator": GENERATOR + __version__}
    return note | ({"antialiased": True} if antialiased else {}) | ({} if up is None else {"up": up})


def comment_of(*, antialiased: bool = False, up: str | None = None) -> str:
    """Return the note of a file as one line of ASCII."""
    return json.dumps(note_of(antialiased=antialiased, up=up))


def read_note(note: Any) -> FileNote:
    """Parse a note; one that is not of sparklod says nothing."""
    if not isinstance(note, dict) or not str(note.get("generator", "")).startswith(GENERATOR):
        return FileNote()
    up, problems = note.get("up"), tuple[str, ...]()
    if up is not None and not (isinstance(up, str) and up in AXES):
        problems = (f"its up axis {quoted_value(up)} is ignored; it is none of {', '.join(AXES)}",)
        up = None
    return FileNote(note.get("antialiased") is True, up, problems, is_ours=True)


def read_comment(comment: str | bytes | None) -> FileNote:
    """Parse a comment; free text says nothing."""
    try:
        return read_note(parse_json(comment or "null"))
    except ValueError:
        return FileNote()
