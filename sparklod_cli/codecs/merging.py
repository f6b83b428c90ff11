"""Several scenes, the splat files beside a manifest, and the files in a zip, as one scene."""

from __future__ import annotations

import contextlib
import io
import posixpath
import struct
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import IO, BinaryIO

import numpy as np

from ..model.scene import common_axis, differing, rotated_axis
from ..model.sh import width_of
from ..model.splats import COLUMNS, Splats
from ..model.transforms import Transform
from ..system.errors import ChecksumError, FormatError, NotSplatsError, UnsupportedError, naming
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..system.units import count_of
from ..system.untrusted import quoted, quoted_value
from .compression import check_promise
from .format_rules import RuleViolation, error_of
from .formats import MANIFEST, META, TILESET
from .reader import Fill, OpenCompanion, OpenFile, Reader, RowBuffer, size_of


@dataclass(frozen=True, eq=False)
class Placed:
    """Scene, its name in messages, empty for none, and the transform of its splats."""

    reader: Reader
    name: str
    transform: Transform = field(default_factory=Transform)


def placed(reader: Reader, transform: Transform) -> Reader:
    """Return a reader that transforms splats as it reads them; its `up` is that of the transformed splats."""
    if transform.is_identity:
        return reader

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        reader.fill(target, threads, progress)
        copy_rows(transform.apply(target.splats), target.splats)

    return replace(reader, fill=fill)


def merged(parts: Sequence[Placed]) -> Reader:
    """Merge one scene or more in this order; SH of lower degrees are padded with zeros.

    The result is antialiased if most splats are, with a note if they differ, and has the up axis that all scenes share.
    Errors name the scene.
    """
    degree, count = max(part.reader.sh_degree for part in parts), sum(part.reader.count for part in parts)
    found = sum(part.reader.count for part in parts if part.reader.antialiased)
    antialiased, notes = 2 * found > count, list[str]()
    if found not in (0, count):
        kind = "antialiased" if antialiased else "not antialiased"
        text = f"{found:,} of {count_of(count, 'splat')} are antialiased, and the others are not"
        notes.append(f"{text}; all are written as {kind}")
    notes += [f"{part.name}: {note}" for part in parts for note in part.reader.notes]
    axes = [part.reader.up and rotated_axis(part.reader.up, part.transform.rotation) for part in parts]
    if len(set(axes)) > 1:
        notes.append(f"{differing(axes)}, so none is noted unless --up names it")
    return Reader(
        count,
        degree,
        " and ".join(sorted({part.reader.format for part in parts})),
        FillMerged(tuple(parts)),
        antialiased,
        tuple(dict.fromkeys(notes)),
        up=common_axis(axes),
        up_by=(common_axis(part.reader.up_by for part in parts) or "")
        if axes == [part.reader.up for part in parts]
        else "",
    )


@dataclass(frozen=True, eq=False)
class FillMerged:
    """`Reader.fill` of several scenes, in the memory of a block; can be pickled if their readers can."""

    parts: tuple[Placed, ...]

    def __call__(self, target: RowBuffer, threads: int, progress: Progress) -> None:
        done = 0
        for number, rows, out in target.shares(part.reader.count for part in self.parts):
            part, at = self.parts[number], 0
            with naming(part.name) if part.name else contextlib.nullcontext():
                for splats in replace(part.reader, threads=threads).blocks(rows.start, rows.stop):
                    copy_rows(part.transform.apply(splats), out.take(slice(at, at := at + len(splats))))
                    done += len(splats)
                    progress("reading", done, len(target.splats), "splat")


#: Run of splats of a file: number of the first, number of splats, and row of the first in the scene.
Piece = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Chunk(Reader):
    """Splat file that a manifest names, opened for each read, and the pieces of it to read.

    Attributes:
        name: path relative to the manifest's folder.
        bytes: size of the file and of the files that it names.
    """

    name: str = ""
    bytes: int = 0
    pieces: tuple[Piece, ...] = ()

    @property
    def rows(self) -> int:
        """Number of splats in the pieces."""
        return sum(count for _, count, _ in self.pieces)


