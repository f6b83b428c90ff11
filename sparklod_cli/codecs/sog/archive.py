"""The zip of a bundled SOG: files as they are, since images are compressed already."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator

#: Permissions of the members, those of any file; and the system that has them, 3 for Unix.
MODE, UNIX = 0o100644 << 16, 3


def zipped(files: Iterable[tuple[str, bytes]]) -> Iterator[bytes]:
    """The bytes of an archive, piece by piece: the same for the same files, as its members have no dates of their own.

    Args:
        files: names and contents, in the order of the archive.
    """
    # A buffer that is emptied member by member could not be sought, and sizes would follow the members' contents
    # instead of standing before them.
    buffer, given = io.BytesIO(), 0
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files:
            member = zipfile.ZipInfo(name)  # of 1980, the earliest date
            member.create_system, member.external_attr = UNIX, MODE
            archive.writestr(member, content)
            yield buffer.getvalue()[given:]
            given = buffer.tell()
    yield buffer.getvalue()[given:]
