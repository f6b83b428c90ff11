"""Machine code of kernels as files: where they are kept, which of them are trusted, and how they are loaded.

A file is an object file of the platform's linker, whose one function needs neither Python nor numba, or a shared
library of all of them. Loading it runs no code, but calling it does: `is_trusted` decides which files are loaded.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import re
import stat
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1]

#: System and processor, such as "linux-x86_64".
PLATFORM = f"{sys.platform}-{platform.machine()}".lower()

#: Folder of the shared libraries that come with a wheel for one platform, such as "linux-x86_64-x86-64-v3.so".
SHIPPED = PACKAGE / "machine_code"

#: Suffix of the files in a cache, each of which has one kernel, compiled for arguments of some types.
SUFFIX = ".o"

#: Bytes of the checksum at the start of a file in a cache. 16 make an accidental match impossible in practice.
CHECKSUM = 16

#: Called with a one-line message if the cache cannot be used.
Trouble = Callable[[str], None]

#: Levels of x86-64 processors, the best first, and the flags that Linux lists for the instructions of each.
LEVELS = {
    "x86-64-v3": frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"]),
    "x86-64-v2": frozenset(["cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"]),
    "x86-64": frozenset[str](),
}

#: Names that LLVM has for flags of Linux.
_LLVM_FLAGS = {"abm": "lzcnt", "bmi1": "bmi", "lahf_lm": "sahf", "pni": "sse3", "sse4_1": "sse4.1", "sse4_2": "sse4.2"}

#: Variables for numba that do not change the machine code. All others count, although few of them change it.
NEUTRAL = (
    "NUMBA_CACHE_DIR",
    "NUMBA_CPU_FEATURES",
    "NUMBA_CPU_NAME",
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

#: Modules that kernels import, directly or not, but that have no influence on machine code.
_WITHOUT_INFLUENCE = {PACKAGE / "system" / name for name in ("errors.py", "machine_code.py", "threads.py")}

#: The module that machine code depends on although no kernel imports it.
_COMPILER = Path(__file__).with_name("compiler.py")

#: An import of another module of the package at the top level of a module: dots, module, names.
_IMPORT = re.compile(rb"^from (\.+)([\w.]*) import (\([^)]*\)|[^\n#]*)", re.MULTILINE)


# --- Names ------------------------------------------------------------------------------------------------------------


@functools.cache
def _source(path: Path) -> bytes | None:
    """Read a module, which may be in a zip; None for a missing module, and for one without source."""
    loader: Any = sys.modules[__name__].__spec__.loader  # type: ignore[union-attr]
    try:
        content: bytes = loader.get_data(str(path))
    except (OSError, AttributeError):
        return None
    return content


@functools.cache
def _imported_by(path: Path) -> tuple[Path, ...]:
    """Return the paths of modules of the package that a module imports."""
    modules = list[Path]()
    for dots, module, names in _IMPORT.findall(_source(path) or b""):
        base = path.parents[len(dots) - 1].joinpath(*module.decode().split(".") if module else ())
        whole = base.with_suffix(".py")
        if _source(whole) is not None:
            modules.append(whole)
        else:  # a package, of which names can be modules
            modules += [base / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)]
    return tuple(modules)


def sources_of(*paths: Path) -> Mapping[Path, bytes]:
    """Return the sources that the kernels of modules depend on: their own, and those of all that they import."""
    sources, left = dict[Path, bytes](), [*paths]
    while left:
        path = left.pop()
        content = None if path in sources or path in _WITHOUT_INFLUENCE else _source(path)
        if content is not None:
            sources[path] = content
            left += _imported_by(path)
    return sources


@functools.cache
def digest_of(path: Path) -> str:
    """Return a digest of the sources that the kernels of a module depend on; "" in a program without sources."""
    sources = sources_of(path, _COMPILER)
    if path not in sources:
        return ""
    return hashlib.sha256(b"".join(content for _, content in sorted(sources.items()))).hexdigest()[:16]


def needed_by(name: str) -> frozenset[str]:
    """Return the flags of a level and of the levels below it."""
    names = [*LEVELS]
    return frozenset[str]().union(*(LEVELS[below] for below in names[names.index(name) :]))


@functools.cache
def level() -> str:
    """Return the kind of processor that machine code is compiled for, as LLVM names it: "x86-64-v3" or "generic".

    NUMBA_CPU_NAME can name a lower level than that of this machine.
    """
    if not PLATFORM.endswith(("-x86_64", "-amd64")):
        return "generic"
    try:
        match = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        flags = set(match[1].split()) if match else set()
    except OSError:
        from llvmlite import binding

        features = binding.get_host_cpu_features()
        flags = {flag for needed in LEVELS.values() for flag in needed if features.get(_LLVM_FLAGS.get(flag, flag))}
    levels = [name for name in LEVELS if flags >= needed_by(name)]
    named = os.environ.get("NUMBA_CPU_NAME")
    return named if named in levels else levels[0]


def stem_of(function: Callable[..., Any]) -> str:
    """Return "module.function", without the package."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def name_of(function: Callable[..., Any], number: int) -> str:
    """Return the name of the machine code of a kernel, which changes with all that the code depends on.

    Args:
        number: that of the signature, of those that the kernel declares.
    """
    digest = digest_of(Path(function.__code__.co_filename))
    variables = sorted((key, os.environ[key]) for key in os.environ if key.startswith("NUMBA_") and key not in NEUTRAL)
    special = "-" + hashlib.sha256(repr(variables).encode()).hexdigest()[:8] if variables else ""
    return f"{stem_of(function)}-{number}-{digest}{special}"


