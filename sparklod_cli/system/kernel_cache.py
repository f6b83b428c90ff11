"""The cache of compiled kernels, which survives damage, full disks and races between processes.

Its files are pickles: the writer of a file runs code as its reader. `is_trusted` decides which files are read.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import re
import stat
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1]

#: Suffix of the files, each of which has one kernel, compiled for arguments of some types.
SUFFIX = ".kernel"

#: Bytes of the checksum at the start of a file. 16 make an accidental match impossible in practice.
CHECKSUM = 16

#: Called with a one-line message if the cache cannot be used.
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

#: Permissions of new folders: others can read what the superuser compiled for them, and would not trust anybody else.
SHARED, OWN = 0o755, 0o700

#: Permissions to write that users have who are not the owner.
OTHERS = 0o022

#: An import of another module of the package at the top level of a module: dots, module, names.
_IMPORT = re.compile(rb"^from (\.+)([\w.]*) import (\([^)]*\)|[^\n#]*)", re.MULTILINE)


def sources_of(*paths: Path) -> Mapping[Path, bytes]:
    """Return the sources that the kernels of modules depend on: their own, and those of all that they import."""
    sources, left = dict[Path, bytes](), [*paths]
    while left:
        path = left.pop()
        if path in sources:
            continue
        sources[path] = content = path.read_bytes() if path.is_file() else b""
        for dots, module, names in _IMPORT.findall(content):
            base = path.parents[len(dots) - 1].joinpath(*module.decode().split(".") if module else ())
            modules = base.with_suffix(".py"), *(base / f"{name.decode()}.py" for name in re.findall(rb"\w+", names))
            left += [imported for imported in modules if imported.is_file()]
    return sources


@functools.cache
def digest_of(*paths: Path) -> str:
    """Return a digest of the `sources_of` modules."""
    return hashlib.sha256(b"".join(content for _, content in sorted(sources_of(*paths).items()))).hexdigest()[:16]


def cache_folders(*sources: Path) -> tuple[Path | None, tuple[Path, ...], tuple[str, ...]]:
    """Return the folders for compiled code, and create the one for new code.

    They are in NUMBA_CACHE_DIR or, where that is not set, in the package and in the user's cache directory.

    Args:
        sources: modules that compile. The name of the folders is a digest of them and of all that they import.

    Returns:
        the folder where new code is stored, which is read first; None if no folder can be written;
        folders that can be read only, such as those of a read-only image;
        a message for each folder that other users can write, which is not used.
    """
    if not all(source.is_file() for source in sources):
        return None, (), ()  # in a zip: there is no source to make a digest of
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [PACKAGE / "__pycache__"]
    if not given:
        with contextlib.suppress(RuntimeError):  # no home directory
            places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sparklod")
    read, distrusted = list[Path](), list[str]()
    for place in places:
        folder = place / f"kernels-{digest_of(*sources)}"
        with contextlib.suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            is_superuser = hasattr(os, "geteuid") and os.geteuid() == 0
            folder.mkdir(SHARED if is_superuser else OWN, exist_ok=True)
        with contextlib.suppress(OSError):
            if not is_trusted(folder.stat()):
                distrusted.append(_distrusting(folder))
            elif os.access(folder, os.W_OK):
                return folder, tuple(read), tuple(distrusted)
            else:
                read.append(folder)
    return None, tuple(read), tuple(distrusted)


def _distrusting(folder: Path) -> str:
    return (
        f"compiled code in {folder} is not used: another user owns it or can write it; remove it, or set"
        " NUMBA_CACHE_DIR to a folder of your own"
    )


def is_trusted(status: os.stat_result) -> bool:
    """Return True if only this user, the superuser or the owner of the package can have written a file or folder.

    The owner of the package need not be distrusted, as its code runs anyway.
    """
    if not hasattr(os, "geteuid"):  # a system where files have no owners
        return True
    return status.st_uid in (0, os.geteuid(), PACKAGE.stat().st_uid) and not status.st_mode & OTHERS


def stem_of(function: Callable[..., Any]) -> str:
    """Return the start of the names of a function's files: "module.function", without the package."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def start_of(function: Callable[..., Any]) -> str:
    """Return the start of the names of a function's files, which stands for its sources and for this machine."""
    return f"{stem_of(function)}-{digest_of(Path(function.__code__.co_filename))}-{_machine()}"


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
    host = binding.get_process_triple(), name, features
    described = repr((host, sorted(variables.items()), numba.__version__, sys.version))
    return hashlib.blake2b(described.encode(), digest_size=8).hexdigest()


