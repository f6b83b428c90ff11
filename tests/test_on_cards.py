"""The kernels for NVIDIA cards, without one: their tests in numba's simulator, and their compilation to PTX."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.cards import SIMULATE

TESTS = "tests/render/test_cards.py", "tests/fitting/test_card_optimiser.py"

#: Seconds, far above what either takes.
PATIENCE = 500


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.mark.slow
def test_kernels_pass_in_the_simulator() -> None:
    found = run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-m", "cuda", *TESTS, **{SIMULATE: "1"})
    assert found.returncode == 0, found.stdout[-4000:] + found.stderr[-2000:]
    assert "skipped" not in found.stdout.splitlines()[-1], found.stdout


@pytest.mark.slow
def test_kernels_compile_for_a_card() -> None:
    from tests.render.compile_kernels import MISSING

    found = run("-m", "tests.render.compile_kernels", **{SIMULATE: "0"})
    if found.returncode == MISSING:
        pytest.skip(found.stdout.strip())
    assert found.returncode == 0, found.stdout[-1000:] + found.stderr[-4000:]
