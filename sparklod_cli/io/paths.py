"""Names of files, plain files, and why a file cannot be opened, in words."""

from __future__ import annotations

import itertools
import os
import stat
from pathlib import Path, PurePath
from typing import BinaryIO

from ..codecs.file_names import META, rad_chunk_number, sog_image_number
from ..support.printable import near

#: Names in a folder that are compared with one that is missing: more take longer than a person expects of an error.
MOST_NAMES = 10_000

#: How similar two names are that may be meant by one another, as `difflib` measures it: a letter or two differ.
SIMILAR = 0.8


def is_file_name(text: str) -> bool:
    """Return whether a text can be a file name: no system takes the byte 0 or half of a surrogate pair."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def leads_away(name: str, *, folders: bool = False) -> bool:
    """Return whether a name could mean anything but a file in the same folder, or in folders there if `folders`."""
    if folders and "/" in name:
        return any(leads_away(part) for part in name.split("/"))
    return name in ("", ".", "..") or any(mark in name for mark in "/\\:") or not is_file_name(name)


def number_of(name: str, header: str) -> int | None:
    """Return the place of a file among those of an output that one called `header` names; None if it is none of them.

    They are the images of a meta.json, and the chunks of any other header.
    """
    if header.lower() == META:
        return sog_image_number(name)
    return rad_chunk_number(name, PurePath(header).stem)


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
    """Return what the system says of an error, to stand after a colon."""
    return (error.strerror or str(error)).lower()


#: For reading; neither follows a link nor waits for the other end of a pipe.
_FLAGS = os.O_RDONLY
for _name in ("O_BINARY", "O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"):
    _FLAGS |= getattr(os, _name, 0)


def open_plain(path: Path) -> BinaryIO:
    """Open a file for reading; `OSError` where it is a link, a folder, a pipe or a device, or does not exist."""
    descriptor = os.open(path, _FLAGS)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is not a plain file")
    return os.fdopen(descriptor, "rb")
