"""Memory and processors available to this process, and the limits that a container sets on both.

Each function returns None if the system does not provide the figure; none of them raises.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

#: Least value that means "no limit" in cgroups version 1, where the kernel writes the largest multiple of a page.
UNLIMITED = 1 << 60


def total_memory() -> int | None:
    """Return bytes of memory of the machine, or the limit of the container if that is lower."""
    physical = _meminfo("MemTotal")
    if physical is None:
        try:
            physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, OSError, ValueError):  # Windows has no sysconf
            return None
    return min([physical, *(limit for limit, _ in _memory_limits())])


def available_memory() -> int | None:
    """Return bytes that can be allocated before the system swaps or the container kills the process."""
    available = _meminfo("MemAvailable")
    if available is None:
        return None
    return max(0, min([available, *(limit - used for limit, used in _memory_limits())]))


def processor_quota() -> float | None:
    """Return processor time that a container grants, in processors, such as 1.5; None without a limit."""
    found = []
    for folder in _groups("cpu"):
        words = _text(folder / "cpu.max").split()  # version 2
        if not words:
            words = [_text(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period")]
        if len(words) == 2 and all(word.isdigit() for word in words) and int(words[1]):
            found.append(int(words[0]) / int(words[1]))
    return min(found, default=None)


def _meminfo(name: str) -> int | None:
    for line in _text(Path("/proc/meminfo")).splitlines():
        words = line.split()
        if words[:1] == [f"{name}:"] and words[1].isdigit():
            return int(words[1]) * 1024
    return None


def _memory_limits() -> Iterator[tuple[int, int]]:
    """Yield memory limit and usage in bytes of each cgroup of this process."""
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
    """Return freed memory to the system; glibc keeps up to 200 MB for later."""
    import ctypes  # which most commands do without

    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library; Windows has no name for it
        ctypes.CDLL(None).malloc_trim(0)
