"""Runs a case in this process and checks the laws that hold for every case."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from sparklod_cli.commands.console import say_error
from sparklod_cli.system.errors import OutOfMemoryError, SparklodError

from .case import Case, LawError, Target
from .streams import STREAMS

#: Peak memory that a case may add to the process, in bytes: a fixed part, and a part for each byte of its files.
MEMORY, MEMORY_PER_BYTE = 400 << 20, 64

#: Length of an error message at most, in characters; `system.untrusted` shortens longer texts to it.
LONGEST = 500

#: Size of an output at most, in bytes: a fixed part, and a part for each byte of the case's files.
OUTPUT, OUTPUT_PER_BYTE = 8 << 20, 200

#: Names of temporary files.
TEMPORARY = re.compile(r".*\.part|\.sparklod-.*|.*\.tmp")


@dataclass(frozen=True)
class Finding:
    """A law that a case broke.

    Attributes:
        kind: exception, warning, law, message, files, stream or memory; `fuzz.child` adds crash and hang.
        text: one line that says what happened.
        where: file and function, or another text by which this fault is told from others.
        detail: everything that is known, such as a traceback.
    """

    kind: str
    text: str
    where: str = ""
    detail: str = ""

    @property
    def signature(self) -> str:
        """A text that is equal for findings which are probably one fault."""
        return f"{self.kind}: {self.where or re.sub(r'[0-9]+', '#', self.text)[:80]}"

    def plain(self) -> dict[str, str]:
        """The attributes as a dict that JSON can hold."""
        return asdict(self)


@dataclass(frozen=True)
class Result:
    """The result of running a case.

    Attributes:
        finding: the law that was broken; None if all held.
        outcome: "refused" if sparklod raised an error of its own, else "result".
        seconds: time that the case took.
    """

    finding: Finding | None
    outcome: str
    seconds: float


def stderr_fault(text: str) -> tuple[str, str]:
    """What is wrong with a text on standard error: the kind of fault, and a message; both empty if nothing is."""
    for line in text.split("\n"):
        fault = ""
        if line.startswith("Traceback"):
            fault = "a traceback"
        elif "Warning:" in line:
            fault = "a warning"
        elif line and not line.isprintable():
            fault = "control characters"
        elif len(re.sub("^error: ", "", line)) > LONGEST:
            fault = "a long line"
        elif line.startswith("::"):
            fault = "what a CI takes for a command"
        if fault:
            return f"{fault} on standard error", f"{fault} on standard error, {len(line):,} characters: {line[:200]!r}"
    return "", ""


def message_fault(error: SparklodError) -> str:
    """What is wrong with an error as the command line prints it; empty if nothing is."""
    say_error(str(error))
    said = STREAMS.take()[1].decode("utf-8", "backslashreplace").removesuffix("\n")
    if not str(error).strip():
        return "the message is empty"
    return f"more than a line on standard error: {said!r:.300}" if "\n" in said else stderr_fault(said)[1]


def run(target: Target, case: Case, folder: Path, watch: WriteWatch) -> Result:
    """Runs a case in `folder`, a fresh folder, and checks the laws that hold for every case."""
    case.write(folder)
    os.chdir(folder)
    STREAMS.begin()
    reset_peak()
    before, start = peak(), time.perf_counter()
    watch.begin(folder)
    outcome, finding = "result", None
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            target.check(case, folder)
        except SparklodError as error:
            outcome, fault = "refused", message_fault(error)
            if fault:
                finding = Finding("message", fault, innermost_frame(error.__traceback__), traceback.format_exc())
            elif isinstance(error, OutOfMemoryError):
                finding = Finding("memory", str(error), innermost_frame(error.__traceback__), traceback.format_exc())
        except LawError as error:
            finding = Finding("law", str(error).splitlines()[0][:300], error.fault, str(error))
        except BaseException as error:
            text = f"{type(error).__name__}: {error}".splitlines()[0][:300]
            where = f"{type(error).__name__} in {innermost_frame(error.__traceback__)}"
            finding = Finding("exception", text, where, traceback.format_exc())
    seconds = time.perf_counter() - start
    watch.end()
    taken = peak() - before
    finding = finding or next(_findings(case, folder, warned, watch), None)
    allowed = MEMORY + MEMORY_PER_BYTE * case.size
    if finding is None and taken > allowed:
        finding = Finding("memory", f"{taken >> 20:,} MiB for {case.size:,} bytes", case.what.split(",")[0])
    return Result(finding, outcome, seconds)


def _findings(case: Case, folder: Path, warned: list[warnings.WarningMessage], watch: WriteWatch) -> Iterator[Finding]:
    for each in warned:
        text = f"{each.category.__name__}: {each.message}"
        yield Finding("warning", text[:300], f"{text[:60]} at {Path(each.filename).name}:{each.lineno}")
    for text in STREAMS.untaken():
        yield Finding("stream", f"unexpected output: {text!r:.300}")
    for text in watch.outside:
        yield Finding("files", text)
    replaced = case.run.get("replaced", ())
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if TEMPORARY.fullmatch(path.name):
            yield Finding("files", f"a temporary file is left: {name!r}", "a temporary file is left")
        elif path.is_file() and name in case.files and name not in replaced and path.read_bytes() != case.files[name]:
            yield Finding("files", f"an input was changed: {name!r}", "an input was changed")
        elif path.is_file() and path.stat().st_size > OUTPUT + OUTPUT_PER_BYTE * case.size:
            yield Finding(
                "files", f"{name!r} has {path.stat().st_size:,} bytes, for inputs of {case.size:,}", "a large output"
            )
    missing = next((name for name in case.files if not (folder / name).exists()), None)
    if missing is not None:
        yield Finding("files", f"an input was removed: {missing!r}", "an input was removed")


def innermost_frame(at: TracebackType | None) -> str:
    """The innermost frame of a traceback that is in sparklod, such as "codecs/spz.py decode"."""
    frames = traceback.extract_tb(at)
    ours = [frame for frame in frames if "sparklod_cli" in frame.filename] or frames
    if not ours:
        return ""
    return f"{ours[-1].filename.rpartition('sparklod_cli/')[2]} {ours[-1].name}"


def peak() -> int:
    """Peak of this process's resident memory since `reset_peak`, in bytes; 0 if the system does not tell."""
    try:
        found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        return 0
    return int(found[1]) << 10 if found else 0


