"""Checkpoints of gsplat and nerfstudio (.pt, .ckpt): zips of PyTorch, read without PyTorch.

A zip has `NAME/data.pkl`, a pickle that describes tensors, and `NAME/data/KEY`, their numbers. Sources: `torch.save`,
`examples/simple_trainer.py` of gsplat, `splatfacto.py` of nerfstudio.
"""

from __future__ import annotations

import math
import pickletools
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..model import MAX_SH_DEGREE
from ..model.gaussian import normalized_quat
from ..model.sh import COEFFICIENTS, notes_on_degree
from ..model.splats import FloatArray
from ..system.errors import FormatError, NotSplatsError, TruncatedError
from ..system.progress import Progress
from ..system.threads import blocks_of, ordered_map
from ..system.untrusted import quoted, quoted_value
from . import quantize
from .formats import ZIP
from .merging import ZIP_ERRORS
from .reader import HARMLESS, OpenFile, Reader, RowBuffer, left_out

#: Largest data.pkl, bytes. That of nerfstudio, with the state of its optimisers, has some 50,000. Chosen.
MOST_PICKLE = 1 << 24

#: Most numbers from one row of a tensor to the next: all SH coefficients of degree 4, of which `sh0` may be a part. The
#: numbers in between are read, too.
MOST_PITCH = 75

#: Bytes of a local header of a zip member before the name, and of the lengths of the name and of the extra field.
LOCAL_HEADER, LENGTHS = 30, slice(26, 30)

#: Prefixes of the tensors of splats in nerfstudio's "pipeline", the newest first.
PREFIXES = ("_model.gauss_params.", "_model.")

#: Entries of a checkpoint, and parts of names of tensors, that belong to the training and not to the scene.
TRAINING = {"optimizer", "optimizers", "scheduler", "schedulers", "scaler", "scalers", "strategy_state"}
TRAINING |= {"psnr", "ssim", "lpips", "device_indicator", "device_indicator_param"}

Decode = Callable[[FloatArray], FloatArray]

#: The tensors of splats: names in gsplat and in nerfstudio, column of `Splats`, numbers per splat (None: three per SH
#: coefficient), and decoder. Scales are logarithms, opacities logits, rotations of any length.
COLUMNS: tuple[tuple[tuple[str, str], str, int | None, Decode], ...] = (
    (("means", "means"), "center", 3, np.asarray),
    (("scales", "scales"), "scale", 3, quantize.decode_log),
    (("quats", "quats"), "quat_xyzw", 4, lambda wxyz: normalized_quat(wxyz)[:, [1, 2, 3, 0]]),
    (("opacities", "opacities"), "opacity", 1, quantize.decode_logit),
    (("sh0", "features_dc"), "rgb", 3, quantize.decode_dc),
    (("shN", "features_rest"), "sh", None, np.asarray),
)


@dataclass(frozen=True)
class _StoredColumn:
    """Tensor of a column of `Splats`: values of `type` for each splat, every `pitch` bytes from `offset` on."""

    tensor: str
    column: str
    decode: Decode
    type: np.dtype[Any]
    offset: int
    pitch: int

    def read(self, source: OpenFile, start: int, stop: int) -> FloatArray:
        """Read the values of a range of splats as float32."""
        if not self.type.itemsize or start == stop:
            return np.empty((stop - start, self.type.shape[0]), np.float32)
        size = (stop - start - 1) * self.pitch + self.type.itemsize
        data = source.read_at(self.offset + start * self.pitch, size)
        if len(data) < size:
            raise TruncatedError(f"cut short inside its tensor {self.tensor}")
        rows = np.ndarray(
            (stop - start, *self.type.shape), self.type.base, data, strides=(self.pitch, self.type.base.itemsize)
        )
        return rows.astype(np.float32)


