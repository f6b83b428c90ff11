"""Messages and progress bars, on standard error."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from time import monotonic, time
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

import click

from ..system import interrupts
from ..system.stdio import silence
from ..system.units import count_of as count_of
from ..system.units import format_duration, format_size
from ..system.untrusted import MOST, printable

if TYPE_CHECKING:
    from ..bake.settings import BakeSettings
    from ..warmup import CompileAhead

#: Columns of reports for people, of the names that their rows begin with, and by which messages go on indented.
WIDTH, NAMES, INDENT = 80, 13, 4

#: Version of the fields that commands print with --json, but for inspect, whose report has a schema of its own.
JSON_VERSION = 1

#: The bar of a job of several stages, as tqdm formats it.
JOB_BAR = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"

#: Seconds between two lines of progress where standard error is a log.
LOG_INTERVAL = 10


@dataclass
class Verbosity:
    """Whether -v was given; `cli.run` reads it after a command has failed."""

    verbose: bool = False


def rows(name: str, text: str) -> list[str]:
    """Return the lines of a row of a report: a name, and a text that is continued below if it is too long."""
    return _wrapped(f"  {name:<{NAMES - 3}} {printable(text, MOST)}".rstrip(), WIDTH, NAMES)


def _wrapped(line: str, width: int, indent: int) -> list[str]:
    """Break a line at blanks, except after a number or a colon."""
    if len(line) <= width:
        return [line]
    import re
    import textwrap

    joined = re.sub(r"(?<=[\d:]) (?=\S)", "\N{NO-BREAK SPACE}", line)
    broken = textwrap.wrap(joined, width, subsequent_indent=" " * indent, break_on_hyphens=False)
    return [part.replace("\N{NO-BREAK SPACE}", " ") for part in broken]


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal; None is a closed stream."""
    return stream is not None and stream.isatty()


def say(text: str) -> None:
    """Print one line on standard error, shortened and without control characters."""
    _echo(printable(text, MOST))


def print_json(record: dict[str, Any], *, indent: int | None = None) -> None:
    """Print a result on standard output as one JSON object that begins with the schema version."""
    click.echo(json.dumps({"schema_version": JSON_VERSION} | record, indent=indent, allow_nan=False))


def say_error(text: str) -> None:
    """Print an error on standard error, in colour on terminals unless NO_COLOR is set (no-color.org)."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    prefix = "error:" if plain else click.style("error:", fg="red", bold=True)
    _echo(f"{prefix} {printable(text, MOST)}")


def say_usage_error(error: click.ClickException) -> None:
    """Print the usage of the command, how to get its help, and the error in the last line."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    if ctx is not None:
        _echo(f"{ctx.get_usage()}\nTry '{ctx.command_path} --help'.\n")
    text = error.format_message()
    if isinstance(error, click.NoSuchOption):
        text = f"there is no option {error.option_name}" + _meant(error)
    say_error(text)


def _meant(error: click.NoSuchOption) -> str:
    """Return a hint on an unknown option: its replacement, an option with such a value, other commands, or a typo."""
    ctx, flag = error.ctx, error.option_name
    if ctx is None:
        return ""
    replaced: Mapping[str, str] = getattr(ctx.command, "replaced", {})
    if flag in replaced:
        return f" any more; write {replaced[flag]}"
    for param in ctx.command.params:
        if isinstance(param.type, click.Choice) and flag.lstrip("-") in param.type.choices:
            return f"; did you mean {param.opts[0]} {flag.lstrip('-')}?"
    root = ctx.find_root()
    assert isinstance(root.command, click.Group)
    others = {name: root.command.get_command(root, name) for name in root.command.list_commands(root)}
    having = [name for name, other in others.items() if other and any(flag in param.opts for param in other.params)]
    if having and ctx is root:
        return f"; options of a command follow its name, as in sparklod {having[0]} {flag}"
    if having:
        return f"; {', '.join(having)} {'have' if having[1:] else 'has'} it"
    return f"; did you mean {error.possibilities[0]}?" if error.possibilities else ""


