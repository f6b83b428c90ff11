"""JSON as bytes: how they become a text, and the keys of an object by its beginning.

Imports nothing heavy: `--help` needs the table of formats, which are told by keys.
"""

from __future__ import annotations

import codecs
import json

#: For a value at a time; `float` takes any number of digits in time proportional to it.
_DECODER = json.JSONDecoder(parse_int=float)


def decoded_text(data: bytes, errors: str = "strict") -> str:
    """Decode a text in UTF-8, or in UTF-16 where a byte order mark says so, as Windows programs write it.

    Raises:
        ValueError: it is not text.
    """
    marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return str(data, "utf-16" if marked else "utf-8-sig", errors)


def keys_of_object(beginning: bytes) -> list[str]:
    """Return the keys of a JSON object as far as its beginning shows them; none of any other data."""
    text, keys, at, mark = decoded_text(beginning, "replace"), list[str](), 0, "{"
    try:
        while text[at := _past_blanks(text, at)] == mark:
            key, at = _DECODER.raw_decode(text, _past_blanks(text, at + 1))
            if not isinstance(key, str) or text[at := _past_blanks(text, at)] != ":":
                break
            keys.append(key)
            _, at = _DECODER.raw_decode(text, _past_blanks(text, at + 1))
            mark = ","
    except (ValueError, IndexError, RecursionError):
        pass  # the beginning ends there, or it is not JSON
    return keys


def _past_blanks(text: str, at: int) -> int:
    """Return the place of the next character that is no blank; `IndexError` at the end."""
    while text[at] in " \t\r\n":
        at += 1
    return at
