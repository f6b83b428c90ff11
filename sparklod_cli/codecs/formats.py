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
        module: in this package; has `decode(file, *, threads, progress) -> Scene`. That of a format which writes trees
            also has `check(scene, options)`, which raises what `encode` would raise.
        suffixes: lower case, with the dot.
        beginning: a regular expression that the first bytes of its files match; None where they can be anything, and
            only the suffix tells.
        writes: what its `encode(scene, options, *, progress) -> Encoded` takes: "" for nothing, "splats", or "trees"
            and plain splats.
        options: the fields of `EncodeOptions` that mean something to it.
        companions: its files name others beside them; `decode` takes another argument, `beside`, which opens these.
        selective: its module also has `examine(file, *, columns, threads, progress) -> Scene`, which decodes columns
            only and passes a broken tree on.
    """

    name: str
    module: str
    suffixes: tuple[str, ...]
    beginning: bytes | None
    writes: str = ""
    options: tuple[str, ...] = ()
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
    Format("PLY", "ply", (".ply",), rb"ply[\r\n]", writes="splats"),
    Format(
        "SPZ",
        "spz",
        (".spz",),
        rb"\x1f\x8b\x08[\0-\x1f]|NGSP",  # gzipped up to version 3
        writes="trees",
        options=("version", "fractional_bits", "compression_level"),
        selective=True,
    ),
    Format(
        "SOG", "sog", (".sog", ".json"), rb"PK\x03\x04|\s*\{\s*\"\w+\"\s*:", companions=True
    ),  # a zip, or its meta.json unpacked
    Format("KSPLAT", "ksplat", (".ksplat",), rb"\0[\x01-\xff]\0\0"),  # version 0.1 and up; a float would be denormal
    Format("SPLAT", "splat", (".splat",), None, writes="splats"),
)


def sniff(head: bytes, suffix: str) -> Format | None:
    """The format of a file that begins with `head`, its first HEAD bytes, judged by that.

    The suffix is asked where the content can be anything.
    """
    by_content = (form for form in FORMATS if form.begins(head))
    by_suffix = (form for form in FORMATS if form.beginning is None and suffix.lower() in form.suffixes)
    return next(by_content, None) or next(by_suffix, None)


def writer(suffix: str, *, tree: bool) -> Format | None:
    """The format that is written by a suffix; the first one that takes what there is where there is no suffix.

    Args:
        suffix: lower case, with the dot; or empty.
        tree: what is written is a Level-of-Detail tree.
    """
    return next((form for form in writers(tree=tree) if suffix in ("", form.suffixes[0])), None)


def writers(*, tree: bool) -> list[Format]:
    """The formats that trees, or plain splats, are written in; the first one is what is written if nobody says."""
    found = [form for form in FORMATS if form.writes == "trees" or (form.writes and not tree)]
    return sorted(found, key=lambda form: form.writes != "trees")
