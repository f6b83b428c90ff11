"""Packages that load what they offer when it is first asked for, so that a short job loads little."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from typing import Any

_ROOT = __name__.partition(".")[0]


def loader_of(package: str, names: Mapping[str, Collection[str]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package or module (PEP 562).

    Args:
        package: its `__name__`.
        names: by module, as "io.reading", what the package offers of it.
    """
    homes = {name: module for module, offered in names.items() for name in offered}

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{_ROOT}.{homes[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return load
