"""The command `sparklod`: its sub-commands, and the one place where errors become exit codes."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any, NoReturn

import click

from . import __version__
from .commands.command import Command
from .commands.console import Verbosity, say, say_error, say_usage_error
from .system import interrupts, stdio
from .system.errors import SparklodError, UnfitError, out_of_memory, reason_of
from .system.untrusted import printable

#: Most characters of an unexpected error in its message.
QUOTED = 200

#: Variables by which a person chooses the threads of numpy's OpenBLAS; the first one is for nothing else.
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")

#: Commands and their lines in `sparklod --help`.
COMMANDS = {
    "build-lod": "Bake splat files into Level-of-Detail files.",
    "convert": "Write a splat file in another format.",
    "simplify": "Write a scene with fewer splats, for all cameras.",
    "inspect": "Report on splat files and check them.",
    "traverse": "Simulate what a viewer draws along a camera path.",
    "render": "Draw pictures of splat files, and compare them.",
    "view": "Show splat files in Spark, in a browser.",
    "warmup": "Compile all kernels ahead of the first run.",
    "doctor": "Check the installation, and say what to do.",
    "completion": "Complete commands, options and file names in a shell.",
    "help": "Print the help of a command.",
}

#: Modules of commands that have no module of their own name.
MODULES = dict.fromkeys(("doctor", "warmup", "completion"), "installation")

#: Names of commands in other tools, and the commands here.
ALIASES = {
    "bake": "build-lod",
    "build": "build-lod",
    "lod": "build-lod",
    "unlod": "convert --leaves",
    "transcode": "convert",
    "export": "convert",
    "decimate": "simplify",
    "reduce": "simplify",
    "check": "inspect",
    "info": "inspect",
    "report": "inspect",
    "stats": "inspect",
    "validate": "inspect",
    "benchmark": "traverse",
    "simulate": "traverse",
    "compare": "render --compare",
    "draw": "render",
    "preview": "render",
    "compile": "warmup",
    "serve": "view",
    "show": "view",
    "open": "view",
}

#: Tasks and their commands, which can be run one after the other.
TASKS = {
    "Bake a scene for the web": "sparklod build-lod scene.ply",
    "Look at it in a browser": "sparklod view scene-lod.spz",
    "Make a scene smaller": "sparklod simplify scene.ply --to 10% -o small.ply",
    "Draw a picture of it": "sparklod render scene-lod.spz -o scene.png",
    "Check a file": "sparklod inspect scene-lod.spz --check",
    "See what viewers load": "sparklod traverse scene-lod.spz --budget 500k",
}

EPILOG = """
\b
Exit status: 0 done, 1 something failed, 2 wrong usage, 3 a check did not
hold, 130 interrupted. Shell completion: sparklod completion --install.
"""


class _EndOfFileError(Exception):
    """Carries an `EOFError` past click, which would report it as Ctrl-D of a person."""


class Sparklod(click.Group):
    """Group of all commands, which imports each when it is needed."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise _EndOfFileError from error

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        if cmd_name == help.name:
            return help
        name = cmd_name.replace("-", "_")
        module = import_module(f".commands.{MODULES.get(name, name)}", __package__)
        command: click.Command = getattr(module, name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            raise click.UsageError(_unknown(args[0]), ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the lines of the commands, without importing any."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


def _unknown(name: str) -> str:
    """Return the error for an unknown command, which names the most similar command, or all."""
    if os.path.isfile(name):  # noqa: PTH113
        import shlex  # needed after a mistake only

        meant: str | None = f"build-lod {shlex.quote(name)}"
    else:
        import difflib  # which takes a millisecond

        plain = name.lower().replace("_", "-")
        names = [*COMMANDS, *ALIASES]
        near = [plain] if plain in names else difflib.get_close_matches(plain, names, n=1, cutoff=0.7)
        meant = next((each if each in COMMANDS else ALIASES[each] for each in near), None)
    hint = f"did you mean {meant}?" if meant else f"the commands are {', '.join(COMMANDS)}"
    return f"there is no command {name!r}; {hint}"


@click.command("help", cls=Command)
@click.argument("command", required=False)
@click.pass_context
def help(ctx: click.Context, command: str | None) -> None:
    """Print the help of COMMAND, or of sparklod itself, as --help does."""
    parent = ctx.find_root()
    if command is None:
        click.echo(parent.get_help())
        return
    named = cli.get_command(parent, command)
    if named is None:
        raise click.UsageError(_unknown(command), parent)
    with named.make_context(command, [], parent=parent, resilient_parsing=True) as child:
        click.echo(child.get_help())


@click.group(
    cls=Sparklod, epilog=EPILOG, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, package_name="sparklod")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Bake Level-of-Detail trees for 3D Gaussian splat scenes."""
    if ctx.invoked_subcommand is None:
        rows = [f"  {task:<26}{command}" for task, command in TASKS.items()]
        title = "Level-of-Detail trees for 3D Gaussian splat scenes. What do you want to do?"
        for line in (title, "", *rows, "", "sparklod COMMAND --help has the options, sparklod --help all commands."):
            say(line)
        ctx.exit(2)


def run(arguments: list[str] | None = None) -> int:
    """Run a command line, by default that of the process, and return its exit code."""
    verbosity, code = Verbosity(), 1
    with stdio.guarded():
        try:
            result = cli.main(arguments, prog_name="sparklod", standalone_mode=False, obj=verbosity)
            code = result if isinstance(result, int) else 0
        except click.ClickException as error:
            say_usage_error(error)
            code = error.exit_code
        except UnfitError as error:
            say_error(str(error))
            code = 2
        except stdio.ReaderGoneError:
            pass
        except SparklodError as error:
            say_error(str(error))
        except (click.Abort, KeyboardInterrupt):
            say("interrupted")
            code = interrupts.INTERRUPTED
        except OSError as error:  # not about a named file or standard output; those are reported at the source
            if out_of_memory(error):
                code = _failed(error, verbosity)
            else:
                is_named = isinstance(error.filename, (str, bytes, os.PathLike))
                where = f"{os.fsdecode(error.filename)}: " if is_named else ""
                say_error(f"cannot go on: {where}{reason_of(error)}")
        except Exception as error:
            cause = error.__cause__ if isinstance(error, _EndOfFileError) else None
            code = _failed(cause or error, verbosity)
    return interrupts.INTERRUPTED if code and interrupts.came.is_set() else code


def _failed(error: BaseException, verbosity: Verbosity) -> int:
    """Report an unexpected error, or a lack of memory, in one line; return the exit code.

    Last resort: reaching this line is a bug, but a user has no use for a traceback.
    """
    if interrupts.came.is_set():
        say("interrupted")
        return interrupts.INTERRUPTED
    if verbosity.verbose:
        import traceback

        for line in "".join(traceback.format_exception(error)).splitlines():
            say(line)
    message = out_of_memory(error)
    if message is None:
        message = (
            f"sparklod failed in a way that it should not: {printable(f'{type(error).__name__}: {error}', QUOTED)};"
            " please report this command, with its input if you can"
        )
        message += "" if verbosity.verbose else " (-v shows where it happened)"
    say_error(message)
    return 1


def main() -> NoReturn:
    """Entry point of the script; cleans up on a polite kill as on Ctrl-C."""
    # Each thread of numpy's OpenBLAS spins for some 60 ms when numpy is loaded. Matrices here are small, or are blocks
    # of large ones on threads of our own.
    if not any(map(os.environ.get, BLAS_THREADS)):
        os.environ[BLAS_THREADS[0]] = "1"
    try:
        stdio.reserve()
        interrupts.handle()
        code = run()
        interrupts.ignore()
    except KeyboardInterrupt:  # before the work began, or after its end
        interrupts.ignore()
        say("interrupted")
        code = interrupts.INTERRUPTED
    # An interrupt that came while Python ran a string, as dataclasses does, would otherwise make it end by that signal,
    # whatever the status: it remembers the last one until another string has run.
    exec("")
    sys.exit(code)
