"""Commands whose `--help` has headings, and the group that finds them, loads them late and says what came near."""

from __future__ import annotations

import inspect
import itertools
import os
import re
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..system.setting_fields import Setting


#: Headings that several commands have: of what most people need, and of what every command has.
COMMON, GENERAL = "Common options", "General"

#: Most options of a command whose `--help` lists them all, and what that of other commands has of its help.
MOST_LISTED, FEW_PARAGRAPHS, FEW_EXAMPLES = 12, 2, 5

#: Options that print help.
HELP = {"--help", "--help-all"}

#: Columns of the longest option that has its help beside it, not below.
TERM_WIDTH = 24

#: Units that people put after a blank. They are no names of files.
UNIT = re.compile(r"%|[kmgt]i?b?|ms|s|[kmg]bit(?:/s)?", re.IGNORECASE)

#: The parameter of the output, and those with which a missing output is no mistake.
OUTPUT, NO_OUTPUT = "output", ("output_dir", "scene")

#: Suffixes that inputs and outputs of build-lod and simplify may share.
TREES = (".spz", ".rad")

#: What else people type, and what they mean by it.
ALIASES = {
    "bake": "build-lod",
    "build": "build-lod",
    "convert": "build-lod",
    "lod": "build-lod",
    "unlod": "build-lod --unlod",
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


class Option(click.Option):
    """An option that stands under a heading of `--help`.

    Args:
        bare: its value where it stands alone; another one follows after "=", never as the next argument.
    """

    def __init__(
        self, *arguments: Any, declared: Setting, heading: str = GENERAL, bare: str | None = None, **attributes: Any
    ) -> None:
        super().__init__(*arguments, **attributes)
        self.declared, self.heading, self.bare = declared, heading, bare


class _Formatter(click.HelpFormatter):
    """A formatter that breaks lines between words only, never within --an-option."""

    #: Hyphen in place of "-" at which no line ends, until the text is complete.
    HYPHEN = "\u2011"

    def write_text(self, text: str) -> None:
        super().write_text(text.replace("-", self.HYPHEN))

    def write_dl(self, rows: Iterable[tuple[str, str]], *arguments: Any, **attributes: Any) -> None:
        super().write_dl([(term, text.replace("-", self.HYPHEN)) for term, text in rows], *arguments, **attributes)

    def getvalue(self) -> str:
        return super().getvalue().replace(self.HYPHEN, "-")


class Command(click.Command):
    """A command whose help lists options under headings, and ends with examples.

    `--help` lists the options under `COMMON`, in a sentence each, if the command has many; `--help-all` lists all.

    Args:
        examples: lines with a command each, the most useful ones first. A command may take several lines.
        headings: the order of the headings; those that are not named follow in the order of their first options, and
            `GENERAL` is the last one.
    """

    def __init__(
        self, *arguments: Any, examples: str = "", headings: Sequence[str] = (COMMON,), **attributes: Any
    ) -> None:
        super().__init__(*arguments, **attributes)
        self.examples = examples.splitlines()
        self.headings = headings
        self.abridged = len(self.params) > MOST_LISTED
        how: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": _print_help_all}
        text = "Print the help of all options, and more examples."
        self.params.append(click.Option(["--help-all"], help=text, hidden=not self.abridged, **how))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        options = [param for param in self.params if isinstance(param, Option) and param.bare is not None]
        bare = {name: f"{name}={param.bare}" for param in options for name in param.opts}
        end = args.index("--") if "--" in args else len(args)
        refuse_lone_units(args[:end], ctx)
        try:
            rest = super().parse_args(ctx, [*(bare.get(arg, arg) for arg in args[:end]), *args[end:]])
        except click.MissingParameter as error:
            if error.param is None or error.param.name != OUTPUT:
                raise
            refuse_output_among_inputs(ctx, missing=True)
            raise
        if not ctx.resilient_parsing:
            refuse_output_among_inputs(ctx)
        return rest

    def by_heading(self, ctx: click.Context, *, whole: bool = True) -> dict[str, list[click.Parameter]]:
        """Return the options that the help lists, by heading, in the order of both.

        Args:
            whole: all; else the common ones and those that print help.
        """
        params = [param for param in self.get_params(ctx) if isinstance(param, click.Option) and not param.hidden]
        if not whole:
            params = [each for each in params if _heading(each) == COMMON or HELP.intersection(each.opts)]
        listed: dict[str, list[click.Parameter]] = {heading: [] for heading in self.headings}
        last: list[click.Parameter] = []
        for param in params:
            heading = _heading(param)
            (last if heading == GENERAL else listed.setdefault(heading, [])).append(param)
        return {heading: params for heading, params in (*listed.items(), (GENERAL, last)) if params}

    def get_help(self, ctx: click.Context, *, whole: bool = False) -> str:
        """Return the help; with `whole`, that of all options."""
        whole = whole or not self.abridged
        formatter = _Formatter(width=ctx.terminal_width, max_width=ctx.max_content_width)
        self.format_usage(ctx, formatter)
        paragraphs = inspect.cleandoc(self.help or "").split("\n\n")
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text("\n\n".join(paragraphs if whole else paragraphs[:FEW_PARAGRAPHS]))
        for heading, params in self.by_heading(ctx, whole=whole).items():
            rows = [record for param in params if (record := param.get_help_record(ctx))]
            with formatter.section(heading):
                formatter.write_dl(rows if whole else [(term, _brief(text)) for term, text in rows], col_max=TERM_WIDTH)
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"{line}\n" for line in self.examples[: None if whole else FEW_EXAMPLES]))
        return formatter.getvalue().rstrip("\n")


