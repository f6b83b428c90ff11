"""Memory and processors of this machine, within the limits of its container, and Python packages.

Functions about memory and processors return None for an unknown figure and never raise.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

#: Values from this one on mean "no limit" in cgroups version 1, which has the largest multiple of a page.
UNLIMITED = 1 << 60


def total_memory() -> int | None:
    """Return the memory of the machine in bytes, or the limit of the container if it is lower."""
    physical = _meminfo("MemTotal")
    if physical is None:
        try:
            physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, OSError, ValueError):  # Windows has no sysconf
            return None
    return min([physical, *(limit for limit, _ in _memory_limits())])


def available_memory() -> int | None:
    """Return the bytes that can be allocated before the system swaps or the container kills the process."""
    available = _meminfo("MemAvailable")
    if available is None:
        return None
    return max(0, min([available, *(limit - used for limit, used in _memory_limits())]))


def processor_quota() -> float | None:
    """Return the processor time that a container grants, in processors (1.5); None without a limit."""
    found = []
    for folder in _groups("cpu"):
        words = _text(folder / "cpu.max").split()  # version 2
        if not words:
            words = [_text(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period")]
        if len(words) == 2 and all(word.isdigit() for word in words) and int(words[1]):
            found.append(int(words[0]) / int(words[1]))
    return min(found, default=None)


def _meminfo(name: str) -> int | None:
    found = re.search(rf"^{name}:\s*([0-9]+)\s", _text(Path("/proc/meminfo")), re.MULTILINE)
    return int(found[1]) * 1024 if found else None


def _memory_limits() -> Iterator[tuple[int, int]]:
    """Yield the memory limit and the usage, in bytes, of each cgroup of this process."""
    for folder in _groups("memory"):
        for limit_name, used_name in (
            ("memory.max", "memory.current"),  # version 2
            ("memory.limit_in_bytes", "memory.usage_in_bytes"),
        ):
            limit, used = _text(folder / limit_name), _text(folder / used_name)
            if limit.isdigit() and int(limit) < UNLIMITED:
                yield int(limit), int(used) if used.isdigit() else 0


def _groups(controller: str) -> list[Path]:
    """Return the folders of the cgroups (versions 1 and 2) of this process, and of their ancestors."""
    root = Path("/sys/fs/cgroup")
    folders = {root, root / controller}  # in a container, its own group is the root
    for line in _text(Path("/proc/self/cgroup")).splitlines():
        number, _, rest = line.partition(":")
        names, _, path = rest.partition(":")
        if number == "0" or controller in names.split(","):
            base = root if number == "0" else root / controller
            own = base / path.lstrip("/")
            folders |= {own, *(parent for parent in own.parents if parent.is_relative_to(base))}
    return sorted(folders)


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def release_memory() -> None:
    """Return freed memory to the system, of which glibc keeps up to 200 MB."""
    import ctypes  # which most commands do not need

    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library, or Windows
        ctypes.CDLL(None).malloc_trim(0)


#: Folder of this package: a checkout, or one of installed packages.
_HOME = Path(__file__).parents[2]

#: Name of this distribution, for pip.
DISTRIBUTION = "sparklod"

#: Files in environments that pipx or `uv tool` created.
_PIPX, _UV_TOOL = "pipx_metadata.json", "uv-receipt.toml"


def pip_install(*packages: str, options: Sequence[str] = ()) -> str:
    """Return the command line that installs packages into the environment of this interpreter."""
    import shlex

    environment = Path(sys.prefix)
    if (environment / _PIPX).is_file():
        if options:
            return shlex.join(["pipx", "runpip", environment.name, "install", *options, *packages])
        return shlex.join(["pipx", "inject", environment.name, *packages])
    return shlex.join([*_pip(environment), *options, *packages])


def _pip(environment: Path) -> list[str]:
    """Return the words that call the pip of an environment, or uv if it has no pip."""
    import shutil
    from importlib.util import find_spec

    is_of_uv = (environment / _UV_TOOL).is_file()
    if is_of_uv or (find_spec("pip") is None and shutil.which("uv")):
        return ["uv", "pip", "install", "--python", sys.executable]
    beside = Path(sys.executable).with_name("pip")
    if sys.prefix == sys.base_prefix or not beside.is_file():
        return [sys.executable, "-m", "pip", "install"]
    if shutil.which("pip") == str(beside):
        return ["pip", "install"]
    with contextlib.suppress(OSError):  # no current folder
        if beside.is_relative_to(Path.cwd()):
            return [str(beside.relative_to(Path.cwd())), "install"]
    return [str(beside), "install"]


def install_hint(extra: str = "", *, package: str = "", options: Sequence[str] = ()) -> str:
    """Return the command line that installs the requirements of sparklod, or of one of its extras.

    No package index is known to have sparklod. So the command names the checkout from which it was installed, or else
    the missing packages.

    Args:
        package: the only package to install, in the version that the extra requires; empty for all of them.
        options: those of pip.
    """
    from importlib import metadata  # takes long to load

    checkout = None if package or (Path(sys.prefix) / _PIPX).is_file() else _checkout()
    if checkout is not None:
        editable = ["-e"] if checkout == _HOME else []
        return pip_install(*editable, f"{checkout}[{extra}]" if extra else str(checkout), options=options)
    try:
        required = list(required_by(DISTRIBUTION, extra))
    except metadata.PackageNotFoundError:
        if not package:
            what = f"the extra {extra} of sparklod" if extra else "sparklod"
            return f"install {what} with pip, from a checkout of its repository"
        required = []
    if package:
        requirements = [one.requirement for one in required if one.name == package][:1] or [package]
    else:
        requirements = [one.requirement for one in required if one.missing] or [one.requirement for one in required]
    return pip_install(*dict.fromkeys(requirements), options=options)


def _checkout() -> Path | None:
    """Return the folder of the repository that holds this package or from which it was installed, if any."""
    import json
    from importlib import metadata
    from urllib.parse import unquote, urlsplit

    folders = [_HOME]
    with contextlib.suppress(metadata.PackageNotFoundError, ValueError, AttributeError):
        source = json.loads(metadata.distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
        address = urlsplit(source.get("url", ""))
        if address.scheme == "file" and "dir_info" in source:
            folders.append(Path(unquote(address.path)))
    return next((folder for folder in folders if (folder / "pyproject.toml").is_file()), None)


@dataclass(frozen=True)
class Required:
    """Distribution that another one requires.

    Attributes:
        least: minimum version; empty for any.
        version: installed version; None if it is not installed.
        source: requirement for pip if the distribution comes with the extra of another one: "imageio[ffmpeg]>=2.31".
    """

    name: str
    least: str
    version: str | None
    source: str = ""

    @property
    def requirement(self) -> str:
        return self.source or (f"{self.name}>={self.least}" if self.least else self.name)

    @property
    def missing(self) -> bool:
        from packaging.version import Version

        return self.version is None or bool(self.least and Version(self.version) < Version(self.least))

    @property
    def state(self) -> str:
        """State for display: "2.4.6", "is missing", or "1.20, older than 1.26"."""
        if self.version is None:
            return "is missing"
        return f"{self.version}, older than {self.least}" if self.missing else self.version


def required_by(distribution: str, extra: str = "") -> Iterator[Required]:
    """Yield the requirements of a distribution, or those of one of its extras alone.

    Raises:
        importlib.metadata.PackageNotFoundError: the distribution is not installed.
    """
    from importlib import metadata  # takes long to load

    from packaging.requirements import Requirement

    for line in metadata.requires(distribution) or []:
        requirement = Requirement(line)
        is_basic, is_of_extra = (
            requirement.marker is None or requirement.marker.evaluate({"extra": name}) for name in ("", extra)
        )
        if not is_of_extra or (extra and is_basic):
            continue
        least = next((each.version for each in requirement.specifier if each.operator == ">="), "")
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            version = None
        extras = sorted(requirement.extras)
        source = f"{requirement.name}[{','.join(extras)}]" + f">={least}" * bool(least) if extras else ""
        yield Required(requirement.name, least, version, source)
        if version is not None:
            for inner in extras:
                yield from (replace(one, source=source) for one in required_by(requirement.name, inner))
