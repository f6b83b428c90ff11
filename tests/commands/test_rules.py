"""The table of rules: every row refuses a command line, and names the option and the reason."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from sparklod_cli.cli import cli, run
from sparklod_cli.codecs.formats import RadOptions
from sparklod_cli.commands.command import Option
from sparklod_cli.commands.rules import LEVELS, RAD, RULES, STREAMED_SOG, TILES_3D, Rule, flag_of
from sparklod_cli.lod.tree_settings import DetailSettings, TileSettings
from sparklod_cli.system.setting_fields import Quantity, Range, settings_in
from sparklod_cli.viewers.viewer_settings import DetailRule
from tests.conftest import FIXTURES, Capture

PLAIN, TREE = FIXTURES / "one.ply", FIXTURES / "golden" / "tree-v3.spz"

#: Command lines without options, by command.
LINES: dict[str, list[Any]] = {
    "build-lod": [PLAIN],
    "convert": [PLAIN, "out.ply"],
    "simplify": [PLAIN, "-o", "out.ply"],
    **{key: [TREE] for key in ("inspect", "traverse", "render", "view")},
}

#: Values of options whose texts are parsed, by their unit in --help.
TEXTS = {
    "x,y,z": "1,2,3",
    "COLOR": "white",
    "WxH": "64x64",
    "EYE:TARGET": "0,0,5:0,0,0",
    "'EYE:TARGET ...'": "0,0,5:0,0,0 5,0,0:0,0,0",
    "SIZE": "1M",
    "RATE": "1Mbit",
    "TIME": "1s",
    "SHARES|auto": "50%",
    "NUMBERS": "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1",
    "N": "5k",
    "N|P%": "5k",
    "N|P%,...": "5k",
    "auto|N": "12",
}

#: Arguments that make a fact true, further inputs or options; for formats, by command.
FACTS: dict[str, list[Any]] = {
    "place=standard output": ["-o", "-"],
    "place=folder": [],
    "source=standard input": ["-"],
    "count=2": [PLAIN],
    "method=quick": ["--method", "quick"],
    "method=quality": ["--method", "quality"],
    "picture=png": ["-o", "out.png"],
    "picture=npy": ["-o", "out.npy"],
    "table=none": [],
    "stdout=terminal": [],
    "scenes=None": [PLAIN],
    "scenes=a Level-of-Detail tree": [],
    "scenes=Streamed SOG": [FIXTURES / "golden" / "sh1-streamed-sog"],
    "scenes=3D Tiles": [FIXTURES / "golden" / "sh1-tiles"],
}
ENDINGS = {"SPZ": "out.spz", "RAD": "out.rad", "3D Tiles": "tileset.json", "PLY": "out.ply"}


def params_of(command: str) -> dict[str, click.Parameter]:
    found = cli.get_command(click.Context(cli), command)
    assert found is not None
    return {str(param.name): param for param in found.params}


def argument(command: str, condition: str) -> list[Any]:
    """The option of a condition, with a value."""
    name, equals, value = condition.partition("=")
    param = params_of(command)[name]
    if isinstance(param, click.Argument):
        return []
    flag = max(param.opts, key=len)
    if equals:
        return [flag, value]
    if not isinstance(param, Option) or param.is_flag or param.bare or not param.type or param._flag_needs_value:
        return [flag]
    kind = param.declared.kind
    if isinstance(kind, Quantity):
        return [flag, TEXTS[kind.unit]]
    if isinstance(kind, tuple):
        return [flag, kind[-1]]
    if isinstance(kind, Range):
        low, high = kind.least or kind.above or 0, kind.most or kind.below
        value = low + 1 if high is None else (low + high) / 2
        return [flag, int(value) if kind.whole else value]
    suffixes = getattr(param.type, "suffixes", ()) or (".x",)
    return [flag, f"some{suffixes[0]}"]


def is_met(command: str, condition: str, line: list[Any]) -> bool:
    name, equals, value = condition.partition("=")
    param = params_of(command).get(name)
    if param is None:
        return False
    flag = max(param.opts, key=len)
    return flag in line or bool(equals and str(param.default) == value)


def with_needs(command: str, name: str, line: list[Any], besides: Rule) -> list[Any]:
    """A command line with what the options on it need by other rows."""
    for rule in RULES:
        if rule is besides or command not in rule.commands or name not in rule.options or rule.when:
            continue
        needs = [each for each in rule.needs if each.partition("=")[0] in params_of(command)]
        if needs and not any(is_met(command, each, line) for each in needs):
            more = argument(command, needs[0])
            line = with_needs(command, needs[0].partition("=")[0], [*line, *more], besides)
    return line


def against(rule: Rule, command: str, name: str) -> Iterator[str]:
    """Conditions under which a row refuses an option; one without a name for a row that needs something."""
    if rule.only_for:
        fact = rule.only_for[0].partition("=")[0]
        formats = [form for form in ENDINGS if form != ("PLY" if command == "build-lod" else "3D Tiles")]
        known = [f"format={form}" for form in formats] if fact == "format" else list(FACTS)
        yield next(each for each in known if each.startswith(f"{fact}=") and each not in rule.only_for)
    elif rule.excludes:
        known = [*params_of(command), *(each.partition("=")[0] for each in FACTS)]
        others = [each for each in rule.excludes if each != name and each.partition("=")[0] in known]
        yield from others if name == rule.options[0] else others[:1]
    else:  # a value that differs from a default that would do
        met = [params_of(command)[each.partition("=")[0]] for each in rule.needs if is_met(command, each, [])]
        others = [f"{param.name}={value}" for param in met for value in getattr(param.type, "choices", ())]
        yield next((each for each in others if each not in rule.needs), "")


ROWS = [
    pytest.param(rule, command, name, condition, id=f"{number}-{command}-{name}-{condition}")
    for number, rule in enumerate(RULES)
    for command in rule.commands
    for name in rule.options
    if name in params_of(command)
    for condition in against(rule, command, name)
]


@pytest.mark.parametrize(("rule", "command", "name", "condition"), ROWS)
def test_every_row_refuses_a_command_line(
    rule: Rule,
    command: str,
    name: str,
    condition: str,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    line, fact = list(LINES[command]), condition.partition("=")[0]
    if (condition.startswith("scenes") and FACTS[condition]) or (
        "scene" in (name, fact) and name not in ("inputs", "files")
    ):
        line = []
    line += argument(command, name)
    if condition in FACTS:
        line += FACTS[condition]
    elif fact == "format":
        ending = ENDINGS[condition.partition("=")[2]]
        line = [*line, "-o", ending] if command != "convert" else [PLAIN, ending, *line[2:]]
    elif condition:
        line += argument(command, condition)
    if rule.when:
        line = [PLAIN, "-", *line[2:]] if command == "convert" else [*line, *argument(command, rule.when[0])]
    if condition == "stdout=terminal" or (condition == "table=none" and not rule.when):
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    if command == "simplify" and not {"--to", "--max-bytes", "--psnr"} & {*map(str, line)}:
        line += ["--to", "50%"]
    if condition in FACTS or fact == "format":
        line = with_needs(command, name, line, rule)
    if command == "render" and not {"-o", "--output"} & {*map(str, line)}:
        line += ["-o", "out.png"]
    assert run([command, *map(str, line)]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    flags = [flag_of(context_of(command), each) for each in rule.options if each in params_of(command)]
    assert error.startswith(tuple(f"error: {flag} " for flag in flags)), line
    for part in rule.why.replace("{", "}").split("}")[::2]:
        assert part in error
    for other in (condition,) if condition and condition not in FACTS and fact != "format" else ():
        shown, _, value = other.partition("=")
        assert rule.why[:1] not in ("", ",") or f"{flag_of(context_of(command), shown)} {value}".rstrip() in error
    assert not list(tmp_path.iterdir())


def context_of(command: str) -> click.Context:
    found = cli.get_command(click.Context(cli), command)
    assert found is not None
    return click.Context(found)


def test_every_name_in_the_table_is_a_parameter() -> None:
    for rule in RULES:
        known = {name for command in rule.commands for name in params_of(command)}
        assert {*rule.options} <= known
        named = [each.partition("=")[0] for each in (*rule.needs, *rule.excludes, *rule.when)]
        assert {*named} <= known | {each.partition("=")[0] for each in FACTS}


@pytest.mark.parametrize(
    ("names", "settings"),
    [(RAD, RadOptions), (STREAMED_SOG, DetailSettings), (TILES_3D, TileSettings), (LEVELS, DetailRule)],
)
def test_the_table_has_all_options_of_a_format(names: tuple[str, ...], settings: type[Any]) -> None:
    assert {each.name or field.name for field, each in settings_in(settings) if each is not None} <= {*names}
