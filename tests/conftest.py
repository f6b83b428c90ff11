"""What all tests share."""

from __future__ import annotations

import inspect
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# Machines differ by a factor of a hundred in speed, and the first example of a kernel compiles it. The fuzzers try many
# more examples than a run of the tests, which tries the same ones every time: what passes here passes elsewhere.
# `--hypothesis-profile=explore` tries others.
TIMELESS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("sparklod", max_examples=40, derandomize=True, **TIMELESS)
settings.register_profile("explore", max_examples=40, **TIMELESS)
settings.load_profile("sparklod")

ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "fixtures"

#: What a test that reads its own standard output and error takes.
Capture = pytest.CaptureFixture[str]
#: Real scenes, which are not part of the repository: where SPARKLOD_SCENES says, or beside the checkout.
SCENES = Path(os.environ.get("SPARKLOD_SCENES") or ROOT.parent / "shared" / "scenes")
#: Root may read and write everything, whatever the permissions.
IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0


def real_scene(name: str) -> Path:
    """A real scene's path; skips the test where the folder is absent."""
    path = SCENES / name
    if not path.is_file():
        pytest.skip(f"no real scene {name}; SPARKLOD_SCENES names the folder of real scenes")
    return path


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compiles all kernels that no cache has, so that no test meets a notice of it, or waits for one of its own."""
    from sparklod_cli import warmup
    from sparklod_cli.commands.console import count_of
    from sparklod_cli.system import jit
    from sparklod_cli.system.threads import processors

    _call_inner_kernels()
    is_worker = hasattr(session.config, "workerinput")  # of xdist; the controlling process has compiled them
    missing = len(warmup.missing()) if jit.CACHE_FOLDER is not None and not is_worker else 0
    if not missing:
        return
    terminal = session.config.pluginmanager.get_plugin("terminalreporter")
    processes, start = min(processors(), 4), time.perf_counter()
    expected = warmup.duration(missing, processes)
    terminal.write_line(f"compiling {count_of(missing, 'kernel')} for this machine, once, {expected} ...", flush=True)

    def report(_stage: str, done: int, total: int, _unit: str) -> None:
        if terminal.isatty:
            terminal.rewrite(f"compiled {done} of {total}", erase=True, flush=True)

    compiled = warmup.warm_up(processes=processes, progress=report)
    seconds = time.perf_counter() - start
    terminal.rewrite("", erase=terminal.isatty)
    terminal.write_line(f"compiled {count_of(compiled, 'kernel')} in {seconds:.0f} s", flush=True)


def _call_inner_kernels() -> None:
    """Has tests call kernels that declare no types, which the package calls from kernels only; numba compiles them."""
    from sparklod_cli.system import jit

    call = jit.Kernel.__call__
    entries: dict[jit.Kernel, Any] = {}

    def called(kernel: jit.Kernel, *arguments: Any) -> Any:
        if kernel.declared:
            return call(kernel, *arguments)
        if kernel not in entries:
            import numba

            names = ", ".join(inspect.signature(kernel.py_func).parameters)
            namespace = {"inner": kernel.inner_on(jit.load_compiler())}
            exec(f"def entry({names}): return inner({names})", namespace)
            entries[kernel] = numba.njit(error_model="numpy")(namespace["entry"])
        return entries[kernel](*arguments)

    jit.Kernel.__call__ = called  # type: ignore[method-assign]


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """Puts signal handlers back: every `sparklod` that a later test starts would inherit a signal left ignored."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
