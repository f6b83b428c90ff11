"""Standard output that cannot be written is said to be that, in every command, and nothing else is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli import cli
from sparklod_cli.cli import run
from sparklod_cli.system.stdio import write_stdout
from tests.conftest import FIXTURES, ROOT

pytestmark = pytest.mark.slow

TREE, PLAIN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "one.ply"
PRINTING = [
    ("--help",),
    ("--version",),
    ("inspect", "--json-schema"),
    ("inspect", TREE),
    ("inspect", TREE, TREE, "--json"),
    ("inspect", TREE, "--histogram", "x"),
    ("inspect", "missing.spz", "--check"),
    ("traverse", TREE, "--look-at", "0,-1,4:0,0,0"),
    ("build-lod", "missing.ply", "--json"),
    ("build-lod", "-o", "-", PLAIN),
    ("render", TREE, "--size", "16x12", "-o", "-"),
]


def sparklod(arguments: tuple[object, ...], shell: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "sparklod_cli", *map(str, arguments)]
    return subprocess.run(["bash", "-c", f'"$@" {shell}', "bash", *words], capture_output=True, text=True, cwd=ROOT)


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if line.startswith("error: ") and "missing" not in line]


@pytest.mark.parametrize("arguments", PRINTING, ids=lambda words: " ".join(map(str, words)))
def test_closed_standard_output_is_a_failure(arguments: tuple[object, ...]) -> None:
    done = sparklod(arguments, ">&-")
    assert done.returncode == 1
    (line,) = errors(done)
    assert line.endswith("standard output is closed")
    assert "Exception" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", PRINTING, ids=lambda words: " ".join(map(str, words)))
def test_full_standard_output_is_a_failure(arguments: tuple[object, ...]) -> None:
    done = sparklod(arguments, "> /dev/full")
    assert done.returncode == 1
    (line,) = errors(done)
    assert line.endswith("cannot write standard output: no space left on device")
    assert "Exception" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_work_goes_on_without_a_standard_error(tmp_path: Path) -> None:
    assert sparklod(("build-lod", PLAIN, "-o", tmp_path / "out.spz"), "2> /dev/full").returncode == 0
    assert (tmp_path / "out.spz").exists()
    assert sparklod(("build-lod", tmp_path / "missing.ply"), "2> /dev/full").returncode == 1
    assert sparklod(("build-lod", PLAIN, "--best"), "2> /dev/full").returncode == 2


def test_a_reader_that_stops_early_causes_no_message() -> None:
    done = sparklod(("inspect", *[TREE] * 50), "| head -n 1")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


def test_characters_outside_the_encoding_are_escaped(tmp_path: Path) -> None:
    tree = tmp_path / "café 漢.spz"
    tree.write_bytes(TREE.read_bytes())
    done = sparklod(("inspect", tree), "").stdout
    assert "café 漢.spz  SPZ 3" in done
    words = [sys.executable, "-m", "sparklod_cli", "inspect", str(tree)]
    env = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    plain = subprocess.run(words, capture_output=True, cwd=ROOT, env=env)
    assert (plain.returncode, plain.stderr) == (0, b"")
    assert "café \\u6f22.spz  SPZ 3".encode("latin-1") in plain.stdout


@pytest.mark.parametrize("filename", ["/cache/kernel.nbi", None])
def test_other_system_errors_are_not_blamed_on_standard_output(
    filename: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device", filename)

    monkeypatch.setattr(cli.cli, "main", fails)
    assert run([]) == 1
    where = f"{filename}: " if filename else ""
    assert capsys.readouterr().err == f"error: cannot go on: {where}no space left on device\n"


def test_an_error_while_making_the_output_is_not_one_of_standard_output() -> None:
    def pieces() -> list[bytes]:
        raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        write_stdout(piece for piece in pieces())


@pytest.mark.skipif(os.name != "posix", reason="a shell of POSIX")
def test_no_file_gets_the_number_of_a_closed_stream() -> None:
    code = "import os; from sparklod_cli.system import stdio; stdio.reserve(); "
    code += "os._exit(os.open(os.devnull, os.O_RDONLY))"
    for closed in ("<&-", ">&-", "2>&-", "<&- >&- 2>&-"):
        done = subprocess.run(["sh", "-c", f"{sys.executable} -c '{code}' {closed}"], cwd=ROOT, check=False)
        assert done.returncode > 2
