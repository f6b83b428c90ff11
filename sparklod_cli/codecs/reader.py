"""Readers, which read a file in blocks and never hold all of its bytes; notes in files; checks of splats.

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
from ..model.scene import AXES, SPECIFIED, Scene, facts_of
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

#: A block of rows: a slice of row numbers, and the rows.
Rows = tuple[slice, NDArray[Any]]

#: Reads the next `size` bytes, or fewer at the end of the data; or `size` bytes from a position on.
Read = Callable[[int], bytes | memoryview]
ReadAt = Callable[[int, int], bytes | memoryview]

#: Opens a file by the name that another file gives it; raises `FormatError` if that fails.
OpenCompanion = Callable[[str], BinaryIO]

#: Opens a temporary file of unpacked data, for formats that do not store splats one after the other. The first call
#: writes it, with the bytes that the argument generates. It stays open as long as the file that is read.
Scratch = Callable[[Callable[[], Iterable[bytes]]], "OpenFile"]


def size_of(file: BinaryIO) -> int:
    """Return the size of a file, bytes, and return to its beginning."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return size


class OpenFile:
    """Open file for a codec.

    Attributes:
        file: binary file at its beginning; stays open until the last read.
        size: size of the file, bytes.
        open_companion: opens the files that this file names; None if no other files can be opened.
        scratch: stores data that must be unpacked before rows can be read in any order; None if all rows are read once.
        threads: number of threads that read the companions.
    """

    def __init__(
        self,
        file: BinaryIO,
        open_companion: OpenCompanion | None = None,
        scratch: Scratch | None = None,
        threads: int = 1,
    ) -> None:
        self.file, self.open_companion, self.scratch, self.threads = file, open_companion, scratch, threads
        self.size = size_of(file)
        self._lock = threading.Lock()
        plain = isinstance(getattr(file, "raw", None), io.FileIO) and hasattr(os, "pread")
        self._descriptor = file.fileno() if plain else None

    def read_at(self, at: int, size: int) -> bytes:
        """Read `size` bytes at a position, or fewer at the end of the file; safe to call from several threads."""
        if self._descriptor is None:
            with self._lock:
                self.file.seek(at)
                return self.file.read(size)
        data = os.pread(self._descriptor, size, at)
        while 0 < len(data) < size:  # one read returns at most 2 GiB
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
    """Encode `count` rows in blocks, on several threads, and yield their bytes in order."""
    parts = blocks_of(count)
    for part, piece in zip(parts, ordered_map(encode, parts, threads), strict=True):
        yield piece
        progress("writing", part.stop, count, "splat")


#: Splats per block of `Reader.blocks`, unless the format has blocks of its own: some 30 MB with SH of degree 3.
BLOCK_SPLATS = 1 << 17


@dataclass(frozen=True, eq=False)
class RowBuffer:
    """Memory that a codec fills with n rows of a file.

    Attributes:
        start: number of the first row in the file.
        tree: (n,) nodes; None for a file without a tree.
        columns: columns of `Splats` to fill; a codec may fill the others, too.
        once: these are all rows of the file and are read once, so that a codec need not unpack them to
            `OpenFile.scratch`.
    """

    splats: Splats
    start: int = 0
    tree: LodTree | None = None
    columns: Collection[str] = COLUMNS
    once: bool = False

    @property
    def stop(self) -> int:
        """Number of the row after the last one, in the file."""
        return self.start + len(self.splats)

    def rows(self, part: slice) -> Splats:
        """Return views of a range of rows, given by their numbers in the file."""
        return self.splats.take(slice(part.start - self.start, part.stop - self.start))

    def shares(self, counts: Iterable[int]) -> Iterator[tuple[int, slice, Splats]]:
        """Divide the buffer among files that are read one after the other.

        Args:
            counts: number of rows of each file.

        Yields:
            for each file with rows in the buffer: its index, the range of its rows, and views of them.
        """
        end = 0
        for number, count in enumerate(counts):
            begin, end = end, end + count
            start, stop = max(self.start, begin), min(self.stop, end)
            if start < stop:
                yield number, slice(start - begin, stop - begin), self.rows(slice(start, stop))

    def nodes(self, part: slice) -> LodTree | None:
        """Return views of a range of nodes, given by their numbers in the file; None without a tree."""
        return None if self.tree is None else self.tree.rows(slice(part.start - self.start, part.stop - self.start))


