"""`Context`: what a run of `run_all.py` measures with, and what it could not have."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Context:
    """Settings of a run; a section is measured in a process of its own, which gets a copy.

    Attributes:
        scenes: folder of real scenes.
        scratch: folder for what sections make; large scenes in it serve several sections.
        runs: of each measurement; None for as many as suit the section.
        quick: small scenes and few runs, only to see that everything works.
        large: also the largest scenes.
        native: Spark's native build-lod.
        notes: what was left out, and why, for the page.
    """

    scenes: Path
    scratch: Path
    runs: int | None = None
    quick: bool = False
    large: bool = False
    native: Path | None = None
    notes: list[str] = field(default_factory=list)

    def count(self, usual: int) -> int:
        """Runs of a measurement that usually has so many."""
        return self.runs or (1 if self.quick else usual)

    def note(self, text: str) -> None:
        """Says once what was left out."""
        if text not in self.notes:
            self.notes.append(text)

    def found(self, *names: str) -> list[Path]:
        """Those of the scenes that there are."""
        paths = [self.scenes / name for name in names]
        for path in paths:
            if not path.exists():
                self.note(f"there is no scene {path.name}")
        return [path for path in paths if path.exists()]

    def scene(self, name: str) -> Path:
        """A scene without which a section cannot be measured."""
        path = self.scenes / name
        if not path.exists():
            raise FileNotFoundError(f"there is no scene {name} in {self.scenes}; SPARKLOD_SCENES names their folder")
        return path

    def made(self, name: str, make: Callable[[Path], object]) -> Path:
        """A file of the scratch folder, which is made once for all sections."""
        path = self.scratch / name
        if not path.exists():
            unfinished = self.scratch / f"unfinished-{name}"
            make(unfinished)
            unfinished.rename(path)
        return path

    def has_spark(self) -> bool:
        """Whether npm's Spark can be measured."""
        return self._has("SPARK_DIR", "npm's Spark")

    def has_splat_transform(self) -> bool:
        """Whether npm's splat-transform can be measured."""
        return self._has("FOREIGN_DIR", "splat-transform")

    def has_native(self) -> bool:
        """Whether Spark's native program can be measured."""
        if self.native is None:
            self.note("Spark's native build-lod was not given (`--native`)")
        return self.native is not None

    def _has(self, variable: str, name: str) -> bool:
        if shutil.which("node") is None:
            self.note(f"{name} was not measured: there is no Node")
            return False
        if not os.environ.get(variable):
            self.note(f"{name} was not measured: {variable} is not set")
            return False
        return True
