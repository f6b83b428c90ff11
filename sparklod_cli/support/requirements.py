"""The requirements of an installed distribution and whether they are met, by metadata alone: nothing is imported."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

#: A requirement as in our metadata: name, extras, minimum version, marker.
REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([\w, -]+)\])?\s*(?:>=\s*([\w.]+))?[^;]*(?:;\s*(.*))?")

#: The two supported kinds of markers; a requirement with any other marker counts as required.
EXTRA, BEFORE = re.compile(r"extra\s*==\s*['\"]([\w.-]+)['\"]"), re.compile(r"python_version\s*<\s*['\"]([\d.]+)['\"]")


@dataclass(frozen=True)
class Required:
    """A distribution that another one requires.

    Attributes:
        name: its name for pip.
        least: the minimum version; empty for any.
        version: the installed version; None if it is not installed.
    """

    name: str
    least: str
    version: str | None

    @property
    def missing(self) -> bool:
        """Whether it has to be installed or upgraded."""
        return self.version is None or _numbers(self.version) < _numbers(self.least)

    @property
    def found(self) -> str:
        """ "2.4.6", "is missing", or "1.20, older than 1.26"."""
        if self.version is None:
            return "is missing"
        return f"{self.version}, older than {self.least}" if self.missing else self.version


def required_by(distribution: str, extra: str = "") -> Iterator[Required]:
    """The requirements of a distribution or, if an extra is given, those of the extra alone.

    Raises:
        importlib.metadata.PackageNotFoundError: the distribution is not installed.
    """
    for line in metadata.requires(distribution) or []:
        match = REQUIREMENT.fullmatch(line)
        if match is None:
            continue
        name, extras, least, marker = (group or "" for group in match.groups())
        of, before = EXTRA.search(marker), BEFORE.search(marker)
        if (of[1] if of else "") != extra or (before and sys.version_info[:2] >= _numbers(before[1])):
            continue
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Required(name, least, None)
            continue
        yield Required(name, least, version)
        for inner in filter(None, re.split(r"[,\s]+", extras)):
            yield from required_by(name, inner)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)[:3]))
