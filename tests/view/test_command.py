"""`sparklod view`: what it prints, how it ends, and what it refuses."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.conftest import Capture
from tests.signals import heed_signals
from tests.view.conftest import CHUNKED, TREE


@contextlib.contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """The command as a process of its own."""
    command = [sys.executable, "-m", "sparklod_cli", "view", *map(str, arguments)]
    environment = {
        name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    }
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, preexec_fn=heed_signals, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def test_it_serves_until_it_is_interrupted() -> None:
    with started(TREE, "--no-open") as process:
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(f"{url}data/0/{TREE.name}") as answer:
            assert answer.read() == TREE.read_bytes()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, out) == (0, "")
    assert err.splitlines() == [f"serving {TREE.name}; Ctrl-C ends it", "stopped"]


def test_json_names_the_address_and_the_files_and_quiet_nothing_else() -> None:
    with started(TREE, CHUNKED, "--json", "-q") as process:
        told = json.loads(process.stdout.readline())
        process.terminate()
        _, err = process.communicate(timeout=20)
    assert told["url"].startswith("http://127.0.0.1:")
    assert [(file["file"], file["format"]) for file in told["files"]] == [(str(TREE), "SPZ"), (str(CHUNKED), "RAD")]
    assert err == ""


def test_without_a_browser_it_says_so() -> None:
    with started(TREE) as process:
        url = process.stdout.readline().strip()
        lines = [process.stderr.readline().strip() for _ in range(2)]
        process.terminate()
    assert sorted(lines) == [
        f"Could not open a browser; open this address yourself: {url}",
        f"serving {TREE.name}; Ctrl-C ends it",
    ]


def test_a_browser_is_opened_with_the_address(monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    import webbrowser

    from sparklod_cli.api import viewing

    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)

    def serve(server: viewing.Server) -> None:
        while not opened:
            pass
        raise KeyboardInterrupt

    monkeypatch.setattr(viewing.Server, "serve_forever", serve)
    assert run(["view", str(TREE)]) == 0
    assert capfd.readouterr().out.split() == opened


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["missing.spz"], 1, "error: missing.spz: cannot be read: no such file or directory"),
        (
            [TREE, "--spark-dir", "nowhere"],
            1,
            "error: nowhere/node_modules has no @sparkjsdev/spark; install it with npm",
        ),
        ([TREE, "--host", "192.0.2.1"], 1, "error: '192.0.2.1' is no address of this machine; give --host 127.0.0.1"),
        ([TREE, "--overwrite"], 2, "error: --overwrite can only be used with --export"),
        ([TREE, "--export", "site", "--cors"], 2, "error: --cors cannot be used with --export"),
        ([TREE, "--budget", "0"], 2, "'0' is out of range; give 1 or more"),
        ([TREE, "--camera-path", "missing.json"], 1, "error: missing.json cannot be read"),
        ([TREE, "--look-at", "1,2,3"], 2, "is not EYE:TARGET"),
        (["-"], 2, "standard input is not read here"),
        ([], 2, "Missing argument"),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_one_line(
    arguments: list[object],
    code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["view", *map(str, arguments)]) == code
    out, err = capfd.readouterr()
    assert out == ""
    assert text in err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_port_in_use_is_one_line(capfd: Capture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert run(["view", str(TREE), "--port", str(port)]) == 1
    assert capfd.readouterr() == (
        "",
        f"error: port {port} is in use; give another --port, or none to have a free one\n",
    )


def test_export_writes_a_site(tmp_path: Path, capfd: Capture) -> None:
    folder = tmp_path / "site"
    command = ["view", str(TREE), "--export", str(folder)]
    assert run([*command, "--json"]) == 0
    out, err = capfd.readouterr()
    told = json.loads(out)
    assert told["folder"] == str(folder)
    assert told["bytes"] == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert err.startswith(f"wrote {folder}: ")
    assert run(command) == 1
    assert "add --overwrite" in capfd.readouterr().err
    assert run([*command, "--overwrite", "-q"]) == 0
    assert capfd.readouterr() == ("", "")
