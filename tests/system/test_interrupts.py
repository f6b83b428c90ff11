"""Signals end a run, whatever it is doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sparklod_cli.system.kernel_cache import SUFFIX
from tests.conftest import FIXTURES, ROOT
from tests.signals import heed_signals
from tests.system.test_kernel_cache import is_whole

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
    assert len(kept) < 9  # it did not go on to the end: a bake has several times as many
    assert all(is_whole(path.read_bytes()) for path in kept)


#: A run of `inspect` whose reading is replaced by a function of a test.
SCRIPT = """
import os, signal, sys, time
from sparklod_cli import cli
from sparklod_cli.io import reading
from sparklod_cli.system import interrupts, jit
{work}
reading.open_splats = work
interrupts.handle()
sys.exit(cli.run(["inspect", "fixtures/one.ply"]))
"""


def run_with(work: str) -> subprocess.CompletedProcess[str]:
    """Run `inspect` with the Python code of `work`, a function, in place of reading."""
    command = [sys.executable, "-c", SCRIPT.format(work=work)]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, preexec_fn=heed_signals, check=False, timeout=60
    )


#: What imports of C modules do: a `KeyboardInterrupt` inside of them becomes an error of another kind.
SWALLOW = """
def work(*args, **kwargs):
    try:
        os.kill(os.getpid(), signal.SIGHUP)
        signal.pause()
    except KeyboardInterrupt:
        raise {error} from None
"""


@pytest.mark.parametrize("error", ["ImportError('numpy')", "OSError(5, 'of a library')", "KeyboardInterrupt"])
def test_an_error_that_a_library_makes_of_an_interruption_is_one(error: str) -> None:
    done = run_with(SWALLOW.format(error=error))
    assert done.returncode == 130
    assert "please report" not in done.stderr


#: Two signals at once: Python prints an error of the second one, whose handler the first one has reset.
TWO = """
def work(*args, **kwargs):
    signal.pthread_sigmask(signal.SIG_BLOCK, interrupts.ENDING)
    os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, interrupts.ENDING)
"""

#: A library that forgets an interruption, as some do of what an import raises; compilation comes next.
FORGET = """
def work(*args, **kwargs):
    try:
        os.kill(os.getpid(), signal.SIGHUP)
        signal.pause()
    except KeyboardInterrupt:
        jit.listeners[0][0]("kernel")
    print("went on")
"""

#: An object that is interrupted while it is deleted, where Python prints exceptions and goes on.
LOSE = """
class Deleted:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(60)

def work(*args, **kwargs):
    item = Deleted()
    del item
    time.sleep(60)
"""


@pytest.mark.parametrize("work", [TWO, FORGET, LOSE], ids=["two signals", "forgotten", "lost"])
def test_an_interruption_ends_the_run_whoever_catches_it(work: str) -> None:
    done = run_with(work)
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "interrupted")
