"""Untrusted contents of files: bounded JSON and TOML, and text that is safe to quote."""

from __future__ import annotations

import json
import re
import reprlib
import struct
import sys
import zipfile
import zlib
from typing import Any

from .printable import printable

#: Deepest nesting that is accepted, so that code may recurse through values; real files are nested a few deep.
MAX_DEPTH = 64

#: Most characters of a whole number of 64 bits; longer ones become floats, as in most readers of JSON.
MAX_DIGITS = 19

#: Replaces larger whole numbers; no sensible number is as large.
LARGEST = sys.float_info.max

#: Most characters that are quoted from a file.
QUOTED = 100

_SURROGATE = re.compile("[\ud800-\udfff]")
_ESCAPED_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

#: What `zipfile` raises on archives that are damaged, encrypted or of a kind that it does not read.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)


def parse_json(data: str | bytes, *, keep_surrogates: bool = False) -> Any:
    """The value of a JSON text.

    Whole numbers beyond 64 bits become the nearest floats, at most `LARGEST`. NaN and Infinity, which Python writes,
    and 1e999 are accepted, so users of a number check that it is finite. Nesting is at most `MAX_DEPTH`.

    Args:
        data: the text, or its bytes in UTF-8.
        keep_surrogates: keep halves of surrogate pairs in texts, by which Python represents names of files that are
            not UTF-8; otherwise they become U+FFFD, so that all texts can be printed and written.

    Raises:
        ValueError: the text is not JSON or nested too deep; the message has one line.
    """
    try:
        text = data if isinstance(data, str) else str(data, "utf-8-sig")
        value = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise _too_deep() from None
    mend = not keep_surrogates and (_ESCAPED_SURROGATE.search(text) or _SURROGATE.search(text))
    return _checked(value, mend=bool(mend))


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text, as by `parse_json`, but whole numbers must have 64 bits, as TOML demands."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        table: dict[str, Any] = _checked(tomllib.loads(text), mend=False)
    except RecursionError:
        raise _too_deep() from None
    return table


def _whole(digits: str) -> int | float:
    if len(digits) <= MAX_DIGITS:
        return int(digits)
    return min(max(float(digits), -LARGEST), LARGEST)


def _too_deep() -> ValueError:
    return ValueError(f"it is nested more than {MAX_DEPTH} deep")


def _checked(root: Any, *, mend: bool) -> Any:
    """Checks a parsed value level by level: recursion would fail on the nesting that it guards against."""
    whole = [root]  # in a list, so that every value is an item of a container
    containers: list[Any] = [whole]
    for _ in range(MAX_DEPTH + 1):
        inner: list[Any] = []
        for container in containers:
            if mend and isinstance(container, dict):
                items = [(well_formed(key), value) for key, value in container.items()]
                container.clear()
                container.update(items)
            for key, value in container.items() if isinstance(container, dict) else enumerate(container):
                if isinstance(value, (dict, list)):
                    inner.append(value)
                elif isinstance(value, int) and value.bit_length() > 64:
                    raise ValueError("it has a whole number of more than 64 bits")
                elif mend and isinstance(value, str):
                    container[key] = well_formed(value)
        if not inner:
            return whole[0]
        containers = inner
    raise _too_deep()


def well_formed(text: str) -> str:
    """A text with U+FFFD in place of halves of surrogate pairs, which no encoding can write."""
    return _SURROGATE.sub("\ufffd", text)


def shown(value: Any) -> str:
    """A value as an error quotes it: on one line and shortened, however deep it is."""
    return printable(reprlib.repr(value), QUOTED)


def quoted(error: Exception) -> str:
    """The message of a library's error, shortened: it may itself quote much of a file."""
    return printable(str(error), 2 * QUOTED)
