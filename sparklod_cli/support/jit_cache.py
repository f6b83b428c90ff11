"""Where compiled kernels are kept: a cache that outlives damage, full disks and processes that race for it."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, compiler
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

from . import atomic
from .errors import out_of_memory

#: Ends the name of every file of a compiled kernel.
SUFFIX = ".kernel"

#: Bytes of the checksum that a file begins with.
CHECKSUM = 16

#: Is told in a line of whatever keeps the cache from working; see `jit.listen`.
Trouble = Callable[[str], None]


class KernelCache(caching._Cache):
    """What numba asks for the compiled code of one function, instead of its own cache.

    numba's trusts what it finds: an empty file ends as an `EOFError`, a flipped bit as an error of LLVM or a crash, a
    full disk as an `OSError`; and two processes that compile two signatures of one function at the same time can each
    take the other's file for its own. Here each signature has a file of its own, named by all that its code depends on
    but the source, which names the folder (`jit.CACHE_FOLDER`). It appears whole or not at all and begins with a
    checksum. Whatever is wrong with a file, the kernel is compiled again; whatever is wrong with the folder, the
    kernel is compiled and not kept.

    Args:
        function: that is compiled.
        folder: for the files.
        trouble: is told what is wrong.
    """

    def __init__(self, function: Callable[..., Any], folder: Path, trouble: Trouble) -> None:
        self._folder, self._trouble = folder, trouble
        self._stem = stem_of(function)
        self._enabled = True

    @property
    def cache_path(self) -> str:
        return str(self._folder)

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        for path in self._folder.glob(f"{self._stem}-*{SUFFIX}"):
            path.unlink(missing_ok=True)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The compiled function, or None where it has to be compiled."""
        target_context.refresh()
        path = self._path(signature, target_context.codegen())
        try:
            content = path.read_bytes() if self._enabled and path.is_file() else None  # no pipe, no device
        except OSError:
            return None
        if content is None:
            return None
        if is_whole(content):
            try:
                return compiler.CompileResult._rebuild(target_context, *pickle.loads(content[CHECKSUM:]))
            except Exception as error:
                # What has been kept as it was written can still be of no use, such as types of another numpy.
                if out_of_memory(error):
                    raise
        self._trouble(f"compiled code in {self._folder} is damaged; what is damaged is compiled again")
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keeps a compiled function, if that can be."""
        if not self._enabled or compiled.lifted or compiled.library.has_dynamic_globals:
            return
        payload = dumps(compiled._reduce())
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            atomic.write(self._path(signature, compiled.codegen), [_checksum(payload), payload], overwrite=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            self._trouble(f"compiled code cannot be kept in {self._folder} ({reason}), so it is compiled in every run")

    def _path(self, signature: Any, codegen: Any) -> Path:
        return self._folder / f"{self._stem}-{_digest(*_machine(codegen))}-{_digest(str(signature))}{SUFFIX}"


def pattern_of(stem: str) -> str:
    """What the files of a kernel match that this process can use, on this processor, by this numba and Python."""
    return f"{stem}-{_digest(*_machine(cpu_target.target_context.codegen()))}-*{SUFFIX}"


def _machine(codegen: Any) -> tuple[Any, ...]:
    return codegen.magic_tuple(), numba.__version__, platform.python_version()


def _digest(*depends_on: Any) -> str:
    return hashlib.blake2b(repr(depends_on).encode(), digest_size=8).hexdigest()


def stem_of(function: Callable[..., Any]) -> str:
    """What the names of a function's files begin with: module of the package, a point, and its name."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def is_whole(content: bytes) -> bool:
    """Whether a file has what was written to it."""
    return content[:CHECKSUM] == _checksum(content[CHECKSUM:])


def _checksum(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=CHECKSUM).digest()
