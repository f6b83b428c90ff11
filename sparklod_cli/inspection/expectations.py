"""Expectations of a file: assertions about its report, from options and files, and their check."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..io.local_files import read_text
from ..system.errors import SparklodError
from ..system.untrusted import QUOTED, near, printable, quoted
from ..tables.assertions import Assertion, BadAssertionError, is_number, number_text, parse_assertion
from .findings import Finding
from .report import NoFieldError, Report, value_at


class ExpectationError(SparklodError):
    """A file of expectations cannot be understood."""


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

#: Formats that have the names which are not about a tree.
FORMATS = dict.fromkeys(("chunk_bytes", "first_bytes"), "RAD, Streamed SOG or 3D Tiles")
FORMATS["tiles"] = "3D Tiles"
FORMATS |= dict.fromkeys(("chunked", "palette"), "RAD") | dict.fromkeys(("levels", "regions"), "Streamed SOG")

#: Codes of findings by name; all other names have expect.value.
CODES = {
    "bytes": "expect.bytes",
    "leaves": "expect.splats",
    "sh": "expect.sh",
    "lod": "expect.lod",
    "growth": "expect.growth",
}

#: Beginnings of the lines that replace the keys of files of expectations in TOML and JSON, which are no longer read.
REPLACED = {
    "max_bytes": "bytes<=",
    "min_splats": "leaves>=",
    "max_splats": "leaves<=",
    "sh": "sh==",
    "lod": "lod==",
    "max_growth": "growth<=",
}
OLD_KEY = re.compile(rf"""(?<![.\w])({"|".join(REPLACED)})["']?\s*[=:]\s*([\w.]+)""")


def parse(text: str) -> Assertion:
    """Return an assertion about a report; `BadAssertionError` if it names nothing that a report has."""
    assertion = parse_assertion(text, example="nodes<=5M")
    known = [*NAMES, *(each.name for each in fields(Report))]
    if assertion.name.partition(".")[0] not in known:
        name = printable(assertion.name, QUOTED)
        raise BadAssertionError(f"{text!r}: there is no {name!r} in a report{near(assertion.name, known)}")
    return assertion


def read(path: Path) -> list[Assertion]:
    """Return the assertions in a text file, one a line; blank lines and lines that begin with # are left out.

    Raises:
        ExpectationError: a line is not an assertion about a report; for a file in TOML or JSON, with its new lines.
    """
    text = read_text(path)
    found = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        try:
            found.append(parse(line))
        except BadAssertionError as error:
            if path.suffix.lower() not in (".toml", ".json"):
                raise ExpectationError(f"{path}, line {number}: {quoted(error)}") from None
            lines = [REPLACED[key] + value.replace("_", "") for key, value in OLD_KEY.findall(text)]
            raise ExpectationError(
                f"{path} has expectations as TOML or JSON, which are no longer read; write assertions, one a line: "
                + printable(", ".join([*lines, "NAME==VALUE, NAME>=MIN and NAME<=MAX for values"]), 2 * QUOTED)
            ) from None
    return found


def check(report: Report, expected: Sequence[Assertion]) -> list[Finding]:
    """Return findings for the assertions that do not hold; none for a file that could not be read."""
    if report.format is None:
        return []
    plain = report.as_dict()
    found = []
    for assertion in expected:
        code, text = CODES.get(assertion.name, "expect.value"), printable(assertion.text, QUOTED)
        try:
            value = _value(plain, assertion.name)
        except NoFieldError as error:
            found.append(Finding(code, f"{text}: {error}"))
            continue
        if not assertion.holds(value):
            shown = number_text(value) if is_number(value) else printable(json.dumps(value), QUOTED)
            found.append(Finding(code, f"{text}: {printable(assertion.name, QUOTED)} is {shown}"))
    return found


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
