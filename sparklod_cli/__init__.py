"""sparklod: Level-of-Detail trees for 3D Gaussian splat scenes, from Python.

    import sparklod_cli as sparklod

    tree = sparklod.build_lod(sparklod.read("scene.ply"))
    sparklod.write("scene-lod.spz", tree)

What `__all__` names is the public interface, described in docs/python.md. Nothing else is promised to stay as it is.
Functions that do long work take `threads`, None for all processors, and `progress`: a callback, or a class such as
`tqdm.tqdm`.
"""

from __future__ import annotations

import os
import sys


def _leave_current_folder() -> None:
    """Take the current folder off the path, which `python -m sparklod_cli` puts first.

    Python would execute a file there that has the name of any module. A checkout that is not installed goes last.
    """
    is_ours = sys.argv[:1] == ["-m"] and not {__name__, f"-m{__name__}"}.isdisjoint(sys.orig_argv)
    if is_ours and not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
        home = os.path.dirname(__path__[0])  # noqa: PTH120 - pathlib would be looked for in the current folder
        sys.path[:] = [*sys.path[1:], *([home] if home == sys.path[0] else [])]


_leave_current_folder()

from importlib import import_module  # noqa: E402
from types import ModuleType  # noqa: E402
from typing import Any  # noqa: E402

__version__ = "0.2.0"


def _stub() -> bytes:
    """Read `__init__.pyi`, which may be in a zip."""
    loader: Any = __spec__.loader
    stub: bytes = loader.get_data(os.path.join(__path__[0], "__init__.pyi"))  # noqa: PTH118
    return stub


#: Module of each public name, as `__init__.pyi` has it. It is imported when the name is first used (PEP 562), so that
#: importing the package loads neither numpy nor numba.
_HOMES = {
    words[3]: words[1]
    for words in map(str.split, _stub().decode().splitlines())
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
    """Module that keeps public functions, which importing a package of the same name (`render`) replaces."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
