"""Imports of packages that only an extra of sparklod brings, and what to install where one is missing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from .errors import SparklodError


@contextlib.contextmanager
def optional_import(purpose: str, requirement: str, error: type[SparklodError] = SparklodError) -> Iterator[None]:
    """Turns a failed import inside it into an error that says what to install.

    The import stays a statement, so that type checkers and import-linter see it.

    Args:
        purpose: what takes the package, and which one: "charts are drawn by matplotlib".
        requirement: what pip installs: "sparklod[render]".
        error: class of the error.

    Raises:
        SparklodError: the package is not installed, or does not load; of the class `error`.
    """
    try:
        yield
    except ImportError as reason:
        quoted = f"'{requirement}'" if "[" in requirement else requirement  # shells expand brackets
        raise error(f"{purpose}: pip install {quoted} ({reason})") from None
