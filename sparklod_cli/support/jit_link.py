"""Runs machine code that numba has made, without numba, which takes half a second to load.

What numba compiles a kernel to is an object file that takes some functions of numba's extension modules, of Python and
of the C library. LLVM's linker, which llvmlite has, puts it into memory. It returns an error where something is
missing, and the kernel is then left to numba.
"""

from __future__ import annotations

import builtins
import ctypes
import functools
import itertools
import json
import pickle
import platform
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .jit_cache import SETTINGS, llvm, numba_folder
from .jit_threads import extension, layer

#: Systems and processors on which this is tested; on others numba loads what it has compiled.
TESTED = {("linux", "x86_64")}

#: Bytes of the length of what precedes the object code in a file.
LENGTH = 4

#: What parallel code takes of the threading layer besides `numba_parallel_for`.
SCHEDULING = (
    *("allocate_sched", "deallocate_sched", "do_scheduling_signed", "do_scheduling_unsigned", "get_num_threads"),
    *("get_parallel_chunksize", "get_sched_size", "get_thread_id", "set_num_threads", "set_parallel_chunksize"),
)


@dataclass(frozen=True)
class MachineCode:
    """The machine code of a kernel for some types of arguments.

    Attributes:
        name: the function's name.
        wrapper: symbol of the function that Python calls.
        environments: symbols of the pointers to the environments of the function and of those that it calls, its own
            first, with the constants in them, which are numpy's types as text.
        parallel: it runs on the threads of `layer`.
        code: the object file.
    """

    name: str
    wrapper: str
    environments: tuple[tuple[str, tuple[str, ...]], ...]
    parallel: bool
    code: bytes

    def pieces(self) -> list[bytes]:
        """The content of a file."""
        about = json.dumps({name: value for name, value in asdict(self).items() if name != "code"}).encode()
        return [len(about).to_bytes(LENGTH, "little"), about, self.code]

    @classmethod
    def from_bytes(cls, content: bytes) -> MachineCode:
        """What `pieces` made.

        Raises:
            ValueError, TypeError: it is something else.
        """
        start = LENGTH + int.from_bytes(content[:LENGTH], "little")
        about = json.loads(content[LENGTH:start])
        about["environments"] = tuple((symbol, tuple(constants)) for symbol, constants in about["environments"])
        return cls(**about, code=content[start:])


def is_tested() -> bool:
    """Whether machine code is linked here: not where it was never tried, nor where a file of settings is for numba."""
    return (sys.platform, platform.machine()) in TESTED and numba_folder() is not None and not SETTINGS.exists()


def link(code: MachineCode, function: Callable[..., Any]) -> Callable[..., Any]:
    """Puts machine code into memory and returns what Python calls.

    Args:
        code: the machine code.
        function: the function that it was compiled from.

    Raises:
        ImportError, AttributeError: numba or llvmlite lacks what this takes.
        RuntimeError: the code takes something that is not there.
        ValueError, TypeError: the code is no machine code for this system.
    """
    with _lock:
        return _linker().link(code, function)


#: numba's function that makes an object of its pickle, such as the class of an array that a kernel returns. numba's own
#: calls Python code, which would load numba, and in which Python handles signals: a `KeyboardInterrupt` raised there is
#: lost, or ends in a `SystemError`. This one calls `pickle.loads`, which is C. Pointers are integers here, because
#: versions of LLVM write them differently.
UNPICKLE = """
declare i64 @PyBytes_FromStringAndSize(i64, i64)
declare i64 @PyObject_CallFunctionObjArgs(i64, ...)
declare void @Py_DecRef(i64)

define i64 @unpickle(i64 %data, i32 %size, i64 %digest) {{
  %length = sext i32 %size to i64
  %pickled = call i64 @PyBytes_FromStringAndSize(i64 %data, i64 %length)
  %object = call i64 (i64, ...) @PyObject_CallFunctionObjArgs(i64 {loads}, i64 %pickled, i64 0)
  call void @Py_DecRef(i64 %pickled)
  ret i64 %object
}}
"""

_lock = threading.RLock()


@functools.cache
def _linker() -> _Linker:
    return _Linker()


class _Linker:
    """LLVM's linker, and what it takes of numba. It lives as long as the process: arrays may outlive all else."""

    def __init__(self) -> None:
        binding = llvm()
        from llvmlite.binding import orcjit

        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        self._orc = orcjit
        self._engine = orcjit.create_lljit_compiler(suppress_errors=True)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._engine))
        self._number = itertools.count()
        self._dynfunc: Any = extension("_dynfunc")
        self._library("numba", self._helpers())
        self._threads = ""

    def _helpers(self) -> dict[str, int]:
        """Addresses of numba's own functions, of None and of the exceptions, under the names that numba gives them."""
        helpers: Any = extension("_helperlib")
        memory: Any = extension("core.runtime._nrt_python")
        memory.memsys_use_cpython_allocator()
        symbols = {"_Py_NoneStruct": id(None)}
        for name, address in {**helpers.c_helpers, **self._dynfunc.c_helpers}.items():
            symbols[name] = symbols[f"numba_{name}"] = address  # functions of the C library have no prefix
        for name, address in memory.c_helpers.items():
            symbols[name if name.startswith("_") else f"NRT_{name}"] = address
        for error in vars(builtins).values():
            if isinstance(error, type) and issubclass(error, BaseException):
                symbols[f"PyExc_{error.__name__}"] = id(error)
        symbols["numba_unpickle"] = self._unpickle()
        return symbols

    def _unpickle(self) -> int:
        """Return the address of `UNPICKLE`."""
        builder = self._orc.JITLibraryBuilder().add_ir(UNPICKLE.format(loads=id(pickle.loads)))
        library = builder.add_current_process().export_symbol("unpickle").link(self._engine, "unpickle")
        address: int = library["unpickle"]
        library.detach()
        return address

    def _library(self, name: str, symbols: dict[str, int]) -> str:
        builder = self._orc.JITLibraryBuilder()
        for symbol, address in symbols.items():
            builder.import_symbol(symbol, address)
        builder.link(self._engine, name).detach()
        return name

    def _threading(self) -> str:
        """The library of what parallel code takes."""
        if not self._threads:
            module = layer().module
            symbols = {"numba_parallel_for": module.parallel_for}
            symbols |= {name: getattr(module, name) for name in SCHEDULING}
            self._threads = self._library("threads", symbols)
        return self._threads

    def link(self, code: MachineCode, function: Callable[..., Any]) -> Callable[..., Any]:
        """See `link`."""
        builder = self._orc.JITLibraryBuilder().add_object_img(code.code).add_jit_library("numba")
        if code.parallel:
            builder.add_jit_library(self._threading())
        builder.add_current_process().export_symbol(code.wrapper)
        for symbol, _ in code.environments:
            builder.export_symbol(symbol)
        library = builder.link(self._engine, f"{code.name} {next(self._number)}")
        environments = []
        for symbol, constants in code.environments:
            environment = self._dynfunc.Environment(function.__globals__)
            environment.consts.extend(map(np.dtype, constants))
            ctypes.c_void_p.from_address(library[symbol]).value = id(environment)
            environments.append(environment)
        wrapper = library[code.wrapper]
        library.detach()  # the code stays in memory as long as the process
        called: Callable[..., Any] = self._dynfunc.make_function(
            sys.modules.get(function.__module__), code.name, "", wrapper, environments[0], environments
        )
        return called
