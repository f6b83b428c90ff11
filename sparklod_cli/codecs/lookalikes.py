"""Files that are given for splats, but are none: adding one is a row here."""

from __future__ import annotations

import re
from typing import NamedTuple

from ..system.printable import printable
from ..system.untrusted import keys_of_object

#: What a clone that was made without Git LFS has in place of a file, of any kind.
POINTER = "a Git LFS pointer; run git lfs pull to get the file"

#: Bytes at the beginning of a file that suffice to recognize a pointer.
SHORT = 64

#: Keys of an unknown object that a message names, and the characters that they may take.
FEW, QUOTED = 5, 100


class Lookalike(NamedTuple):
    """A kind of file that holds no splats, or none that are read.

    Attributes:
        text: what it is, and what to do, to stand after "not a splat file, but".
        beginning: a regular expression that the first bytes match; None if any JSON object with the keys is one.
        keys: that it has at the top level.
    """

    text: str
    beginning: bytes | None = None
    keys: tuple[str, ...] = ()


_CAMERAS = "a file of cameras; give it as --camera-path"

#: In the order in which they are tried.
LOOKALIKES = (
    Lookalike(POINTER, rb"version https://git-lfs\.github\.com/spec/v1\s"),
    Lookalike("a web page, perhaps of a download that failed", rb"\s*<(?i:!doctype html|html)"),
    Lookalike("a glTF without splats", keys=("asset", "nodes")),
    Lookalike(_CAMERAS, keys=("frames",)),
    Lookalike(_CAMERAS, keys=("cameras",)),
    Lookalike(_CAMERAS, keys=("keyframes",)),
    Lookalike(_CAMERAS, keys=("camera_path",)),
    Lookalike("the manifest of an LCC scene; convert it to another format", keys=("totalLevel",)),
    # Longer than two bytes, as a .splat or .hier file may begin with any number.
    Lookalike(
        "a JSON list; if it holds cameras, give it as --camera-path",
        rb"(?:\xef\xbb\xbf)?\s*\[\s*\{\s*\"\w+\"\s*:",
    ),
)


def lookalike_of(head: bytes) -> str | None:
    """Return the text of a file of no known format by its first bytes; None if these tell nothing."""
    keys = keys_of_object(head)
    for each in LOOKALIKES:
        if each.beginning is not None and re.match(each.beginning, head):
            return each.text
        if each.keys and set(each.keys) <= set(keys):
            return each.text
    if not keys:
        return None
    named = printable(", ".join(keys[:FEW]), QUOTED) + (", ..." if len(keys) > FEW else "")
    return f"a JSON object of no format that holds splats ({named})"


def is_pointer(head: bytes) -> bool:
    """Return True if a file that begins so is a pointer of Git LFS."""
    return lookalike_of(head[:SHORT]) == POINTER
