"""Promises that files break, as formats with many rules state them: for reports, and for readers, which stop at one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ..support.errors import FormatError


@dataclass(frozen=True)
class Violation:
    """A promise of the container that a file breaks.

    Attributes:
        code: for `inspect`, such as "rad.sizes".
        text: what is wrong, with the values.
        fatal: a viewer, or this reader, cannot read the file, or would read something else than was written.
    """

    code: str
    text: str
    fatal: bool = True


def check(broken: Iterable[Violation]) -> None:
    """Raises a `FormatError` with the code and the text of the first fatal violation."""
    for violation in broken:
        if violation.fatal:
            raise error_of(violation.code, violation.text)


def error_of(code: str, text: str) -> FormatError:
    """The error for a broken promise, which has its code."""
    error = FormatError(text)
    error.code = code
    return error
