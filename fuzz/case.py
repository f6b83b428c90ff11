"""A case: files and what to do with them, all of which follows from a target, a seed and a number."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

Rng = np.random.Generator

#: The seed of a run that names none.
SEED = 1

#: Targets, each a module of `fuzz.targets`.
TARGETS = ("decoders", "trees", "builds", "cameras", "instances", "expectations", "assertions", "rgba", "options")


class LawError(Exception):
    """What the project promises was not kept.

    Args:
        text: what came instead; its first line for the table.
        fault: tells this fault from others; by the text unless given.
    """

    def __init__(self, text: str, fault: str = "") -> None:
        super().__init__(text)
        self.fault = fault


@dataclass(frozen=True)
class Case:
    """What a target tries.

    Attributes:
        what: how it was made, for people.
        files: bytes by the name in the case's folder, with / between folders.
        run: what else the target's `check` must know; plain values, as JSON has them. `replaced` names files that a
            command may replace; all others keep their bytes.
    """

    what: str
    files: Mapping[str, bytes]
    run: Mapping[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(map(len, self.files.values()))

    def write(self, folder: Path) -> None:
        """Puts the files into a folder."""
        for name, data in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    def packed(self, target: str, finding: str) -> bytes:
        """A zip file that `unpacked` reads, with what was found for people."""
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            about = {"target": target, "what": self.what, "run": dict(self.run)}
            archive.writestr("case.json", json.dumps(about, indent=1))
            archive.writestr("finding.txt", finding.encode("utf-8", "backslashreplace"))
            for name, data in self.files.items():
                archive.writestr(f"files/{name}", data)
        return file.getvalue()


def unpacked(path: Path) -> tuple[str, Case]:
    """The target and the case of a file that `Case.packed` made."""
    with zipfile.ZipFile(path) as archive:
        about = json.loads(archive.read("case.json"))
        names = [name for name in archive.namelist() if name.startswith("files/")]
        files = {name.removeprefix("files/"): archive.read(name) for name in names}
    return about["target"], Case(about["what"], files, about["run"])


class Target(Protocol):
    """What a target's module has."""

    def make(self, rng: Rng) -> Case:
        """A case, from nothing but the generator."""

    def check(self, case: Case, folder: Path) -> None:
        """Runs a case whose files are in `folder`, the current directory.

        Raises:
            SparklodError: an input was refused, which is as good as a result.
            LawError: a law does not hold.
        """


def target_of(name: str) -> Target:
    """A target's module; a name with a dot is that of any module, for one that is only tried out."""
    module: Any = import_module(name if "." in name else f"fuzz.targets.{name}")
    return module


def case_of(name: str, seed: int, number: int) -> Case:
    """Case `number` of a target: the same bytes, whenever it is asked for."""
    return target_of(name).make(np.random.default_rng([seed, number, zlib.crc32(name.encode())]))
