"""Compiler of kernels, from Python functions to object files that need neither numba nor Python.

numba translates a kernel and a C function around it (`numba.cfunc`) to LLVM's language, and LLVM translates that to the
processor's. Of numba's undocumented interfaces, this module uses the options `no_cfunc_wrapper` and
`no_cpython_wrapper`, the flag `noalias`, and the layout of the header of an array's memory (`RUNTIME`).
"""

from __future__ import annotations

import gc
import re
from collections.abc import Mapping
from types import FunctionType
from typing import Any

import numba
from llvmlite import binding, ir
from numba import carray, types
from numba.core import cgutils
from numba.core.compiler import Compiler
from numba.extending import intrinsic

from .machine_code import level

#: Functions that replace numba's and Python's in machine code. They allocate by `malloc`. An error in a kernel, such as
#: a failed allocation, ends in `PyErr_WriteUnraisable`, and the C function then returns the value of @failure.
RUNTIME = """
@failure = global i64 0

declare ptr @malloc(i64)
declare void @free(ptr)

; The header has 48 bytes: count of references, destructor and its data, address of the data, size, allocator.
define ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
  %alignment = zext i32 %align to i64
  %room = add i64 %alignment, 48
  %total = add i64 %size, %room
  %info = call ptr @malloc(i64 %total)
  %failed = icmp eq ptr %info, null
  br i1 %failed, label %none, label %some
none:
  store i64 1, ptr @failure
  ret ptr null
some:
  call void @llvm.memset.p0.i64(ptr %info, i8 0, i64 48, i1 false)
  store i64 1, ptr %info
  %start = ptrtoint ptr %info to i64
  %end = add i64 %start, %room
  %over = urem i64 %end, %alignment
  %data = sub i64 %end, %over
  %pointer = inttoptr i64 %data to ptr
  %place = getelementptr i8, ptr %info, i64 24
  store ptr %pointer, ptr %place
  %length = getelementptr i8, ptr %info, i64 32
  store i64 %size, ptr %length
  ret ptr %info
}
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)

; Of lists, whose elements here are numbers, without a destructor.
define ptr @NRT_MemInfo_new_varsize_dtor(i64 %size, ptr %destructor) {
  %info = call ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 16)
  ret ptr %info
}

; Of C-contiguous arrays: the strides of another shape.
define i32 @numba_attempt_nocopy_reshape(i64 %axes, ptr %shape, ptr %strides, i64 %count, ptr %new, ptr %out, i64 %size,
    i32 %fortran) {
  br label %next
next:
  %left = phi i64 [%count, %0], [%axis, %more]
  %stride = phi i64 [%size, %0], [%larger, %more]
  %done = icmp eq i64 %left, 0
  br i1 %done, label %end, label %more
more:
  %axis = sub i64 %left, 1
  %place = getelementptr i64, ptr %out, i64 %axis
  store i64 %stride, ptr %place
  %from = getelementptr i64, ptr %new, i64 %axis
  %length = load i64, ptr %from
  %larger = mul i64 %stride, %length
  br label %next
end:
  ret i32 1
}

define void @NRT_MemInfo_call_dtor(ptr %info) {
  call void @free(ptr %info)
  ret void
}
define void @NRT_Free(ptr %memory) {
  call void @free(ptr %memory)
  ret void
}
define void @PyErr_WriteUnraisable(ptr %object) {
  %before = cmpxchg ptr @failure, i64 0, i64 2 monotonic monotonic
  ret void
}
define void @numba_gil_ensure(ptr %state) {
  ret void
}
define void @numba_gil_release(ptr %state) {
  ret void
}
define void @PyErr_Clear() {
  ret void
}
define void @PyErr_SetNone(ptr %kind) {
  ret void
}
define void @PyErr_SetString(ptr %kind, ptr %text) {
  ret void
}
define void @Py_DecRef(ptr %object) {
  ret void
}
define void @numba_do_raise(ptr %object) {
  ret void
}
define ptr @PyBytes_FromStringAndSize(ptr %text, i64 %size) {
  ret ptr null
}
define ptr @PyUnicode_FromString(ptr %text) {
  ret ptr null
}
define ptr @numba_runtime_build_excinfo_struct(ptr %a, ptr %b) {
  ret ptr null
}
define ptr @numba_unpickle(ptr %a, i32 %b, ptr %c) {
  ret ptr null
}
"""

#: Functions of C that machine code may call; every process has them.
LIBRARY = re.compile("malloc|free|mem(cpy|set|move)|(acos|atan2|ceil|cos|exp|floor|fmod|log|log2|pow|sin|sqrt)f?")


def decorated(function: FunctionType, options: Mapping[str, Any], *, is_apart: bool) -> Any:
    """Return numba's dispatcher of a function, for other functions that numba compiles.

    Args:
        options: keyword arguments of `numba.njit`.
        is_apart: its arrays do not overlap.
    """
    decorate: Any = numba.njit(
        error_model="numpy",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
        pipeline_class=_ApartCompiler if is_apart else Compiler,
        **options,
    )
    return decorate(function)


