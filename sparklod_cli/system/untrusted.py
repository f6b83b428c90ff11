"""Untrusted file contents: bounded JSON and TOML, and text that is safe to quote."""

from __future__ import annotations

import json
import re
import reprlib
import struct
import sys
import zipfile
import zlib
from typing import Any

from .json_text import decoded_text
from .printable import printable

#: Maximum nesting depth, so that code can recurse through values; real files have a few levels.
MAX_DEPTH = 64

#: Maximum number of digits of a 64-bit integer; longer ones become floats, as in most JSON readers.
MAX_DIGITS = 19

#: Replaces larger integers; no meaningful number is this large.
LARGEST = sys.float_info.max

#: Maximum number of characters quoted from a file.
QUOTED = 100

_SURROGATE = re.compile("[\ud800-\udfff]")
_ESCAPED_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

#: What `zipfile` raises on archives that are damaged, encrypted or of a kind that it does not read.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)


def parse_json(data: str | bytes, *, keep_surrogates: bool = False, depth: int = MAX_DEPTH) -> Any:
    """Parse a JSON text.

    Integers beyond 64 bits become the nearest floats, at most `LARGEST`. NaN and Infinity, which Python writes, and
    1e999 are accepted, so callers must check that numbers are finite.

    Args:
        data: the text, or its bytes, see `decoded_text`.
        keep_surrogates: keep lone surrogates, with which Python represents file names that are not UTF-8; otherwise
            they become U+FFFD, so that all texts can be printed and written.
        depth: most nesting; Python's own parser manages some hundreds.

    Raises:
        ValueError: the text is not JSON, or too deeply nested; the message is one line.
    """
    try:
        text = data.removeprefix("\ufeff") if isinstance(data, str) else decoded_text(data)
        value = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise _too_deep(depth) from None
    replace_surrogates = not keep_surrogates and (_ESCAPED_SURROGATE.search(text) or _SURROGATE.search(text))
    return _checked(value, depth, replace_surrogates=bool(replace_surrogates))


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text as `parse_json` does, but integers must fit 64 bits, as TOML requires."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        table: dict[str, Any] = _checked(tomllib.loads(text), MAX_DEPTH, replace_surrogates=False)
    except RecursionError:
        raise _too_deep(MAX_DEPTH) from None
    return table


def _whole(digits: str) -> int | float:
    if len(digits) <= MAX_DIGITS:
        return int(digits)
    return min(max(float(digits), -LARGEST), LARGEST)


def _too_deep(depth: int) -> ValueError:
    return ValueError(f"it is nested more than {depth} deep")


def _checked(root: Any, depth: int, *, replace_surrogates: bool) -> Any:
    """Check a parsed value level by level, since recursion would fail on the nesting it guards against."""
    whole = [root]  # in a list, so that every value is an item of a container
    containers: list[Any] = [whole]
    for _ in range(depth + 1):
        inner: list[Any] = []
        for container in containers:
            if replace_surrogates and isinstance(container, dict):
                items = [(well_formed(key), value) for key, value in container.items()]
                container.clear()
                container.update(items)
            for key, value in container.items() if isinstance(container, dict) else enumerate(container):
                if isinstance(value, (dict, list)):
                    inner.append(value)
                elif isinstance(value, int) and value.bit_length() > 64:
                    raise ValueError("it has a whole number of more than 64 bits")
                elif replace_surrogates and isinstance(value, str):
                    container[key] = well_formed(value)
        if not inner:
            return whole[0]
        containers = inner
    raise _too_deep(depth)


def well_formed(text: str) -> str:
    """Return a text with U+FFFD in place of lone surrogates, which cannot be encoded."""
    return _SURROGATE.sub("\ufffd", text)


def quoted_value(value: Any) -> str:
    """Return a value as quoted in an error: on one line and shortened, at any nesting depth."""
    return printable(reprlib.repr(value), QUOTED)


def quoted(error: Exception) -> str:
    """Return the message of a library's error, shortened: it may itself quote much of a file."""
    return printable(str(error), 2 * QUOTED)
