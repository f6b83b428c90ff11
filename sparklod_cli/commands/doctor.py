"""`sparklod doctor`: what sparklod needs, whether it is here, and what to do where it is not."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import click

from .. import __version__
from ..support.printable import printable
from .command import GENERAL, Command, option
from .console import Console, count_of
from .options.common import verbose_option

if TYPE_CHECKING:
    from ..doctor import Check

EXAMPLES = """
\b
Examples:
  sparklod doctor
  sparklod doctor --quiet || exit 1                       # in CI
  sparklod doctor --json > doctor.json                    # to attach to a report
"""


@click.command("doctor", cls=Command, epilog=EXAMPLES)
@option("--json", "as_json", heading=GENERAL, is_flag=True, help="Print one JSON object on standard output.")
@option("-q", "--quiet", heading=GENERAL, is_flag=True, help="Print problems only.")
@verbose_option("Print what is being checked.")
@click.version_option(__version__, package_name="sparklod")
@click.pass_context
def doctor(ctx: click.Context, as_json: bool, quiet: bool, verbose: bool) -> None:
    """Check the installation: packages, extras, OpenGL, compiled kernels, threads and memory.

    A problem is something that baking needs; a note is something optional that is missing, or could be better. Each
    comes with a line on what to do. The exit status is 1 if there is a problem, else 0.
    """
    with Console(quiet=quiet, verbose=verbose) as console:
        from ..doctor import check_all

        checks = check_all(lambda name: console.detail(f"checking {name}"))
        problems = [check for check in checks if check.state == "problem"]
        if as_json:
            about = {"ok": not problems, "checks": [dataclasses.asdict(check) for check in checks]}
            click.echo(json.dumps(about, indent=2))
        else:
            for line in _lines(problems if quiet else checks):
                click.echo(line)
        notes = sum(check.state == "note" for check in checks)
        console.say(f"{count_of(len(problems), 'problem')}, {count_of(notes, 'note')}")
    ctx.exit(1 if problems else 0)


def _lines(checks: list[Check]) -> list[str]:
    """A line for each check, in columns, and one below for what to do."""
    width = max((len(check.name) for check in checks), default=0)
    lines = []
    for check in checks:
        lines.append(printable(f"{check.state:<8}{check.name:<{width}}  {check.value}"))
        if check.advice:
            lines.append(" " * (8 + width + 2) + printable(f"-> {check.advice}"))
    return lines
