"""`Figures`: what was measured, as JSON beside the documentation."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from performance.calibration import Calibration
from performance.rows import Row


@dataclass(frozen=True)
class Measured:
    """A section as it was measured once.

    Attributes:
        date: of the day, ISO.
        machine: that measured.
        load: processes that wanted to run in the minute before, on average.
        seconds: that the section took.
        before, after: calibrations.
        rows: of the table.
        notes: what was left out.
    """

    date: str
    machine: str
    load: float
    seconds: float
    before: Calibration
    after: Calibration
    rows: Sequence[Row]
    notes: Sequence[str] = field(default=())

    def as_json(self) -> dict[str, Any]:
        return {
            "date": self.date,
            "machine": self.machine,
            "load": round(self.load, 2),
            "seconds": round(self.seconds, 1),
            "before": self.before.as_json(),
            "after": self.after.as_json(),
            "notes": list(self.notes),
            "rows": [row.as_json() for row in self.rows],
        }

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> Measured:
        calibrations = {name: Calibration.of_json(data[name]) for name in ("before", "after")}
        rows = [Row.of_json(row) for row in data["rows"]]
        plain = {name: data[name] for name in ("date", "machine", "load", "seconds", "notes")}
        return cls(**plain, **calibrations, rows=rows)


#: Sections by name.
Figures = dict[str, Measured]


def read(path: Path) -> Figures:
    """The figures of a file; none if there is none."""
    return of_text(path.read_text()) if path.exists() else {}


def of_text(text: str) -> Figures:
    """The figures of a file's text."""
    return {name: Measured.of_json(section) for name, section in json.loads(text).items()}


def write(path: Path, figures: Figures) -> None:
    """Writes figures, a row of a table a line; whole or not at all."""
    parts = []
    for name, section in figures.items():
        data = section.as_json()
        rows = ",\n".join(f"    {json.dumps(row)}" for row in data.pop("rows"))
        rest = json.dumps(data, indent=1)[2:-2]
        parts.append(f'"{name}": {{\n{rest},\n "rows": [\n{rows}\n ]\n}}')
    unfinished = path.with_name(f"{path.name}.unfinished")
    unfinished.write_text("{\n" + ",\n".join(parts) + "\n}\n")
    unfinished.replace(path)


def committed(path: Path) -> Figures:
    """The figures of the last commit; those of the file where it is in no repository, or new there."""
    shown = ["git", "-C", str(path.resolve().parent), "show", f"HEAD:./{path.name}"]
    try:
        done = subprocess.run(shown, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return read(path)
    return of_text(done.stdout) if done.returncode == 0 else read(path)