def _brief(text: str) -> str:
    """Return the first sentence of the help of an option, and its default as far as a semicolon."""
    about, _, default = text.partition("  [")
    sentence = about.split(". ")[0].rstrip(".") + "."
    return f"{sentence}  [{re.split('[];]', default)[0]}]" if default else sentence


def _heading(param: click.Parameter) -> str:
    return getattr(param, "heading", GENERAL)


def _print_help_all(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        assert isinstance(ctx.command, Command)
        click.echo(ctx.command.get_help(ctx, whole=True))
        ctx.exit()


def refuse_lone_units(args: Sequence[str], ctx: click.Context) -> None:
    """Raise a `click.UsageError` for a unit apart from its number, as in --to 10 %: it would be taken for an input."""
    for before, unit in itertools.pairwise(args):
        number = re.fullmatch(r"(?:-{1,2}[\w-]+=)?([0-9]+(?:\.[0-9]*)?)", before)
        if number and UNIT.fullmatch(unit) and not os.path.exists(unit):  # noqa: PTH110
            raise click.UsageError(f"{before} {unit} has a blank before its unit; write {before}{unit}", ctx)


def refuse_output_among_inputs(ctx: click.Context, *, missing: bool = False) -> None:
    """Raise a `click.UsageError` if the last input seems to be the output, as of cp: nothing has its name yet.

    Args:
        missing: the command must have an output, and has none.
    """
    if (not missing and OUTPUT not in ctx.params) or any(ctx.params.get(name) for name in (OUTPUT, *NO_OUTPUT)):
        return
    *others, last = ctx.params.get("inputs") or ctx.params.get("files") or (None,)
    if not others or not isinstance(last, Path) or not last.suffix or last.exists():
        return
    alike = {other.suffix.lower() for other in others if other.suffix} - set(TREES if "inputs" in ctx.params else ())
    if last.suffix.lower() in alike and not missing:
        return  # a second input whose name is wrong
    import shlex  # needed after a mistake only

    raise click.UsageError(f"{last} does not exist; did you mean -o {shlex.quote(str(last))}?", ctx)


class Group(click.Group):
    """A group of commands that are each imported when they are called for.

    Args:
        rows: by the name of a command what `--help` says of it. Its module in `commands`, and the function there, have
            the same name, with _ for -.
    """

    def __init__(self, *arguments: Any, rows: dict[str, str], **attributes: Any) -> None:
        super().__init__(*arguments, **attributes)
        self.rows = rows

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.rows)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.rows:
            return None
        if cmd_name == help.name:
            return help
        name = cmd_name.replace("-", "_")
        command: click.Command = getattr(import_module(f".{name}", __package__), name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in self.rows and not args[0].startswith("-"):
            raise click.UsageError(self.unknown(args[0]), ctx)
        return super().resolve_command(ctx, args)

    def unknown(self, name: str) -> str:
        """Return the error for an unknown command, with the command that was probably meant, or all of them."""
        if os.path.isfile(name):  # noqa: PTH113
            import shlex  # needed after a mistake only

            meant: str | None = f"build-lod {shlex.quote(name)}"
        else:
            meant = near_command(name, list(self.rows))
        hint = f"did you mean {meant}?" if meant else f"the commands are {', '.join(self.rows)}"
        return f"there is no command {name!r}; {hint}"

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the rows, without loading a command."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self.rows.items()))


def near_command(name: str, names: Sequence[str]) -> str | None:
    """Return the command that was probably meant by another name, or None."""
    import difflib  # which takes a millisecond, and is needed after a mistake only

    plain = name.lower().replace("_", "-")
    if plain in names or plain in ALIASES:
        return plain if plain in names else ALIASES[plain]
    for near in difflib.get_close_matches(plain, [*names, *ALIASES], n=1, cutoff=0.7):
        return ALIASES.get(near, near)
    return None


@click.command("help", cls=Command)
@click.argument("command", required=False)
@click.pass_context
def help(ctx: click.Context, command: str | None) -> None:
    """Print the help of COMMAND, or of sparklod itself, as --help does."""
    parent = ctx.parent
    assert parent is not None and isinstance(parent.command, Group)
    if command is None:
        click.echo(parent.get_help())
        return
    named = parent.command.get_command(parent, command)
    if named is None:
        raise click.UsageError(parent.command.unknown(command), parent)
    with named.make_context(command, [], parent=parent, resilient_parsing=True) as child:
        click.echo(child.get_help())
