"""What a CI job expects of a file, and where a report falls short of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ..io import read_text
from ..support.errors import SparklodError
from ..support.printable import printable
from ..support.units import count_of
from ..support.untrusted import QUOTED, parse_json, parse_toml, quoted, shown
from .findings import Finding
from .report import Report


class ExpectationError(SparklodError):
    """An expectation cannot be understood."""


@dataclass(frozen=True)
class Expectations:
    """What a file should be; None means anything.

    Attributes:
        max_bytes: of the file.
        min_splats, max_splats: of a plain file, or leaves of a tree.
        sh: the SH degree.
        lod: whether it should be a tree.
        max_growth: nodes over leaves.
        values: by the way to a value of the report ("tree.depth"), what it should be: a value, or a table of `min` and
            `max`.
    """

    max_bytes: int | None = None
    min_splats: int | None = None
    max_splats: int | None = None
    sh: int | None = None
    lod: bool | None = None
    max_growth: float | None = None
    values: dict[str, Any] = field(default_factory=dict)


def read(path: Path) -> Expectations:
    """The expectations in a .json or .toml file.

    Raises:
        ExpectationError: it cannot be read, or says something that is not an expectation.
    """
    try:
        text = read_text(path)
        data = parse_toml(text) if path.suffix.lower() == ".toml" else parse_json(text)
    except ValueError as error:
        raise ExpectationError(f"{path} is not what it is called: {quoted(error)}") from None
    if not isinstance(data, dict):
        raise ExpectationError(f"{path} is not a table of expectations")
    types: dict[str, tuple[type, ...]] = {each.name: (int,) for each in fields(Expectations)}
    types |= {"lod": (bool,), "max_growth": (int, float), "values": (dict,)}
    for name, value in data.items():
        if name not in types:
            raise ExpectationError(f"{path}: {printable(name, QUOTED)} is not one of {', '.join(types)}")
        if not isinstance(value, types[name]) or (isinstance(value, bool) and name != "lod"):
            raise ExpectationError(f"{path}: {name} cannot be {shown(value)}")
        if isinstance(value, (int, float)) and not 0 <= value < math.inf:
            raise ExpectationError(f"{path}: {name} cannot be {shown(value)}")
    values = dict(_flat(data.get("values", {}), str(path)))
    return Expectations(**data | {"values": values})


def _flat(table: dict[str, Any], path: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Expectations by the whole ways to their values; in TOML `tree.depth = 2` is a table in a table."""
    for key, wanted in table.items():
        way = prefix + key
        if isinstance(wanted, dict) and wanted and not wanted.keys() & {"min", "max"}:
            yield from _flat(wanted, path, f"{way}.")
            continue
        if isinstance(wanted, dict) and not (wanted and wanted.keys() <= {"min", "max"}):
            raise ExpectationError(f"{path}: {printable(way, QUOTED)} is to have min and max, not {shown(wanted)}")
        if isinstance(wanted, dict) and not all(map(_is_number, wanted.values())):
            raise ExpectationError(
                f"{path}: min and max of {printable(way, QUOTED)} are to be numbers, not {shown(wanted)}"
            )
        try:
            json.dumps(wanted)
        except TypeError:
            raise ExpectationError(
                f"{path}: {printable(way, QUOTED)} cannot be {shown(wanted)}, no report has such a value"
            ) from None
        yield way, wanted


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and not math.isnan(value)


def value_at(report: dict[str, Any], way: str) -> Any:
    """The value at a way of keys and indices with dots between ("tree.levels.0.nodes").

    Raises:
        ExpectationError: there is none.
    """
    value: Any = report
    try:
        for key in way.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
    except (KeyError, IndexError, TypeError, ValueError):
        raise ExpectationError(f"the report has no {printable(way, QUOTED)}") from None
    return value


def check(report: Report, expected: Expectations) -> list[Finding]:
    """Where a report falls short of expectations; of a file that could not be read nothing is expected."""
    if report.format is None:
        return []
    found = []
    is_tree = report.tree is not None
    splats = report.tree.leaves if report.tree is not None else report.splats or 0
    found_splats = count_of(splats, "leaf", "leaves") if is_tree else count_of(splats, "splat")
    if expected.max_bytes is not None and (report.bytes or 0) > expected.max_bytes:
        found.append(Finding("expect.bytes", f"{report.bytes:,} bytes, expected at most {expected.max_bytes:,}"))
    if expected.min_splats is not None and splats < expected.min_splats:
        found.append(Finding("expect.splats", f"{found_splats}, expected at least {expected.min_splats:,}"))
    if expected.max_splats is not None and splats > expected.max_splats:
        found.append(Finding("expect.splats", f"{found_splats}, expected at most {expected.max_splats:,}"))
    if expected.sh is not None and report.sh_degree != expected.sh:
        found.append(Finding("expect.sh", f"SH degree {report.sh_degree}, expected {expected.sh}"))
    if expected.lod is not None and is_tree != expected.lod:
        found.append(Finding("expect.lod", "no tree, expected one" if expected.lod else "a tree, expected none"))
    if expected.max_growth is not None:
        growth = report.tree.growth if report.tree is not None else None
        if growth is None or growth > expected.max_growth:
            what = "no tree" if growth is None else f"growth {growth}"
            found.append(Finding("expect.growth", f"{what}, expected a growth of at most {expected.max_growth:g}"))
    return found + _values(report.as_dict(), expected.values)


def _values(report: dict[str, Any], expected: dict[str, Any]) -> list[Finding]:
    found = []
    for way, wanted in expected.items():
        try:
            value = value_at(report, way)
        except ExpectationError as error:
            found.append(Finding("expect.value", f"{error}, expected {_as_json(wanted)}"))
            continue
        if not _fits(value, wanted):
            found.append(
                Finding("expect.value", f"{printable(way, QUOTED)} is {_as_json(value)}, expected {_as_json(wanted)}")
            )
    return found


def _as_json(value: Any) -> str:
    """As the report and its expectations are written, and no longer than a line of a log."""
    return printable(json.dumps(value), QUOTED)


def _fits(value: Any, wanted: Any) -> bool:
    if isinstance(wanted, dict):
        return _is_number(value) and bool(wanted.get("min", value) <= value <= wanted.get("max", value))
    return bool(value == wanted) and isinstance(value, bool) == isinstance(wanted, bool)
