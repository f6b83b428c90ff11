"""Runs `sparklod` out of core and within a limit, for `bench_scale.py`: `scale_child.py BYTES [ARGUMENT]...`.

With 0 bytes there is no limit, and it bakes as it likes.

The last line of standard output is JSON: what the process took, and how long each task of a bake out of core was.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def record_tasks(tasks: list[dict[str, Any]]) -> None:
    """Has the engine of this process note how long each task takes; those of a round wait for all of the one before."""
    from sparklod_cli.bake.job import LocalEngine

    run, rounds = LocalEngine.run, itertools.count()

    def timed(task: Any, number: int) -> Any:
        def work(*arguments: Any, **named: Any) -> None:
            start = time.perf_counter()
            task.run(*arguments, **named)
            seconds = round(time.perf_counter() - start, 4)
            tasks.append({"name": task.name, "needs": list(task.needs), "seconds": seconds, "round": number})

        return dataclasses.replace(task, run=work)

    def recorded(self: Any, stage: str, given: Sequence[Any], *rest: Any, **named: Any) -> None:
        number = next(rounds)
        run(self, stage, [timed(task, number) for task in given], *rest, **named)

    LocalEngine.run = recorded  # type: ignore[method-assign]


def status(name: str) -> int:
    """A figure of this process in bytes: "VmHWM", the most memory that it had."""
    found = re.search(rf"{name}:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return 1024 * int(found[1])


def main() -> None:
    """Runs the command line."""
    limit, arguments = int(sys.argv[1]), sys.argv[2:]
    if limit:
        # Memory that the process asks for, not what it maps of files: a limit on address space would count those, too.
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    tasks: list[dict[str, Any]] = []
    if limit:
        from sparklod_cli.bake import estimate

        estimate.in_memory_bytes = lambda *_, **__: 1 << 62  # out of core, also where that is not needed
        record_tasks(tasks)
    from sparklod_cli.cli import run

    start = time.perf_counter()
    code = run(arguments)
    seconds = time.perf_counter() - start
    transfers = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    figures = {
        "code": code,
        "seconds": round(seconds, 3),
        "peak": status("VmHWM"),
        "read": int(transfers["rchar"]),
        "written": int(transfers["wchar"]),
        "tasks": tasks,
    }
    print("\n" + json.dumps(figures))


if __name__ == "__main__":
    main()
