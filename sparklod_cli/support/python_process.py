"""Command lines of Python processes that import from the folders that this process imports from.

With `-c` and `-m` alone, Python searches the current folder first, and would execute a file there that has the name of
a module. Its option `-P` is unknown to Python 3.10, and `-I` ignores PYTHONPATH and the packages of the user.
"""

from __future__ import annotations

import sys
from pathlib import Path


def program_command(program: str) -> list[str]:
    """Return the command line that runs the text of a program."""
    folders = [str(Path(folder).absolute()) for folder in sys.path]
    return [sys.executable, "-c", f"import sys; sys.path[:] = {folders!r}\n{program}"]


def module_command(name: str, *arguments: str) -> list[str]:
    """Return the command line that runs a module as `python -m` does, or a package that has a `__main__`."""
    program = f"import runpy; runpy.run_module({name!r}, run_name='__main__', alter_sys=True)"
    return [*program_command(program), *arguments]
