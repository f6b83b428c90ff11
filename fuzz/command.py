"""Runs the command line inside this process and checks the laws that hold for every command."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import click

from sparklod_cli import cli
from sparklod_cli.system.errors import SparklodError

from .case import LawError
from .oracle import innermost_frame, stderr_fault
from .streams import STREAMS

#: Exit codes of sparklod: done, a failure, wrong usage, a check that did not hold.
CODES = (0, 1, 2, 3)


@dataclass(frozen=True)
class CommandResult:
    """Exit code and output of a command."""

    code: int
    out: bytes
    err: str


def command(arguments: Sequence[str]) -> CommandResult:
    """Runs `sparklod` with these arguments.

    Raises:
        LawError: the exit code or the text on standard error breaks a law, or an exception reached the last guard.
    """
    with _unforeseen() as caught:
        code = cli.run(list(arguments))
    out, err = STREAMS.take()
    done = CommandResult(code, out, err.decode("utf-8", "backslashreplace"))
    if caught:
        kind, where = caught[0]
        raise LawError(
            f"{kind} reached the last guard\n{arguments}\n{done.err}", f"{kind.partition(':')[0]} in {where}"
        )
    if code not in CODES:
        raise LawError(f"exit code {code}\n{arguments}\n{done.err}")
    for fault, text in _faults(done):
        raise LawError(f"{text}\n{arguments}\n{done.err}", f"{fault}, of {arguments[0]}")
    return done


def _faults(done: CommandResult) -> Iterator[tuple[str, str]]:
    fault, text = stderr_fault(done.err)
    if fault:
        yield fault, text
    if done.code == 1 and not done.err.strip():
        yield "silence", "exit code 1 without a word"
    if done.code == 2 and "error: " not in done.err:
        yield "silence", f"exit code 2 without an error: {done.err[:100]!r}"


@contextmanager
def _unforeseen() -> Iterator[list[tuple[str, str]]]:
    """Records the unexpected exceptions that `cli.run` would turn into exit codes."""
    caught: list[tuple[str, str]] = []
    original = cli.cli.main

    def main(*args: Any, **kwargs: Any) -> Any:
        try:
            return original(*args, **kwargs)
        except (SparklodError, click.ClickException, click.exceptions.Exit):
            raise
        except BaseException as error:
            caught.append(
                (f"{type(error).__name__}: {error}".splitlines()[0][:200], innermost_frame(sys.exc_info()[2]))
            )
            raise

    cli.cli.main = main  # type: ignore[method-assign]
    try:
        yield caught
    finally:
        del cli.cli.main
