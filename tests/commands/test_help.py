"""Help of commands and options, names that were mistyped, versions of JSON, completion in shells, `sparklod doctor`."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest

from sparklod_cli import __version__
from sparklod_cli.cli import ALIASES, BLAS_THREADS, COMMANDS, TASKS
from sparklod_cli.cli import cli as program
from sparklod_cli.commands import installation as doctor
from sparklod_cli.commands.command import COMMON, FEW_EXAMPLES, GENERAL, Command
from sparklod_cli.commands.console import JSON_VERSION
from sparklod_cli.commands.installation import SHELLS, Check
from sparklod_cli.inspection.report import SCHEMA_VERSION
from tests.commands.cli import Cli, process
from tests.conftest import ROOT

NAMES = [name for name in COMMANDS if name != "help"]

#: Columns of the narrowest terminal that help is written for, and the most options that `--help` lists.
COLUMNS, MOST = 80, 14


def command_of(name: str) -> Command:
    command = program.get_command(click.Context(program), name)
    assert isinstance(command, Command)
    return command


def listed(text: str) -> list[str]:
    """Return the options that a help text lists below its first heading, by their last names."""
    _, _, options = text.partition(":\n")
    return re.findall(r"^  (?:-\w, )?(?:--[\w-]+ / )?(--[\w-]+)(?![\w-])", options, re.MULTILINE)


# --- Help -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_each_option_stands_under_one_heading(name: str, cli: Cli) -> None:
    command = command_of(name)
    headings = command.by_heading(click.Context(command))
    params = [param for params in headings.values() for param in params]
    params_of_all = command.get_params(click.Context(command))
    options = [param for param in params_of_all if isinstance(param, click.Option) and not param.hidden]
    assert sorted(map(id, params)) == sorted(map(id, options))
    text = cli(f"{name} --help-all").out
    assert all(f"\n{heading}:\n" in text for heading in headings) and [*headings][-1] == GENERAL
    text = text[text.index(f"\n{next(iter(headings))}:\n") :]  # after the words about the command
    for option in options:
        assert len(re.findall(rf"^  (?:-\w, )?{re.escape(option.opts[-1])}(?![\w-])", text, re.MULTILINE)) == 1
        assert option.help and option.help[0].isupper(), option.name
        sentence = option.help.partition("  [default")[0]
        assert name not in ("render", "traverse") or sentence.endswith((".", "design)")), sentence


@pytest.mark.parametrize("name", NAMES)
def test_help_lists_the_few_options_that_most_people_need(name: str, cli: Cli) -> None:
    command, text = command_of(name), cli(f"{name} --help").out
    assert text == cli(f"help {name}").out
    assert f"  sparklod {name}" in text.partition("Examples:\n")[2]
    if not command.abridged:
        assert len(listed(text)) <= MOST and text == cli(f"{name} --help-all").out
        return
    common = command.by_heading(click.Context(command))[COMMON]
    shown = [*(param.opts[-1] for param in common), "--help-all", "--help"]
    assert [flag for flag in listed(text) if flag != "--no-summary"] == [flag for flag in shown if flag != "--summary"]
    assert 5 <= len(shown) <= MOST
    assert [line for line in text.splitlines() if line in command.examples] == command.examples[:FEW_EXAMPLES]
    assert not any(line.endswith("\\") for line in command.examples[:FEW_EXAMPLES])  # each is whole


@pytest.mark.parametrize("line", ["--help", *(f"{name} {flag}" for name in NAMES for flag in ("--help", "--help-all"))])
def test_help_fits_the_narrowest_terminal(line: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    for text in cli(line).out.splitlines():
        assert len(text) <= COLUMNS, text
        assert not re.search(r"[\w-]-$", text), text  # which is broken within a word


def test_brief_help_of_an_option_is_its_first_sentence_and_its_first_default(cli: Cli) -> None:
    text = re.sub(r"\s+", " ", cli("build-lod --help").out)
    for row in (
        "--output FILE Output of a single input, or a folder for all outputs; - is standard output."
        " [default: NAME-lod.spz beside the input] --output-dir",
        "--max-sh N Highest degree of spherical harmonics to keep. [default: 3] --min-opacity",
    ):
        assert row in text
    assert "Scenes as trained" not in text
    text = " ".join(cli("traverse --help-all").out.split())
    for row in ("EYE:TARGET", "'EYE:TARGET ...'", "WxH", "sparklod, csv, nerfstudio", "opengl-c2w|opencv-c2w"):
        assert row in text


@pytest.mark.parametrize("name", NAMES)
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


def test_without_a_command_the_program_shows_tasks_that_can_be_run_in_order(cli: Cli) -> None:
    done = cli("", status=2)
    lines = done.err.splitlines()
    assert done.out == "" and max(map(len, lines)) <= COLUMNS
    rows = [f"{task:<26}{command}" for task, command in TASKS.items()]
    assert [line[2:] for line in lines if line.startswith("  ")] == rows
    cli.copy("sh0.ply")
    Path("sh0.ply").rename("scene.ply")
    for command in TASKS.values():
        words = command.partition(" ")[2]
        cli(f"{words} -q" + " --export site" * words.startswith("view"))  # which serves until Ctrl-C


def test_help_alone_is_that_of_the_program(cli: Cli) -> None:
    text = cli("help").out
    assert text == cli("--help").out and "Usage: sparklod" in text
    for name, summary in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", text, re.MULTILINE)
    for line in ("--version", "build-lod --version"):
        assert cli(line).out == f"sparklod, version {__version__}\n"


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        *ALIASES.items(),
        *(("build_lod", "build-lod"), ("Build-LOD", "build-lod"), ("buildlod", "build-lod"), ("inspct", "inspect")),
        *(("travers", "traverse"), ("rendr", "render"), ("warm-up", "warmup")),
    ],
)
def test_a_mistyped_command_is_recognised(typed: str, meant: str, cli: Cli) -> None:
    assert typed not in COMMANDS and meant.split()[0] in COMMANDS
    for words in ([typed, "scene.ply"], ["help", typed]):
        said = f"error: there is no command {typed!r}; did you mean {meant}?\n"
        assert cli("", *words, status=2).err.endswith(said)


@pytest.mark.parametrize("arguments", [(), *((name,) for name in COMMANDS)], ids=" ".join)
def test_help_loads_nothing_heavy(arguments: tuple[str, ...]) -> None:
    code = "import sys; from sparklod_cli.cli import run; run(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", code, *arguments, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {name.split(".")[0] for name in done.stderr.split()}
    assert not loaded & {"numpy", "numba", "plyfile", "zstandard", "tqdm", "PIL", "open3d", "pyvista"}
    assert arguments or "sparklod_cli.commands.build_lod" not in done.stderr.split()


@pytest.mark.parametrize(("given", "found"), [(None, "1"), ("3", None)])
def test_numpy_starts_no_threads_unless_a_person_asks_for_them(given: str | None, found: str | None) -> None:
    code = """