def open_content(source: OpenFile) -> Reader:
    """Open a checkpoint of gsplat or of nerfstudio's splatfacto."""
    archive = _TensorArchive(source)
    root = archive.root()
    tensors, program = _tensors_of(root)
    known = [names[program] for names, *_ in COLUMNS]
    missing = [name for name in known if name not in tensors]
    if missing:
        why = ", as trainings with another colour model" if {*missing} <= {"sh0", "shN"} else ""
        raise FormatError(f"its splats have no {', '.join(missing)}{why}")
    count = tensors[known[0]].size[:1]
    stored = []
    for names, column, width, decode in COLUMNS:
        name = names[program]
        tensor = tensors[name]
        values = math.prod(tensor.size[1:]) if tensor.size else 0
        widths = [width] if width else [3 * terms for terms in COEFFICIENTS]
        if tensor.size[:1] != count or values not in widths:
            raise FormatError(f"its tensor {name} has the shape {tensor.size}, which is not one of splats")
        offset, pitch = archive.place_of(name, tensor)
        if program and name == "features_dc" and not math.prod(tensors["features_rest"].size[1:]):
            decode = quantize.decode_logit  # without SH nerfstudio trains logits of colours
        stored.append(_StoredColumn(names[0], column, decode, np.dtype((tensor.type, (values,))), offset, pitch))
    degree = COEFFICIENTS.index(values // 3)
    notes = notes_on_degree(degree) + left_out("tensor", "tensors", _others(root, {*known, *HARMLESS}))

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        @np.errstate(over="ignore", invalid="ignore")  # invalid numbers are reported later
        def read(part: slice) -> slice:
            for each in stored:
                out = getattr(target.splats, each.column)[part]
                values = each.read(source, target.start + part.start, target.start + part.stop)
                out[...] = each.decode(values[:, : math.prod(out.shape[1:])]).reshape(out.shape)  # no SH above degree 3
            return part

        for part in ordered_map(read, blocks_of(len(target.splats)), threads):
            progress("reading", part.stop, len(target.splats), "splat")

    return Reader(count[0], min(degree, MAX_SH_DEGREE), "checkpoint", fill, notes=notes, concurrent=True)


def _tensors_of(root: Any) -> tuple[Mapping[str, Tensor], int]:
    """Return the tensors of the splats by name, and the index of the names of their program in `COLUMNS`."""
    entries = {key: root[key] for key in ("splats", "pipeline") if isinstance(root, dict) and key in root}
    for key, prefix, program in (("splats", "", 0), *(("pipeline", prefix, 1) for prefix in PREFIXES)):
        if isinstance(entries.get(key), dict):
            tensors = {
                name.removeprefix(prefix): each
                for name, each in entries[key].items()
                if isinstance(each, Tensor) and name.startswith(prefix)
            }
            if key == "splats" or "means" in tensors:
                return tensors, program
    raise NotSplatsError("a checkpoint of PyTorch without splats of gsplat (splats) or nerfstudio (pipeline)")


def _others(root: Mapping[str, Any], known: Collection[str]) -> Iterator[str]:
    """Yield the names of tensors of the scene that are not `known`, or of the modules that they belong to."""
    walked = set[int]()  # a pickle may have one dict in many places
    for key, value in root.items():
        entries = value if isinstance(value, dict) else {key: value}
        if id(entries) in walked:
            continue
        walked.add(id(value))
        for name, each in entries.items():
            parts = name.removeprefix("_model.").removeprefix("gauss_params.").split(".")
            label = parts[0] if key in ("splats", "pipeline") else key
            is_of_scene = label not in known and TRAINING.isdisjoint((key, *parts))
            if is_of_scene and isinstance(each, Tensor) and 0 not in each.size:
                yield label


class _TensorArchive:
    """Zip of PyTorch with one checkpoint."""

    def __init__(self, source: OpenFile) -> None:
        self._file, self._size = source.file, source.size
        try:
            self._zip = zipfile.ZipFile(source.file)
            names = Counter(self._zip.namelist())
        except ZIP_ERRORS as error:
            raise FormatError(f"not a complete zip archive: {quoted(error)}") from None
        pickles = sum(count for name, count in names.items() if name.endswith("/data.pkl"))
        if pickles > 1:
            raise FormatError(f"its zip has {pickles:,} checkpoints; give each in a file of its own")
        twice = next((name for name, count in names.items() if count > 1), None)
        if twice is not None:
            raise FormatError(f"corrupt: its zip has several members {quoted_value(twice)}")
        self._names = names.keys()
        self._folder = next((name[: -len("data.pkl")] for name in names if name.endswith("/data.pkl")), "")

    def _member(self, name: str) -> zipfile.ZipInfo:
        if self._folder + name not in self._names:
            raise FormatError(f"corrupt: its zip has no {quoted_value(name)}")
        member = self._zip.getinfo(self._folder + name)
        if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
            raise FormatError(f"its {quoted_value(name)} is compressed or encrypted, as PyTorch writes none")
        return member

    def _offset(self, member: zipfile.ZipInfo) -> int:
        """Return the position of the first byte of a member's data."""
        self._file.seek(max(member.header_offset, 0))  # negative in a damaged directory
        header = self._file.read(LOCAL_HEADER)
        if len(header) < LOCAL_HEADER or not header.startswith(ZIP):
            raise TruncatedError("cut short, or corrupt: a member of its zip does not begin where it should")
        return member.header_offset + LOCAL_HEADER + int(np.frombuffer(header[LENGTHS], "<u2").sum(dtype=np.int64))

    def _read(self, name: str, most: int) -> bytes:
        member = self._member(name)
        if member.file_size > most:
            raise FormatError(f"its {quoted_value(name)} has {member.file_size:,} bytes, more than {most:,}")
        try:
            return self._zip.read(member)
        except ZIP_ERRORS as error:
            raise FormatError(f"{quoted_value(name)} cannot be read: {quoted(error)}") from None

    def root(self) -> Any:
        """Read the object of the pickle, which consists of dicts, lists, plain values and tensors."""
        if self._folder + "byteorder" in self._names and self._read("byteorder", 16) != b"little":
            raise FormatError("its numbers are big-endian, which is not read")
        return unpickled(self._read("data.pkl", MOST_PICKLE))

    def place_of(self, name: str, tensor: Tensor) -> tuple[int, int]:
        """Return the position of a tensor's first value in the file, and the bytes from one row to the next."""
        if tensor.type is None:
            raise FormatError(f"its tensor {name} has no numbers of 16, 32 or 64 bits with a point")
        member, values = self._member(f"data/{tensor.key}"), math.prod(tensor.size)
        pitch, rows = tensor.pitch, tensor.size[0] if tensor.size else 1
        if pitch is None or pitch > MOST_PITCH:
            raise FormatError(f"the values of its tensor {name} are not in order; save it with .contiguous()")
        end = tensor.first + (values and (rows - 1) * pitch + values // rows)
        offset, size = self._offset(member), end * tensor.type.itemsize
        if size > member.file_size or offset + size > self._size:
            raise TruncatedError(f"cut short, or corrupt: its tensor {name} announces {values:,} values")
        return offset + tensor.first * tensor.type.itemsize, pitch * tensor.type.itemsize


#: Most steps of a pickle. That of nerfstudio, with the states of optimisers and metrics, takes some 15,000. Chosen.
MOST_STEPS = 1 << 18

#: Most axes of a tensor; those of splats have three. Chosen.
MOST_AXES = 8

#: Most bits of a number: sizes, strides and offsets of PyTorch have 64.
MOST_BITS = 64

#: Types of numbers, by PyTorch's names of storages.
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

#: Opcodes that make a tuple, and the number of its values.
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

IGNORED = {"PROTO", "FRAME"}
PUTS, GETS = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}


@dataclass(frozen=True)
class Tensor:
    """Description of a tensor.

    Attributes:
        type: type of the numbers; None if it is not in `STORAGES`.
        key: name of the storage.
        first: index of the first number in the storage.
        size, stride: length of each axis, and numbers from one index to the next.
    """

    type: np.dtype[Any] | None
    key: str
    first: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def pitch(self) -> int | None:
        """Numbers from one row, an index of the first axis, to the next; None if the numbers of a row are not in order.

        Rows of a slice of a larger tensor have gaps between them, such as gsplat's SH without the first coefficient.
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
    """A function or class that the pickle names: its module, a space and its name."""

    name: str


@dataclass(frozen=True)
class _Storage:
    """Storage that a persistent identifier names; fields as in `Tensor`."""

    type: np.dtype[Any] | None
    key: str


def unpickled(data: bytes) -> Any:
    """Decode a pickle to dicts, lists, tuples, plain values and tensors; other objects become None.

    Entries of dicts whose keys are not str are dropped. Lists and tuples may contain themselves, and each other many
    times: do not walk through them.
    """
    machine = _Machine()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about invalid escapes in texts
            for step, (opcode, argument, _) in enumerate(pickletools.genops(data)):
                if opcode.name == "STOP":
                    return machine.stack.pop()
                if step == MOST_STEPS:
                    raise FormatError(f"its pickle takes more than {MOST_STEPS:,} steps, which PyTorch does not write")
                machine.run(opcode.name, argument)
    except (IndexError, KeyError, ValueError) as error:  # an empty stack, an empty place, errors of `pickletools`
        raise FormatError("corrupt: its pickle cannot be read") from error
    raise FormatError("corrupt: its pickle has no end")


class _Machine:
    """Stack machine of pickles (PEP 307) that only builds data: it imports and calls nothing that a pickle names.

    The effort is bounded: there are limits for the number of steps, the axes of a tensor and the size of a number, and
    a step takes time in proportion to the bytes of its argument and the values that it takes from the stack. Texts and
    names come from the pickle, never from other objects.
    """

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def run(self, opcode: str, argument: Any) -> None:
        """Execute one opcode."""
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
        elif opcode in ("SETITEM", "APPEND", "SETITEMS", "APPENDS", "ADDITEMS"):
            values = self._since_mark() if opcode.endswith("S") else self._popped(2 if opcode == "SETITEM" else 1)
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
    """Append values to a list, or add alternate keys and values to a dict."""
    if isinstance(container, list):
        container.extend(values)
    elif isinstance(container, dict):
        pairs = zip(values[::2], values[1::2], strict=True)
        # Only str, whose hashes are seeded: those of integers can be made to collide.
        container.update((key, value) for key, value in pairs if isinstance(key, str))


def _named(module: Any, name: Any) -> _Global | None:
    return _Global(f"{module} {name}") if isinstance(module, str) and isinstance(name, str) else None


def _storage(pid: Any) -> _Storage | None:
    if not (isinstance(pid, tuple) and len(pid) >= 3 and pid[0] == "storage" and isinstance(pid[1], _Global)):
        return None
    return _Storage(STORAGES.get(pid[1].name), pid[2]) if isinstance(pid[2], str) else None


def _called(function: Any, arguments: Any) -> Any:
    """Return the tensor or dict that a call in the pickle creates; None for other calls."""
    name = function.name if isinstance(function, _Global) else ""
    if name == "collections OrderedDict":
        return {}
    if not isinstance(arguments, tuple):
        return None
    if name == "torch._utils _rebuild_parameter":
        return arguments[0]
    return _tensor(*arguments[:4]) if name == "torch._utils _rebuild_tensor_v2" and len(arguments) >= 4 else None


def _tensor(storage: Any, first: Any, size: Any, stride: Any) -> Tensor | None:
    """Return the tensor that `_rebuild_tensor_v2` creates; None if it has more than `MOST_AXES` axes."""
    if not (isinstance(storage, _Storage) and isinstance(size, tuple) and isinstance(stride, tuple)):
        raise ValueError("no storage, size or stride")
    if len(size) > MOST_AXES:
        return None
    if len(size) != len(stride) or not all(type(each) is int and each >= 0 for each in (first, *size, *stride)):
        raise ValueError("sizes that are no whole numbers")  # True is an instance of int
    return Tensor(storage.type, storage.key, first, size, stride)
