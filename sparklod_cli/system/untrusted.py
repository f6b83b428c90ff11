"""Untrusted text: bounded JSON, typed access to JSON, and text that is safe for terminals and CI logs.

Imports nothing heavy: `--help` needs the table of formats, which recognizes some of them by keys.
"""

from __future__ import annotations

import codecs
import contextlib
import json
import math
import re
import reprlib
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import Self

#: Maximum nesting depth, so that code can recurse through values; real files have a few levels.
MAX_DEPTH = 64

#: Maximum number of digits of an integer; longer ones become floats, as in most JSON readers.
MAX_DIGITS = 19

#: Replaces larger integers; no meaningful number is this large.
LARGEST = sys.float_info.max

#: Maximum number of characters quoted from a file.
QUOTED = 100

_SURROGATE = re.compile("[\ud800-\udfff]")
_ESCAPED_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

#: Decoder of single values; `float` takes time proportional to the number of digits, `int` its square.
_DECODER = json.JSONDecoder(parse_int=float)

#: Punctuation mark of JSON, with the blanks around it.
_MARK = re.compile(r"[ \t\r\n]*([{,:])[ \t\r\n]*")

T = TypeVar("T")


def parse_json(data: str | bytes, *, keep_surrogates: bool = False, depth: int = MAX_DEPTH) -> Any:
    """Parse a JSON text.

    Integers beyond 64 bits become the nearest floats, at most `LARGEST`. NaN and Infinity, which Python writes, and
    1e999 are accepted, so callers must check that numbers are finite.

    Args:
        data: the text, or its bytes, see `decoded_text`.
        keep_surrogates: keep lone surrogates, with which Python represents file names that are not UTF-8; otherwise
            they become U+FFFD, so that all texts can be printed and written.
        depth: deepest nesting; Python's own parser manages some hundreds.

    Raises:
        ValueError: the text is not JSON or too deeply nested; the message is one line.
    """
    try:
        text = data.removeprefix("\ufeff") if isinstance(data, str) else decoded_text(data)
        value = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError(f"it is nested more than {depth} deep") from None
    replace_surrogates = not keep_surrogates and (_ESCAPED_SURROGATE.search(text) or _SURROGATE.search(text))
    return _checked(value, depth, replace_surrogates=bool(replace_surrogates))


def _whole(digits: str) -> int | float:
    if len(digits) <= MAX_DIGITS:
        return int(digits)
    return min(max(float(digits), -LARGEST), LARGEST)


def _checked(root: Any, depth: int, *, replace_surrogates: bool) -> Any:
    """Check a value level by level, as recursion would fail on the nesting that this function refuses."""
    whole = [root]  # so that a container holds every value
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
    raise ValueError(f"it is nested more than {depth} deep")


def well_formed(text: str) -> str:
    """Replace lone surrogates, which cannot be encoded, by U+FFFD."""
    return _SURROGATE.sub("\ufffd", text)


def quoted_value(value: Any) -> str:
    """Format a value of any depth for an error: shortened, on one line."""
    return printable(reprlib.repr(value), QUOTED)


def quoted(error: Exception) -> str:
    """Return the message of a library's error, shortened, as it may quote much of a file."""
    return printable(str(error), 2 * QUOTED)


def decoded_text(data: bytes, errors: str = "strict") -> str:
    """Decode UTF-8, or UTF-16 with a byte order mark, as Windows programs write it; raise `ValueError` if invalid."""
    marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return str(data, "utf-16" if marked else "utf-8-sig", errors)


def keys_of_object(beginning: bytes) -> list[str]:
    """Return the complete keys in the beginning of a JSON object; none for other data."""
    text, keys, at, sign = decoded_text(beginning, "replace"), list[str](), 0, "{"
    with contextlib.suppress(ValueError, RecursionError):  # the beginning ends here, or it is not JSON
        while (mark := _MARK.match(text, at)) and mark[1] == sign:
            key, at = _DECODER.raw_decode(text, mark.end())
            colon = _MARK.match(text, at)
            if not isinstance(key, str) or colon is None or colon[1] != ":":
                break
            keys.append(key)
            _, at = _DECODER.raw_decode(text, colon.end())
            sign = ","
    return keys


class Origin(NamedTuple):
    """Name of a JSON file in errors, and the class of these errors."""

    called: str
    error: Callable[[str], Exception]