import atexit, os, sys
from sparklod_cli.cli import main
atexit.register(lambda: print(os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS")))
sys.argv = ["sparklod", "--version"]
main()
"""
    environment = {name: value for name, value in os.environ.items() if name not in BLAS_THREADS}
    if given is not None:
        environment["OMP_NUM_THREADS"] = given
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)
    assert result.stdout.splitlines()[-1] == f"{found} {given}", result.stderr


# --- JSON -------------------------------------------------------------------------------------------------------------

#: Lines that print an object with little work, by command.
RECORDS = {
    "build-lod": "build-lod sh0.ply -o a.spz",
    "convert": "convert sh0.ply a.sog",
    "simplify": "simplify sh0.ply --to 50% -o a.ply",
    "inspect": "inspect tree-v3.spz",
    "traverse": "traverse tree-v3.spz --orbit 2",
    "render": "render tree-v3.spz --size 32x24 -o a.png",
    "render --compare": "render --compare tree-v3.spz --orbit 1 --size 64x48 --budget 50%",
    "view": "view tree-v3.spz --export a",
    "warmup": "warmup --jobs 1",
    "doctor": "doctor",
}


@pytest.mark.parametrize("command", RECORDS)
def test_an_object_has_the_version_of_its_fields_first(command: str, cli: Cli) -> None:
    assert {name.split()[0] for name in RECORDS} == set(COMMANDS) - {"completion", "help"}
    record = cli(f"{RECORDS[command]} --json", status=None).json
    first, version = next(iter(record.items()))
    assert (first, version) == ("schema_version", SCHEMA_VERSION if command == "inspect" else JSON_VERSION)


# --- Completion -------------------------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty home folder."""
    for name in ("ZDOTDIR", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def command(tmp_path: Path) -> Path:
    """A folder of an environment that is not active, with a `sparklod` of this checkout; its name has to be quoted."""
    (folder := tmp_path / "it's a $HOME" / "bin").mkdir(parents=True)
    lines = ("import sys", f"sys.path.insert(0, {str(ROOT)!r})", "from sparklod_cli.cli import main", "main()")
    (folder / "sparklod").write_text("\n".join([f"#!{sys.executable}", *lines, ""]))
    (folder / "sparklod").chmod(0o755)
    return folder


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_runs_the_program_by_its_path(shell: str, command: Path) -> None:
    words = [command / "sparklod", "completion", shell]
    text = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    (line,) = (line for line in text.splitlines() if f"_SPARKLOD_COMPLETE={shell}_complete" in line)
    assert "bin/sparklod'" in line and "$1" not in line and "$+commands[sparklod]" not in text


@pytest.mark.parametrize("shell", SHELLS)
def test_installing_adds_one_line(shell: str, home: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    _, folder, name, line = SHELLS[shell]
    path = home / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("alias ll='ls -l'")
    monkeypatch.setenv("SHELL", f"/usr/bin/{shell}")
    monkeypatch.setattr(sys, "argv", ["/opt/tool/bin/sparklod"])
    said = "'/opt/tool/bin/sparklod'" if shell == "fish" else "/opt/tool/bin/sparklod"
    for message in ("loads the completion from the next shell on", "loads the completion already"):
        assert cli("completion --install").err == f"{path} {message}\n"
        assert path.read_text() == f"alias ll='ls -l'\n{line.format(program=said)}\n"


def test_the_program_of_a_module_is_beside_its_python(home: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/sparklod_cli/__main__.py"])
    monkeypatch.setattr(sys, "executable", str(home / "python"))
    (home / "sparklod").touch()
    assert f"bash_complete {home}/sparklod)" in cli("completion bash").out
    (home / ".bashrc").mkdir()
    said = f"error: {home / '.bashrc'}: cannot be changed: is a directory\n"
    assert cli("completion bash --install", status=1).err == said
    monkeypatch.setenv("SHELL", "/bin/ash")
    assert cli("completion", status=2).err.endswith("name one of bash, zsh, fish\n")


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_new_shell_completes_before_and_after_activation(shell: str, home: Path, command: Path) -> None:
    import pty  # which Windows does not have

    path = shutil.which(shell)
    if path is None:
        pytest.skip(f"{shell} is not installed")
    subprocess.run([command / "sparklod", "completion", shell, "--install"], check=True, env={**os.environ})
    (home / "my-scan.ply").touch()
    (home / "venv").symlink_to(command)
    environment = {**os.environ, "PS1": "$ ", "TERM": "dumb", "COLUMNS": "200"}
    # After a tab, the function has expanded the line; Ctrl-A and "echo " turn it into one that prints it.
    before = {
        "venv/sparklod simpl": "venv/sparklod simplify",
        "~/venv/sparklod view my-s": f"{home}/venv/sparklod view my-scan.ply",
    }
    after = {
        "sparklod simpl": "sparklod simplify",
        "sparklod render --color-b": "sparklod render --color-by",
        "sparklod render --color-by lod-o": "sparklod render --color-by lod-opacity",
        "sparklod view my-s": "sparklod view my-scan.ply",
    }
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [path, "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=home, env=environment, start_new_session=True
    ):
        os.close(theirs)
        for lines in (before, after):
            for line, whole in lines.items():
                os.write(ours, f"{line}\t\x01echo completed: \n".encode())
                assert f"completed: {whole}" in _read_until(ours, f"\ncompleted: {whole}"), line
            os.write(ours, b"PATH=~/venv:$PATH; echo is act''ive\n")  # as the script activate does
            _read_until(ours, "\nis active")
        os.write(ours, b"exit\n")
        _read_until(ours, "")
        os.close(ours)


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_a_new_fish_completes_before_and_after_activation(home: Path, command: Path) -> None:
    subprocess.run([command / "sparklod", "completion", "fish", "--install"], check=True)
    (home / "venv").symlink_to(command)
    (home / "my-scan.ply").touch()
    script = """
        complete -C "venv/sparklod simpl"
        complete -C "~/venv/sparklod render --color-by lod-o"
        set PATH ~/venv $PATH
        complete -C "sparklod simpl"
        complete -C "sparklod view my-s"
    """
    wholes = ["simplify", "lod-opacity", "simplify", "my-scan.ply"]
    done = subprocess.run(["fish", "-c", script], cwd=home, capture_output=True, text=True, check=True)
    assert ([line.split()[0] for line in done.stdout.splitlines()], done.stderr) == (wholes, "")


def _read_until(terminal: int, text: str) -> str:
    """Read the output of a terminal up to a text; "" for the end."""
    shown = ""
    while not text or text not in shown:
        ready, _, _ = select.select([terminal], [], [], 60)
        try:
            more = os.read(terminal, 4096) if ready else b""
        except OSError:  # the other end is closed
            more = b""
        if not more:
            break
        shown += more.decode(errors="replace").replace("\r", "")
    return shown


# --- doctor -----------------------------------------------------------------------------------------------------------

FINE = Check("sparklod", "ok", "0.1.0")
NOTE = Check("extra video", "note", "imageio is missing", "pip install imageio")
MEMORY = Check("memory", "note", "1.0 of 2.0 GB are available", "free some")
PROBLEM = Check("numba", "problem", "is \x1b[31mmissing", "pip install 'numba>=0.60'")
WORKS = "OK: everything that baking needs works"


@pytest.mark.parametrize(
    ("checks", "said"),
    [
        ((FINE,), WORKS),
        ((FINE, MEMORY), f"{WORKS}; 1 note"),
        ((FINE, NOTE), f"{WORKS}; 1 optional extra not installed (video)"),
        (
            (NOTE, dataclasses.replace(NOTE, name="extra cuda"), MEMORY, MEMORY),
            f"{WORKS}; 2 optional extras not installed (video, cuda); 2 other notes",
        ),
        ((PROBLEM, PROBLEM, MEMORY), "2 problems to solve before baking works; 1 note"),
        (
            (FINE, NOTE, PROBLEM),
            "1 problem to solve before baking works; 1 optional extra not installed (video)",
        ),
    ],
)
def test_doctor_lists_its_checks_and_ends_with_a_verdict(
    checks: tuple[Check, ...], said: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check_all(begun: Callable[[str], None]) -> list[Check]:
        begun("everything")
        return list(checks)

    monkeypatch.setattr(doctor, "check_all", check_all)
    status = 1 if PROBLEM in checks else 0
    done = cli("doctor", status=status)
    assert done.err == f"{said}\n"
    assert cli("doctor -v", status=status).err == f"checking everything\n{said}\n"
    if checks == (FINE, NOTE, PROBLEM):
        assert done.out.splitlines() == [
            "ok      sparklod     0.1.0",
            "note    extra video  imageio is missing",
            "                     -> pip install imageio",
            "problem numba        is \\x1b[31mmissing",
            "                     -> pip install 'numba>=0.60'",
        ]
    quiet = cli("doctor -q", status=status)
    assert quiet.err == "" and quiet.out.count("problem ") == checks.count(PROBLEM) and "note" not in quiet.out
    about = cli("doctor --json --quiet", status=status).json
    assert about["ok"] is (status == 0) and [Check(**check) for check in about["checks"]] == list(checks)


@pytest.mark.parametrize("broken", ["numpy", "numba", "moderngl"])
def test_a_broken_package_does_not_stop_the_other_checks(broken: str, tmp_path: Path) -> None:
    for name in {broken, "open3d"}:  # which takes many seconds where it works
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('broken on purpose')")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    done = process("doctor --json", text=True, env=environment, cwd=tmp_path)
    needed = broken in ("numpy", "numba")
    assert done.returncode == (1 if needed else 0), done.stderr
    checks = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    assert {"processors", "memory", "Node", "Chromium"} <= set(checks)
    if needed:
        assert checks["kernels"]["state"] == "problem" and "broken on purpose" in checks["kernels"]["value"]
