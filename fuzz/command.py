"""Runs the command line inside this process, and holds it to what holds for every command."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import click

from sparklod_cli import cli
from sparklod_cli.support.errors import SparklodError

from .case import LawError
from .oracle import lines_fault, where_of
from .streams import STREAMS

CODES = (0, 1, 2, 3)


@dataclass(frozen=True)
class Done:
    """What a command did."""

    code: int
    out: bytes
    err: str


def command(arguments: Sequence[str]) -> Done:
    """Runs `sparklod` with these arguments.

    Raises:
        LawError: of its exit code, or of what it says on standard error.
    """
    with _unforeseen() as caught:
        code = cli.run(list(arguments))
    out, err = STREAMS.take()
    done = Done(code, out, err.decode("utf-8", "backslashreplace"))
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


def _faults(done: Done) -> Iterator[tuple[str, str]]:
    fault, text = lines_fault(done.err)
    if fault:
        yield fault, text
    if done.code == 1 and not done.err.strip():
        yield "silence", "exit code 1 without a word"
    if done.code == 2 and "Error:" not in done.err:
        yield "silence", f"exit code 2 without an error: {done.err[:100]!r}"


@contextmanager
def _unforeseen() -> Iterator[list[tuple[str, str]]]:
    """Notes what is raised below the one place where errors become exit codes, and is none of those that are meant."""
    caught: list[tuple[str, str]] = []
    original = cli.cli.main

    def main(*args: Any, **kwargs: Any) -> Any:
        try:
            return original(*args, **kwargs)
        except (SparklodError, click.ClickException, click.exceptions.Exit):
            raise
        except BaseException as error:
            caught.append((f"{type(error).__name__}: {error}".splitlines()[0][:200], where_of(sys.exc_info()[2])))
            raise

    cli.cli.main = main  # type: ignore[method-assign]
    try:
        yield caught
    finally:
        del cli.cli.main
