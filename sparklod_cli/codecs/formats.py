"""The table of formats: adding one is a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: for people.
        module: in this package; has `decode(file, *, threads, progress) -> Scene`.
        suffixes: lower case, with the dot.
        magics: what a file of it may begin with.
    """

    name: str
    module: str
    suffixes: tuple[str, ...]
    magics: tuple[bytes, ...]

    def codec(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)


FORMATS = (
    Format("PLY", "ply", (".ply",), (b"ply\n", b"ply\r")),
    Format("SPZ", "spz", (".spz",), (b"\x1f\x8b", b"NGSP")),  # versions 1 to 3 are gzipped, 4 is not
)


def sniff(head: bytes) -> Format | None:
    """The format of a file that begins with `head`, judged by content alone."""
    return next((form for form in FORMATS if head.startswith(form.magics)), None)