def for_screen(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the lines of a table without control characters, a piece at a time."""
    for piece in pieces:
        yield "\n".join(printable(line) for line in piece.decode("utf-8", "replace").split("\n")).encode()


def _echo(text: str) -> None:
    """Print a line on standard error; ignore that it is closed or full."""
    try:
        click.echo(text, err=True)
    except OSError:
        silence(sys.stderr)


class Console(contextlib.AbstractContextManager["Console"]):
    """Messages and progress on standard error: a bar on a terminal, lines in a log; a context manager.

    `progress` is a `system.progress.Progress`.
    """

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self._quiet, self.verbose = quiet, verbose
        self._bars = not quiet and is_terminal(sys.stderr)
        self._bar: Any = None
        self._stage, self._start, self._logged = "", 0.0, 0.0
        #: Begin and share of each stage of a job, and the part of the job that is done, 0 to 1; it never falls.
        self._job: dict[str, tuple[float, float]] | None = None
        self._reached = 0.0
        #: Durations of compilations, and the process that compiles ahead.
        self._compiled: list[float] = []
        self._ahead: CompileAhead | None = None
        self._troubles: set[str] = set()
        self._stack = contextlib.ExitStack()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.clear()
        self._stack.close()
        if self._compiled:
            count = len(self._compiled) + (self._ahead.compiled if self._ahead is not None else 0)
            self.say(f"compiled {count_of(count, 'kernel')} in {sum(self._compiled):.1f} s")

    def clear(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def error(self, text: str) -> None:
        self.clear()
        say_error(text)

    def say(self, text: str) -> None:
        """Print a line, broken between words where a terminal is too narrow."""
        if not self._quiet:
            self.clear()
            try:
                width = os.get_terminal_size(sys.stderr.fileno()).columns
            except (AttributeError, OSError, ValueError):  # it is closed, redirected, or no file
                width = 0
            line = printable(text, MOST)
            for part in _wrapped(line, max(width, 2 * INDENT), INDENT) if width else [line]:
                _echo(part)

    def detail(self, text: str) -> None:
        """Print a line with `--verbose` only."""
        if self.verbose:
            self.say(text)

    @contextlib.contextmanager
    def job(self, shares: Mapping[str, float]) -> Iterator[None]:
        """Show the stages of the work inside as one bar, with the time left.

        `shares` has the relative time of each stage, in order; other stages add nothing.
        """
        self.clear()
        whole, begin = sum(shares.values()), 0.0
        self._job, self._reached = {}, 0.0
        for stage, share in shares.items():
            self._job[stage] = begin, share / whole
            begin += share / whole
        self._start = self._logged = monotonic()
        try:
            yield
        finally:
            self.clear()
            self._job, self._stage = None, ""

    def progress(self, stage: str, done: int, total: int, unit: str) -> None:
        """Update the bar, or print a line for the log every `LOG_INTERVAL` seconds."""
        now = monotonic()
        if self._job is not None:
            begin, share = self._job.get(stage, (0.0, 0.0))
            self._reached = min(max(self._reached, begin + share * done / max(total, 1)), 1.0)
        elif stage != self._stage:
            self._stage, self._start, self._logged = stage, now, now
        if self._bars:
            self._draw(stage, done, total, unit)
        elif now - self._logged >= LOG_INTERVAL and (self._job is not None or done < total):
            self._logged, lasted, reached = now, now - self._start, self._reached
            if self._job is not None:
                left = f", about {format_duration(lasted * (1 / reached - 1))} left" if reached else ""
                self.say(f"{stage}: {100 * reached:.0f} % done after {format_duration(lasted)}{left}")
            else:
                size = f"{format_size(done)} of {format_size(total)}"
                amount = size if unit == "B" else f"{done:,} of {total:,} {unit}s"
                self.say(f"{stage}: {amount} ({100 * done / total:.0f} %), {format_duration(lasted)}")

    def _draw(self, stage: str, done: int, total: int, unit: str) -> None:
        """Draw the bar of a stage, or of a job with the estimated time left."""
        bar = self._bar
        if self._job is None:
            if bar is None or bar.desc != stage:
                scaled = {"unit_scale": True, "unit": unit if unit == "B" else f" {unit}s"}
                bar = self._open_bar(total=total, desc=stage, **scaled)
            bar.update(done - bar.n)
            return
        if bar is None:
            bar = self._open_bar(total=1.0, desc=stage, initial=self._reached, bar_format=JOB_BAR, smoothing=0)
        bar.initial, bar.start_t = 0, time() - (monotonic() - self._start)  # the rate is that of the whole job
        bar.update(self._reached - bar.n)
        if bar.desc != stage:
            bar.set_description_str(stage)

    def _open_bar(self, **how: Any) -> Any:
        from tqdm import tqdm

        self.clear()
        tqdm.set_lock(threading.RLock())  # tqdm's own is for several processes, and may start one
        self._bar = tqdm(leave=False, file=sys.stderr, dynamic_ncols=True, **how)
        return self._bar

    def announce_compiling(self, work: str | BakeSettings | None = None) -> None:
        """Report the compilation of kernels from now on, and at the end how long it took.

        When the first one is compiled, a second process begins to compile the kernels of `work`, a bake or one of
        `warmup.JOBS`.
        """
        from ..system import jit

        listener = functools.partial(self._begin_compiling, work), self._end_compiling, self._say_trouble
        jit.listeners.append(listener)
        self._stack.callback(jit.listeners.remove, listener)

    def _begin_compiling(self, work: str | BakeSettings | None, name: str) -> None:
        from ..system import jit
        from ..warmup import CompileAhead, jobs_of, missing

        interrupts.leave_if_lost()
        if self._ahead is None:
            absent = missing()
            self._ahead = CompileAhead(absent, [] if work is None else jobs_of(work), name)
            self._stack.callback(self._ahead.close)
            often = f"kept for later runs; sparklod warmup compiles all {len(absent)} in advance"
            often = often if jit.CACHE_FOLDER else "in every run: no cache can be written"
            self.say(f"Compiling kernels for this machine, up to a minute ({often}) ...")
        if self._bars:
            # How many a command needs is not known.
            text = f"compiling: kernel {len(self._compiled) + 1}, {sum(self._compiled):.0f} s so far"
            self._open_bar(desc=text, bar_format="{desc}")

    def _end_compiling(self, duration: float) -> None:
        self._compiled.append(duration)
        self._start += duration  # compiling does not count as time of the job
        self._logged += duration
        self.clear()

    def _say_trouble(self, trouble: str) -> None:
        if trouble not in self._troubles:
            self._troubles.add(trouble)
            self.say(trouble)
