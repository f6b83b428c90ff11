"""Starts the worker process that runs cases, sends it requests, and kills it when a case takes too long."""

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

#: Seconds that a case may take.
LIMIT = 10.0

#: Seconds that a case may take if it may have to compile kernels: the first of a process, and one that is repeated.
PATIENCE = 300.0

#: Seconds that the worker is given to start, and that the fault handler is given to write where a case hangs.
STARTS, TELLS = 300.0, 10.0


class Child:
    """A worker process that runs cases; it is started by the first request, and again after it died.

    Args:
        limit: seconds that a case may take.
        patience: seconds that a case may take if it may compile kernels.
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
        """Runs a request in the worker and returns its answer; a crash or a hang of the worker becomes a finding."""
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
            log = self._trace(process)
            finding = Finding("hang", f"longer than {wait:g} s", _place(log), log)
        self.stop()
        return {"finding": finding.plain(), "outcome": "", "seconds": time.perf_counter() - started, "what": ""}

    def stop(self) -> None:
        """Kills the worker, if it runs."""
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
        for variable in ("ZDOTDIR", "XDG_CONFIG_HOME"):  # folders with the settings of a shell, outside of that home
            environment.pop(variable, None)
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

        if select.select([self._results], [], [], STARTS)[0]:
            self._results.readline()  # that it is ready, or nothing if it died, which the first request will find

    def _trace(self, process: subprocess.Popen[bytes]) -> str:
        """What the fault handler of a worker that hangs writes, once it has written all of it."""
        process.send_signal(signal.SIGUSR1)
        before, ends = "", time.monotonic() + TELLS
        while time.monotonic() < ends:
            time.sleep(0.25)
            log = self._log_text()
            if log and log == before:
                break
            before = log
        return before

    def _log_text(self) -> str:
        return self._log.read_text(errors="replace")[-20_000:]


def _cache() -> str:
    """The user's cache folder: the worker has another HOME, but should find the kernels that are compiled already."""
    return os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")


def _place(log: str) -> str:
    """The innermost frame in sparklod, or else the innermost frame at all, of the last trace by faulthandler."""
    threads = log.rpartition("Current thread")[2] or log
    frames = re.findall(r'File "([^"]*)", line \d+ in (\S+)', threads)
    ours = [frame for frame in frames if "sparklod_cli" in frame[0]] or frames
    return f"{ours[0][0].rpartition('sparklod_cli/')[2]} {ours[0][1]}" if ours else ""
