"""Measures whole processes: their time by the clock, the time of processors that they use, their peak of memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import sparklod_cli as sparklod

T = TypeVar("T")

LAUNCH = Path(__file__).with_name("launch.py")

#: The command line of this checkout.
SPARKLOD = (sys.executable, "-m", "sparklod_cli")


@dataclass(frozen=True)
class Took:
    """What a process took, from its start to its end.

    Attributes:
        wall_s: seconds by the clock.
        cpu_s: seconds of processors, of all its threads, for itself and for the system.
        peak_bytes: most of resident memory; what starts it takes some 10 MB, below which nothing can be told.
        output: what it printed.
    """

    wall_s: float
    cpu_s: float
    peak_bytes: int
    output: str


class CommandError(Exception):
    """A measured command failed."""


def run(
    command: Sequence[str | Path],
    *,
    cwd: Path | None = None,
    variables: Mapping[str, str | None] | None = None,
    codes: Sequence[int] = (0,),
) -> Took:
    """Runs a command once.

    Args:
        command: the program and its arguments.
        cwd: the folder that it runs in.
        variables: of its environment, besides those of this process; those that are None are unset.
        codes: exit codes of success.

    Raises:
        CommandError: it ended with another one.
    """
    reader, writer = os.pipe()
    with os.fdopen(reader) as told:
        launch = [sys.executable, "-I", "-S", str(LAUNCH), str(writer), *map(str, command)]
        done = subprocess.run(
            launch, cwd=cwd, env=environment(variables), pass_fds=[writer], capture_output=True, text=True, check=False
        )
        os.close(writer)
        took = told.read()
    if done.returncode not in codes:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise CommandError(f"{' '.join(map(str, command))} failed: {last[0]}")
    return Took(**json.loads(took), output=done.stdout)


def environment(variables: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """That of this process, with this checkout's package found from every folder, and some variables changed.

    Python may keep the bytecode of modules, as that of an installed package is kept; compiling it anew in each process
    takes longer than many commands.
    """
    home = str(Path(sparklod.__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH"))))
    every: dict[str, str | None] = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": None}
    every |= variables or {}
    return {name: value for name, value in every.items() if value is not None}


def runs_of(found: Sequence[Took], prefix: str = "") -> dict[str, list[float]]:
    """The runs of a `Row`, by name."""
    names = ("wall_s", "cpu_s", "peak_bytes")
    return {prefix + name: [getattr(took, name) for took in found] for name in names}


def in_turn(runs: int, jobs: Sequence[Callable[[], T]], *, first: bool = True) -> list[list[T]]:
    """What the runs of each job return; they take turns, so that a slow minute is slow for all.

    Args:
        runs: of each that count.
        jobs: what to run.
        first: run each once before, which fills the caches and does not count.
    """
    results: list[list[T]] = [[] for _ in jobs]
    for turn in range(runs + first):
        for job, found in zip(jobs, results, strict=True):
            result = job()
            if turn or not first:
                found.append(result)
    return results
