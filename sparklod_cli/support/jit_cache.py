"""The cache of compiled kernels, which survives damage, full disks and races between processes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from . import atomic
from .kernel_sources import digest_of, sources_of

#: Suffix of the files with machine code, which `jit_link` loads without numba.
CODE = ".code"

#: Suffix of the files that numba loads, where machine code is not linked.
SUFFIX = ".kernel"

#: Suffix of the files with what numba needs of a kernel to compile its callers.
INNER = ".inner"

#: Bytes of the checksum at the start of a file. 16 make an accidental match impossible in practice.
CHECKSUM = 16

#: Called with a one-line message if the cache cannot be used; see `jit.listen`.
Trouble = Callable[[str], None]

#: Variables for numba that do not change the machine code. All others count, although few of them change it.
NEUTRAL = (
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "NUMBA_NUM_THREADS",
    "NUMBA_THREADING_LAYER",
    "NUMBA_THREADING_LAYER_PRIORITY",
)

#: File of settings that numba reads in the working directory.
SETTINGS = Path(".numba_config.yaml")


def start_of(function: Callable[..., Any]) -> str:
    """The start of the names of a function's files, which stands for its sources and for this machine."""
    source = Path(function.__code__.co_filename)
    return f"{stem_of(function)}-{digest_of(sources_of(source))}-{_machine()}"


@functools.cache
def _machine() -> str:
    """A digest of all that machine code depends on besides the sources, found without loading numba."""
    binding = llvm()
    try:
        features = binding.get_host_cpu_features().flatten()
    except RuntimeError:  # LLVM does not know them, and numba does not use them
        features = ""
    variables = {name: value for name, value in os.environ.items() if name.startswith("NUMBA_") and name not in NEUTRAL}
    settings = SETTINGS.read_bytes() if SETTINGS.is_file() else b""
    host = binding.get_process_triple(), binding.get_host_cpu_name(), features
    return digest(host, sorted(variables.items()), settings, numba_version(), sys.version)


def llvm() -> Any:
    """llvmlite's module of LLVM.

    Raises:
        MemoryError: LLVM does not fit into memory.
        ImportError, OSError: it cannot be loaded.
    """
    try:
        from llvmlite import binding
    except OSError as error:
        reasons = f"{error} {error.__cause__} {error.__context__}"
        if "failed to map segment" in reasons or "annot allocate memory" in reasons:
            raise MemoryError from error
        raise
    return binding


@functools.cache
def numba_folder() -> Path | None:
    """Where numba is installed; None if it is not, or not in a folder."""
    try:
        spec = importlib.util.find_spec("numba")
    except ValueError:  # loaded in an unusual way
        return None
    return Path(spec.submodule_search_locations[0]) if spec and spec.submodule_search_locations else None


def numba_version() -> bytes:
    """What tells the installed version of numba from others: the content of its module of the version."""
    folder = numba_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            return (folder / "_version.py").read_bytes()
    from importlib import metadata  # takes long to load

    return metadata.version("numba").encode()


def digest(*depends_on: Any) -> str:
    """A short digest of some values, made of their representations."""
    return hashlib.blake2b(repr(depends_on).encode(), digest_size=8).hexdigest()


def stem_of(function: Callable[..., Any]) -> str:
    """The start of the names of a function's files: "module.function", without the package."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def read(path: Path) -> bytes | None:
    """The content of a file of the cache; None if there is none that can be read.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        content = path.read_bytes() if path.is_file() else None  # not a pipe or a device
    except OSError:
        return None
    if content is None:
        return None
    if not is_whole(content):
        raise ValueError("the checksum does not match")
    return content[CHECKSUM:]


def discard(path: Path, trouble: Trouble) -> None:
    """Removes a damaged file."""
    trouble(f"compiled code in {path.parent} is damaged; the damaged kernels are compiled again")
    with contextlib.suppress(OSError):
        path.unlink()


def write(path: Path, pieces: Sequence[bytes], trouble: Trouble) -> None:
    """Writes a file atomically."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write(path, [_checksum(*pieces), *pieces], overwrite=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        trouble(f"cannot cache compiled code in {path.parent} ({reason}); it is compiled in every run")


def is_whole(content: bytes) -> bool:
    """Whether the content of a file matches its checksum."""
    return content[:CHECKSUM] == _checksum(content[CHECKSUM:])


def _checksum(*pieces: bytes) -> bytes:
    checksum = hashlib.blake2b(digest_size=CHECKSUM)
    for piece in pieces:
        checksum.update(piece)
    return checksum.digest()
