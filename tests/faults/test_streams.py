"""Readers that go away, streams that a run does not need: no traceback, and an exit status that shows the failure."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.faults.runs import DEMO, SMALL, TREE, WRITERS, check_whole, shell, sparklod

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="these are pipes and shells of Unix"),
]


#: Commands that print bytes, a table and text.
PRINTERS = {
    "build-lod": ["build-lod", SMALL, "-o", "-"],
    "traverse": ["traverse", TREE, "--orbit", "3"],
    "inspect --json": ["inspect", TREE, "--json"],
}


def nobody_reads() -> int:
    """Returns the writing end of a pipe whose reading end is closed."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


@pytest.mark.parametrize("name", PRINTERS)
def test_a_pipe_without_a_reader_is_exit_code_1(name: str) -> None:
    pipe = nobody_reads()
    try:
        done = sparklod(*PRINTERS[name], stdout=pipe, stderr=-1, capture_output=False)
    finally:
        os.close(pipe)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert sum(line.startswith("error: ") for line in done.stderr.splitlines()) <= 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["build-lod", DEMO, "-o", "-"],
        ["traverse", TREE, "--orbit", "2000"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_reader_that_stops_early_causes_no_traceback(arguments: list[object]) -> None:
    done = shell('set -o pipefail; "$@" | head -c 10 | wc -c', *arguments)
    assert done.stdout.strip() == "10"
    assert done.returncode in (0, 1)  # a short output is in the pipe before its reader goes away
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


@pytest.mark.parametrize(
    ("name", "closed"),
    [("build-lod", "2>&-"), ("build-lod", "<&- >&- 2>&-"), ("traverse", ">&-"), ("render", ">&- 2>&-")],
)
def test_what_is_written_to_a_file_needs_no_streams(name: str, closed: str, tmp_path: Path) -> None:
    arguments, output = WRITERS[name]
    done = shell(f'"$@" {closed}', *arguments, tmp_path / output)
    assert (done.returncode, done.stdout) == (0, "")
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [output]
    check_whole(tmp_path / output)


def test_errors_without_a_stream_to_say_them_are_exit_codes(tmp_path: Path) -> None:
    for arguments, code in (
        (["build-lod", tmp_path / "absent.ply"], 1),
        (["inspect"], 2),
        (["render", TREE, "--x"], 2),
    ):
        done = shell('"$@" 2>&-', *arguments)
        assert (done.returncode, done.stdout) == (code, ""), arguments


def test_a_standard_error_without_a_reader_spoils_no_output(tmp_path: Path) -> None:
    pipe = nobody_reads()
    try:
        target = tmp_path / "demo.spz"
        done = sparklod("build-lod", DEMO, "-o", target, stdout=-1, stderr=pipe, capture_output=False)
    finally:
        os.close(pipe)
    assert done.returncode in (0, 1)
    assert [path for path in tmp_path.iterdir() if path != target] == []
    if target.exists():
        check_whole(target)
