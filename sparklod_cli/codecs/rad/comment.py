"""The comment of a RAD file's header, in which sparklod notes what the format has no field for."""

from __future__ import annotations

import json

from ... import __version__
from ...support.untrusted import parse_json

#: How the "generator" of a comment of sparklod begins; its version follows.
GENERATOR = "sparklod "


def comment_of(*, antialiased: bool) -> str:
    """The comment of a file: JSON with "generator", and "antialiased" where that is true."""
    return json.dumps({"generator": GENERATOR + __version__} | ({"antialiased": True} if antialiased else {}))


def tells_antialiased(comment: str | None) -> bool:
    """Whether a comment is one of sparklod's and says that the scene is antialiased."""
    try:
        notes = parse_json(comment or "null")
    except ValueError:  # free text
        return False
    if not isinstance(notes, dict) or not str(notes.get("generator", "")).startswith(GENERATOR):
        return False
    return notes.get("antialiased") is True
