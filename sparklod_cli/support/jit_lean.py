"""Has numba do less than usual while it compiles a kernel whose machine code is linked by `jit_link`.

By itself numba makes machine code, a function that Python can call and one that C can call not only of the kernel, but
also of every function in it: of other kernels, of each loop that runs on several threads, and of those by which numba
implements numpy. All of these are put into the kernel as LLVM's bitcode, and nothing calls them by any other way. Here
only bitcode is made of them.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from typing import Any

from llvmlite import binding
from numba import _dynfunc
from numba.core import codegen, cpu, ir, targetconfig
from numba.core.compiler_lock import global_compiler_lock

#: What is in the names of libraries that wrap the optimised body of a parallel loop, twice.
_WRAPPERS = ("_GufuncWrapper", "parallelgufuncwrapper")

#: Types of what instructions of numba's have that holds no variables.
_PLAIN = frozenset({str, int, float, bool, type(None), ir.Loc})


class _Library(codegen.JITCodeLibrary):  # type: ignore[misc]
    """Compiled functions of which machine code is made when it is asked for."""

    def _optimize_functions(self, ll_module: Any) -> None:
        """Optimises the functions of a module one by one, but not those that it merely declares."""
        if not hasattr(codegen, "create_pass_builder"):  # an older numba, which does not take long for this
            super()._optimize_functions(ll_module)
            return
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:
                manager, builder = self._codegen._function_pass_manager()
                manager.run(function, builder)

    def _optimize_final_module(self) -> None:
        """Optimises the module, but not what wraps the body of a parallel loop, which is optimised with its caller."""
        if not any(wrapper in self.name for wrapper in _WRAPPERS):
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        raise NotImplementedError(f"{name} is not in memory")

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        serialized: tuple[str, str, bytes] = self.serialize_using_bitcode()
        return serialized

    @classmethod
    def _unserialize(cls, generator: Any, state: tuple[str, str, Any]) -> _Library:
        name, kind, data = state
        library = cls(generator, name)
        library._final_module = binding.parse_bitcode(data if kind == "bitcode" else data[1])
        library._finalize_final_module()
        return library

    def machine_code(self) -> bytes:
        """The object file."""
        code: bytes = self._codegen._tm.emit_object(self._final_module)
        return code


def _get_executable(_context: Any, library: Any, description: Any, environment: Any) -> Any:
    """Stands for what Python would call."""
    name = description.qualname.rpartition(".")[2]
    return _dynfunc.make_function(description.lookup_module(), name, "", 0, environment, (library,))


def _values(config: targetconfig.TargetConfig) -> dict[str, Any]:
    """All options: what `TargetConfig.values` returns, which numba calls 90,000 times in the compilation of a bake."""
    kind = type(config)
    if kind not in _defaults:
        _defaults[kind] = {name: option.default for name, option in kind.options.items()}
    return _defaults[kind] | config._values


#: The defaults of the options of each class of numba's options.
_defaults: dict[type, dict[str, Any]] = {}


def _rec_list_vars(instruction: Any, value: Any) -> list[Any]:
    """The variables in a value: what numba's function of this name returns, in half the time."""
    if isinstance(value, ir.Var):
        return [value]
    if isinstance(value, ir.Inst):
        return value.list_vars()
    if not isinstance(value, (list, tuple, dict)):
        return []
    found: list[Any] = []
    for item in value.values() if isinstance(value, dict) else value:
        kind = type(item)
        if kind is ir.Var:
            found.append(item)
        elif kind not in _PLAIN:
            found.extend(_rec_list_vars(instruction, item))
    return found


def _nothing(*_arguments: Any) -> None:
    pass


#: What numba does otherwise in `lean`.
_REPLACED = (
    (codegen.JITCPUCodegen, "_library_class", _Library),
    (codegen.JITCPUCodegen, "set_env", _nothing),
    (cpu.CPUContext, "create_cfunc_wrapper", _nothing),
    (cpu.CPUContext, "get_executable", _get_executable),
    (ir.Inst, "_rec_list_vars", _rec_list_vars),
    (targetconfig.TargetConfig, "values", _values),
)


#: How many objects Python makes before it looks for those in cycles that nothing uses any more: by default 700, which
#: takes 3 % of the time of compiling.
_GARBAGE = 20_000


@contextlib.contextmanager
def lean() -> Iterator[None]:
    """Has numba make bitcode only. Other threads that compile wait meanwhile.

    Raises:
        AttributeError: this numba works otherwise.
    """
    with global_compiler_lock:
        usual = [(owner, name, owner.__dict__[name]) for owner, name, _ in _REPLACED]
        first, *later = gc.get_threshold()
        try:
            gc.set_threshold(max(first, _GARBAGE) if first else 0, *later)  # 0 turns it off
            for owner, name, value in _REPLACED:
                setattr(owner, name, value)
            yield
        finally:
            gc.set_threshold(first, *later)
            for owner, name, value in usual:
                setattr(owner, name, value)
