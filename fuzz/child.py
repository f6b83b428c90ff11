"""The parent's side of the process that runs cases: starts it, waits no longer than is right, buries it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from .oracle import Finding

ROOT = Path(__file__).resolve().parents[1]

#: Seconds that a case may take; and the first of a process, or one that is tried again: these may compile kernels.
LIMIT, PATIENCE = 10.0, 300.0


class Child:
    """A process that runs cases, started when it is needed.

    Args:
        limit: seconds of a case.
        patience: seconds of one that may compile.
    """

    def __init__(self, limit: float = LIMIT, patience: float = PATIENCE) -> None:
        self.limit, self.patience = limit, patience
        self.scratch = Path(tempfile.mkdtemp(prefix="fuzz-"))
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        shutil.rmtree(self.scratch, ignore_errors=True)

    def run(self, request: dict[str, Any], *, patient: bool = False) -> dict[str, Any]:
        """What came of a request, as the process answers it; a crash or a hang is a finding, too."""
        if self._process is None:
            self._start()
            patient = True
        process = self._process
        assert process is not None
        wait = self.patience if patient else self.limit
        started = time.perf_counter()
        with contextlib.suppress(BrokenPipeError):
            self._requests.write(json.dumps(request) + "\n")
            self._requests.flush()
        ready, _, _ = select.select([self._results], [], [], wait)
        line = self._results.readline() if ready else ""
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        if ready:
            code = process.wait()
            log = self._log_text()
            name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            finding = Finding("crash", f"the process died: {name}", f"{name} in {_place(log)}", log)
        else:
            process.send_signal(signal.SIGUSR1)
            time.sleep(0.5)
            log = self._log_text()
            finding = Finding("hang", f"longer than {wait:g} s", _place(log), log)
        self.stop()
        return {"finding": finding.plain(), "outcome": "", "seconds": time.perf_counter() - started, "what": ""}

    def stop(self) -> None:
        """Ends the process."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        self._process = None
        for file in (self._requests, self._results):
            with contextlib.suppress(OSError):
                file.close()

    def _start(self) -> None:
        shutil.rmtree(self.scratch, ignore_errors=True)
        for name in ("case", "home", "tmp", "matplotlib"):
            (self.scratch / name).mkdir(parents=True)
        requests, answers = os.pipe(), os.pipe()
        self._log = self.scratch / "log"
        log = os.open(self._log, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        home = str(self.scratch / "home")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": home, "XDG_CACHE_HOME": _cache()}
        environment |= {
            "MPLBACKEND": "agg",
            "MPLCONFIGDIR": str(self.scratch / "matplotlib"),
            "NO_COLOR": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        command = [sys.executable, "-m", "fuzz.worker", f"--requests={requests[0]}", f"--results={answers[1]}"]
        command += [f"--log={log}", f"--scratch={self.scratch}"]
        inherited = (requests[0], answers[1], log)
        self._process = subprocess.Popen(
            command, cwd=self.scratch, env=environment, pass_fds=inherited, stdin=subprocess.DEVNULL
        )
        for descriptor in inherited:
            os.close(descriptor)
        self._requests, self._results = os.fdopen(requests[1], "w"), os.fdopen(answers[0])

    def _log_text(self) -> str:
        return self._log.read_text(errors="replace")[-20_000:]


def _cache() -> str:
    """Where kernels are kept when NUMBA_CACHE_DIR does not say: as without a home of its own."""
    return os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")


def _place(log: str) -> str:
    """The innermost place of sparklod, or else of anything, in what faulthandler wrote last."""
    threads = log.rpartition("Current thread")[2] or log
    frames = re.findall(r'File "([^"]*)", line \d+ in (\S+)', threads)
    ours = [frame for frame in frames if "sparklod_cli" in frame[0]] or frames
    return f"{ours[0][0].rpartition('sparklod_cli/')[2]} {ours[0][1]}" if ours else ""
