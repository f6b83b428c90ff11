"""What an installed distribution requires, and whether that is installed: by metadata alone, nothing is imported."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

#: A requirement as our metadata have them: name, extras, least version, marker.
REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([\w, -]+)\])?\s*(?:>=\s*([\w.]+))?[^;]*(?:;\s*(.*))?")

#: The two kinds of markers that are understood; a requirement with another one counts as required.
EXTRA, BEFORE = re.compile(r"extra\s*==\s*['\"]([\w.-]+)['\"]"), re.compile(r"python_version\s*<\s*['\"]([\d.]+)['\"]")


@dataclass(frozen=True)
class Required:
    """A distribution that another one requires.

    Attributes:
        name: as pip knows it.
        least: the oldest version that will do; empty if any will.
        version: the one that is installed; None if none is.
    """

    name: str
    least: str
    version: str | None

    @property
    def missing(self) -> bool:
        """Whether it has to be installed, or a newer one."""
        return self.version is None or _numbers(self.version) < _numbers(self.least)

    @property
    def found(self) -> str:
        """ "2.4.6", "is missing", or "1.20, older than 1.26"."""
        if self.version is None:
            return "is missing"
        return f"{self.version}, older than {self.least}" if self.missing else self.version


def required_by(distribution: str, extra: str = "") -> Iterator[Required]:
    """What a distribution requires: by itself or, where an extra is named, for that alone.

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