def reset_peak() -> None:
    """Starts a new measurement of `peak`, if the system allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


class WriteWatch:
    """Records what is written, renamed or removed outside of the case's folder.

    It is an audit hook, which Python cannot remove again: make one of it in a process.
    """

    def __init__(self, allowed: list[Path]) -> None:
        self._always = [os.path.realpath(path) for path in allowed]
        self._folder: str | None = None
        self.outside: list[str] = []
        sys.addaudithook(self._hook)

    def begin(self, folder: Path) -> None:
        self.outside = []
        self._folder = os.path.realpath(folder)

    def end(self) -> None:
        self._folder = None

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if self._folder is None:
            return
        if event == "open":
            path, _, flags = args
            writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
            if not (flags or 0) & writes:
                return
        elif event in ("os.rename", "os.link", "os.symlink"):
            path = args[1]
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod"):
            path = args[0]
        else:
            return
        if isinstance(path, (str, bytes, os.PathLike)):
            folder, self._folder = self._folder, None  # ignore what this hook itself does
            try:
                place = os.path.realpath(os.fsdecode(path))
            except ValueError:
                place = "/dev/null"
            finally:
                self._folder = folder
            beneath = [folder, *self._always]
            if not any(place == root or place.startswith(root.rstrip("/") + "/") for root in beneath) and (
                "__pycache__" not in place
            ):
                self.outside.append(f"{event} outside of the case's folder: {place!r:.200}")
