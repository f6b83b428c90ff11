"""Random changes to bytes, texts and JSON, from a flipped bit to values that no writer would write."""

from __future__ import annotations

import copy
import json
import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from .case import Rng

T = TypeVar("T")

#: Numbers of changes to pick from. One is the most likely: a file with many is refused for the first of them.
CHANGES = (1, 1, 1, 1, 2, 2, 3, 4)

#: Integers at the edges of number types and near powers of two.
INTEGERS = (
    *(0, 1, 2, 3, 4, 5, 7, 8, 15, 16, 24, 31, 32, 64, 127, 128, 255, 256, 1000, 4095, 4096, 32767, 32768, 65535, 65536),
    *(65537, 1 << 20, (1 << 24) - 1, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 2, (1 << 32) - 1, 1 << 32, 1 << 40),
    *((1 << 63) - 1, (1 << 64) - 1),
)

#: Floats that are special, or at the edges of float16, float32 and SPZ's fixed point.
FLOATS = (
    *(math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1.0, 0.5, 1e-45, 1e-30, 1e30, 1e38, -1e38, 3.4e38, -3.4e38),
    *(-0.02, 65504.0, 8388607.0, -8388607.0, 8388608.0, 1e7),
)

#: Texts that parsers, terminals, spreadsheets or CI runs treat in a special path.
WORDS = (
    *("0", "-1", "1", "2", "nan", "NaN", "inf", "-Infinity", "1e38", "-1e38", "1e308", "1e999", "1e-320", "0.0", "-0"),
    *(
        "99999999999999999999",
        "4294967295",
        "4294967296",
        "65536",
        "9" * 500,
        "9" * 5000,
        "0x10",
        "1_000",
        "\uff11",
        "\u00bd",
    ),
    *("", " ", "\t", "\n", "\r", "\0", "\x1b[31m", "\x07", "\u2028", "\u202e", "::error::oops", "=1+1", "é", "\ufeff"),
    *("null", "true", "{", "}", "[", "]", ",", ":", ";", '"', "'", "#", "//", "a" * 8000, "../../x", "/dev/zero", "%s"),
    *("element vertex 3\n", "property float x\n", "property list uchar int v\n", "format ascii 1.0\n", "end_header\n"),
)

#: Placeholders for JSON that `json.dumps` cannot write; `json_text` replaces them.
DEEP, DIGITS, LONE = "@deep@", "@digits@", "@lone@"

#: Values to put into JSON.
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 0.5, -0.02, 1e-300, 1e12, 1e38, -1e38, 1e300, 1e308, -1e308, math.nan, math.inf),
    *(1 << 31, 1 << 32, 1 << 53, 1 << 64, 10**400, 65536, 255, 256, 1000, 1e7),
    *("", "0", "1e5", "nan", "a", "x\ny", "\x1b]0;x\x07", "::error::x", "=cmd|'/C calc'!A0", "é" * 300, "a" * 8000),
    *("../up", "/etc/passwd", ".", "..", "a\0b", "C:x", DEEP, DIGITS, LONE),
    *([], {}, [[]], [0] * 3, [0] * 16, [1, 2], [None], {"": 0}, [math.nan] * 3, [1e308] * 4),
)


def pick(rng: Rng, options: Sequence[T]) -> T:
    """Picks one option at random."""
    return options[int(rng.integers(len(options)))]


def random_offset(rng: Rng, length: int, header: int) -> int:
    """Picks an offset in a file; half of the time in its header, if it has one."""
    reach = min(header, length) if header and rng.integers(2) else length
    return int(rng.integers(reach + 1))


def mutated(rng: Rng, data: bytes, *, other: bytes = b"", header: int = 0) -> bytes:
    """Makes one to four changes to bytes.

    Args:
        rng: the case's random generator.
        data: the bytes to change.
        other: bytes to splice in.
        header: number of leading bytes that are changed more often than the others.
    """
    changed = bytearray(data)
    for _ in range(int(pick(rng, CHANGES))):
        pick(rng, BYTE_CHANGES)(rng, changed, other or data, random_offset(rng, len(changed), header))
    return bytes(changed)


