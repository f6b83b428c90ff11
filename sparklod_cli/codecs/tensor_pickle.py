"""Pickles that describe tensors of PyTorch, read as data: nothing that they name is imported or called.

A pickle is a program for a stack machine. What one can bring about is bounded here: the number of its steps, each of
which takes time in proportion to the bytes of its argument and the values that it takes from the stack, the axes of a
tensor, and the size of a number. Texts and names are those that stand in the pickle, never made from other objects.
"""

from __future__ import annotations

import pickletools
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..system.errors import FormatError

#: Steps of a pickle at most. That of nerfstudio, with the states of optimisers and metrics, takes some 15,000. Chosen.
MOST_STEPS = 1 << 18

#: Axes of a tensor at most; those of splats have three. Chosen.
MOST_AXES = 8

#: Bits of a number that means something: sizes, strides and offsets of PyTorch have 64.
MOST_BITS = 64

#: Types of numbers by PyTorch's names of storages.
STORAGES: dict[str, np.dtype[Any]] = {
    "torch FloatStorage": np.dtype("<f4"),
    "torch DoubleStorage": np.dtype("<f8"),
    "torch HalfStorage": np.dtype("<f2"),
}

#: Opcodes that push their argument, and that push a constant or an empty container.
VALUES = {
    *("BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"),
    *("BINUNICODE8", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": (), "EMPTY_SET": None}

#: Opcodes that make a tuple of so many values.
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

IGNORED = {"PROTO", "FRAME"}
PUTS, GETS = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}


@dataclass(frozen=True)
class Tensor:
    """Description of a tensor.

    Attributes:
        type: of its numbers; None for other ones than `STORAGES` has.
        key: of its storage.
        first: index of its first number in the storage.
        size, stride: of each axis, in numbers.
    """

    type: np.dtype[Any] | None
    key: str
    first: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def pitch(self) -> int | None:
        """Numbers from one row, of the first axis, to the next; None if the numbers of a row have gaps or turns.

        The rows of a part of a larger tensor are apart, as those of SH that gsplat cuts off from all coefficients.
        """
        row = 1
        for size, stride in zip(reversed(self.size[1:]), reversed(self.stride[1:]), strict=True):
            if size != 1 and stride != row:
                return row if 0 in self.size else None
            row *= size
        if not self.size or self.size[0] <= 1 or not row:
            return row
        return self.stride[0] if self.stride[0] >= row else None


@dataclass(frozen=True)
class _Global:
    """A function or class that the pickle names: module and name."""

    name: str


@dataclass(frozen=True)
class _Storage:
    """Numbers that a persistent identifier names; attributes as those of `Tensor`."""

    type: np.dtype[Any] | None
    key: str


def unpickled(data: bytes) -> Any:
    """Return the object of a pickle: dicts, lists, tuples, plain values, tensors; other objects become None.

    Entries of dicts whose keys are no texts are left out. Lists and tuples may contain themselves, and each other many
    times: do not walk through them.

    Raises:
        FormatError: the pickle is corrupt, takes too many steps, or has opcodes that PyTorch does not write.
    """
    machine = _Machine()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about strange escapes in texts
            for step, (opcode, argument, _) in enumerate(pickletools.genops(data)):
                if opcode.name == "STOP":
                    return machine.stack.pop()
                if step == MOST_STEPS:
                    raise FormatError(f"its pickle takes more than {MOST_STEPS:,} steps, which PyTorch does not write")
                machine.run(opcode.name, argument)
    except (IndexError, KeyError, ValueError) as error:  # of an empty stack, of an empty place, and of `pickletools`
        raise FormatError("corrupt: its pickle cannot be read") from error
    raise FormatError("corrupt: its pickle has no end")


class _Machine:
    """Stack machine of pickles (PEP 307) that builds data only."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def run(self, opcode: str, argument: Any) -> None:
        """Carry out one opcode."""
        stack = self.stack
        if opcode in VALUES:
            is_long = type(argument) is int and argument.bit_length() > MOST_BITS
            stack.append(None if is_long else argument)
        elif opcode in CONSTANTS:
            stack.append(CONSTANTS[opcode])
        elif opcode == "EMPTY_DICT":
            stack.append({})
        elif opcode == "EMPTY_LIST":
            stack.append([])
        elif opcode == "MARK":
            self._marks.append(len(stack))
        elif opcode in TUPLES:
            stack.append(tuple(self._popped(TUPLES[opcode])))
        elif opcode == "TUPLE":
            stack.append(tuple(self._since_mark()))
        elif opcode in PUTS:
            self._memo[argument] = stack[-1]
        elif opcode == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif opcode in GETS:
            stack.append(self._memo[argument])
        elif opcode == "GLOBAL":
            stack.append(_Global(argument))
        elif opcode == "STACK_GLOBAL":
            stack.append(_named(*self._popped(2)))
        elif opcode == "BINPERSID":
            stack.append(_storage(stack.pop()))
        elif opcode in ("REDUCE", "NEWOBJ"):
            stack.append(_called(*self._popped(2)))
        elif opcode in ("SETITEM", "APPEND"):
            values = self._popped(2 if opcode == "SETITEM" else 1)
            _extend(stack[-1], values)
        elif opcode in ("SETITEMS", "APPENDS", "ADDITEMS"):
            values = self._since_mark()
            _extend(stack[-1], values)
        elif opcode == "BUILD":
            stack.pop()  # the state of an object
        elif opcode not in IGNORED:
            raise FormatError(f"its pickle has the opcode {opcode}, which PyTorch does not write")

    def _popped(self, count: int) -> list[Any]:
        if len(self.stack) < count:
            raise IndexError
        values = self.stack[-count:]
        del self.stack[-count:]
        return values

    def _since_mark(self) -> list[Any]:
        mark = self._marks.pop()
        values = self.stack[mark:]
        del self.stack[mark:]
        return values


def _extend(container: Any, values: list[Any]) -> None:
    """Add values to a list, and keys and values in turn to a dict."""
    if isinstance(container, list):
        container.extend(values)
    elif isinstance(container, dict):
        pairs = zip(values[::2], values[1::2], strict=True)
        # Texts alone: their hashes are seeded, but those of integers can be made to collide.
        container.update((key, value) for key, value in pairs if isinstance(key, str))


def _named(module: Any, name: Any) -> _Global | None:
    """Return a function or class by the texts of its module and name."""
    return _Global(f"{module} {name}") if isinstance(module, str) and isinstance(name, str) else None


def _storage(pid: Any) -> _Storage | None:
    """Return the storage that a persistent identifier names."""
    if not (isinstance(pid, tuple) and len(pid) >= 3 and pid[0] == "storage" and isinstance(pid[1], _Global)):
        return None
    return _Storage(STORAGES.get(pid[1].name), pid[2]) if isinstance(pid[2], str) else None


def _called(function: Any, arguments: Any) -> Any:
    """Return what a call that the pickle describes makes, if it is a tensor or a dict; None for all else."""
    name = function.name if isinstance(function, _Global) else ""
    if name == "collections OrderedDict":
        return {}
    if not isinstance(arguments, tuple):
        return None
    if name == "torch._utils _rebuild_parameter":
        return arguments[0]
    return _tensor(*arguments[:4]) if name == "torch._utils _rebuild_tensor_v2" and len(arguments) >= 4 else None


def _tensor(storage: Any, first: Any, size: Any, stride: Any) -> Tensor | None:
    """Return a tensor by the arguments of its function; None for one of many axes."""
    if not (isinstance(storage, _Storage) and isinstance(size, tuple) and isinstance(stride, tuple)):
        raise ValueError("no storage, size or stride")
    if len(size) > MOST_AXES:
        return None
    if len(size) != len(stride) or not all(type(each) is int and each >= 0 for each in (first, *size, *stride)):
        raise ValueError("sizes that are no whole numbers")  # True is an instance of int
    return Tensor(storage.type, storage.key, first, size, stride)
