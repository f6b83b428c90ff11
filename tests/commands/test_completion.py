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
from sparklod_cli.commands.completion import SHELLS
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
    """A folder for PATH, with a `sparklod` of this checkout."""
    (folder := tmp_path / "bin").mkdir()
    lines = ("import sys", f"sys.path.insert(0, {str(ROOT)!r})", "from sparklod_cli.cli import main", "main()")
    (folder / "sparklod").write_text("\n".join([f"#!{sys.executable}", *lines, ""]))
    (folder / "sparklod").chmod(0o755)
    return folder


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_is_printed_for_each_shell(shell: str, capsys: Capture) -> None:
    assert run(["completion", shell]) == 0
    assert f"_SPARKLOD_COMPLETE={shell}_complete" in capsys.readouterr().out


@pytest.mark.parametrize("shell", SHELLS)
def test_installing_adds_one_line(shell: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    _, folder, name, line = SHELLS[shell]
    path = home / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("alias ll='ls -l'")
    monkeypatch.setenv("SHELL", f"/usr/bin/{shell}")
    for message in ("loads the completion from the next shell on", "loads the completion already"):
        assert run(["completion", "--install"]) == 0
        assert capsys.readouterr().err == f"{path} {message}\n"
        assert path.read_text() == f"alias ll='ls -l'\n{line}\n"


def test_a_shell_that_is_not_known_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("SHELL", "/bin/ash")
    assert run(["completion"]) == 2
    assert capsys.readouterr().err.endswith("name one of bash, zsh, fish\n")


def test_settings_that_cannot_be_changed_are_an_error(home: Path, capsys: Capture) -> None:
    (home / ".bashrc").mkdir()
    assert run(["completion", "bash", "--install"]) == 1
    assert capsys.readouterr().err == f"error: {home / '.bashrc'}: cannot be changed: is a directory\n"


@pytest.mark.skipif(os.name != "posix" or shutil.which("bash") is None, reason="needs bash and pseudo-terminals")
def test_bash_completes_commands_options_and_files(home: Path, command: Path) -> None:
    import pty  # which Windows does not have

    bash = shutil.which("bash")
    assert bash is not None
    assert run(["completion", "bash", "--install"]) == 0
    (home / "my-scan.ply").touch()
    path = f"{command}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PS1": "$ ", "TERM": "dumb", "COLUMNS": "200"}
    # After a tab, the function has expanded the line; Ctrl-A and "echo " turn it into one that prints it.
    wholes = {
        "sparklod simpl": "sparklod simplify",
        "sparklod render --color-b": "sparklod render --color-by",
        "sparklod render --color-by lod-o": "sparklod render --color-by lod-opacity",
        "sparklod view my-s": "sparklod view my-scan.ply",
    }
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [bash, "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=home, env=environment, start_new_session=True
    ):
        os.close(theirs)
        for line, whole in wholes.items():
            os.write(ours, f"{line}\t\x01echo completed: \n".encode())
            assert f"completed: {whole}" in _read_until(ours, f"\ncompleted: {whole}"), line
        os.write(ours, b"exit\n")
        _read_until(ours, "")
        os.close(ours)


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