# --- Folders ----------------------------------------------------------------------------------------------------------


def cache_folders() -> tuple[Path | None, tuple[Path, ...], tuple[str, ...]]:
    """Return the folders for compiled code, and create the one for new code.

    They are in NUMBA_CACHE_DIR or, where that is not set, in the package and in the user's cache directory.

    Returns:
        the folder where new code is stored, which is read first; None if no folder can be written;
        folders that can be read only, such as those of a read-only image;
        a message for each folder that other users can write, which is not used.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [PACKAGE / "__pycache__"]
    if not given:
        with contextlib.suppress(RuntimeError):  # no home directory
            places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sparklod")
    read, distrusted = list[Path](), list[str]()
    for place in places:
        folder = place / f"kernels-{PLATFORM}-{level()}"
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


def read(name: str, folders: Sequence[Path], trouble: Trouble) -> bytes | None:
    """Return the object file of that name from the first folder that has it; None if it is missing or damaged."""
    for folder in folders:
        path = folder / f"{name}{SUFFIX}"
        with contextlib.suppress(OSError):
            if not path.is_file():  # or a pipe or a device
                continue
            with path.open("rb") as file:
                is_closed = not folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH)
                if not (is_closed or is_trusted(os.fstat(file.fileno()))):
                    trouble(_distrusting(folder))
                    continue
                checksum, content = file.read(CHECKSUM), file.read()
            if checksum == hashlib.blake2b(content, digest_size=CHECKSUM).digest():
                return content
            trouble(f"compiled code in {folder} is damaged; the damaged kernels are compiled again")
            path.unlink()
            return None
    return None


def write(name: str, content: bytes, folder: Path, trouble: Trouble) -> None:
    """Write an object file to the cache, atomically."""
    from .output import write_atomically  # here, as most runs write none

    try:
        folder.mkdir(OWN, parents=True, exist_ok=True)  # another process may have removed it
        checksum = hashlib.blake2b(content, digest_size=CHECKSUM).digest()
        write_atomically(folder / f"{name}{SUFFIX}", [checksum, content], overwrite=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        trouble(f"cannot cache compiled code in {folder} ({reason}); it is compiled in every run")


# --- Loading ----------------------------------------------------------------------------------------------------------


@functools.cache
def shipped_library() -> ctypes.CDLL | None:
    """Load the shared library of the package for this kind of processor; None if the package has none."""
    path = SHIPPED / f"{PLATFORM}-{level()}.so"
    try:
        return ctypes.CDLL(str(path)) if path.is_file() else None
    except OSError:  # made for another system
        return None


def shipped(name: str) -> int | None:
    """Return the address of a kernel in the shared library of the package; None if the library lacks it."""
    library = shipped_library()
    if library is None:
        return None
    try:
        return ctypes.cast(library[name], ctypes.c_void_p).value
    except AttributeError:
        return None


@functools.cache
def _engine() -> Any:
    """Return LLVM's linker of object files in memory, which lives as long as the process."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    machine = binding.Target.from_triple(binding.get_process_triple()).create_target_machine()
    # use_lmm: all sections of an object file are close to each other, as its relocations demand.
    return binding.create_mcjit_compiler(binding.parse_assembly(""), machine, use_lmm=True)


def load(name: str, content: bytes) -> int:
    """Return the address of the function in an object file."""
    from llvmlite import binding

    engine = _engine()
    engine.add_object_file(binding.ObjectFileRef.from_data(content))
    engine.finalize_object()
    address: int = engine.get_function_address(name)
    return address
