"""The command `sparklod`: its sub-commands, and the one place where errors become exit codes."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import NoReturn

import click

from . import __version__, interrupts
from .commands.console import say, say_error
from .errors import SparklodError

#: Sub-commands, each a module of `commands` with a function of its name; imported when it is called for.
COMMANDS = {name: name.replace("-", "_") for name in ("build-lod", "inspect", "traverse", "render", "warmup")}

EPILOG = """
\b
Exit status: 0 done, 1 something failed, 2 wrong usage, 3 a check did not hold, 130 interrupted.
Shell completion: eval "$(_SPARKLOD_COMPLETE=bash_source sparklod)", or zsh_source, fish_source.
"""


class LazyGroup(click.Group):
    """A group that imports a command when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f".commands.{COMMANDS[cmd_name]}", __package__)
        command: click.Command = getattr(module, COMMANDS[cmd_name])
        return command


@click.group(cls=LazyGroup, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, package_name="sparklod")
def cli() -> None:
    """Bake Level-of-Detail trees for 3D Gaussian splat scenes."""


def run(arguments: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code; arguments are those of the process unless given."""
    try:
        code = cli.main(arguments, prog_name="sparklod", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except SparklodError as error:
        say_error(str(error))
        return 1
    except (click.Abort, KeyboardInterrupt) as error:
        if isinstance(error.__cause__, EOFError):  # which click takes for the end of what somebody types
            raise error.__cause__ from None
        say("interrupted")
        return interrupts.INTERRUPTED
    except BrokenPipeError:
        # Whoever read standard output has gone; pointing it elsewhere keeps the interpreter's last flush quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # all files are opened elsewhere, and their errors told: this is standard output
        say_error(f"cannot write standard output: {(error.strerror or str(error)).lower()}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code if isinstance(code, int) else 0


def main() -> NoReturn:
    """Entry point of the script; cleans up on a polite kill as on Ctrl-C."""
    interrupts.handle()
    code = run()
    interrupts.ignore()
    sys.exit(code)
