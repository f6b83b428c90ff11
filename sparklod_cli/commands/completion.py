"""`sparklod completion`: prints or installs the script by which a shell completes command lines."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from ..system.errors import SparklodError, reason_of
from .command import Command
from .console import say

#: By shell, the variable of the folder with its settings, that folder below the home folder, the file in it, and the
#: line that loads the script. It names the program by its path, which a virtual environment need not have on PATH. The
#: folder completions of fish is not used, since fish reads it only for commands on PATH.
SHELLS = {
    "bash": ("", "", ".bashrc", '[ -x {program} ] && eval "$({program} completion bash)"'),
    "zsh": (
        "ZDOTDIR",
        "",
        ".zshrc",
        "[ -x {program} ] && {{ (( $+functions[compdef] )) || {{ autoload -Uz compinit && compinit -i; }}; "
        'eval "$({program} completion zsh)"; }}',
    ),
    "fish": (
        "XDG_CONFIG_HOME",
        ".config",
        "fish/conf.d/sparklod.fish",
        "test -x {program}; and {program} completion fish | source",
    ),
}

#: Where the scripts of click run the program by the name that was typed, or by its own.
CALLED = re.compile(r"(?<=_complete )((?:\S+=\(.*?\) )*)(?:\$1|sparklod)(?=\))")

#: Where the script of click gives up as the program is not on PATH.
GUARD = "(( ! $+commands[sparklod] )) && return 1"

EXAMPLES = """\
  sparklod completion --install          # for the shell of $SHELL
  eval "$(sparklod completion bash)"     # in this shell only
"""


@click.command("completion", cls=Command, examples=EXAMPLES)
@click.argument("shell", type=click.Choice(list(SHELLS)), required=False, metavar="[SHELL]")
@click.option("--install", is_flag=True, help="Add a line that loads the script to the settings of the shell.")
@click.pass_context
def completion(ctx: click.Context, shell: str | None, install: bool) -> None:
    """Print the script by which SHELL completes commands, options and file names.

    SHELL is that of the variable SHELL unless it is given. bash must be 4.4 or newer; the script for zsh needs its
    compinit, which --install calls if nothing has.
    """
    shell = shell or Path(os.environ.get("SHELL", "")).name
    if shell not in SHELLS:
        raise click.UsageError(f"the shell is not known from $SHELL; name one of {', '.join(SHELLS)}", ctx)
    if install:
        _install(shell)
        return
    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(ctx.find_root().command, {}, "sparklod", "_SPARKLOD_COMPLETE").source()
    program = _program(shell)
    click.echo(CALLED.sub(lambda found: found[1] + program, script).replace(GUARD, ""))


def _program(shell: str) -> str:
    """Return the absolute path of the command sparklod, quoted for a shell."""
    started, beside = Path(sys.argv[0]), Path(sys.executable).with_name("sparklod")
    if started.name != beside.name:  # python -m sparklod_cli
        started = beside if beside.is_file() else Path(shutil.which(beside.name) or beside)
    path = os.path.abspath(shutil.which(started) or started)  # noqa: PTH100  # a link stays one: pipx moves its target
    if shell == "fish":
        return "'" + path.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return shlex.quote(path)


def _install(shell: str) -> None:
    """Append the line that loads the script to the settings of a shell, unless they have it."""
    variable, folder, name, line = SHELLS[shell]
    line = line.format(program=_program(shell))
    path = Path(os.environ.get(variable) or Path.home() / folder) / name
    try:
        before = path.read_text("utf-8", "surrogateescape") if path.exists() else ""
        if line in before.splitlines():
            say(f"{path} loads the completion already")
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write("\n" * bool(before and not before.endswith("\n")) + line + "\n")
    except OSError as error:
        raise SparklodError(f"{path}: cannot be changed: {reason_of(error)}") from None
    say(f"{path} loads the completion from the next shell on")
