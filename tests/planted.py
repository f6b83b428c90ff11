"""A fuzz target for tests of the fuzzers: it plants the fault that the environment variable PLANTED names."""

from __future__ import annotations

import os
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from fuzz.case import Case, LawError, Rng
from sparklod_cli.commands import console
from sparklod_cli.system.errors import FormatError


def raises() -> None:
    raise ValueError("a decoder's own fault")


def hangs() -> None:
    time.sleep(60)


def crashes() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def leaves() -> None:
    os._exit(7)


def warns() -> None:
    warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)


def eats() -> None:
    bytearray(600 << 20)[:: 1 << 12] = bytes((600 << 20) >> 12)


def eats_everything() -> None:
    bytearray(64 << 30)


def talks() -> None:
    os.write(2, b"libpng: bad\n")


def _as_it_is(text: str, most: int | None = None) -> str:
    return text


def says_two_lines() -> None:
    console.printable = _as_it_is
    raise FormatError("first\nsecond")


def says_a_lot() -> None:
    console.printable = _as_it_is
    raise FormatError("x" * 100_000)


def says_escapes() -> None:
    os.write(2, b"\x1b[31m")


def breaks_a_law() -> None:
    raise LawError("half a splat")


def writes_elsewhere() -> None:
    (Path.home() / "elsewhere.txt").write_text("")


def writes_upwards() -> None:
    Path("../up.txt").write_text("")


def leaves_parts() -> None:
    Path(".sparklod-0123456789abcdef.part").write_text("half")


def changes_its_input() -> None:
    Path("input.bin").write_bytes(b"changed")


def removes_its_input() -> None:
    Path("input.bin").unlink()


def writes_much() -> None:
    Path("page.html").write_bytes(bytes(30 << 20))


#: The faults, with the kind of finding that each must give.
FAULTS: dict[Callable[[], None], str] = {
    raises: "exception",
    hangs: "hang",
    crashes: "crash",
    leaves: "crash",
    warns: "warning",
    eats: "memory",
    eats_everything: "exception",
    talks: "stream",
    says_two_lines: "message",
    says_a_lot: "message",
    says_escapes: "stream",
    breaks_a_law: "law",
    writes_elsewhere: "files",
    writes_upwards: "files",
    leaves_parts: "files",
    changes_its_input: "files",
    removes_its_input: "files",
    writes_much: "files",
}


def refuses() -> None:
    raise FormatError("it is cut short")


def works() -> None:
    Path("output.bin").write_bytes(Path("input.bin").read_bytes())


def make(rng: Rng) -> Case:
    return Case("planted", {"input.bin": rng.bytes(10)}, {"what": os.environ["PLANTED"]})


def check(case: Case, folder: Path) -> None:
    globals()[case.run["what"]]()
