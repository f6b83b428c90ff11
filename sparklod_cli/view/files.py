"""Which files a viewer shows, and under which names it gets them.

A site is a closed table of names: whatever is not in it is not served, so no name can lead out of it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from ..codecs.formats import FORMATS, HEAD, sniff
from ..codecs.rad_header import MAGIC, Header, read_header
from ..codecs.sog_files import META
from ..io.beside import companions, in_folder
from ..io.names import leads_away, reason_of
from ..io.plain import open_plain
from ..support.errors import FormatError, UnknownFormatError, UnreadableError
from ..support.untrusted import quoted_value

#: What Spark calls the formats that sparklod reads; a SOG is something else where it is unpacked.
SPARK_TYPES = {"compressed PLY": "ply", "PLY": "ply", "SPZ": "spz", "KSPLAT": "ksplat", "SPLAT": "splat"}
SPARK_TYPES |= {"SOG": "pcsogszip", "RAD": "rad"}
UNPACKED_SOG = "pcsogs"

#: Media types by suffix; anything else is bytes.
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}
BYTES = "application/octet-stream"

#: By name, with / between folders: bytes, or the real path of a file.
Resources = Mapping[str, bytes | Path]


@dataclass(frozen=True)
class ShownFile:
    """A splat file that the page shows.

    Attributes:
        path: as the user gave it; of an unpacked SOG, of its meta.json.
        name: for display.
        url: where the page finds it, relative to the page.
        format: for display: "RAD", "SPZ".
        spark_type: what Spark calls its format.
        header: of a RAD file.
        files: itself and what it refers to, by the names that it is served under.
    """

    path: Path
    name: str
    url: str
    format: str
    spark_type: str
    header: Header | None
    files: Mapping[str, Path]

    @property
    def bytes(self) -> int:
        """Of all its files."""
        return sum(path.stat().st_size for path in self.files.values())


def media_type(name: str) -> str:
    """The media type of a resource, by its suffix."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), BYTES)


def url_of(name: str) -> str:
    """A resource's name as a relative address."""
    return quote(os.fsencode(name))


def shown_files(paths: Sequence[Path]) -> list[ShownFile]:
    """The files that a page shows, each with those that it refers to.

    Raises:
        FormatError: a file cannot be read, is of no known format, or refers to one that is missing or elsewhere; the
            text names it.
    """
    return [_named(path, f"data/{number}") for number, path in enumerate(paths)]


def _named(path: Path, folder: str) -> ShownFile:
    try:
        return _shown(path, folder)
    except FormatError as error:
        raise type(error)(f"{path}: {error}") from None
    except OSError as error:
        raise UnreadableError(f"{path}: cannot be read: {reason_of(error)}") from None


def _shown(path: Path, folder: str) -> ShownFile:
    given = path
    if path.is_dir():
        path = in_folder(path)
    if path.exists() and not path.is_file():
        raise UnreadableError("it is a pipe or a device; save it to a file first")
    header = None
    with open_plain(path.resolve()) as file:
        head = file.read(HEAD)
        if head.startswith(MAGIC):
            file.seek(0)
            header = read_header(file)
    if not head:
        raise UnreadableError("the file is empty")
    found = sniff(head, path.suffix)
    if found is None:
        raise UnknownFormatError(f"not a splat file that sparklod reads ({', '.join(form.name for form in FORMATS)})")
    form = found.name
    files = {f"{folder}/{path.name}": path.resolve()}
    if header is not None:
        files |= {f"{folder}/{name}": beside for name, beside in _chunk_files(path, header)}
    unpacked = form == "SOG" and path.name == META
    if unpacked:
        files |= {f"{folder}/{beside.name}": _inside(path, beside) for beside in companions(path, ())}
    name = given.resolve().name if given.is_dir() else path.name
    spark_type = UNPACKED_SOG if unpacked else SPARK_TYPES[form]
    return ShownFile(path, name, url_of(f"{folder}/{path.name}"), form, spark_type, header, files)


def _chunk_files(path: Path, header: Header) -> Iterator[tuple[str, Path]]:
    """The chunk files that the header of a RAD file names."""
    for entry in header.chunks:
        name = entry.filename
        if name is None:
            continue
        if leads_away(name):
            raise FormatError(f"it names {quoted_value(name)}, which is not a file beside it")
        beside = path.parent / name
        if not beside.is_file():
            raise FormatError(f"its chunk file {quoted_value(name)} is missing")
        yield name, _inside(path, beside)


def _inside(path: Path, beside: Path) -> Path:
    """The real path of a file that another one names; `FormatError` where a link leads out of their folder."""
    real = beside.resolve()
    if real.parent != path.parent.resolve():
        raise FormatError(f"{quoted_value(beside.name)}, which it names, is a link to another folder; copy it there")
    return real
