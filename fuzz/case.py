"""A case: files and what to do with them, determined by a target, a seed and a number."""

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

#: Default of `--seed`.
SEED = 1

#: Names of the targets; each is a module in `fuzz/targets/`.
TARGETS = (
    "decoders",
    "checkpoints",
    "trees",
    "builds",
    "outputs",
    "cameras",
    "instances",
    "expectations",
    "assertions",
    "rgba",
    "options",
)


class LawError(Exception):
    """A law that docs/fuzzing.md states did not hold.

    Args:
        text: what happened instead; its first line goes into the table of findings.
        fault: findings with the same `fault` count as one fault; without it, those with the same text do.
    """

    def __init__(self, text: str, fault: str = "") -> None:
        super().__init__(text)
        self.fault = fault


@dataclass(frozen=True)
class Case:
    """One input of a target.

    Attributes:
        what: a description of how it was made, for people.
        files: the content of each file by its path in the case's folder, with / as the separator.
        run: what else the target's `check` needs; values that JSON can hold. `replaced` lists the files that a command
            may replace; all others must keep their bytes.
    """

    what: str
    files: Mapping[str, bytes]
    run: Mapping[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Total size of the files, in bytes."""
        return sum(map(len, self.files.values()))

    def write(self, folder: Path) -> None:
        """Writes the files into a folder."""
        for name, data in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    def packed(self, target: str, finding: str) -> bytes:
        """Packs the case and the text of a finding into a zip file, which `unpacked` reads."""
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            about = {"target": target, "what": self.what, "run": dict(self.run)}
            archive.writestr("case.json", json.dumps(about, indent=1))
            archive.writestr("finding.txt", finding.encode("utf-8", "backslashreplace"))
            for name, data in self.files.items():
                archive.writestr(f"files/{name}", data)
        return file.getvalue()


def unpacked(path: Path) -> tuple[str, Case]:
    """Reads the target's name and the case from a zip file that `Case.packed` made."""
    with zipfile.ZipFile(path) as archive:
        about = json.loads(archive.read("case.json"))
        names = [name for name in archive.namelist() if name.startswith("files/")]
        files = {name.removeprefix("files/"): archive.read(name) for name in names}
    return about["target"], Case(about["what"], files, about["run"])


class Target(Protocol):
    """The two functions that the module of a target defines."""

    def make(self, rng: Rng) -> Case:
        """Makes a case from the random generator alone."""

    def check(self, case: Case, folder: Path) -> None:
        """Runs a case whose files are in `folder`, the current directory.

        Raises:
            SparklodError: the input was refused, which is as good an outcome as a result.
            LawError: a law did not hold.
        """


def target_of(name: str) -> Target:
    """Imports the module of a target; a name with a dot is a full module name, of a target that is not in `TARGETS`."""
    module: Any = import_module(name if "." in name else f"fuzz.targets.{name}")
    return module


def case_of(name: str, seed: int, number: int) -> Case:
    """Makes case `number` of a target; the same arguments always give the same bytes."""
    return target_of(name).make(np.random.default_rng([seed, number, zlib.crc32(name.encode())]))
