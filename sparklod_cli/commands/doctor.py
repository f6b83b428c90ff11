"""`sparklod doctor`: what sparklod needs, whether it is here, and what to do where it is not."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from ..system.untrusted import printable
from .command import Command, flag, values_of
from .console import Console, count_of, print_json
from .options.common import QUIET, VERBOSE, Messages

if TYPE_CHECKING:
    from ..doctor import Check

#: Beginning of the names of checks of extras.
EXTRA = "extra "

EXAMPLES = """\
  sparklod doctor
  sparklod doctor --quiet || exit 1      # in CI
  sparklod doctor --json > doctor.json   # to attach to a report
"""


@dataclass(frozen=True)
class _Messages(Messages):
    quiet: bool = flag("Print problems only.", flags=QUIET)
    verbose: bool = flag("Print what is being checked.", **VERBOSE)


@click.command("doctor", cls=Command, options=_Messages, examples=EXAMPLES)
@click.pass_context
def doctor(ctx: click.Context, /, **_: Any) -> None:
    """Check the installation: packages, extras, OpenGL, compiled kernels, threads and memory.

    A problem is something that baking needs; a note is something optional that is missing, or could be better. Each
    comes with a line on what to do. The exit status is 1 if there is a problem, else 0.
    """
    messages = values_of(ctx, _Messages)
    with Console(quiet=messages.quiet, verbose=messages.verbose) as console:
        from ..doctor import check_all

        checks = check_all(lambda name: console.detail(f"checking {name}"))
        problems = [check for check in checks if check.state == "problem"]
        if messages.as_json:
            about = {"ok": not problems, "checks": [dataclasses.asdict(check) for check in checks]}
            print_json(about, indent=2)
        else:
            for line in _lines(problems if messages.quiet else checks):
                click.echo(line)
        console.say(_summary(checks))
    ctx.exit(1 if problems else 0)


def _summary(checks: list[Check]) -> str:
    problems = sum(check.state == "problem" for check in checks)
    notes = [check.name for check in checks if check.state == "note"]
    extras = [name.removeprefix(EXTRA) for name in notes if name.startswith(EXTRA)]
    others = len(notes) - len(extras)
    parts = [f"{count_of(problems, 'problem')} to solve before baking works"] if problems else []
    if extras:
        parts.append(f"{count_of(len(extras), 'optional extra')} not installed ({', '.join(extras)})")
    if others:
        parts.append(count_of(others, "other note" if extras else "note"))
    if problems:
        return "; ".join(parts)
    return "; ".join(["OK: everything that baking needs works", *parts])


def _lines(checks: list[Check]) -> list[str]:
    width = max((len(check.name) for check in checks), default=0)
    lines = []
    for check in checks:
        lines.append(printable(f"{check.state:<8}{check.name:<{width}}  {check.value}"))
        if check.advice:
            lines.append(" " * (8 + width + 2) + printable(f"-> {check.advice}"))
    return lines