@dataclass(frozen=True)
class SceneFiles:
    """Splat files beside a manifest: chunks of a Streamed SOG, tiles of 3D Tiles.

    Attributes:
        open_companion: opens a file by name; None if no other files can be opened.
        manifest: name of the manifest in messages.
        code: code of the finding that a file cannot be read.
        open_content: reads the header of a file with a name.
    """

    open_companion: OpenCompanion | None
    manifest: str
    code: str
    open_content: Callable[[str, OpenFile], Reader]

    def open(self, name: str, pieces: Sequence[Piece] | None = None, row: int = 0) -> Chunk:
        """Read the header of a file, to read its `pieces` later, by default all splats from `row` on."""
        with self._opened(name) as source:
            content = self.open_content(name, source)
        facts, expected = vars(content), (content.count, content.sh_degree)
        size = content.header.get("bytes", source.size)
        pieces = ((0, content.count, row),) if pieces is None else tuple(pieces)

        def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
            with self._opened(name) as source:
                content = self.open_content(name, source)
                if (content.count, content.sh_degree) != expected:
                    raise FormatError("it was changed while it was read; start again")
                content.fill(target, threads, progress)

        return Chunk(**facts | {"fill": fill, "coding": None}, name=name, bytes=size, pieces=pieces)

    def read(
        self, chunks: Sequence[Chunk], out: Splats, threads: int = 1, progress: Progress = silent, first_row: int = 0
    ) -> None:
        """Read pieces of several files at a time into `out`, whose first row is `first_row`; errors name the file."""
        together = min(threads, len(chunks))

        def work(chunk: Chunk) -> int:
            splats, _ = replace(chunk, threads=max(1, threads // together)).read(0, chunk.count, once=True)
            for start, count, row in chunk.pieces:
                rows = slice(row - first_row, row - first_row + count)
                copy_rows(splats.take(slice(start, start + count)), out.take(rows))
            return chunk.rows

        done = 0
        for rows in ordered_map(work, chunks, together):
            done += rows
            progress("reading", done, len(out), "splat")

    def _fill(self, chunks: Sequence[Chunk], degree: int, threads: int) -> Fill:
        """Return the `Reader.fill` of files; reading blocks keeps one file in memory, and needs rows in their order."""
        count = sum(chunk.rows for chunk in chunks)
        last: dict[int, Splats] = {}  # of the file that was read last, by its number

        def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
            if len(target.splats) == count:
                self.read(chunks, target.splats, threads, progress)
                return
            for number, rows, out in target.shares(chunk.rows for chunk in chunks):
                if number not in last:
                    last.clear()
                    chunk = chunks[number]
                    splats = Splats.empty(chunk.rows, degree)
                    self.read([chunk], splats, threads, first_row=chunk.pieces[0][2])
                    last[number] = splats
                copy_rows(last[number].take(rows), out)
            if target.stop == count:
                last.clear()

        return fill

    def reader(
        self,
        chunks: Sequence[Chunk],
        format: str,
        header: Mapping[str, int],
        size: int,
        notes: Iterable[str],
        threads: int,
    ) -> Reader:
        """Return a reader of files, one after the other; `size` and `notes` are those of the manifest."""
        degree, size = max(chunk.sh_degree for chunk in chunks), size + sum(chunk.bytes for chunk in chunks)
        count, header = sum(chunk.rows for chunk in chunks), {**header, "bytes": size}
        check_promise(count * 4 * width_of(degree), size)
        every = tuple(dict.fromkeys([*notes, *(note for chunk in chunks for note in chunk.notes)]))
        antialiased = any(chunk.antialiased for chunk in chunks)
        return Reader(count, degree, format, self._fill(chunks, degree, threads), antialiased, every, header)

    def violations(
        self,
        chunks: Sequence[Chunk],
        rules: Callable[[Chunk, Splats], Iterable[RuleViolation]],
        threads: int = 1,
        progress: Progress = silent,
    ) -> Iterator[RuleViolation]:
        """Decode files one at a time, and yield the violations that `rules` finds in their splats."""
        total, done = sum(chunk.count for chunk in chunks), 0
        for chunk in chunks:
            splats = Splats.empty(chunk.rows, chunk.sh_degree)
            try:
                self.read([chunk], splats, threads)
            except FormatError as error:
                yield RuleViolation(self.code, str(error))
                continue
            yield from rules(chunk, splats)
            done += chunk.count
            progress("checking", done, total, "splat")

    @contextlib.contextmanager
    def _opened(self, name: str) -> Iterator[OpenFile]:
        """Open a file, with the way to open the files that it names; errors of the body name it."""
        if self.open_companion is None:
            raise FormatError(f"{self.manifest} names {quoted_value(name)}, but other files cannot be opened here")
        open_companion, folder = self.open_companion, posixpath.dirname(name)

        def beside(other: str) -> BinaryIO:
            return open_companion(f"{folder}/{other}" if folder else other)

        try:
            opened = open_companion(name)
        except FormatError as error:  # which names it
            raise error_of(self.code, str(error)) from None
        with opened as file:
            try:
                yield OpenFile(file, beside)
            except UnsupportedError as error:  # the file is sound
                raise UnsupportedError(f"{quoted_value(name)}: {error}") from None
            except FormatError as error:
                raise error_of(self.code, f"{quoted_value(name)}: {error}") from None


def not_finite(chunk: Chunk, splats: Splats) -> RuleViolation | None:
    """Return the violation of a file with numbers that are not finite; None if all are finite."""
    invalid = splats.invalid()
    if not invalid:
        return None
    count = int(np.count_nonzero(np.any(list(invalid.values()), axis=0)))
    text = f"{count_of(count, 'splat')} of {quoted_value(chunk.name)} have a number that is not finite"
    return RuleViolation("values.non-finite", text, fatal=False)


def copy_rows(splats: Splats, out: Splats) -> None:
    """Copy splats to as many rows; SH coefficients that they do not have become 0."""
    for name in COLUMNS:
        column = getattr(out, name)
        if name == "sh":
            has = splats.sh.shape[1]
            column[:, has:] = 0
            column[:, :has] = splats.sh
        else:
            column[...] = getattr(splats, name)


#: Errors of `zipfile` about archives that are damaged, encrypted or of a kind that it does not read.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)

#: Compression methods that are read, and the flag of an encrypted member.
METHODS, ENCRYPTED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), 1

#: Bytes that are read at a time.
PIECE = 1 << 20

#: Members that a message names.
FEW = 3


class ZipFolder:
    """Files of a scene in a zip, possibly inside a folder of it.

    Attributes:
        first: name of the file that names the others, such as meta.json; their names are relative to it.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._size, self._lock = size_of(file), threading.Lock()
        try:
            self._zip = zipfile.ZipFile(file)
        except ZIP_ERRORS as error:
            raise FormatError(f"not a complete zip archive: {quoted(error)}") from None
        files = [each for each in self._zip.infolist() if not each.is_dir()]
        # Windows PowerShell writes backslashes, and some programs "./" before names.
        self._members = {str(PurePosixPath(each.filename.replace("\\", "/"))): each for each in files}
        path = _first_file(list(self._members))
        self.first = PurePosixPath(path).name
        self._folder = path.removesuffix(self.first)

    def _member(self, name: str) -> zipfile.ZipInfo:
        try:
            return self._members[self._folder + name]
        except KeyError:
            raise FormatError(f"{self.first} names {quoted_value(name)}, which is not in the archive") from None

    def bytes_of(self, name: str) -> int:
        """Return the compressed size of a member in bytes."""
        return self._member(name).compress_size

    def open(self, name: str) -> BinaryIO:
        """Unpack a member into memory, as a file."""
        with self.opened(name) as file:
            return io.BytesIO(b"".join(iter(lambda: file.read(PIECE), b"")))

    @contextlib.contextmanager
    def opened(self, name: str, *, whole: bool = True) -> Iterator[IO[bytes]]:
        """Open a member; `whole` reads it to its end at last, which checks the checksum."""
        member = self._member(name)
        if member.compress_type not in METHODS or member.flag_bits & ENCRYPTED:
            raise FormatError(f"{quoted_value(name)} is encrypted, or compressed by a method that is not read")
        check_promise(member.file_size, self._size)
        try:
            with self._lock:
                opened = self._zip.open(member)
            with opened as file:
                try:
                    yield file
                finally:
                    while whole and file.read(PIECE):
                        pass
        except ZIP_ERRORS as error:
            kind = ChecksumError if "CRC" in str(error) else FormatError
            raise kind(f"{quoted_value(name)} cannot be unpacked: {quoted(error)}") from None


def _first_file(names: list[str]) -> str:
    """Return the name of the topmost file that lists others, such as lod-meta.json; an error if there is not one."""
    above = {MANIFEST: (), META: (MANIFEST,), TILESET: (TILESET,)}
    paths = {path: name for name in names if (path := PurePosixPath(name)).name in above}
    found = [
        name
        for path, name in paths.items()
        if not any(folder / manifest in paths for folder in path.parent.parents for manifest in above[path.name])
    ]
    if len(found) == 1:
        return found[0]
    listed = ", ".join(quoted_value(name) for name in (found or names)[:FEW])
    listed += ", ..." if len(found or names) > FEW else ""
    if found:
        raise NotSplatsError(f"a zip archive of several scenes ({listed}): unzip it, and give one of them")
    raise NotSplatsError(
        f"a zip archive ({listed}) without {META}, {MANIFEST} or {TILESET}: unzip it, and give a splat file that was"
        " in it"
    )
