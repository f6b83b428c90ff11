"""Writers that are killed, permissions on the way, what others have left: with unnamed files, and without."""

from __future__ import annotations

import ast
import contextlib
import os
import random
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sparklod_cli.system import output
from tests.conftest import ROOT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX only")

#: Writes for ever: new files, or one file again and again.
WRITER = """
import itertools, pathlib, sys
from sparklod_cli.system import output
folder, unnamed, overwrite = pathlib.Path(sys.argv[1]), sys.argv[2] == "True", sys.argv[3] == "True"
if not unnamed:
    output.UNNAMED = None
print("ready", flush=True)
for number in itertools.count():
    name = "out" if overwrite else f"out-{number}"
    output.write_atomically(folder / name, [bytes([number % 256]) * 100_000] * 4, overwrite=overwrite)
"""
SIZE = 400_000
KILLS = 12


def has_unnamed_files(folder: Path) -> bool:
    with contextlib.closing(output.NewFile(folder / "out", overwrite=False)) as new:
        return new.part is None


@pytest.fixture(params=[True, False], ids=["unnamed", "named"])
def unnamed(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether files have no name before they are complete."""
    if not request.param:
        monkeypatch.setattr(output, "UNNAMED", None)
    elif not has_unnamed_files(tmp_path):
        pytest.skip("no files without names here")
    output.sweep.cache_clear()
    return bool(request.param)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.slow
def test_a_writer_that_is_killed_leaves_whole_files_only(overwrite: bool, unnamed: bool, tmp_path: Path) -> None:
    seen = 0
    chance = random.Random(1)
    for number in range(KILLS):
        folder = tmp_path / "web"
        folder.mkdir(exist_ok=True)
        command = [sys.executable, "-c", WRITER, str(folder), str(unnamed), str(overwrite)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(chance.uniform(0, 0.1) * (1 if seen else 1.5**number))  # a busy machine may take longer
            process.kill()
        parts = [name for name in names(folder) if not name.startswith("out")]
        if unnamed and not overwrite:
            assert parts == []
        for name in set(names(folder)) - set(parts):
            data = (folder / name).read_bytes()
            assert data == data[:1] * SIZE
            seen += 1
        output.sweep.cache_clear()  # what another run begins with
        output.write_atomically(folder / "out-last", [b"x"], overwrite=True)
        assert [name for name in names(folder) if not name.startswith("out")] == []
        for path in folder.glob("out-*"):
            path.unlink()
    assert seen  # not all were killed before they had written anything


def test_files_of_running_processes_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "UNNAMED", None)
    target = tmp_path / "out"

    def pieces() -> Iterator[bytes]:
        yield b"outer"
        before = names(tmp_path)
        assert len(before) == 1
        output.sweep.cache_clear()
        output.write_atomically(tmp_path / "other", [b"inner"], overwrite=False)
        assert names(tmp_path) == sorted([*before, "other"])

    output.write_atomically(target, pieces(), overwrite=False)
    assert names(tmp_path) == ["other", "out"]
    assert target.read_bytes() == b"outer"


def test_only_files_of_dead_processes_are_removed(tmp_path: Path, unnamed: bool) -> None:
    left = tmp_path / output.PARTS.format("0123456789abcdef")
    left.write_bytes(b"half a")
    kept = [tmp_path / name for name in (".sparklod-notes.txt", "a.part", ".sparklod-link.part", ".sparklod-dir.part")]
    for path in kept[:2]:
        path.write_bytes(b"precious")
    kept[2].symlink_to(kept[1])
    kept[3].mkdir()
    output.write_atomically(tmp_path / "out", [b"x"], overwrite=False)
    assert names(tmp_path) == sorted(["out", *(path.name for path in kept)])
    assert kept[1].read_bytes() == b"precious"


def modes_of_parts(folder: Path) -> list[int]:
    """Permissions of all files of a folder that are not complete, with names or without."""
    modes = [stat.S_IMODE(path.stat().st_mode) for path in folder.glob(output.PARTS.format("*"))]
    for number in output.OPEN_FILES.iterdir() if output.OPEN_FILES.exists() else ():
        with contextlib.suppress(OSError):
            about = number.stat()
            if not about.st_nlink and str(number.readlink()).startswith(str(folder)):
                modes.append(stat.S_IMODE(about.st_mode))
    return modes


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
@pytest.mark.parametrize("before", [None, 0o600, 0o640, 0o666, 0o444, 0o6755, 0o1777])
def test_no_part_has_more_permissions_than_the_file(
    before: int | None, mask: int, unnamed: bool, tmp_path: Path
) -> None:
    target = tmp_path / "out"
    if before is not None:
        target.write_bytes(b"old")
        target.chmod(before)
    final = 0o666 & ~mask if before is None else before & 0o777  # nothing runs as somebody else because of us
    seen: list[int] = []

    def pieces() -> Iterator[bytes]:
        yield b"new"
        seen.extend(modes_of_parts(tmp_path))

    umask = os.umask(mask)
    try:
        output.write_atomically(target, pieces(), overwrite=True)
    finally:
        os.umask(umask)
    assert len(seen) == 1
    assert seen[0] & ~final == 0
    assert stat.S_IMODE(target.stat().st_mode) == final
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("overwrite", [False, True])
def test_files_are_written_without_hard_links(
    overwrite: bool, unnamed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*args: object, **kwargs: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    target = tmp_path / "out"
    if overwrite:
        target.write_bytes(b"old")
    assert output.write_atomically(target, [b"a" * 3_000_000, b"b"], overwrite=overwrite) == 3_000_001
    assert target.read_bytes() == b"a" * 3_000_000 + b"b"
    with pytest.raises(FileExistsError):
        output.write_atomically(target, [b"c"], overwrite=False)
    assert names(tmp_path) == ["out"]


def swept(folder: Path) -> None:
    """As another process that starts in a folder."""
    for path in folder.glob(output.PARTS.format("*")):
        path.unlink()


def test_a_part_swept_before_it_is_locked_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "UNNAMED", None)
    lock: Callable[[int], None] = output.lock
    rounds = []

    def late(descriptor: int) -> None:
        if not rounds:
            swept(tmp_path)
        rounds.append(descriptor)
        lock(descriptor)

    monkeypatch.setattr(output, "lock", late)
    output.write_atomically(tmp_path / "out", [b"x"], overwrite=False)
    assert len(rounds) == 2
    assert (tmp_path / "out").read_bytes() == b"x"


#: Modules that write files, and what: outputs (whole, or to a device or an address), the cache of kernels, what the
#: process of Open3D says, a line in the settings of a shell.
WRITERS = {
    *("system/output.py", "system/addresses.py"),
    *("render/open3d_backend.py", "commands/completion.py"),
}


def writes(call: ast.Call) -> bool:
    """Whether a call writes a file; a help formatter of click, on which `write_text` is called, too, writes none."""
    if isinstance(call.func, ast.Attribute):
        name = "" if ast.unparse(call.func.value) in ("formatter", "super()") else call.func.attr
    else:
        name = getattr(call.func, "id", "")
    modes = [
        value.value
        for value in [*call.args, *(each.value for each in call.keywords)]
        if isinstance(value, ast.Constant)
    ]
    return name in ("write_bytes", "write_text", "touch", "NamedTemporaryFile", "mkstemp") or (
        name == "open" and any(isinstance(mode, str) and set(mode) & set("wxa") for mode in modes)
    )


def test_only_these_modules_write_files() -> None:
    found = set()
    for path in (ROOT / "sparklod_cli").rglob("*.py"):
        calls = (node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call))
        if any(map(writes, calls)):
            found.add(path.relative_to(ROOT / "sparklod_cli").as_posix())
    assert found <= WRITERS
    assert "system/output.py" in found  # so it finds what there is