class Json:
    """Value of an untrusted JSON file, with its place for errors: `lods[3].file of meta.json: expected a text, not 5`.

    The arguments `way` are keys and indices that lead from this value to an inner one. Null counts as missing, as in
    viewers. Methods raise the error of the file if a value, or one on the way to it, is of another kind.
    """

    __slots__ = ("_above", "_key", "value")

    def __init__(self, value: Any, above: Json | Origin, key: str | int = "") -> None:
        self.value, self._above, self._key = value, above, key

    @classmethod
    def parse(cls, data: str | bytes, origin: Origin, *, most: int | None = None, **options: Any) -> Self:
        """Parse a file of at most `most` bytes, with options of `parse_json`."""
        if most is not None and len(data) > most:
            raise origin.error(f"{origin.called} has more than {most:,} bytes")
        try:
            return cls(parse_json(data, **options), origin)
        except ValueError as error:
            raise origin.error(f"{origin.called or 'it'} is not JSON: {quoted(error)}") from None

    @property
    def place(self) -> str:
        """Keys and indices from the top of the file to the value; empty at the top."""
        words, here = list[str](), self
        while isinstance(here._above, Json):
            words.append(f"[{here._key}]" if isinstance(here._key, int) else f".{printable(here._key, QUOTED)}")
            here = here._above
        return "".join(reversed(words)).removeprefix(".")

    def error(self, problem: str) -> Exception:
        """Return an error that begins with the place of this value."""
        top: Json | Origin = self
        while isinstance(top, Json):
            top = top._above
        subject = " of ".join(filter(None, (self.place, top.called)))
        return top.error(f"{subject}: {problem}" if subject else problem)

    def unexpected(self, kind: str) -> Exception:
        """Return the error for a value that is missing or not of the expected kind."""
        found = "but it is missing" if self.value is None else f"not {quoted_value(self.value)}"
        return self.error(f"expected {kind}, {found}")

    def get(self, *way: str | int) -> Self:
        here = self
        for key in way:
            value = here.value
            if isinstance(key, str):
                if not isinstance(value, dict):
                    raise here.unexpected("an object")
                value = value.get(key)
            else:
                if not isinstance(value, list):
                    raise here.unexpected("a list")
                value = value[key] if key < len(value) else None
            here = type(self)(value, here, key)
        return here

    def _at(self, way: tuple[str | int, ...]) -> Any:
        if len(way) == 1 and isinstance(self.value, dict):  # called half a million times for a large manifest
            return self.value.get(way[0])
        return self.get(*way).value

    def has(self, *keys: str) -> bool:
        return isinstance(self.value, dict) and all(self.value.get(key) is not None for key in keys)

    @overload
    def optional(self, key: str, read: Callable[[Self], T]) -> T | None: ...

    @overload
    def optional(self, key: str, read: Callable[[Self], T], default: T) -> T: ...

    def optional(self, key: str, read: Callable[[Self], T], default: T | None = None) -> T | None:
        """Return what a method reads from the value of a key; the default if the key is missing."""
        found = self.get(key)
        return default if found.value is None else read(found)

    def items(self, *way: str | int) -> Iterator[Self]:
        here = self.get(*way)
        if not isinstance(here.value, list):
            raise here.unexpected("a list")
        return (type(self)(value, here, index) for index, value in enumerate(here.value))

    def entries(self, *way: str | int) -> Iterator[tuple[str, Self]]:
        here = self.get(*way)
        if not isinstance(here.value, dict):
            raise here.unexpected("an object")
        return ((key, type(self)(value, here, key)) for key, value in here.value.items() if value is not None)

    def whole(self, *way: str | int, least: int = 0, most: float = math.inf) -> int:
        value = self._at(way)
        if type(value) is int and least <= value <= most:
            return value
        bounds = f"of {least:,} or more" if most == math.inf else f"from {least:,} to {most:,}"
        raise self.get(*way).unexpected(f"a whole number {bounds}")

    def number(self, *way: str | int, most: float = LARGEST) -> float:
        """Return a finite number of at most this magnitude."""
        number = self._number(self._at(way))
        if number is not None and abs(number) <= most:
            return number
        raise self.get(*way).unexpected("a finite number" if most == LARGEST else f"a number up to {most:g}")

    def _number(self, value: Any) -> float | None:
        return float(value) if type(value) in (int, float) else None

    def numbers(self, *counts: int, most: float = LARGEST) -> list[float]:
        """Return a list of numbers that has one of these lengths, or any length without arguments."""
        if not isinstance(self.value, list) or (counts and len(self.value) not in counts):
            raise self.unexpected(f"a list of {''.join(f'{count} or ' for count in counts)[:-3]}numbers")
        return [item.number(most=most) for item in self.items()]

    def matrix(self, *rows: int, columns: int = 4, most: float = LARGEST) -> list[float]:
        """Return the numbers of a matrix with one of these row counts, given as a list of rows or of numbers."""
        value = self.value
        if isinstance(value, list) and len(value) in rows and all(isinstance(row, list) for row in value):
            return [number for row in self.items() for number in row.numbers(columns, most=most)]
        return self.numbers(*(columns * count for count in rows), most=most)

    def text(self, *way: str | int) -> str:
        value = self._at(way)
        if not isinstance(value, str):
            raise self.get(*way).unexpected("a text")
        return value

    def flag(self, *way: str | int) -> bool:
        value = self._at(way)
        if not isinstance(value, bool):
            raise self.get(*way).unexpected("true or false")
        return value


