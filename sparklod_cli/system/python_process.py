"""Child processes that run Python with the modules of this one, and never those of the current folder."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from .errors import SparklodError

#: Variable by which Python 3.11 and its children search the current folder for no module.
SAFE_PATH = "PYTHONSAFEPATH"


def program_command(program: str) -> list[str]:
    """Return the command line that runs the text of a program."""
    folders = [str(Path(folder).absolute()) for folder in sys.path]
    return [sys.executable, "-c", f"import sys; sys.path[:] = {folders!r}\n{program}"]


def module_command(name: str, *arguments: str) -> list[str]:
    """Return the command line that runs a module as `python -m` does, or a package that has a `__main__`."""
    program = f"import runpy; runpy.run_module({name!r}, run_name='__main__', alter_sys=True)"
    return [*program_command(program), *arguments]


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Have processes that other packages start by `python -c` search the current folder for no module.

    Those of `multiprocessing` get the folders of this process later, after modules of the standard library. Python 3.10
    does not know the variable, see `check_current_folder`.
    """
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


def check_current_folder() -> None:
    """Raise a `SparklodError` where Python 3.10 would execute a file in the current folder as of its own library."""
    for path in Path().iterdir() if sys.version_info < (3, 11) else ():
        is_module = path.suffix in (".py", ".pyc", ".so", ".pyd") or (path / "__init__.py").exists()
        if is_module and path.name.partition(".")[0] in sys.stdlib_module_names:
            raise SparklodError(f"Python 3.10 would execute {path} of the current folder; work in another folder")
