"""`--help` has every option under a heading, and whoever mistypes hears what was meant."""

from __future__ import annotations

import re
import subprocess
import sys

import click
import pytest

from sparklod_cli.cli import COMMANDS, cli, run
from sparklod_cli.commands.command import ALIASES, COMMON, GENERAL, Command
from tests.conftest import ROOT, Capture

COMMAND_NAMES = [name for name in COMMANDS if name != "help"]


def command_of(name: str) -> Command:
    command = cli.get_command(click.Context(cli), name)
    assert isinstance(command, Command)
    return command


def printed(*arguments: str, capsys: Capture) -> str:
    assert run([*arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_each_option_stands_under_one_heading(name: str, capsys: Capture) -> None:
    command = command_of(name)
    headings = command.by_heading(click.Context(command))
    listed = [param for params in headings.values() for param in params]
    options = [param for param in command.get_params(click.Context(command)) if isinstance(param, click.Option)]
    assert sorted(map(id, listed)) == sorted(map(id, options))
    text = printed(name, "--help", capsys=capsys)
    for heading in headings:
        assert f"\n{heading}:\n" in text
    text = text[text.index(f"\n{next(iter(headings))}:\n") :]  # after the words about the command
    for option in options:
        assert len(re.findall(rf"^  (?:-\w, )?{re.escape(option.opts[-1])}(?![\w-])", text, re.MULTILINE)) == 1
    assert next(iter(reversed(headings))) == GENERAL


@pytest.mark.parametrize("name", ["build-lod", "inspect"])
def test_the_first_heading_has_the_few_options_that_most_people_need(name: str) -> None:
    command = command_of(name)
    first, params = next(iter(command.by_heading(click.Context(command)).items()))
    assert first == COMMON
    assert 5 <= len(params) <= 12


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_can_be_had_by_help(name: str, capsys: Capture) -> None:
    assert printed("help", name, capsys=capsys) == printed(name, "--help", capsys=capsys)


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_help_ends_with_examples(name: str, capsys: Capture) -> None:
    _, _, examples = printed(name, "--help", capsys=capsys).partition("Examples:\n")
    assert f"  sparklod {name}" in examples


def test_without_a_command_the_program_prints_its_help(capsys: Capture) -> None:
    help_text = printed("--help", capsys=capsys)
    run([])
    said = capsys.readouterr()
    assert (said.out + said.err).strip() == help_text.strip()


def test_help_alone_is_that_of_the_program(capsys: Capture) -> None:
    text = printed("help", capsys=capsys)
    assert text == printed("--help", capsys=capsys)
    for name, summary in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        *ALIASES.items(),
        ("build_lod", "build-lod"),
        ("Build-LOD", "build-lod"),
        ("buildlod", "build-lod"),
        ("inspct", "inspect"),
        ("travers", "traverse"),
        ("rendr", "render"),
        ("warm-up", "warmup"),
    ],
)
def test_a_command_that_there_is_not_names_the_one_that_was_meant(typed: str, meant: str, capsys: Capture) -> None:
    for arguments in ([typed, "scene.ply"], ["help", typed]):
        assert run(arguments) == 2
        assert capsys.readouterr().err.endswith(f"error: there is no command {typed!r}; did you mean {meant}?\n")


def test_every_alias_means_a_command() -> None:
    assert {meant.split()[0] for meant in ALIASES.values()} <= set(COMMANDS)
    assert not set(ALIASES) & set(COMMANDS)


def test_a_command_like_no_other_lists_them(capsys: Capture) -> None:
    assert run(["xyzzy"]) == 2
    assert f"there is no command 'xyzzy'; the commands are {', '.join(COMMANDS)}\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["build-lod", "--ouput", "x"], "--output"),
        (["build-lod", "--spz-versoin", "2"], "--spz-version"),
        (["inspect", "--chek"], "--check"),
        (["build-lod", "--quality"], "--method quality"),
        (["--verison"], "--version"),
    ],
)
def test_an_option_that_there_is_not_names_the_one_that_was_meant(
    arguments: list[str], meant: str, capsys: Capture
) -> None:
    assert run(arguments) == 2
    err = capsys.readouterr().err
    wrong = next(each for each in arguments if each.startswith("--"))
    assert err.splitlines()[-1] == f"error: there is no option {wrong}; did you mean {meant}?"


@pytest.mark.parametrize("arguments", [(), *((name,) for name in COMMANDS)], ids=" ".join)
def test_help_loads_nothing_heavy(arguments: tuple[str, ...]) -> None:
    code = "import sys; from sparklod_cli.cli import run; run(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", code, *arguments, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {name.split(".")[0] for name in done.stderr.split()}
    assert not loaded & {"numpy", "numba", "plyfile", "zstandard", "tqdm", "PIL", "open3d", "pyvista"}
    assert arguments or "sparklod_cli.commands.build_lod" not in done.stderr.split()


#: The headings of the commands that have most options, between the common ones and the general ones.
HEADINGS = {
    "render": ["Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming", "Appearance", "Comparison", "Output"],
    "traverse": ["Inputs", "Cameras", "Cut", "Streamed SOG", "Streaming", "Output"],
}


@pytest.mark.parametrize("name", HEADINGS)
def test_options_stand_under_headings_the_common_ones_first(name: str) -> None:
    command = command_of(name)
    groups = command.by_heading(click.Context(command))
    assert [*groups] == [COMMON, *HEADINGS[name], GENERAL]
    assert len(groups[COMMON]) == 10
    general = {"--threads", "--json", "--quiet", "--verbose", "--version", "--help"}
    assert {max(param.opts, key=len) for param in groups[GENERAL]} == general


@pytest.mark.parametrize("name", ["render", "traverse"])
def test_help_texts_are_phrases_that_end_in_a_point(name: str) -> None:
    for param in command_of(name).params:
        if isinstance(param, click.Option):
            assert param.help, param.name
            text = param.help.partition("  [default")[0]
            assert text[0].isupper(), param.name
            assert text.endswith((".", "design)")), text
            assert not re.search(r"\bso (much|many)\b|\bwhat is\b|\bthere\b[.]", text), text