def _flip(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    if at < len(data):
        data[at] ^= 1 << int(rng.integers(8))


def _byte(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    data[at : at + 1] = bytes([pick(rng, (0, 1, 2, 3, 4, 7, 9, 127, 128, 255, int(rng.integers(256))))])


def _integer(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    form = pick(rng, ("<H", "<I", "<I", "<Q", ">I"))
    size = struct.calcsize(form)
    at -= at % size * int(rng.integers(2))
    value = pick(rng, INTEGERS)
    if at + size <= len(data):
        if rng.integers(3) == 0:
            value = struct.unpack_from(form, data, at)[0] + int(rng.integers(-2, 3))
        struct.pack_into(form, data, at, value & ((1 << 8 * size) - 1))


def _float(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    at -= at % 4 * int(rng.integers(4) > 0)
    step = 4 * int(rng.integers(1, 20))
    value = struct.pack("<f", pick(rng, FLOATS))
    for index in range(int(pick(rng, (1, 1, 1, 3, 20)))):
        if at + index * step + 4 <= len(data):
            data[at + index * step : at + index * step + 4] = value


def _delete(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    del data[at : at + int(pick(rng, (1, 2, 4, 8, 16, 32, 100)))]


def _truncate(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    if rng.integers(3) == 0:
        del data[at:]


def _extend(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    data += rng.bytes(int(pick(rng, (1, 4, 32, 1000)))) if rng.integers(2) else bytes(data)


def _insert(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    data[at:at] = pick(rng, WORDS).encode() if rng.integers(2) else rng.bytes(int(rng.integers(1, 40)))


def _copy(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    start, width = int(rng.integers(len(data) + 1)), int(pick(rng, (1, 4, 16, 32, 200)))
    data[at : at + width] = data[start : start + width]


def _splice(rng: Rng, data: bytearray, other: bytes, at: int) -> None:
    start = int(rng.integers(len(other) + 1))
    if rng.integers(2):
        data[at:] = other[start:]
    else:
        data[at : at + 64] = other[start : start + 64]


BYTE_CHANGES: tuple[Callable[[Rng, bytearray, bytes, int], None], ...] = (
    *(_flip, _flip, _byte, _byte, _integer, _integer, _integer, _float, _float),
    *(_delete, _truncate, _extend, _insert, _copy, _splice),
)


#: Characters from which a line is only doubled: lines that are repeated 200 times again and again would take longer to
#: make than a case may take.
LONGEST_LINE = 1 << 12


def text_mutated(rng: Rng, text: str) -> str:
    """Makes one to four changes to the words, numbers and lines of a text."""
    for _ in range(int(pick(rng, CHANGES))):
        words = [(found.start(), found.end()) for found in re.finditer(r"[\w.+-]+|[^\w\s]", text)]
        start, end = pick(rng, words) if words else (0, 0)
        kind = int(rng.integers(6))
        if kind <= 2:
            text = text[:start] + pick(rng, WORDS) + text[end:]
        elif kind == 3:
            text = text[:start] + text[end:]
        elif kind == 4:
            again, last = pick(rng, words) if words else (0, 0)
            text = text[:start] + text[again:last] + text[start:]
        else:
            lines = text.splitlines(keepends=True) or [""]
            at = int(rng.integers(len(lines)))
            often = 2 if len(lines[at]) > LONGEST_LINE else 200
            lines[at : at + 1] = pick(rng, ([], [lines[at]] * 2, [lines[at]] * often, [lines[at], "\n"]))
            text = "".join(lines)
    return text


def json_mutated(rng: Rng, data: bytes) -> bytes:
    """Makes one to four changes to the structure of JSON, and in one case of twelve to its text as well."""
    root = {"": json.loads(data)}
    for _ in range(int(pick(rng, CHANGES))):
        # Walk down from the root: a uniform choice would nearly always hit a number in a long list.
        path = [(root, "")]
        while True:
            holder, key = path[-1]
            below = list(_below(holder[key]))
            if not below or rng.integers(5) == 0:
                break
            path.append(pick(rng, below))
        _change(rng, *pick(rng, path[-2:]))
    return json_text(rng, root.get(""))


def json_text(rng: Rng, value: Any) -> bytes:
    """Writes a value as JSON, and replaces `DEEP`, `DIGITS` and `LONE` by what `json.dumps` cannot write."""
    text = json.dumps(value)
    deep = int(pick(rng, (100, 900, 3000, 100_000)))
    text = text.replace(f'"{DEEP}"', "[" * deep + "]" * deep).replace(f'"{DIGITS}"', "9" * 5000)
    text = text.replace(LONE, "x\\ud800")
    return mutated(rng, text.encode()) if rng.integers(12) == 0 else text.encode()


def _below(value: Any) -> Iterator[tuple[Any, Any]]:
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return ((value, key) for key in keys)


def _value(rng: Rng) -> Any:
    """Picks a value, as a copy: a case must not change what the next one starts from."""
    return copy.deepcopy(pick(rng, VALUES))


def _change(rng: Rng, holder: Any, key: Any) -> None:
    kind, value = int(rng.integers(10)), holder[key]
    if kind <= 3:
        holder[key] = _value(rng)
    elif kind == 4:
        if isinstance(holder, list) or key:
            del holder[key]
    elif kind == 5:
        holder[key] = pick(rng, ([value], {"a": value}, [value, copy.deepcopy(value)]))
    elif kind == 6 and isinstance(value, list):
        holder[key] = pick(rng, (value[:1], value[1:], value * 2, value[::-1], value * 50))
    elif kind == 7 and type(value) in (int, float) and abs(value) < 1e300:
        holder[key] = pick(rng, (-value, value * 1e30, value * 1e-30, value + 1, str(value), 0))
    elif kind == 8 and isinstance(value, dict):
        value[str(pick(rng, WORDS))] = _value(rng)
    elif kind == 9 and isinstance(holder, dict) and key:
        holder[str(pick(rng, WORDS))] = holder.pop(key)
    else:
        holder[key] = _value(rng)