#: Maximum length of a message, in characters. A path can have 4,096, and strings in a file have no limit.
MOST = 500

#: Replaces the omitted middle of a text.
GAP = " ... "

#: Replaces passwords and signatures in addresses.
HIDDEN = "***"

#: User and password before the host of an address. A password may hold an @, and a slash unless it looks like a port.
_CREDENTIALS = re.compile(r"(?<=://)[^\s/:@]{0,256}:(?:[^\s/]{0,1024}|(?!:|\d{1,5}/)[^\s@]{0,1024})@")

#: Query of an address of the web, or one with parameters; in other addresses, a ? may belong to a name.
_QUERY = re.compile(
    r"((?i:https?)://[^\s?]{0,4096}|://[^\s?]{0,4096}(?=\?\S{0,4096}?=))\?[^\s'\"]{0,8192}[^\s'\",:;.)]"
)

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

#: Code points that represent bytes of file names that are not UTF-8.
_BYTES = range(0xDC80, 0xDD00)


def printable(text: str, most: int | None = None) -> str:
    """Return a text as one line that cannot control a terminal or a log.

    Unprintable characters are escaped as in Python strings: control characters, line ends, directional marks and lone
    surrogates; so is the start of a GitHub Actions command. Secrets in addresses are hidden, see `redacted`.

    Args:
        most: maximum length. A longer text loses its middle, as it may begin with a path and end with a reason.
    """
    text = shortened(redacted(text), most)
    if not text.isprintable():
        text = "".join(mark if mark.isprintable() else _escaped(mark) for mark in text)
    text = text.replace("##[", "\\x23#[")
    if text.lstrip().startswith("::"):
        text = text.replace(":", "\\x3a", 1)
    return shortened(text, most)


def redacted(text: str) -> str:
    """Hide the passwords, and the queries, which may be signatures, of all addresses in a text."""
    return _QUERY.sub(rf"\1?{HIDDEN}", _CREDENTIALS.sub(f"{HIDDEN}@", text)) if "://" in text else text


def without_secrets(text: str, url: str) -> str:
    """Hide the passwords and queries of an address in a text, even where it quotes them alone."""
    credentials = [match[0][:-1] for match in _CREDENTIALS.finditer(url)]
    queries = [match[0][len(match[1]) + 1 :] for match in _QUERY.finditer(url)]
    secrets = (*credentials, *(each.partition(":")[2] for each in credentials), *queries)
    for secret in sorted(filter(None, secrets), key=len, reverse=True):
        text = re.sub(re.escape(secret), HIDDEN, text, flags=re.IGNORECASE)
    return redacted(text)


def shortened(text: str, most: int | None) -> str:
    """Shorten a text to at most `most` characters of its beginning and its end."""
    if most is None or len(text) <= most:
        return text
    end = (most - len(GAP)) // 4
    return text[: most - len(GAP) - end] + GAP + text[len(text) - end :]


def _escaped(mark: str) -> str:
    code = ord(mark)
    if code in _BYTES:
        return f"\\x{code - 0xDC00:02x}"
    if code > 0xFFFF:
        return f"\\U{code:08x}"
    return _SHORT.get(mark) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")


def near(name: str, known: Iterable[str], *, cutoff: float = 0.6, folder: Path | None = None) -> str:
    """Return the end of an error about an unknown name, ", did you mean ...?"; empty if no known name is similar.

    Args:
        cutoff: least similarity, 0 to 1, see `difflib`.
        folder: printed before the names, if these are files.
    """
    import difflib  # takes a millisecond to load, and is needed only after a mistake

    found = difflib.get_close_matches(name, list(known), n=3, cutoff=cutoff)
    return f", did you mean {' or '.join(str(folder / each) if folder else each for each in found)}?" if found else ""
