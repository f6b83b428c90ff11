"""Signals end a run, whatever it is doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sparklod_cli.support.jit_cache import SUFFIX, is_whole
from sparklod_cli.warmup import JOBS
from tests.conftest import FIXTURES, ROOT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_compilation_at_once_and_leaves_a_whole_cache(
    tmp_path: Path, how: signal.Signals, again: bool
) -> None:
    cache = tmp_path / "cache"
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", str(FIXTURES / "demo.ply"), "--method", "quality"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    process = subprocess.Popen(
        [*command, "-o", str(tmp_path / "tree.spz")],
        cwd=ROOT,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(how, signal.SIG_DFL),  # a shell has what it runs in the background ignore some
    )
    assert process.stderr is not None
    assert "Compiling" in process.stderr.readline()
    while not list(cache.rglob(f"*{SUFFIX}")):  # until the first of many is compiled
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(how)
    if again:
        process.send_signal(signal.SIGTERM)
    rest = process.stderr.read()
    assert process.wait() in ((130, -signal.SIGTERM) if again else (130,))  # a second one need not wait for anything
    assert rest.count("interrupted") <= 1
    assert again or rest.endswith("interrupted\n")
    assert "->" not in rest  # as of a bake that is done
    assert not (tmp_path / "tree.spz").exists()
    kept = list(cache.rglob(f"*{SUFFIX}"))
    assert len(kept) < len(JOBS["quality"].kernels) / 2  # it did not go on to the end
    assert all(is_whole(path.read_bytes()) for path in kept)