#: Reads and decodes rows on some threads; raises `FormatError` if the file is cut short or corrupt.
Fill = Callable[[RowBuffer, int, Progress], None]


@dataclass(frozen=True, eq=False)
class Reader:
    """Reader of the splats of a file, or of several files as one scene, after their headers have been read.

    Attributes:
        count: number of splats according to the header.
        sh_degree: SH degree of the decoded splats.
        format, antialiased, notes, up, up_by, chunk_bytes: see `Scene`.
        header: see `Scene`; reading all splats may add entries.
        coding: returns `Scene.coding` once all splats have been read; None for float32.
        block: smallest number of splats that are read together; `blocks` reads multiples of it.
        concurrent: `fill` can be called from several threads at a time.
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
        """Read columns of a range of splats, and the nodes if the file has a tree; `once` is that of `RowBuffer`."""
        splats, tree = Splats.zeros(stop - start, self.sh_degree), None
        if self.has_tree:
            tree = LodTree(np.empty(stop - start, np.uint16), np.empty(stop - start, np.uint32))
        self.fill(RowBuffer(splats, start, tree, columns, once), self.threads, progress)
        return splats, tree

    def scene(self, *, columns: Collection[str] = COLUMNS, progress: Progress = silent, validate: bool = True) -> Scene:
        """Read the whole scene; `validate` refuses a broken tree, and sets the `child_start` of leaves to 0."""
        splats, tree = self.read(0, self.count, columns, progress, once=True)
        coding = None if self.coding is None else self.coding()
        scene = Scene(splats, tree, chunk_bytes=self.chunk_bytes, coding=coding, **facts_of(self))
        tree = scene.tree  # the scene's own copy, which remembers that it was validated
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
        """Read a range of splats, all by default, in blocks; raises the errors of `check_plain` and `read`."""
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
    """Read a whole scene from an open file with the module of its format; `more` is passed on to `Reader.scene`."""
    reader: Reader = codec.open_content(OpenFile(file, open_companion, threads=threads))
    return dataclasses.replace(reader, threads=threads).scene(progress=progress, **more)


#: Most names, or runs of them, in a note, and most characters of each, since the file chooses both. Chosen.
MOST_NAMED, MOST_NAME = 8, 40

#: Properties that do not matter for splats: normals, colours for viewers of point clouds, the state of an editor.
HARMLESS = {"nx", "ny", "nz", "normal_x", "normal_y", "normal_z", "normals", "red", "green", "blue", "alpha", "state"}

#: Fewest names of a run, which count up one by one, that are abbreviated to the first and the last.
LEAST_RUN = 3

#: A name that ends in a number of at most 9 digits.
_COUNTED = re.compile(r"(.*?)(0|[1-9][0-9]{0,8})", re.DOTALL)


class Note(str):
    """A note on a scene, with the code under which `inspect` reports it; None if `inspect` does not.

    A plain str is a note on data that the reader leaves out.
    """

    code: str | None

    def __new__(cls, text: str, code: str | None = None) -> Note:
        note = super().__new__(cls, text)
        note.code = code
        return note


def code_of(note: str) -> str | None:
    """Return the code under which `inspect` reports a note; None if it does not."""
    return note.code if isinstance(note, Note) else "container.left-out"


def left_out(noun: str, plural: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return a note on ignored data, such as "its properties label and motion_0 to motion_8 are left out", if any."""
    every = sorted(set(names), key=_counted)
    if not every:
        return ()
    shown = list(_runs(every))
    more = len(shown) - MOST_NAMED
    shown = [*shown[:MOST_NAMED], f"{more:,} more"] if more > 0 else shown
    text = " and ".join(filter(None, (", ".join(shown[:-1]), shown[-1])))
    return (f"its {noun} {text} is left out" if len(every) == 1 else f"its {plural} {text} are left out",)


