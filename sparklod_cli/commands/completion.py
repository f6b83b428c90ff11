"""`sparklod completion`: prints or installs the script by which a shell completes command lines."""

from __future__ import annotations

import os
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from ..support.errors import SparklodError
from .command import Command
from .console import say

#: By shell, the variable of the folder with its settings, that folder below the home folder, the file in it, and the
#: line that loads the script.
SHELLS = {
    "bash": ("", "", ".bashrc", 'command -v sparklod > /dev/null && eval "$(sparklod completion bash)"'),
    "zsh": ("ZDOTDIR", "", ".zshrc", 'command -v sparklod > /dev/null && eval "$(sparklod completion zsh)"'),
    "fish": ("XDG_CONFIG_HOME", ".config", "fish/completions/sparklod.fish", "sparklod completion fish | source"),
}

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

    SHELL is that of the variable SHELL unless it is given. bash must be 4.4 or newer; in zsh, compinit must have been
    called before.
    """
    shell = shell or Path(os.environ.get("SHELL", "")).name
    if shell not in SHELLS:
        raise click.UsageError(f"the shell is not known from $SHELL; name one of {', '.join(SHELLS)}", ctx)
    if install:
        _install(shell)
        return
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(ctx.find_root().command, {}, "sparklod", "_SPARKLOD_COMPLETE").source())


def _install(shell: str) -> None:
    """Append the line that loads the script to the settings of a shell, unless they have it.

    Raises:
        SparklodError: the file cannot be read or written; names it.
    """
    variable, folder, name, line = SHELLS[shell]
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
        raise SparklodError(f"{path}: cannot be changed: {(error.strerror or str(error)).lower()}") from None
    say(f"{path} loads the completion from the next shell on")