class _ApartCompiler(Compiler):
    """Compiles functions whose arrays do not overlap, which LLVM then need not test before it vectorizes loops."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines."""
        self.state.flags.noalias = True
        return super().define_pipelines()


class _Entry:
    """Source of the C function around a kernel, which makes arrays of addresses and lengths.

    As a part of it, the kernel is optimized a second time. That makes loops of ranges fast: LLVM optimizes a function,
    and then numba removes the counts of references to arrays, which keep loops from being vectorized.
    """

    def __init__(self) -> None:
        self.names, self.types = list[str](), list[Any]()
        self.namespace = dict[str, Any](carray=carray)

    def parameter(self, kind: Any) -> str:
        """Add a parameter of one of numba's types, and return its name."""
        self.names.append(f"p{len(self.names)}")
        self.types.append(kind)
        return self.names[-1]

    def argument(self, declared: Any) -> str:
        """Add the parameters of an argument, and return the expression for it."""
        declared = getattr(declared, "declared", declared)  # of `jit.out`
        if hasattr(declared, "kernel_types"):
            self.namespace[declared.__name__] = declared
            return f"{declared.__name__}({', '.join(map(self.argument, declared.kernel_types))})"
        scalar = numba.from_dtype(declared.dtype)
        if not declared.axes:
            return f"({self.parameter(types.uint8)} != 0)" if scalar == types.boolean else self.parameter(scalar)
        data = self.parameter(types.CPointer(scalar))
        shape = "".join(f"{self.parameter(types.int64)}, " for _ in range(declared.axes))
        return f"carray({data}, ({shape}))"


def object_file(inner: Any, declared: Any, returns: Any, *, ranges: bool, symbol: str) -> bytes:
    """Compile a kernel to an object file with one function: `int64_t symbol(...)`, which returns 0 if it succeeded.

    Its parameters are those of the kernel: numbers by value; arrays by the address of the first element and the length
    of each axis; NamedTuples by their fields; last, addresses for the numbers that the kernel returns.

    Args:
        inner: `decorated` kernel.
        declared: types of the arguments.
        returns: types of the numbers that it returns.
        ranges: the kernel takes the first row of a range before its arguments.
    """
    entry = _Entry()
    arguments = [entry.parameter(types.int64)] if ranges else []
    arguments += map(entry.argument, declared)
    results = [f"carray({entry.parameter(types.CPointer(numba.from_dtype(each.dtype)))}, (1,))" for each in returns]
    lines = [f"result = inner({', '.join(arguments)})"]
    lines += [f"{array}[0] = result{f'[{n}]' if len(returns) > 1 else ''}" for n, array in enumerate(results)]
    entry.namespace["inner"] = inner
    exec(f"def entry({', '.join(entry.names)}):\n    " + "\n    ".join(lines), entry.namespace)
    collects = gc.isenabled()
    gc.disable()  # among a compiler's millions of objects, looking for garbage takes a tenth of the time
    try:
        function = numba.cfunc(types.void(*entry.types), error_model="numpy")(entry.namespace["entry"])
        return _assembled(function.inspect_llvm(), function.native_name, symbol)
    finally:
        if collects:
            gc.enable()


def _assembled(language: str, name: str, symbol: str) -> bytes:
    """Return the object file of a module in LLVM's language, with the function of that name as `symbol`."""
    module = binding.parse_assembly(language)
    inner = module.get_function(name)
    parameters = [f"{each.type} %p{n}" for n, each in enumerate(inner.arguments)]
    kinds = [each.name for each in module.global_variables if each.name.startswith("PyExc_")]  # of exceptions
    module.link_in(
        binding.parse_assembly(f"""{RUNTIME}
            {" ".join(f"@{kind} = global i8 0" for kind in kinds)}
            declare void @"{name}"({", ".join(parameters)})
            define i64 @"{symbol}"({", ".join(parameters)}) {{
              call void @"{name}"({", ".join(parameters)})
              %result = atomicrmw xchg ptr @failure, i64 0 monotonic
              ret i64 %result
            }}
        """)
    )
    for each in (*module.functions, *module.global_variables):
        if each.is_declaration:
            if not (each.name.startswith("llvm.") or LIBRARY.fullmatch(each.name)):
                raise NotImplementedError(f"{symbol} calls {each.name}, which needs Python")
        elif each.name != symbol:
            each.linkage = "internal"  # names are unique in one process of numba only
    machine = binding.Target.from_triple(module.triple).create_target_machine(
        cpu=level(), opt=3, reloc="pic", codemodel="small"
    )
    content: bytes = machine.emit_object(module)
    return content


def _lower_prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Return the type of `jit.prefetch`, and the function that generates its machine code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = context.make_array(signature.args[0])(context, builder, arguments[0])
        shape, strides = cgutils.unpack_tuple(builder, row.shape), cgutils.unpack_tuple(builder, row.strides)
        place = cgutils.get_item_pointer2(context, builder, row.data, shape, strides, "C", [arguments[1]])
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        read, all_levels, data = word(0), word(3), word(1)
        builder.call(fetch, [builder.bitcast(place, byte), read, all_levels, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


#: `jit.prefetch` in machine code.
prefetch: Any = intrinsic(_lower_prefetch)
