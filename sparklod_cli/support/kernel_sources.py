"""Which source files compiled code depends on."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

#: An import of another module of the package at the top level of a module: dots, module, names.
_IMPORT = re.compile(rb"^from (\.+)([\w.]*) import (\([^)]*\)|[^\n#]*)", re.MULTILINE)


@functools.cache
def sources_of(path: Path) -> frozenset[Path]:
    """The sources that the kernels of a module depend on: its own, and those of all that it imports."""
    found: set[Path] = set()
    left = {path}
    while left:
        found |= left
        left = {imported for each in left for imported in _imports(each)} - found
    return frozenset(found)


def digest_of(paths: Iterable[Path]) -> str:
    """A digest of the content of some sources."""
    return hashlib.sha256(b"".join(_content(path) for path in sorted(paths))).hexdigest()[:16]


@functools.cache
def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


@functools.cache
def _imports(path: Path) -> frozenset[Path]:
    """The sources of what a module of the package imports from it."""
    found = set()
    for dots, module, names in _IMPORT.findall(_content(path)):
        base = path.parents[len(dots) - 1].joinpath(*module.decode().split(".") if module else ())
        found.add(base.with_suffix(".py"))
        found |= {base / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)}
    return frozenset(path for path in found if path.is_file())
