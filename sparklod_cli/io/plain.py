"""Opens plain files, and nothing that has taken the place of one: for those who serve files to others."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

#: For reading; neither follows a link nor waits for the other end of a pipe.
_FLAGS = os.O_RDONLY
for _name in ("O_BINARY", "O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"):
    _FLAGS |= getattr(os, _name, 0)


def open_plain(path: Path) -> BinaryIO:
    """Opens a file for reading; `OSError` where it is a link, a folder, a pipe or a device, or does not exist."""
    descriptor = os.open(path, _FLAGS)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is not a plain file")
    return os.fdopen(descriptor, "rb")
