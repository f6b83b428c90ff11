"""The table of formats: adding one is a module and a row here."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import import_module
from typing import Any

#: Bytes of a file that are looked at to tell its format.
HEAD = 1 << 16


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: for people.
        module: in this package; has `decode(file, *, threads, progress) -> Scene`.
        writable: its module also has `encode(scene, options, *, threads, progress) -> Iterator[bytes]`, and
            `settled(scene, options) -> WriteOptions`, the options with nothing left open, which raises `FormatError`
            where the scene cannot be written.
        trees: what is written can be a Level-of-Detail tree.
        suffixes: lower case, with the dot.
        beginning: a regular expression that the first bytes of its files match; None where they can be anything, and
            only the suffix tells.
        companions: its files name others beside them; `decode` takes another argument, `beside`, which opens these.
        selective: its module also has `examine(file, *, columns, threads, progress) -> Scene`, which decodes columns
            only and passes a broken tree on.
    """

    name: str
    module: str
    suffixes: tuple[str, ...]
    beginning: bytes | None
    writable: bool = False
    trees: bool = False
    companions: bool = False
    selective: bool = False

    def codec(self) -> Any:
        """The module, imported when it is needed."""
        return import_module(f".{self.module}", __package__)

    def begins(self, head: bytes) -> bool:
        """Whether a file that begins with `head` is of this format, as far as one can see."""
        return self.beginning is not None and re.match(self.beginning, head, re.DOTALL) is not None


#: In the order in which they are tried: compressed PLY is PLY, too. A .splat begins with any float, so no beginning may
#: be of two bytes or less.
FORMATS = (
    Format(
        "compressed PLY",
        "compressed_ply",
        (".ply",),
        rb"ply\s(?:(?!end_header).)*[\r\n]\s*property\s+\w+\s+packed_position\s",
    ),
    Format("PLY", "ply", (".ply",), rb"ply[\r\n]", writable=True),
    # Gzipped up to version 3.
    Format("SPZ", "spz", (".spz",), rb"\x1f\x8b\x08[\0-\x1f]|NGSP", writable=True, trees=True, selective=True),
    # A zip, or its meta.json unpacked.
    Format("SOG", "sog", (".sog", ".json"), rb"PK\x03\x04|\s*\{\s*\"\w+\"\s*:", companions=True),
    Format("KSPLAT", "ksplat", (".ksplat",), rb"\0[\x01-\xff]\0\0"),  # version 0.1 and up; a float would be denormal
    Format("SPLAT", "splat", (".splat",), None, writable=True),
)

#: The formats that can be written, by the suffix of the file.
WRITABLE = {suffix: form for form in FORMATS if form.writable for suffix in form.suffixes}


def sniff(head: bytes, suffix: str) -> Format | None:
    """The format of a file that begins with `head`, its first HEAD bytes, judged by that.

    The suffix is asked where the content can be anything.
    """
    by_content = (form for form in FORMATS if form.begins(head))
    by_suffix = (form for form in FORMATS if form.beginning is None and suffix.lower() in form.suffixes)
    return next(by_content, None) or next(by_suffix, None)
