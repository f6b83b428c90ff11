"""`sparklod build-lod` as a process: standard streams and signals."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sparklod_cli.io import read_scene
from tests.commands.build_lod.runs import SMALL, sparklod
from tests.conftest import FIXTURES, ROOT
from tests.signals import heed_signals


def test_a_closed_standard_output_is_an_error_and_a_closed_standard_error_is_none(tmp_path: Path) -> None:
    command = f"{sys.executable} -m sparklod_cli build-lod {SMALL}"
    done = subprocess.run(["bash", "-c", f"{command} -o - >&-"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (1, f"error: {SMALL}: standard output is closed\n")
    done = subprocess.run(["bash", "-c", f"{command} -o {tmp_path}/out.spz 2>&-"], check=False, cwd=ROOT)
    assert done.returncode == 0
    assert read_scene(tmp_path / "out.spz").tree is not None


def test_standard_output_takes_the_file(tmp_path: Path) -> None:
    result = sparklod("build-lod", SMALL, "-o", "-")
    assert result.returncode == 0
    (tmp_path / "out.spz").write_bytes(result.stdout)
    assert read_scene(tmp_path / "out.spz").tree is not None


def test_a_reader_that_goes_away_is_a_failure_without_a_traceback() -> None:
    command = f"{sys.executable} -m sparklod_cli build-lod {FIXTURES / 'demo.ply'} -o - | head -c 10 > {os.devnull}"
    result = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, check=False, cwd=ROOT)
    assert result.returncode == 1
    assert b"Traceback" not in result.stderr
    assert b"broken pipe" in result.stderr


def handles(process: int, how: signal.Signals) -> bool:
    """Whether a process has its own handler for SIGTERM and a signal; Python itself has one for SIGINT."""
    status = Path(f"/proc/{process}/status")
    if not status.exists():
        time.sleep(0.4)
        return True
    caught = int(re.search(r"SigCgt:\s*(\w+)", status.read_text())[1], 16)  # type: ignore[index]
    return all(caught >> number - 1 & 1 for number in (how, signal.SIGTERM))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_leaves_nothing_behind(tmp_path: Path, how: signal.Signals) -> None:
    source = FIXTURES / "demo.ply"
    command = [sys.executable, "-m", "sparklod_cli", "build-lod", str(source), "--output-dir", str(tmp_path), "-q"]
    # Wherever it is caught: while it imports, reads, compiles, builds or writes. Before that it is Python's to handle.
    for delay in (0.05, 0.3, 0.6):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, preexec_fn=heed_signals)
        while process.poll() is None and not handles(process.pid, how):
            time.sleep(0.01)
        time.sleep(delay)
        process.send_signal(how)
        _, err = process.communicate()
        assert process.returncode in (0, 130, -how), err  # -how: while Python left
        left = list(tmp_path.iterdir())
        if left:  # it was done before, or all but done
            assert [path.name for path in left] == ["demo-lod.spz"]
            assert read_scene(left[0]).tree is not None
            left[0].unlink()
        else:
            assert process.returncode != 0
        assert b"Exception ignored" not in err
