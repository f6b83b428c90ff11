"""Child processes that run Python with the modules of this process, and never those of the current folder."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from .errors import SparklodError

#: Variable that makes Python 3.11 and its children search the current folder for no module.
SAFE_PATH = "PYTHONSAFEPATH"


def program_command(program: str) -> list[str]:
    """Return the command line that runs a program, given as its source text."""
    folders = [str(Path(folder).absolute()) for folder in sys.path]
    return [sys.executable, "-c", f"import sys; sys.path[:] = {folders!r}\n{program}"]


def module_command(name: str, *arguments: str) -> list[str]:
    """Return the command line that runs a module or package as `python -m` does."""
    program = f"import runpy; runpy.run_module({name!r}, run_name='__main__', alter_sys=True)"
    return [*program_command(program), *arguments]


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Prevent processes that other packages start by `python -c` from searching the current folder for modules.

    Processes of `multiprocessing` get the folders of this process only after they imported modules of the standard
    library. Python 3.10 ignores the variable, see `check_current_folder`.
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
    """Raise a `SparklodError` if Python 3.10 would take a file in the current folder for one of its own library."""
    for path in Path().iterdir() if sys.version_info < (3, 11) else ():
        is_module = path.suffix in (".py", ".pyc", ".so", ".pyd") or (path / "__init__.py").exists()
        if is_module and path.name.partition(".")[0] in sys.stdlib_module_names:
            raise SparklodError(f"Python 3.10 would execute {path} of the current folder; work in another folder")
