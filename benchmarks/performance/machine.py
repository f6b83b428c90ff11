"""Describes the machine that measures."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path

from sparklod_cli.system.threads import processors


def machine() -> str:
    """Processor, threads and Python, for tables."""
    return f"{_model()}, {processors()} threads, Python {platform.python_version()}"


def whole_machine() -> str:
    """The same with memory, system and the versions of what computes."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    system = f"{platform.system()} {platform.release().split('-')[0]}"
    return f"{machine()}, {memory:.0f} GB, {system}, numba {version('numba')}, numpy {version('numpy')}"


def load() -> float:
    """Processes that wanted to run during the last minute, on average; 0 on an idle machine."""
    return os.getloadavg()[0]


def _model() -> str:
    info = Path("/proc/cpuinfo")
    text = info.read_text() if info.exists() else ""
    models = [line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