@dataclass(frozen=True)
class KernelCache:
    """The files of what numba makes of one function, for numba's dispatcher in place of its own cache.

    numba's cache trusts its files: an empty one ends in an `EOFError`, a flipped bit in an error of LLVM or a crash, a
    full disk in an `OSError`; and two processes that compile two signatures of one function at the same time can each
    take the other's file for its own. Besides, it looks at the file of a kernel only, not at the kernels and constants
    that it uses. Here each signature has its own file, named by all that its code depends on. A file is written
    atomically and begins with a checksum. If a file is damaged, the kernel is compiled again; if the folder cannot be
    used, the kernel is compiled but not stored.

    Attributes:
        folder: where files are written, and read first; None if no folder can be written.
        read: further folders, which are only read.
        trouble: called with a one-line message if the cache cannot be used.
    """

    function: Callable[..., Any]
    folder: Path | None
    read: Sequence[Path]
    trouble: Trouble

    def name(self, signature: Any) -> str:
        """Return the name of the file for a signature, which is a tuple of numba's types."""
        digest = hashlib.blake2b(repr((str(signature),)).encode(), digest_size=8).hexdigest()
        return f"{start_of(self.function)}-{digest}{SUFFIX}"

    def _found(self, signature: Any) -> tuple[Path, bytes | None] | None:
        """Return the first file for a signature that can be read and trusted, and its content; None if damaged."""
        name = self.name(signature)
        for folder in (*([] if self.folder is None else [self.folder]), *self.read):
            path = folder / name
            with contextlib.suppress(OSError):
                if path.is_file():  # not a pipe or a device
                    with path.open("rb") as file:
                        is_closed = not folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH)
                        if is_closed or is_trusted(os.fstat(file.fileno())):
                            checksum, content = file.read(CHECKSUM), file.read()
                            is_whole = checksum == hashlib.blake2b(content, digest_size=CHECKSUM).digest()
                            return path, content if is_whole else None
                    self.trouble(_distrusting(folder))
        return None

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Load the compiled function; return None if it has to be compiled."""
        from numba.core.compiler import CompileResult

        from .errors import out_of_memory  # here, so that no kernel depends on its source

        found = self._found(signature)
        if found is None:
            return None
        path, content = found
        target_context.refresh()
        try:
            if content is not None:
                return CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception as error:
            # An undamaged file may still be unusable, for example if it refers to types of another numpy.
            if out_of_memory(error):
                raise
        self.trouble(f"compiled code in {path.parent} is damaged; the damaged kernels are compiled again")
        with contextlib.suppress(OSError):
            path.unlink()
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write a compiled function to its file, if it can be cached."""
        if self.folder is None or compiled.lifted or compiled.library.has_dynamic_globals:
            return
        from numba.core.serialize import dumps

        from .output import write_atomically  # here, so that no kernel depends on its source

        path, content = self.folder / self.name(signature), dumps(compiled._reduce())
        try:
            path.parent.mkdir(OWN, parents=True, exist_ok=True)  # another process may have removed it
            checksum = hashlib.blake2b(content, digest_size=CHECKSUM).digest()
            write_atomically(path, [checksum, content], overwrite=True)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            self.trouble(f"cannot cache compiled code in {path.parent} ({reason}); it is compiled in every run")

    def is_cached(self, signature: Any) -> bool:
        """Return True if there is a whole file for a signature."""
        found = self._found(signature)
        return found is not None and found[1] is not None
