"""A shell completes commands, options and file names once `sparklod completion` has installed its script."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.commands.installation import SHELLS
from tests.conftest import ROOT, Capture


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
def test_a_script_is_printed_for_each_shell(shell: str, capsys: Capture) -> None:
    assert run(["completion", shell]) == 0
    assert f"_SPARKLOD_COMPLETE={shell}_complete" in capsys.readouterr().out


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_runs_the_program_by_its_path(shell: str, command: Path) -> None:
    text = subprocess.run(
        [command / "sparklod", "completion", shell], capture_output=True, text=True, check=True
    ).stdout
    (line,) = (line for line in text.splitlines() if "_SPARKLOD_COMPLETE" in line)
    assert "bin/sparklod'" in line
    assert "$1" not in line
    assert "$+commands[sparklod]" not in text


@pytest.mark.parametrize("shell", SHELLS)
def test_installing_adds_one_line(shell: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    _, folder, name, line = SHELLS[shell]
    path = home / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("alias ll='ls -l'")
    monkeypatch.setenv("SHELL", f"/usr/bin/{shell}")
    monkeypatch.setattr(sys, "argv", ["/opt/tool/bin/sparklod"])
    program = "'/opt/tool/bin/sparklod'" if shell == "fish" else "/opt/tool/bin/sparklod"
    for message in ("loads the completion from the next shell on", "loads the completion already"):
        assert run(["completion", "--install"]) == 0
        assert capsys.readouterr().err == f"{path} {message}\n"
        assert path.read_text() == f"alias ll='ls -l'\n{line.format(program=program)}\n"


def test_the_program_of_a_module_is_the_one_beside_its_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/sparklod_cli/__main__.py"])
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    (tmp_path / "sparklod").touch()
    assert run(["completion", "bash"]) == 0
    assert f"bash_complete {tmp_path}/sparklod)" in capsys.readouterr().out


def test_a_shell_that_is_not_known_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("SHELL", "/bin/ash")
    assert run(["completion"]) == 2
    assert capsys.readouterr().err.endswith("name one of bash, zsh, fish\n")


def test_settings_that_cannot_be_changed_are_an_error(home: Path, capsys: Capture) -> None:
    (home / ".bashrc").mkdir()
    assert run(["completion", "bash", "--install"]) == 1
    assert capsys.readouterr().err == f"error: {home / '.bashrc'}: cannot be changed: is a directory\n"


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_new_shell_completes_before_and_after_activation(shell: str, home: Path, command: Path) -> None:
    import pty  # which Windows does not have

    program = shutil.which(shell)
    if program is None:
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
        [program, "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=home, env=environment, start_new_session=True
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
    """What a terminal shows until a text; "" for the end."""
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
