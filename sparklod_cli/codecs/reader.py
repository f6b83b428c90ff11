"""Readers of files in blocks, so that no file is in memory as a whole; notes in files; checks of their splats.

Formats without a field for it hold a note of sparklod: a JSON object with "generator". It is the comment of a RAD, PLY
or SPZ file, and "asset" of a SOG or a Streamed SOG, which may have more keys.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..model.lod_tree import LodTree
from ..model.scene import AXES, SPECIFIED, Scene
from ..model.splats import COLUMNS, UNIT_TOLERANCE, Splats, describe_invalid
from ..system.errors import FormatError, HasTreeError, InvalidSplatsError, TreeError, TruncatedError
from ..system.progress import Progress, silent
from ..system.threads import BLOCK_ROWS, blocks_of, ordered_map
from ..system.untrusted import parse_json, printable, quoted_value
from .kernels.drawable import count_doubtful

if TYPE_CHECKING:
    from ..model.scene import FileCoding

#: Least bytes of a block: with narrow rows, such as SPZ's streams, handing a smaller one to a thread costs more than it
#: saves.
BLOCK_BYTES = 1 << 18

#: A block of rows: which rows, and their content.
Rows = tuple[slice, NDArray[Any]]

#: Reads the next `size` bytes, or fewer at the end of the data; or `size` bytes from a position on.
Read = Callable[[int], bytes | memoryview]
ReadAt = Callable[[int, int], bytes | memoryview]

#: Opens a file that another one names; raises `FormatError` where it cannot.
OpenCompanion = Callable[[str], BinaryIO]

#: Opens an unpacked file with these bytes, which are made at the first call, for formats whose splats do not lie one
#: after the other. The file stays open as long as the one that is read.
Scratch = Callable[[Callable[[], Iterable[bytes]]], "OpenFile"]


def size_of(file: BinaryIO) -> int:
    """Return the bytes of a file, which is left at its beginning."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return size


class OpenFile:
    """Open file for a codec.

    Attributes:
        file: open for reading, at its beginning, until the last read.
        size: bytes of the file.
        open_companion: opens the files that it names; None if no other files can be opened.
        scratch: keeps data that must be unpacked before rows can be read in any order; None to read all rows once.
        threads: number of threads that read the files which it names.
    """

    def __init__(
        self,
        file: BinaryIO,
        open_companion: OpenCompanion | None = None,
        scratch: Scratch | None = None,
        threads: int = 1,
    ) -> None:
        self.file, self.open_companion, self.scratch, self.threads = file, open_companion, scratch, threads
        self.size = file.seek(0, io.SEEK_END)
        file.seek(0)
        self._lock = threading.Lock()
        plain = isinstance(getattr(file, "raw", None), io.FileIO) and hasattr(os, "pread")
        self._descriptor = file.fileno() if plain else None

    def read_at(self, at: int, size: int) -> bytes:
        """Return the `size` bytes from `at` on, or fewer at the end of the file; several threads may call this."""
        if self._descriptor is None:
            with self._lock:
                self.file.seek(at)
                return self.file.read(size)
        data = os.pread(self._descriptor, size, at)
        while 0 < len(data) < size:  # a read may give less, at most 2 GiB
            more = os.pread(self._descriptor, size - len(data), at + len(data))
            if not more:
                break
            data += more
        return data


