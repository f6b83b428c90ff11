"""The worker process in which cases run; `fuzz.child` starts it, and starts another when it dies.

It says that it is ready, and then reads requests from one pipe and writes answers to another, a JSON object a line.
Python's fault handler writes its traces to a log: of a crash, and of SIGUSR1, which `fuzz.child` sends to a worker that
hangs.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

#: Bytes of address space that the process may add to those it has after its first case, so that no case uses up the
#: machine's memory.
ADDRESS_SPACE = 4 << 30

#: The line that the worker writes before it reads requests: Python, numpy and sparklod are loaded.
READY = "ready"

#: Files and folders of the home folder that `completion --install` may write.
SETTINGS = (".bashrc", ".zshrc", ".config")

#: Packages that cases cannot import: they take seconds to load and call into graphics drivers.
BLOCKED = ("pyvista", "open3d")


def main() -> None:
    """Runs cases until the pipe of requests is closed."""
    parser = argparse.ArgumentParser()
    for name in ("requests", "results", "log"):
        parser.add_argument(f"--{name}", type=int)
    parser.add_argument("--scratch", type=Path)
    given = parser.parse_args()
    log = os.fdopen(given.log, "w")
    faulthandler.enable(log)
    faulthandler.register(signal.SIGUSR1, log, all_threads=True)
    sys.modules.update(dict.fromkeys(BLOCKED))  # type: ignore[arg-type]
    temporary = given.scratch / "tmp"
    temporary.mkdir(parents=True, exist_ok=True)
    tempfile.tempdir = str(temporary)

    from .oracle import WriteWatch
    from .streams import STREAMS

    STREAMS.redirect()
    caches = [Path(os.environ["XDG_CACHE_HOME"]) / "sparklod", Path(os.environ.get("NUMBA_CACHE_DIR") or temporary)]
    settings = [given.scratch / "home" / name for name in SETTINGS]
    watch = WriteWatch([temporary, given.scratch / "matplotlib", Path("/dev"), Path("/proc"), *settings, *caches])
    limited = False
    with os.fdopen(given.requests) as requests, os.fdopen(given.results, "w") as results:
        results.write(f"{READY}\n")
        results.flush()
        for line in requests:
            answer = attempt(json.loads(line), given.scratch, watch)
            results.write(json.dumps(answer) + "\n")
            results.flush()
            if not limited:  # large libraries, such as LLVM, are loaded by the first case
                limited = True
                _limit()


def attempt(request: dict[str, Any], scratch: Path, watch: Any) -> dict[str, Any]:
    """Runs the case of one request and returns the answer."""
    from .case import case_of, target_of, unpacked
    from .oracle import Finding, run

    folder = scratch / "case"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    if "replay" in request:
        name, case = unpacked(Path(request["replay"]))
    else:
        name = request["target"]
        case = case_of(name, request["seed"], request["case"])
    result = run(target_of(name), case, folder, watch)
    os.chdir(scratch)
    left = [path.name for path in (scratch / "tmp").iterdir()]
    finding = result.finding
    if left and finding is None:
        finding = Finding("files", f"temporary files are left: {left[:3]}", "temporary files are left")
        for path in (scratch / "tmp").iterdir():
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink()
    return {
        "finding": finding and finding.plain(),
        "outcome": result.outcome,
        "seconds": result.seconds,
        "what": case.what,
    }


def _limit() -> None:
    with contextlib.suppress(OSError, ValueError):
        found = re.search(r"VmSize:\s*(\d+) kB", Path("/proc/self/status").read_text())
        if found:
            most = (int(found[1]) << 10) + ADDRESS_SPACE
            resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    main()
