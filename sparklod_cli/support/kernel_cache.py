"""The cache of compiled kernels, which survives damage, full disks and races between processes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1]

#: Suffix of the files, each of which has one kernel, compiled for arguments of some types.
SUFFIX = ".kernel"

#: Bytes of the checksum at the start of a file. 16 make an accidental match impossible in practice.
CHECKSUM = 16

#: Called with a one-line message if the cache cannot be used; see `jit.listen`.
Trouble = Callable[[str], None]

#: Variables for numba that do not change the machine code. All others count, although few of them change it.
NEUTRAL = (
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "NUMBA_ENABLE_CUDASIM",
    "NUMBA_NUM_THREADS",
    "NUMBA_THREADING_LAYER",
    "NUMBA_THREADING_LAYER_PRIORITY",
)

#: File of settings that numba reads in the working directory.
SETTINGS = Path(".numba_config.yaml")

#: An import of another module of the package at the top level of a module: dots, module, names.
_IMPORT = re.compile(rb"^from (\.+)([\w.]*) import (\([^)]*\)|[^\n#]*)", re.MULTILINE)


@functools.cache
def sources_of(path: Path) -> frozenset[Path]:
    """Return the sources that the kernels of a module depend on: its own, and those of all that it imports."""
    sources: set[Path] = set()
    left = {path}
    while left:
        sources |= left
        left = {imported for each in left for imported in _imports(each)} - sources
    return frozenset(sources)


@functools.cache
def _imports(path: Path) -> frozenset[Path]:
    """Return the sources of what a module of the package imports from it."""
    sources = set()
    for dots, module, names in _IMPORT.findall(_content(path)):
        base = path.parents[len(dots) - 1].joinpath(*module.decode().split(".") if module else ())
        sources.add(base.with_suffix(".py"))
        sources |= {base / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)}
    return frozenset(path for path in sources if path.is_file())


@functools.cache
def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def digest_of(paths: Iterable[Path]) -> str:
    """Return a digest of the content of some sources."""
    return hashlib.sha256(b"".join(_content(path) for path in sorted(paths))).hexdigest()[:16]


def cache_folder(source: Path) -> Path | None:
    """Create the folder for compiled code and return it; None if none is writable.

    It is in NUMBA_CACHE_DIR or, where that is not set, in the package, or in the user's cache directory.

    Args:
        source: module that compiles. The name of the folder is a digest of it and of all that it imports.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [PACKAGE / "__pycache__"]
    if not given:
        with contextlib.suppress(RuntimeError):  # no home directory
            places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sparklod")
    for place in places:
        folder = place / f"kernels-{digest_of(sources_of(source))}"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder
    return None


def stem_of(function: Callable[..., Any]) -> str:
    """Return the start of the names of a function's files: "module.function", without the package."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def start_of(function: Callable[..., Any]) -> str:
    """Return the start of the names of a function's files, which stands for its sources and for this machine."""
    source = Path(function.__code__.co_filename)
    return f"{stem_of(function)}-{digest_of(sources_of(source))}-{_machine()}"


@functools.cache
def _machine() -> str:
    """Return a digest of all that machine code depends on besides the sources."""
    import numba
    from llvmlite import binding

    # A processor that is named replaces the one of this machine, as in numba's code generator, so that an image can be
    # built on one machine and run on others: NUMBA_CPU_NAME=x86-64-v3 with NUMBA_CPU_FEATURES empty.
    name = numba.config.CPU_NAME or binding.get_host_cpu_name()
    features = numba.config.CPU_FEATURES
    if features is None:
        try:
            features = binding.get_host_cpu_features().flatten()
        except RuntimeError:  # LLVM does not know them, and numba does not use them
            features = ""
    variables = {key: value for key, value in os.environ.items() if key.startswith("NUMBA_") and key not in NEUTRAL}
    settings = SETTINGS.read_bytes() if SETTINGS.is_file() else b""
    host = binding.get_process_triple(), name, features
    return _digest(host, sorted(variables.items()), settings, numba.__version__, sys.version)


def _digest(*values: Any) -> str:
    return hashlib.blake2b(repr(values).encode(), digest_size=8).hexdigest()


def is_whole(content: bytes) -> bool:
    """Return True if the content of a file matches its checksum."""
    return content[:CHECKSUM] == _checksum(content[CHECKSUM:])


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=CHECKSUM).digest()


class KernelCache:
    """The files of what numba makes of one function, for numba's dispatcher in place of its own cache.

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
        self._function, self._folder, self._trouble = function, folder, trouble
        self.cache_path = str(folder)

    def path(self, signature: Any) -> Path:
        """Return the file for a signature, which is a tuple of numba's types."""
        return self._folder / f"{start_of(self._function)}-{_digest(str(signature))}{SUFFIX}"

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Load the compiled function; return None if it has to be compiled."""
        from numba.core.compiler import CompileResult

        from .errors import out_of_memory  # here, so that no kernel depends on its source

        path = self.path(signature)
        try:
            content = path.read_bytes() if path.is_file() else None  # not a pipe or a device
        except OSError:
            content = None
        if content is None:
            return None
        target_context.refresh()
        try:
            if is_whole(content):
                return CompileResult._rebuild(target_context, *pickle.loads(content[CHECKSUM:]))
        except Exception as error:
            # An undamaged file may still be unusable, for example if it refers to types of another numpy.
            if out_of_memory(error):
                raise
        self._trouble(f"compiled code in {path.parent} is damaged; the damaged kernels are compiled again")
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write a compiled function to its file, if it can be cached."""
        if compiled.lifted or compiled.library.has_dynamic_globals:
            return
        from numba.core.serialize import dumps

        from . import atomic  # here, so that no kernel depends on its source

        path, content = self.path(signature), dumps(compiled._reduce())
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write(path, [_checksum(content), content], overwrite=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            self._trouble(f"cannot cache compiled code in {path.parent} ({reason}); it is compiled in every run")

    def is_cached(self, signature: Any) -> bool:
        """Return True if there is a whole file for a signature."""
        with contextlib.suppress(OSError):
            path = self.path(signature)
            return path.is_file() and is_whole(path.read_bytes())
        return False
