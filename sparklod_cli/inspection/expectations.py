"""Expectations of a file, from options, assertions and files of expectations, and their check against a report."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ..io import read_text
from ..system.errors import SparklodError
from ..system.untrusted import QUOTED, near, parse_json, parse_toml, printable, quoted, quoted_value
from ..tables.assertions import BadAssertionError, Condition, is_number, number_text, parse_condition
from .findings import Finding
from .report import NoFieldError, Report, value_at


class ExpectationError(SparklodError):
    """An expectation cannot be understood."""


#: Short names for values of a report, besides its fields.
NAMES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "nodes": lambda report: report["splats"],
    "leaves": lambda report: report["tree"]["leaves"] if report["tree"] else report["splats"],
    "growth": lambda report: report["tree"]["growth"],
    "depth": lambda report: report["tree"]["depth"],
    "sh": lambda report: report["sh_degree"],
    "lod": lambda report: report["tree"] is not None,
    "chunk_bytes": lambda report: _streamed(report)["chunk_bytes" if report["rad"] else "file_bytes"]["max"],
    "first_bytes": lambda report: _streamed(report)["first_bytes"],
    "chunked": lambda report: report["rad"]["chunked"],
    "palette": lambda report: report["rad"]["palette"],
    "levels": lambda report: len(report["streamed_sog"]["levels"]),
    "regions": lambda report: report["streamed_sog"]["regions"],
    "tiles": lambda report: report["tiles"]["tiles"],
}

#: The formats that have the names which are not about a tree.
FORMATS = dict.fromkeys(("chunk_bytes", "first_bytes"), "RAD, Streamed SOG or 3D Tiles")
FORMATS["tiles"] = "3D Tiles"
FORMATS |= dict.fromkeys(("chunked", "palette"), "RAD") | dict.fromkeys(("levels", "regions"), "Streamed SOG")

#: The codes of findings about names; all others have expect.value.
CODES = {
    "bytes": "expect.bytes",
    "leaves": "expect.splats",
    "sh": "expect.sh",
    "lod": "expect.lod",
    "growth": "expect.growth",
}

#: Keys of a file of expectations, also options of inspect: the name and the sign of their conditions.
KEYS = {
    "max_bytes": ("bytes", "<="),
    "min_splats": ("leaves", ">="),
    "max_splats": ("leaves", "<="),
    "sh": ("sh", "=="),
    "lod": ("lod", "=="),
    "max_growth": ("growth", "<="),
}


@dataclass(frozen=True)
class Expectations:
    """Expectations of a file; None means anything. Each is a condition, see `assertions.Condition`.

    Attributes:
        min_splats, max_splats: of a plain file, or leaves of a tree.
        max_growth: nodes over leaves.
        values: expected value, or a table of `min` and `max`, by the field of the report ("tree.depth").
        asserts: texts such as "nodes<=5M"; they name `NAMES` and fields of the report.
    """

    max_bytes: int | None = None
    min_splats: int | None = None
    max_splats: int | None = None
    sh: int | None = None
    lod: bool | None = None
    max_growth: float | None = None
    values: dict[str, Any] = field(default_factory=dict)
    asserts: tuple[str, ...] = ()

    def conditions(self) -> list[Condition]:
        found = [
            Condition.of(name, sign, getattr(self, key))
            for key, (name, sign) in KEYS.items()
            if getattr(self, key) is not None
        ]
        for name, expected in self.values.items():
            ranged = expected if isinstance(expected, dict) else {}
            ends = [(sign, ranged[end]) for end, sign in (("min", ">="), ("max", "<=")) if end in ranged]
            found += [Condition.of(name, sign, bound) for sign, bound in ends or [("==", expected)]]
        return found + [parse_assertion(text) for text in self.asserts]


def parse_assertion(text: str) -> Condition:
    """Return a condition on a report; `BadAssertionError` if it names nothing that a report has."""
    condition = parse_condition(text, example="nodes<=5M")
    known = [*NAMES, *(each.name for each in fields(Report))]
    if condition.name.partition(".")[0] not in known:
        name = printable(condition.name, QUOTED)
        raise BadAssertionError(f"{text!r}: there is no {name!r} in a report{near(condition.name, known)}")
    return condition


def read(path: Path) -> Expectations:
    """Return the expectations in a .json or .toml file: keys that are attributes of `Expectations`, and `assert`."""
    try:
        text = read_text(path)
        data = parse_toml(text) if path.suffix.lower() == ".toml" else parse_json(text)
    except ValueError as error:
        raise ExpectationError(f"{path} is not what it is called: {quoted(error)}") from None
    if not isinstance(data, dict):
        raise ExpectationError(f"{path} is not a table of expectations")
    types: dict[str, tuple[type, ...]] = dict.fromkeys(KEYS, (int,))
    types |= {"lod": (bool,), "max_growth": (int, float), "values": (dict,), "assert": (list,)}
    for name, value in data.items():
        if name not in types:
            raise ExpectationError(f"{path}: {printable(name, QUOTED)} is not one of {', '.join(types)}")
        if not isinstance(value, types[name]) or (isinstance(value, bool) and name != "lod"):
            raise ExpectationError(f"{path}: {name} cannot be {quoted_value(value)}")
        if isinstance(value, (int, float)) and not 0 <= value < math.inf:
            raise ExpectationError(f"{path}: {name} cannot be {quoted_value(value)}")
    values = dict(_flat(data.pop("values", {}), str(path)))
    asserts = data.pop("assert", [])
    for each in asserts:
        if not isinstance(each, str):
            raise ExpectationError(f"{path}: assert cannot hold {quoted_value(each)}, only texts such as 'nodes<=5M'")
        try:
            parse_assertion(each)
        except BadAssertionError as error:
            raise ExpectationError(f"{path}: assert {quoted(error)}") from None
    return Expectations(**data, values=values, asserts=tuple(asserts))


def _flat(table: dict[str, Any], path: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield expectations by the full names of their fields; in TOML `tree.depth = 2` is a table in a table."""
    for key, expected in table.items():
        name = prefix + key
        if isinstance(expected, dict) and expected and not expected.keys() & {"min", "max"}:
            yield from _flat(expected, path, f"{name}.")
            continue
        if isinstance(expected, dict) and not (expected and expected.keys() <= {"min", "max"}):
            raise ExpectationError(f"{path}: {printable(name, QUOTED)} takes min and max, not {quoted_value(expected)}")
        if isinstance(expected, dict) and not all(map(is_number, expected.values())):
            raise ExpectationError(
                f"{path}: min and max of {printable(name, QUOTED)} must be numbers, not {quoted_value(expected)}"
            )
        try:
            json.dumps(expected)
        except TypeError:
            raise ExpectationError(
                f"{path}: {printable(name, QUOTED)} cannot be {quoted_value(expected)}, no report has such a value"
            ) from None
        yield name, expected


def _value(plain: dict[str, Any], name: str) -> Any:
    if name not in NAMES:
        return value_at(plain, name)
    try:
        return NAMES[name](plain)
    except TypeError:
        form = FORMATS.get(name)
        raise NoFieldError("the file has no tree" if form is None else f"the file is not {form}") from None


def _streamed(report: dict[str, Any]) -> Any:
    return report["rad"] or report["streamed_sog"] or report["tiles"]


def check(report: Report, expected: Expectations) -> list[Finding]:
    """Return findings for the expectations that a report does not meet; none for a file that could not be read."""
    if report.format is None:
        return []
    plain = report.as_dict()
    found = []
    for condition in expected.conditions():
        code = CODES.get(condition.name, "expect.value")
        text = printable(condition.text, QUOTED)
        try:
            value = _value(plain, condition.name)
        except NoFieldError as error:
            found.append(Finding(code, f"{text}: {error}"))
            continue
        if not condition.holds(value):
            found.append(Finding(code, f"{text}: {printable(condition.name, QUOTED)} is {_text(value)}"))
    return found


def _text(value: Any) -> str:
    return number_text(value) if is_number(value) else printable(json.dumps(value), QUOTED)
