"""`--help` has every option under a heading, and whoever mistypes hears what was meant."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from sparklod_cli.cli import ALIASES, COMMANDS, TASKS, cli, run
from sparklod_cli.commands.command import COMMON, FEW_EXAMPLES, GENERAL, Command
from tests.conftest import FIXTURES, ROOT, Capture

COMMAND_NAMES = [name for name in COMMANDS if name != "help"]

#: Columns of the narrowest terminal that help is written for, and the most options that `--help` lists.
COLUMNS, MOST = 80, 14


def command_of(name: str) -> Command:
    command = cli.get_command(click.Context(cli), name)
    assert isinstance(command, Command)
    return command


def printed(*arguments: str, capsys: Capture) -> str:
    assert run([*arguments]) == 0
    return capsys.readouterr().out


def listed(text: str) -> list[str]:
    """The options that a help text lists below its first heading, by their last names."""
    _, _, options = text.partition(":\n")
    return re.findall(r"^  (?:-\w, )?(?:--[\w-]+ / )?(--[\w-]+)(?![\w-])", options, re.MULTILINE)


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_each_option_stands_under_one_heading(name: str, capsys: Capture) -> None:
    command = command_of(name)
    headings = command.by_heading(click.Context(command))
    params = [param for params in headings.values() for param in params]
    params_of_all = command.get_params(click.Context(command))
    options = [param for param in params_of_all if isinstance(param, click.Option) and not param.hidden]
    assert sorted(map(id, params)) == sorted(map(id, options))
    text = printed(name, "--help-all", capsys=capsys)
    for heading in headings:
        assert f"\n{heading}:\n" in text
    text = text[text.index(f"\n{next(iter(headings))}:\n") :]  # after the words about the command
    for option in options:
        assert len(re.findall(rf"^  (?:-\w, )?{re.escape(option.opts[-1])}(?![\w-])", text, re.MULTILINE)) == 1
    assert next(iter(reversed(headings))) == GENERAL


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_help_lists_the_few_options_that_most_people_need(name: str, capsys: Capture) -> None:
    command = command_of(name)
    text = printed(name, "--help", capsys=capsys)
    if not command.abridged:
        assert len(listed(text)) <= MOST
        assert text == printed(name, "--help-all", capsys=capsys)
        return
    common = command.by_heading(click.Context(command))[COMMON]
    shown = [*(param.opts[-1] for param in common), "--help-all", "--help"]
    assert [flag for flag in listed(text) if flag != "--no-summary"] == [flag for flag in shown if flag != "--summary"]
    assert 5 <= len(shown) <= MOST
    assert [line for line in text.splitlines() if line in command.examples] == command.examples[:FEW_EXAMPLES]
    assert not any(line.endswith("\\") for line in command.examples[:FEW_EXAMPLES])  # each is whole


@pytest.mark.parametrize(
    "arguments", [("--help",), *((name, flag) for name in COMMAND_NAMES for flag in ("--help", "--help-all"))]
)
def test_help_fits_the_narrowest_terminal(
    arguments: tuple[str, ...], capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    for line in printed(*arguments, capsys=capsys).splitlines():
        assert len(line) <= COLUMNS, line
        assert not re.search(r"[\w-]-$", line), line  # which is broken within a word


def test_brief_help_of_an_option_is_its_first_sentence_and_its_first_default(capsys: Capture) -> None:
    text = re.sub(r"\s+", " ", printed("build-lod", "--help", capsys=capsys))
    for row in (
        "--output FILE Output of a single input, or a folder for all outputs; - is standard output."
        " [default: NAME-lod.spz beside the input] --output-dir",
        "--max-sh N Highest degree of spherical harmonics to keep. [default: 3] --min-opacity",
        "Scenes as trained",
    ):
        assert (row in text) == row.startswith("--")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_can_be_had_by_help(name: str, capsys: Capture) -> None:
    assert printed("help", name, capsys=capsys) == printed(name, "--help", capsys=capsys)


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_help_ends_with_examples(name: str, capsys: Capture) -> None:
    _, _, examples = printed(name, "--help", capsys=capsys).partition("Examples:\n")
    assert f"  sparklod {name}" in examples


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_examples_are_command_lines(name: str) -> None:
    command = command_of(name)
    for line in "\n".join(command.examples).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if "sparklod" not in words:  # but in a substitution, or not at all
            continue
        called, *arguments = words[words.index("sparklod") + 1 :]
        end = next((at for at, word in enumerate(arguments) if word in ("|", "||", ">")), None)
        assert called == name
        command.make_context(name, arguments[:end])


def test_without_a_command_the_program_shows_tasks(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run([]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert max(map(len, err.splitlines())) <= COLUMNS
    assert [line[2:] for line in err.splitlines() if line.startswith("  ")] == [
        f"{task:<26}{command}" for task, command in TASKS.items()
    ]


def test_the_commands_of_tasks_can_be_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.ply").write_bytes((FIXTURES / "sh0.ply").read_bytes())
    for command in TASKS.values():
        arguments = command.split()[1:]
        if arguments[0] == "view":  # which serves until Ctrl-C
            arguments += ["--export", "site"]
        assert run([*arguments, "-q"]) == 0, command


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


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["warmup", "--outside-foveate", "1"], "; traverse, render have it"),
        (["inspect", "--leaves"], "; convert has it"),
        (["--overwrite", "build-lod"], "; options of a command follow its name, as in sparklod build-lod --overwrite"),
        (["-q"], "; options of a command follow its name, as in sparklod build-lod -q"),
        (["inspect", "--max-bytes", "9"], " any more; write --assert 'bytes<=N'"),
        (["doctor", "--xyzzy"], ""),
    ],
)
def test_an_option_of_other_commands_names_them(arguments: list[str], hint: str, capsys: Capture) -> None:
    assert run(arguments) == 2
    flag = next(each for each in arguments if each.startswith("-"))
    assert capsys.readouterr().err.splitlines()[-1] == f"error: there is no option {flag}{hint}"


def test_a_file_in_place_of_a_command_names_what_bakes_it(tmp_path: Path, capsys: Capture) -> None:
    (path := tmp_path / "my scene.ply").touch()
    assert run([str(path)]) == 2
    assert capsys.readouterr().err.endswith(
        f"error: there is no command {str(path)!r}; did you mean build-lod '{path}'?\n"
    )


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
    assert len(groups[COMMON]) == 11
    general = {"--threads", "--json", "--quiet", "--verbose", "--version", "--help-all", "--help"}
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
