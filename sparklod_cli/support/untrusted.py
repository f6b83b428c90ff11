"""What files say that nobody vouches for: JSON and TOML that can be worked with, and text as it may be quoted."""

from __future__ import annotations

import json
import re
import reprlib
import sys
from typing import Any

from .printable import printable

#: Files that people and tools write are nested a handful deep. Whatever walks through values may recurse so far.
MAX_DEPTH = 64

#: Digits, with a sign, of whole numbers of 64 bits; longer ones become floats, as most readers of JSON have them.
MAX_DIGITS = 19

#: Stands for every whole number that is larger; no number that makes sense is as large.
LARGEST = sys.float_info.max

#: As much is quoted of what a file says, in characters.
QUOTED = 100

_SURROGATE = re.compile("[\ud800-\udfff]")
_ESCAPED_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def parse_json(data: str | bytes, *, keep_surrogates: bool = False) -> Any:
    """The value of a JSON text.

    Whole numbers that do not fit into 64 bits come as the floats next to them, at most `LARGEST`. NaN and Infinity,
    which Python writes, and 1e999 are taken, so who uses a number looks whether it is finite. Nothing is deeper than
    `MAX_DEPTH`.

    Args:
        data: the text, or its bytes in UTF-8.
        keep_surrogates: leave halves of surrogate pairs in texts, which is how Python writes names of files that are
            not UTF-8; otherwise they become U+FFFD, and all texts can be printed and written.

    Raises:
        ValueError: it is not JSON, or is too deep; one line that says so.
    """
    try:
        text = data if isinstance(data, str) else str(data, "utf-8-sig")
        value = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise _too_deep() from None
    mend = not keep_surrogates and (_ESCAPED_SURROGATE.search(text) or _SURROGATE.search(text))
    return _checked(value, mend=bool(mend))


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text; as `parse_json`, but whole numbers are those of 64 bits, as TOML has them."""
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
    """A parsed value, looked through level by level: a recursion would be what it should protect from."""
    whole = [root]  # in a list, so that every value is an item of something
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
    """A value as it may be quoted: on one line, and not too much of it, however deep it is."""
    return printable(reprlib.repr(value), QUOTED)


def quoted(error: Exception) -> str:
    """What a library says of a file, as it may be quoted: it may quote the file at length itself."""
    return printable(str(error), 2 * QUOTED)
