"""What all tests share."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

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
    from sparklod_cli.support import jit

    if not hasattr(session.config, "workerinput") and jit.CACHE_FOLDER is not None:  # once, not in each of xdist's
        warmup.warm_up(processes=2)


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """Puts signal handlers back: every `sparklod` that a later test starts would inherit a signal left ignored."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
