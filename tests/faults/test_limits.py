"""Limits of a process: open files, the size of files. Those of memory are in tests/commands/test_memory.py."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.faults.runs import TREE, WRITERS, check_whole, said_one_error, shell

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ulimit")]


@pytest.mark.parametrize("name", WRITERS)
def test_a_limit_of_file_size_is_one_error_or_a_small_file(name: str, tmp_path: Path) -> None:
    arguments, output = WRITERS[name]
    # Without bytecode, because Python 3.11 leaves incomplete .pyc files if it cannot write all of a module.
    done = shell('ulimit -f 1; PYTHONDONTWRITEBYTECODE=1 "$@"', *arguments, tmp_path / output)
    if done.returncode == 0:  # the output is small
        check_whole(tmp_path / output)
        assert (tmp_path / output).stat().st_size <= 1024
        return
    assert done.returncode == 1
    line = said_one_error(done.stderr)
    assert "file too large" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "most"), [("build-lod", 10), ("traverse", 16), ("render", 10), ("inspect", 16)])
def test_too_few_open_files_are_one_error_or_none(name: str, most: int, tmp_path: Path) -> None:
    arguments, output = WRITERS[name]
    done = shell(f'ulimit -n {most}; "$@"', *arguments, tmp_path / output)
    assert done.returncode in (0, 1), done.stderr
    if done.returncode:
        assert "Traceback" not in done.stderr
        said_one_error(done.stderr)
        assert list(tmp_path.iterdir()) == []
    else:
        check_whole(tmp_path / output)


def test_many_files_are_not_open_at_a_time(tmp_path: Path) -> None:
    arguments = ["render", TREE, "--orbit", "40", "--size", "16x12", "-o", tmp_path / "out.%04d.png"]
    done = shell('ulimit -n 32; "$@"', *arguments)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.iterdir())) == 40
