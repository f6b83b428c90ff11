"""`Row`, what a benchmark measured, and `Table`, how rows are shown in Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Label = str | int | float


@dataclass(frozen=True)
class Row:
    """What was measured of one thing.

    Attributes:
        labels: what it was, such as the scene, and counts that do not vary from run to run.
        runs: by name, the figure of every run; names end in their unit: _s, _ms, _bytes.
    """

    labels: Mapping[str, Label]
    runs: Mapping[str, Sequence[float]]

    def median(self, name: str) -> float | None:
        """The median of the runs; None where it was not measured."""
        runs = self.runs.get(name)
        return statistics.median(runs) if runs else None

    def ratio(self, over: str, under: str) -> float | None:
        """The ratio of two medians, or of a median and a label; None where one was not measured."""
        top, bottom = self.value(over), self.value(under)
        return None if top is None or not bottom else top / bottom

    def value(self, name: str) -> float | None:
        """The median of the runs of this name, or else the number in the label of this name."""
        label = self.labels.get(name)
        return float(label) if isinstance(label, (int, float)) else self.median(name)

    def as_json(self) -> dict[str, Any]:
        """For `of_json`, with six significant digits."""
        return {
            "labels": dict(self.labels),
            "runs": {name: [float(f"{run:.6g}") for run in runs] for name, runs in self.runs.items()},
        }

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> Row:
        return cls(data["labels"], data["runs"])


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: with the unit.
        cell: what a row shows; empty where it was not measured.
    """

    heading: str
    cell: Callable[[Row], str]


@dataclass(frozen=True)
class Table:
    """How the rows of a benchmark are shown, and which figures tell whether it fell behind.

    Attributes:
        columns: from left to right.
        key: labels that tell rows apart.
        judged: runs that ought not to grow: times, peaks of memory, sizes.
    """

    columns: tuple[Column, ...]
    key: tuple[str, ...]
    judged: tuple[str, ...] = ()

    def head(self) -> str:
        """The first two lines in Markdown."""
        return line([column.heading for column in self.columns]) + "\n" + "|---" * len(self.columns) + "|"

    def line(self, row: Row) -> str:
        """A row in Markdown."""
        return line([column.cell(row) for column in self.columns])

    def markdown(self, rows: Iterable[Row]) -> str:
        """The whole table."""
        return "\n".join([self.head(), *map(self.line, rows)])

    def show(self, rows: Iterable[Row]) -> None:
        """Prints the table row by row, as they are measured."""
        print(self.head())
        for row in rows:
            print(self.line(row), flush=True)

    def key_of(self, row: Row) -> tuple[Label, ...]:
        """What tells a row apart from the others."""
        return tuple(row.labels[name] for name in self.key)


def line(cells: Sequence[str]) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def label(name: str, heading: str | None = None) -> Column:
    """A label as it is; whole numbers with commas."""

    def cell(row: Row) -> str:
        value = row.labels.get(name, "")
        return f"{value:,}" if isinstance(value, int) else str(value)

    return Column(heading or name, cell)


def figure(name: str, heading: str, digits: int, *, per: float = 1.0, spread: bool = False) -> Column:
    """The median of some runs, or a label's number, divided by `per`; with the least and the most if `spread`."""

    def cell(row: Row) -> str:
        value = row.value(name)
        if value is None:
            return ""
        told = f"{value / per:,.{digits}f}"
        runs = row.runs.get(name)
        if not (spread and runs):
            return told
        return f"{told} ({min(runs) / per:,.{digits}f} to {max(runs) / per:,.{digits}f})"

    return Column(f"{heading} (min to max)" if spread else heading, cell)


def ratio(over: str, under: str, heading: str, digits: int = 1, *, per: float = 1.0, unit: str = "") -> Column:
    """The ratio of two figures, divided by `per`."""

    def cell(row: Row) -> str:
        value = row.ratio(over, under)
        return "" if value is None else f"{value / per:,.{digits}f}{unit}"

    return Column(heading, cell)
