"""What commands say to a person, on standard error: lines and progress bars."""

from __future__ import annotations

import contextlib
import os
import sys
from types import TracebackType
from typing import Any, TextIO

import click


def count_of(count: int, noun: str) -> str:
    """ "1 node", "1,234 nodes"."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def size_of(size: int) -> str:
    """ "2.9 MB"."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a person sits at a stream; one that is closed is None."""
    return stream is not None and stream.isatty()


def say(text: str) -> None:
    """One line on standard error, if that is not closed."""
    if sys.stderr is not None:
        click.echo(text, err=True)


def say_error(text: str) -> None:
    """One line on standard error, in colour where that is a terminal that wants it (no-color.org)."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    prefix = "error:" if plain else click.style("error:", fg="red", bold=True)
    say(f"{prefix} {text}")


class Console:
    """Says lines on standard error, and shows a bar for each stage of work where that is a terminal.

    Used as a context manager, which clears the bar. Its `progress` is a `sparklod_cli.progress.Progress`.
    """

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose = quiet, verbose
        self._bars = not quiet and is_terminal(sys.stderr)
        self._bar: Any = None
        self._ended = contextlib.ExitStack()

    def __enter__(self) -> Console:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.clear()
        self._ended.close()

    @property
    def quiet(self) -> bool:
        """Whether a person wants to hear of errors alone."""
        return self._quiet

    def clear(self) -> None:
        """Takes the bar away."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def error(self, text: str) -> None:
        self.clear()
        say_error(text)

    def say(self, text: str) -> None:
        if not self._quiet:
            self.clear()
            say(text)

    def detail(self, text: str) -> None:
        """Something only `--verbose` wants to know."""
        if self._verbose:
            self.say(text)

    def progress(self, stage: str, done: int, total: int, unit: str) -> None:
        if not self._bars:
            return
        if self._bar is None or self._bar.desc != stage:
            from tqdm import tqdm

            self.clear()
            scaled = {"unit_scale": True, "unit": unit if unit == "B" else f" {unit}s"}
            self._bar = tqdm(total=total, desc=stage, leave=False, file=sys.stderr, dynamic_ncols=True, **scaled)
        self._bar.update(done - self._bar.n)

    def announce_compiling(self) -> None:
        """Says so when kernels are compiled, until this console ends."""
        from .. import jit

        often = "once" if jit.CACHE_FOLDER else "every time, as no cache can be written"
        stop = jit.on_first_compile(
            lambda: self.say(f"Compiling for this machine, which takes some 10 seconds; this happens {often} ...")
        )
        self._ended.callback(stop)
