"""Random changes to pickles opcode by opcode, so that most of a changed one still runs."""

from __future__ import annotations

import pickletools
import struct
from collections.abc import Callable

from .case import Rng
from .mutate import CHANGES, INTEGERS, WORDS, mutated, pick

#: A pickle as its opcodes, each with its argument.
Steps = list[bytes]

#: Opcodes at most after a change that repeats some; a reader is to refuse more.
MOST = 1 << 19

#: Opcodes without an argument, which PyTorch writes, and some that it does not.
PLAIN = (*b"Nt)]}(us0Q\x81Reab\x85\x86\x87\x88\x89\x93\x94\x8f\x90\x91.1Hdlo2", 0)

#: Names of functions and classes that a reader may know, and some that it must not run.
NAMES = (
    *("torch._utils\n_rebuild_tensor_v2", "torch._utils\n_rebuild_parameter", "collections\nOrderedDict"),
    *("torch\nFloatStorage", "torch\nHalfStorage", "torch\nLongStorage", "os\nsystem", "builtins\neval"),
)

#: Texts that a reader looks for.
TEXTS = ("splats", "pipeline", "means", "scales", "quats", "opacities", "sh0", "shN", "storage", "cpu", "0", "1")


def split(data: bytes) -> Steps:
    """Splits a pickle into its opcodes; raises ValueError if it is broken."""
    places = [place for _, _, place in pickletools.genops(data) if place is not None]
    return [data[start:stop] for start, stop in zip(places, [*places[1:], len(data)], strict=True)]


def text(value: str) -> bytes:
    """Pickles a text."""
    encoded = value.encode("utf-8", "replace")
    return b"X" + struct.pack("<I", len(encoded)) + encoded


def integer(value: int) -> bytes:
    """Pickles an integer of any size."""
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data if len(data) < 256 else b"\x8b" + struct.pack("<i", len(data)) + data


def _opcode(rng: Rng) -> bytes:
    """Picks an opcode with an argument."""
    kind = int(rng.integers(8))
    if kind == 0:
        return bytes([int(pick(rng, PLAIN))])
    if kind == 1:
        return text(pick(rng, (*TEXTS, *WORDS)))
    if kind == 2:
        value = int(pick(rng, (*INTEGERS, 10**400, 10**5000)))
        return integer(-value if rng.integers(4) == 0 else value)
    if kind == 3:
        return b"c" + pick(rng, NAMES).encode() + b"\n"
    if kind == 4:
        return b"G" + struct.pack(">d", float(pick(rng, (0.0, 1.5, float("nan"), float("inf"), 1e300))))
    if kind == 5:
        return b"q" + bytes([int(rng.integers(4))])
    if kind == 6:
        return b"h" + bytes([int(rng.integers(4))])
    return bytes([int(rng.integers(256))]) + rng.bytes(int(rng.integers(6)))


def _replace(rng: Rng, steps: Steps, at: int) -> None:
    steps[at : at + 1] = [_opcode(rng)]


def _insert(rng: Rng, steps: Steps, at: int) -> None:
    steps[at:at] = [_opcode(rng) for _ in range(int(pick(rng, (1, 1, 2, 3, 8))))]


def _delete(rng: Rng, steps: Steps, at: int) -> None:
    del steps[at : at + int(pick(rng, (1, 1, 2, 5, 20)))]


def _swap(rng: Rng, steps: Steps, at: int) -> None:
    other = int(rng.integers(len(steps)))
    steps[at], steps[other] = steps[other], steps[at]


def _copy(rng: Rng, steps: Steps, at: int) -> None:
    start = int(rng.integers(len(steps)))
    steps[at:at] = steps[start : start + int(pick(rng, (1, 2, 5, 20, 60)))]


def _repeat(rng: Rng, steps: Steps, at: int) -> None:
    part = steps[at : at + int(pick(rng, (1, 2, 3, 8, 20)))]
    steps[at:at] = part * min(int(pick(rng, (2, 10, 1000, 100_000))), MOST // len(part))


def _grow(rng: Rng, steps: Steps, at: int) -> None:
    """Inserts an object that doubles, deepens or fills itself again and again."""
    loop = pick(rng, (b"h\0\x86q\0", b"h\0\x87q\0", b"\x85", b"h\0a", b"h\0h\0\x93q\0", b"h\0Q", b"X\1\0\0\0ah\0s"))
    steps[at:at] = [pick(rng, (b")", b"]", b"}", b"N", text("a"))), b"q\0", *[loop] * int(pick(rng, (3, 60, 20_000)))]


def _number(rng: Rng, steps: Steps, at: int) -> None:
    """Changes one of the integers, such as those of sizes, strides and offsets."""
    places = [place for place, step in enumerate(steps) if step[:1] in (b"K", b"M", b"J", b"\x8a", b"\x8b")]
    if places:
        steps[pick(rng, places)] = integer(int(pick(rng, (*INTEGERS, 10**200, 10**400))))


STEP_CHANGES: tuple[Callable[[Rng, Steps, int], None], ...] = (
    *(_replace, _replace, _insert, _insert, _delete, _swap, _copy, _repeat, _grow, _number, _number, _number),
)


def pickle_mutated(rng: Rng, data: bytes) -> bytes:
    """Makes one to four changes to the opcodes of a pickle, and in one case of twelve to its bytes as well."""
    try:
        steps = split(data)
    except ValueError:
        return mutated(rng, data)
    for _ in range(int(pick(rng, CHANGES))):
        if steps:
            # What is below the root on the stack changes nothing of it, so that such a pickle is read to its end.
            at = min(1, len(steps) - 1) if rng.integers(3) == 0 else int(rng.integers(len(steps)))
            pick(rng, STEP_CHANGES)(rng, steps, at)
    changed = b"".join(steps)
    return mutated(rng, changed) if rng.integers(12) == 0 else changed
