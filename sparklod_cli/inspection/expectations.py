"""What a CI job expects of a file, and where a report falls short of it."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ..errors import SparklodError
from ..io import read_text
from .findings import Finding
from .report import Report

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


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
        data = tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ExpectationError(f"{path} is not what it is called: {error}") from None
    if not isinstance(data, dict):
        raise ExpectationError(f"{path} is not a table of expectations")
    types: dict[str, tuple[type, ...]] = {each.name: (int,) for each in fields(Expectations)}
    types |= {"lod": (bool,), "max_growth": (int, float), "values": (dict,)}
    for name, value in data.items():
        if name not in types:
            raise ExpectationError(f"{path}: {name} is not one of {', '.join(types)}")
        if not isinstance(value, types[name]) or (isinstance(value, bool) and name != "lod"):
            raise ExpectationError(f"{path}: {name} cannot be {value!r}")
    return Expectations(**data)


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
        raise ExpectationError(f"the report has no {way}") from None
    return value


def check(report: Report, expected: Expectations) -> list[Finding]:
    """Where a report falls short of expectations; of a file that could not be read nothing is expected."""
    if report.format is None:
        return []
    found = []
    is_tree = report.tree is not None
    splats = report.tree.leaves if report.tree is not None else report.splats or 0
    of = "leaves" if is_tree else "splats"
    if expected.max_bytes is not None and (report.bytes or 0) > expected.max_bytes:
        found.append(Finding("expect.bytes", f"{report.bytes:,} bytes, expected at most {expected.max_bytes:,}"))
    if expected.min_splats is not None and splats < expected.min_splats:
        found.append(Finding("expect.splats", f"{splats:,} {of}, expected at least {expected.min_splats:,}"))
    if expected.max_splats is not None and splats > expected.max_splats:
        found.append(Finding("expect.splats", f"{splats:,} {of}, expected at most {expected.max_splats:,}"))
    if expected.sh is not None and report.sh_degree != expected.sh:
        found.append(Finding("expect.sh", f"SH degree {report.sh_degree}, expected {expected.sh}"))
    if expected.lod is not None and is_tree != expected.lod:
        found.append(Finding("expect.lod", "no tree, expected one" if expected.lod else "a tree, expected none"))
    if expected.max_growth is not None and report.tree is not None and report.tree.growth > expected.max_growth:
        found.append(Finding("expect.growth", f"growth {report.tree.growth}, expected at most {expected.max_growth:g}"))
    plain = report.as_dict()
    for way, wanted in expected.values.items():
        value = value_at(plain, way)
        if not _fits(value, wanted, way):
            found.append(Finding("expect.value", f"{way} is {json.dumps(value)}, expected {json.dumps(wanted)}"))
    return found


def _fits(value: Any, wanted: Any, way: str) -> bool:
    if not isinstance(wanted, dict):
        return bool(value == wanted)
    if not wanted or not wanted.keys() <= {"min", "max"}:
        raise ExpectationError(f"{way}: a table of expectations has min and max, not {', '.join(wanted) or 'nothing'}")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return bool(wanted.get("min", value) <= value <= wanted.get("max", value))