def _runs(names: list[str]) -> Iterator[str]:
    """Yield names, with runs of names that count up one by one abbreviated, such as "motion_0 to motion_8"."""
    run: list[str] = []
    for name in [*names, ""]:  # the empty name ends the last run
        start, number = _counted(name)
        if run and number >= 0 and _counted(run[-1]) == (start, number - 1):
            run.append(name)
            continue
        ends = [printable(each, MOST_NAME) for each in run]
        yield from ends if len(run) < LEAST_RUN else [f"{ends[0]} to {ends[-1]}"]
        run = [name]


def _counted(name: str) -> tuple[str, int]:
    """Split a name into text and the number at its end; -1 without a number."""
    match = _COUNTED.fullmatch(name)
    return (match[1], int(match[2])) if match else (name, -1)


#: How the "generator" of a note of sparklod begins; its version follows.
GENERATOR = "sparklod "


@dataclass(frozen=True)
class FileNote:
    """Contents of the note in a file: `is_ours` if sparklod wrote it, `problems` are messages about invalid values."""

    antialiased: bool = False
    up: str | None = None
    problems: tuple[str, ...] = ()
    is_ours: bool = False

    def axis_of(self, form: str) -> tuple[str | None, str]:
        """Return `up` and `up_by` of a file: from its note, or from `SPECIFIED` if another program wrote it."""
        if self.up is None and not self.is_ours:
            return SPECIFIED[form], form
        return self.up, ""


def note_of(*, antialiased: bool = False, up: str | None = None) -> dict[str, Any]:
    """Return the note for a new file: "generator", "antialiased" if that is true, and "up" if it is known."""
    note: dict[str, Any] = {"generator": GENERATOR + __version__}
    return note | ({"antialiased": True} if antialiased else {}) | ({} if up is None else {"up": up})


def comment_of(*, antialiased: bool = False, up: str | None = None) -> str:
    """Return the note for a new file as one line of ASCII."""
    return json.dumps(note_of(antialiased=antialiased, up=up))


def read_note(note: Any) -> FileNote:
    """Parse the note in a file; notes of other programs are ignored."""
    if not isinstance(note, dict) or not str(note.get("generator", "")).startswith(GENERATOR):
        return FileNote()
    up, problems = note.get("up"), tuple[str, ...]()
    if up is not None and not (isinstance(up, str) and up in AXES):
        problems = (f"its up axis {quoted_value(up)} is ignored; expected one of {', '.join(AXES)}",)
        up = None
    return FileNote(note.get("antialiased") is True, up, problems, is_ours=True)


def read_comment(comment: str | bytes | None) -> FileNote:
    """Parse the comment of a file as a note; free text is ignored."""
    try:
        return read_note(parse_json(comment or b"{}"))
    except ValueError:
        return FileNote()


def is_valid_and_visible(splats: Splats, threads: int) -> tuple[bool, bool]:
    """Return whether all splats are valid, and whether all are visible, by a fast test.

    False only means that `Splats.invalid` and `Selection` must decide: their rounding differs, so this test accepts
    quaternions within half the tolerance only.
    """
    from ..model.selection import EXAMINED

    tolerance = np.float32(UNIT_TOLERANCE / 2)

    def counts(part: slice) -> tuple[int, int]:
        return count_doubtful(*(getattr(splats, name)[part].reshape(-1) for name in COLUMNS), tolerance)

    tallies = list(ordered_map(counts, blocks_of(len(splats), EXAMINED), threads))
    return not any(doubtful for doubtful, _ in tallies), not any(invisible for _, invisible in tallies)


def check_valid(splats: Splats, threads: int) -> None:
    """Raise `InvalidSplatsError` if a splat of an input is invalid."""
    if not is_valid_and_visible(splats, threads)[0] and (invalid := splats.invalid()):
        raise InvalidSplatsError(f"{describe_invalid(invalid)}; such splats are not written, leave them out")
