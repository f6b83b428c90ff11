"""sparklod: Level-of-Detail trees for 3D Gaussian splat scenes, from Python.

    import sparklod_cli as sparklod

    tree = sparklod.build_lod(sparklod.read("scene.ply"))
    sparklod.write("scene-lod.spz", tree)

What `__all__` names is the public interface, described in docs/python.md. Nothing else is promised to stay as it is.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

__version__ = "0.2.0"

# By the loader, as the package may be in a zip.
_stubs = __spec__.loader.get_data(str(Path(__file__).with_suffix(".pyi"))).decode()  # type: ignore[union-attr]

#: Module of each public name, as `__init__.pyi` has it. It is imported when the name is first used (PEP 562), so that
#: importing the package loads neither numpy nor numba.
_HOMES = {
    words[3]: words[1]
    for words in map(str.split, _stubs.splitlines())
    if words[:1] == ["from"] and words[1].startswith(".")
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name], __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


class _Package(ModuleType):
    """Module that keeps public functions, which importing a module of the same name (`render`, `compare`) replaces."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