def rows_of(
    read: ReadAt, offset: int, row_type: np.dtype[Any], start: int, stop: int, count: int, subject: str = "splats"
) -> Iterator[Rows]:
    """Read rows from `start` to `stop` in blocks of at least `BLOCK_BYTES`; row 0 of `count` is at `offset`."""
    step = max(BLOCK_ROWS, BLOCK_BYTES // row_type.itemsize)
    for first in range(start, stop, step):
        part = slice(first, min(first + step, stop))
        data = read(offset + first * row_type.itemsize, (part.stop - first) * row_type.itemsize)
        whole = len(data) // row_type.itemsize
        if part.start + whole < part.stop:
            raise TruncatedError(f"cut short after {part.start + whole:,} of {count:,} {subject}")
        yield part, np.frombuffer(data, row_type)


def encode_rows(encode: Callable[[slice], bytes], count: int, threads: int, progress: Progress) -> Iterator[bytes]:
    """Return the bytes of `count` rows in order: `encode` is called with blocks of rows, on several threads."""
    parts = blocks_of(count)
    for part, piece in zip(parts, ordered_map(encode, parts, threads), strict=True):
        yield piece
        progress("writing", part.stop, count, "splat")


#: Splats of a block that a scene is read in, unless its format has other ones: some 30 MB with SH of degree 3.
BLOCK_SPLATS = 1 << 17


@dataclass(frozen=True, eq=False)
class RowBuffer:
    """Rows of a file to fill.

    Attributes:
        splats: n rows.
        start: number in the file of the first.
        tree: (n,) nodes to fill; None in a file without a tree.
        columns: of `Splats` to fill; a codec may fill the others, too.
        once: these are all rows of the file and are read once, so that they need not be unpacked to `OpenFile.scratch`.
    """

    splats: Splats
    start: int = 0
    tree: LodTree | None = None
    columns: Collection[str] = COLUMNS
    once: bool = False

    @property
    def stop(self) -> int:
        """Number in the file of the row after the last."""
        return self.start + len(self.splats)

    def rows(self, part: slice) -> Splats:
        """Return views of rows, which are counted as those of the file."""
        return self.splats.take(slice(part.start - self.start, part.stop - self.start))

    def shares(self, counts: Iterable[int]) -> Iterator[tuple[int, slice, Splats]]:
        """Yield the files, of these counts one after the other, that have rows of these: number, rows and views."""
        end = 0
        for number, count in enumerate(counts):
            begin, end = end, end + count
            start, stop = max(self.start, begin), min(self.stop, end)
            if start < stop:
                yield number, slice(start - begin, stop - begin), self.rows(slice(start, stop))

    def nodes(self, part: slice) -> LodTree | None:
        """Return views of nodes, counted as `rows`."""
        return None if self.tree is None else self.tree.rows(slice(part.start - self.start, part.stop - self.start))


#: Reads and decodes rows on some threads; raises `FormatError` if the file is cut short or corrupt.
Fill = Callable[[RowBuffer, int, Progress], None]


@dataclass(frozen=True, eq=False)
class Reader:
    """Splats of a file, or of several as one scene, whose headers have been read.

    Attributes:
        count: N splats, as the header promises.
        sh_degree: of the decoded splats.
        format, antialiased, notes, up, up_by, chunk_bytes: as in `Scene`.
        header: as in `Scene`; reading all splats may add to it.
        coding: called when all splats have been read, returns `Scene.coding`; None for float32.
        block: smallest number of splats that are read together; ranges are read in multiples of it.
        concurrent: several threads may call `fill` at a time.
    """

    count: int
    sh_degree: int
    format: str
    fill: Fill
    antialiased: bool = False
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    has_tree: bool = False
    chunk_bytes: tuple[int, ...] | None = None
    coding: Callable[[], FileCoding] | None = None
    block: int = 1
    up_by: str = ""
    concurrent: bool = False
    threads: int = 1

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "header": dict(self.header), "coding": None}  # which belongs to an open file

    def read(
        self,
        start: int,
        stop: int,
        columns: Collection[str] = COLUMNS,
        progress: Progress = silent,
        *,
        once: bool = False,
    ) -> tuple[Splats, LodTree | None]:
        """Read a range of splats, and their nodes in a file with a tree; other columns may be 0.

        `once` is that of `RowBuffer`.
        """
        splats, tree = Splats.zeros(stop - start, self.sh_degree), None
        if self.has_tree:
            tree = LodTree(np.empty(stop - start, np.uint16), np.empty(stop - start, np.uint32))
        self.fill(RowBuffer(splats, start, tree, columns, once), self.threads, progress)
        return splats, tree

    def scene(self, *, columns: Collection[str] = COLUMNS, progress: Progress = silent, validate: bool = True) -> Scene:
        """Read all splats, once; `validate` refuses a broken tree, and gives leaves a `child_start` of 0."""
        splats, tree = self.read(0, self.count, columns, progress, once=True)
        coding = None if self.coding is None else self.coding()
        facts = self.antialiased, self.format, self.notes, self.header, self.chunk_bytes, coding, self.up, self.up_by
        scene = Scene(splats, tree, *facts)
        tree = scene.tree  # which knows that it is valid once it has been validated
        if tree is None or not validate:
            return scene
        try:
            tree.validate()
        except TreeError as error:
            raise FormatError(f"its Level-of-Detail tree is broken: {error}") from error
        start = tree.first_child()
        is_same = np.array_equal(start, tree.child_start)
        return scene if is_same else dataclasses.replace(scene, tree=LodTree(tree.child_count, start))

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[Splats]:
        """Read a range of splats, all by default, in blocks; raises as `check_plain` and `read`."""
        self.check_plain()
        stop = self.count if stop is None else stop
        step = self.block * max(1, BLOCK_SPLATS // self.block)
        for first in range(start - start % self.block, stop, step):
            yield self.read(max(first, start), min(first + step, stop))[0]

    def check_plain(self) -> None:
        """Raise `HasTreeError` if the file has a tree, and `FormatError` if it has no splats and is corrupt."""
        if self.has_tree:
            raise HasTreeError("it is a Level-of-Detail file already; give the splats that it was built from")
        if not self.count:
            self.read(0, 0)


def decode_file(
    codec: Any,
    file: BinaryIO,
    *,
    open_companion: OpenCompanion | None = None,
    threads: int = 1,
    progress: Progress = silent,
    **more: Any,
) -> Scene:
    """Read a whole scene from an open file by the module of its format; `more` is passed on to `Reader.scene`."""
    reader: Reader = codec.open_content(OpenFile(file, open_companion, threads=threads))
    return dataclasses.replace(reader, threads=threads).scene(progress=progress, **more)


#: Names, or families of them, in a note, and characters of each at most: the file chooses both. Chosen.
MOST_NAMED, MOST_NAME = 8, 40

#: Properties that say nothing of a splat: normals, colours for viewers of point clouds, the state of an editor.
HARMLESS = {"nx", "ny", "nz", "normal_x", "normal_y", "normal_z", "normals", "red", "green", "blue", "alpha", "state"}

#: Members of a family, names that count up, from which its first and last name stand for all.
FAMILY = 3

#: A name with a number at its end, of few enough digits to count with.
_COUNTED = re.compile(r"(.*?)(0|[1-9][0-9]{0,8})", re.DOTALL)


class Note(str):
    """A note on a scene, with the code of the finding that `inspect` makes of it; None for no finding.

    A plain text is a note on data that the reader leaves out.
    """

    code: str | None

    def __new__(cls, text: str, code: str | None = None) -> Note:
        note = super().__new__(cls, text)
        note.code = code
        return note


def code_of(note: str) -> str | None:
    """Return the code of the finding that a note is; None for no finding."""
    return note.code if isinstance(note, Note) else "container.left-out"


def left_out(noun: str, plural: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the note that names data, such as "its properties label and motion_0 to motion_8 are left out"."""
    every = sorted(set(names), key=_counted)
    if not every:
        return ()
    shown = list(_families(every))
    more = len(shown) - MOST_NAMED
    shown = [*shown[:MOST_NAMED], f"{more:,} more"] if more > 0 else shown
    text = " and ".join(filter(None, (", ".join(shown[:-1]), shown[-1])))
    return (f"its {noun} {text} is left out" if len(every) == 1 else f"its {plural} {text} are left out",)


def _families(names: list[str]) -> Iterator[str]:
    """Yield the names, and the first and the last of runs of names that count up one by one."""
    run: list[str] = []
    for name in [*names, ""]:  # which ends the last run
        start, number = _counted(name)
        if run and number >= 0 and _counted(run[-1]) == (start, number - 1):
            run.append(name)
            continue
        ends = [printable(each, MOST_NAME) for each in run]
        yield from ends if len(run) < FAMILY else [f"{ends[0]} to {ends[-1]}"]
        run = [name]


def _counted(name: str) -> tuple[str, int]:
    """Return a name without the number at its end, and that number; -1 without one."""
    match = _COUNTED.fullmatch(name)
    return (match[1], int(match[2])) if match else (name, -1)


#: How the "generator" of a note of sparklod begins; its version follows.
GENERATOR = "sparklod "


@dataclass(frozen=True)
class FileNote:
    """Contents of the note in a file; `is_ours` if sparklod wrote it; `problems` are notes on invalid values."""

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
        problems = (f"its up axis {quoted_value(up)} is ignored; expected one of {', '.join(AXES)}",)
        up = None
    return FileNote(note.get("antialiased") is True, up, problems, is_ours=True)


def read_comment(comment: str | bytes | None) -> FileNote:
    """Parse a comment; free text says nothing."""
    if not comment:
        return FileNote()
    try:
        return read_note(parse_json(comment))
    except ValueError:
        return FileNote()


def is_valid_and_visible(splats: Splats, threads: int) -> tuple[bool, bool]:
    """Return whether all splats are certainly valid, and visible; otherwise `Splats.invalid` and `Selection` decide.

    Rounding differs from theirs, so a rotation has to be nearer to a unit one.
    """
    from ..model.selection import EXAMINED

    tolerance = np.float32(UNIT_TOLERANCE / 2)

    def counts(part: slice) -> tuple[int, int]:
        columns = (getattr(splats, name)[part].reshape(-1) for name in COLUMNS)
        doubtful, invisible = count_doubtful(*columns, tolerance)
        return int(doubtful), int(invisible)

    tallies = list(ordered_map(counts, blocks_of(len(splats), EXAMINED), threads))
    return not any(doubtful for doubtful, _ in tallies), not any(invisible for _, invisible in tallies)


def check_valid(splats: Splats, threads: int) -> None:
    """Check splats where they enter: from a file or from the API; `InvalidSplatsError` if one is invalid."""
    if not is_valid_and_visible(splats, threads)[0] and (invalid := splats.invalid()):
        raise InvalidSplatsError(f"{describe_invalid(invalid)}; such splats are not written, leave them out")
