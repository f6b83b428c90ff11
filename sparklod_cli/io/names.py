"""Names of files, which of them belong together, and why one cannot be opened, in words."""

from __future__ import annotations

import itertools
import os
from pathlib import Path, PurePath

from ..codecs.rad import names as rad_names
from ..codecs.sog import names as sog_names
from ..support.printable import near

#: Names in a folder that are compared with one that is missing: more take longer than a person expects of an error.
MOST_NAMES = 10_000

#: How similar two names are that may be meant by one another, as `difflib` measures it: a letter or two differ.
SIMILAR = 0.8


def is_file_name(text: str) -> bool:
    """Whether a text can be a file name: no system takes the byte 0 or half of a surrogate pair."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def leads_away(name: str, *, folders: bool = False) -> bool:
    """Whether a name could mean something else than a file in the same folder, or in folders there if `folders`."""
    if folders and "/" in name:
        return any(leads_away(part) for part in name.split("/"))
    return name in ("", ".", "..") or any(mark in name for mark in "/\\:") or not is_file_name(name)


def number_of(name: str, header: str) -> int | None:
    """The place of a file among those of an output that one called `header` names; None if it is none of them.

    They are the images of a meta.json, and the chunks of any other header.
    """
    if header.lower() == sog_names.META:
        return sog_names.number_of(name)
    return rad_names.number_of(name, PurePath(header).stem)


def reason_unreadable(error: OSError) -> str:
    """Return what the system says of an input that cannot be read, and a file of a similar name if it is missing."""
    reason = reason_of(error)
    if not isinstance(error, FileNotFoundError) or not isinstance(error.filename, (str, PurePath)):
        return reason
    folder, name = Path(error.filename).parent, Path(error.filename).name
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in itertools.islice(entries, MOST_NAMES)]
    except OSError:
        return reason
    return reason + near(name, names, cutoff=SIMILAR, folder=folder)


def reason_of(error: OSError) -> str:
    """What the system says of an error, to stand after a colon."""
    return (error.strerror or str(error)).lower()
