"""The cache of compiled kernels, which survives damage, full disks and races between processes."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import platform
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, compiler
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

from . import atomic
from .errors import out_of_memory
from .kernel_sources import digest_of, sources_of

#: Suffix of the files of compiled kernels.
SUFFIX = ".kernel"

#: Bytes of the checksum at the start of a file. 16 make an accidental match impossible in practice.
CHECKSUM = 16

#: Called with a one-line message if the cache cannot be used; see `jit.listen`.
Trouble = Callable[[str], None]


class KernelCache(caching._Cache):
    """The cache of one function's compiled code, in place of numba's own.

    numba's cache trusts its files: an empty one ends in an `EOFError`, a flipped bit in an error of LLVM or a crash, a
    full disk in an `OSError`; and two processes that compile two signatures of one function at the same time can each
    take the other's file for its own. Besides, it looks at the file of a kernel only, not at the kernels and constants
    that it uses. Here each signature has its own file, named by all that its code depends on. A file is written
    atomically and begins with a checksum. If a file is damaged, the kernel is compiled again; if the folder cannot be
    used, the kernel is compiled but not stored.

    Args:
        function: the Python function.
        folder: folder of the files.
        trouble: called with a one-line message if the cache cannot be used.
    """

    def __init__(self, function: Callable[..., Any], folder: Path, trouble: Trouble) -> None:
        self._folder, self._trouble = folder, trouble
        self._stem, self._sources = stem_of(function), sources_of(Path(function.__code__.co_filename))
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
        """Loads the compiled function; returns None if it has to be compiled."""
        target_context.refresh()
        path = self._path(signature, target_context.codegen())
        try:
            content = path.read_bytes() if self._enabled and path.is_file() else None  # not a pipe or a device
        except OSError:
            return None
        if content is None:
            return None
        if is_whole(content):
            try:
                return compiler.CompileResult._rebuild(target_context, *pickle.loads(content[CHECKSUM:]))
            except Exception as error:
                # An undamaged file may still be unusable, for example if it refers to types of another numpy.
                if out_of_memory(error):
                    raise
        self._trouble(f"compiled code in {self._folder} is damaged; the damaged kernels are compiled again")
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Writes a compiled function to the cache, if it can be cached."""
        if not self._enabled or compiled.lifted or compiled.library.has_dynamic_globals:
            return
        payload = dumps(compiled._reduce())
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            atomic.write(self._path(signature, compiled.codegen), [_checksum(payload), payload], overwrite=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            self._trouble(f"cannot cache compiled code in {self._folder} ({reason}); it is compiled in every run")

    def _path(self, signature: Any, codegen: Any) -> Path:
        start = _start(self._stem, self._sources, codegen)
        return self._folder / f"{start}-{_digest(str(signature))}{SUFFIX}"


def pattern_of(stem: str, source: Path) -> str:
    """Glob pattern of the files of a kernel that this process can load: those for its processor, numba and Python.

    Args:
        stem: "module.function".
        source: the module.
    """
    return f"{_start(stem, sources_of(source), cpu_target.target_context.codegen())}-*{SUFFIX}"


def _start(stem: str, sources: Collection[Path], codegen: Any) -> str:
    return f"{stem}-{digest_of(sources)}-{_digest(*_machine(codegen))}"


def _machine(codegen: Any) -> tuple[Any, ...]:
    return codegen.magic_tuple(), numba.__version__, platform.python_version()


def _digest(*depends_on: Any) -> str:
    return hashlib.blake2b(repr(depends_on).encode(), digest_size=8).hexdigest()


def stem_of(function: Callable[..., Any]) -> str:
    """The start of the names of a function's files: "module.function", without the package."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def is_whole(content: bytes) -> bool:
    """Whether the content of a file matches its checksum."""
    return content[:CHECKSUM] == _checksum(content[CHECKSUM:])


def _checksum(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=CHECKSUM).digest()
