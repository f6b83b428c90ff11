"""Outputs are tried before the work: a command that may not write says so before it has read its inputs."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.system.errors import OutputError
from sparklod_cli.system.output import check_writable, try_place
from tests.commands.test_keep_apart import OUTPUTS, PLAIN
from tests.conftest import FIXTURES, IS_ROOT, Capture

resource = pytest.importorskip("resource", reason="this system has no limits of processes")

NOBODY = 65_534

#: Ways to write at P, by the command: X is an input that cannot be read, which is found out when it is.
WAYS: dict[str, list[str]] = {
    "build-lod": [
        "X -o P/a.spz",
        "X -o P/a.rad",
        "X -o P/new/a.rad --format rad-chunked",
        "X -o P/lod-meta.json",
        "X -o P/new/tileset.json",
        "X -o P/a.spz --refine 3",
        "X -o P/a.rad --memory 4M",
        "X -o P/a.spz --skip-existing",
        "X -o P/a.spz --skip-existing=verify --overwrite",
        "X X -o P/a.spz --merge",
        "X --output-dir P",
        "X --output-dir P --format streamed-sog",
    ],
    "convert": [
        "X P/a.ply",
        "X P/a.spz",
        "X P/meta.json",
        "X P/a.npz --layout packed",
        "X P/a.rad --format rad-chunked",
    ],
    "simplify": [
        "X --to 50% -o P/a.spz",
        "X --psnr 40 -o P/a.ply",
        "X --max-bytes 1kB -o P/meta.json",
        "X --to 50% --refine 3 -o P/a.rad",
    ],
    "render": [
        "X -o P/a.png",
        "X -o P/new/a.npy",
        "X --orbit 3 -o P/a.%d.png",
        "X --orbit 3 -o P/",
        "X --orbit 3 -o P/a.gif",
        "X --orbit 3 -o P/a.mp4",
        "X --orbit 3 --sheet -o P/a.png",
        "X --dolly 2:1 -o P/a.webp",
        "X --diff X -o P/a.png",
        "X --thumbnail -o P/a.png --json",
        "X --compare -o P/a.csv",
        "X --compare -o P/a.parquet",
        "X --compare --plot P/a.png",
    ],
    "traverse": [
        "X -o P/a.csv",
        "X -o P/a.json --summary",
        "X -o P/a.parquet",
        "X --plot P/a.png",
        "X --indices-out P",
        "X --indices-out P/new",
        "X --json -o P/a.csv",
    ],
    "inspect": [
        "X --html P/a.html",
        "X X --html P/a.html",
        "X --plot P/a.png",
        "X --chunks-out P/a.csv",
        "X --chunks-out P/a.json --check",
        "X --leaves-of X --html P/a.html",
    ],
    "view": ["X --export P/a", "X --export P/new/a --overwrite"],
}
ROWS = [(command, way) for command, ways in WAYS.items() for way in ways]


def test_every_output_of_a_command_is_tried() -> None:
    assert {command for command, outputs in OUTPUTS.items() if outputs} <= WAYS.keys()
    for command, outputs in OUTPUTS.items():
        for flag in (name for options in outputs.values() for name in options if name != "Y"):
            assert any(flag in way for way in WAYS[command]), (command, flag)


@contextlib.contextmanager
def as_another_user() -> Iterator[None]:
    """Root may write everywhere, so it becomes somebody else; other users are that already."""
    if IS_ROOT:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if IS_ROOT:
            os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that other users may look into, which those of pytest are not."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def tried(command: str, way: str, place: Path, folder: Path, capsys: Capture) -> str:
    """Return what a command says of a place where nothing can be written; it has read no input, and left nothing."""
    source = folder / "x.ply"
    source.write_bytes(b"no splats, which a command that reads it would say\n")
    before = sorted(folder.rglob("*"))
    given = [part.replace("P", os.fspath(place), 1) if "P" in part else part for part in way.split()]
    assert run([command, *(os.fspath(source) if part == "X" else part for part in given)]) == 1
    assert sorted(folder.rglob("*")) == before
    _, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert re.match(rf"error: (.*: )?cannot write {re.escape(os.fspath(place))}", line), line
    return line


@pytest.mark.parametrize(("command", "way"), ROWS)
def test_no_input_is_read_for_an_output_below_a_file(command: str, way: str, tmp_path: Path, capsys: Capture) -> None:
    place = tmp_path / "file"
    place.write_bytes(b"")
    if "P" in way.split():
        place = place / "folder"
    assert "a file" in tried(command, way, place, tmp_path, capsys)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="this system has no folder where nobody can write")
@pytest.mark.parametrize(("command", "way"), ROWS)
def test_no_input_is_read_for_an_output_where_nobody_can_write(
    command: str, way: str, tmp_path: Path, capsys: Capture
) -> None:
    tried(command, way, Path("/proc/sparklod"), tmp_path, capsys)


@pytest.mark.parametrize(("command", "way"), ROWS)
def test_no_input_is_read_for_an_output_in_a_folder_of_another_user(
    command: str, way: str, open_folder: Path, capsys: Capture
) -> None:
    closed = open_folder / "closed"
    closed.mkdir(0o555)
    if Path("/proc/self").exists():
        tried(command, way, Path("/proc/sparklod"), open_folder, capsys)  # loads all modules: others may not read them
    (open_folder / "x.ply").touch()
    (open_folder / "x.ply").chmod(0o666)
    with as_another_user():
        assert "permission denied" in tried(command, way, closed, open_folder, capsys)


@pytest.mark.slow
def test_workers_try_their_outputs(tmp_path: Path, capsys: Capture) -> None:
    pytest.importorskip("distributed")
    assert run(["build-lod", str(PLAIN), str(FIXTURES / "sh0.ply"), "--workers", "1", "--output-dir", "/proc/a"]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 2 and all("cannot write /proc/a/" in line for line in lines)


def test_a_place_that_can_be_written_is_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "there.spz").write_bytes(b"former")
    before = [(path.name, path.stat().st_mtime_ns) for path in (tmp_path, tmp_path / "there.spz")]
    check_writable(tmp_path / "new" / "deep" / "a.spz", overwrite=False)
    check_writable(tmp_path / "a.spz", overwrite=False)
    check_writable(tmp_path / "there.spz", overwrite=True)
    try_place(tmp_path / "site")
    assert before == [(path.name, path.stat().st_mtime_ns) for path in (tmp_path, tmp_path / "there.spz")]
    assert (tmp_path / "there.spz").read_bytes() == b"former"


def test_a_place_is_tried_without_unnamed_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.system.output.UNNAMED", None)
    check_writable(tmp_path / "a.spz", overwrite=False)
    assert not any(tmp_path.iterdir())
    if Path("/proc/self").exists():
        with pytest.raises(OutputError, match=r"cannot write /proc/a\.spz"):
            check_writable(Path("/proc/a.spz"), overwrite=False)


def test_a_file_that_is_only_read_may_be_replaced(open_folder: Path) -> None:
    target = open_folder / "a.spz"
    target.touch(0o444)
    open_folder.chmod(0o777)
    if IS_ROOT:
        os.chown(target, NOBODY, NOBODY)
    with as_another_user():
        check_writable(target, overwrite=True)


@pytest.mark.skipif(not IS_ROOT, reason="only root can give files to somebody else")
def test_a_file_of_another_user_in_a_shared_folder_may_not_be_replaced(open_folder: Path) -> None:
    open_folder.chmod(0o1777)
    (open_folder / "a.spz").touch()
    with as_another_user():
        check_writable(open_folder / "b.spz", overwrite=True)
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: operation not permitted"):
            check_writable(open_folder / "a.spz", overwrite=True)


def test_a_file_that_is_marked_as_immutable_may_not_be_replaced(tmp_path: Path) -> None:
    target = tmp_path / "a.spz"
    target.touch()
    marked = shutil.which("chattr") and subprocess.run(["chattr", "+i", target], capture_output=True).returncode == 0
    if not marked:
        pytest.skip("files cannot be marked as immutable here")
    try:
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: operation not permitted"):
            check_writable(target, overwrite=True)
    finally:
        subprocess.run(["chattr", "-i", target], check=True)


def test_a_place_on_which_something_is_mounted_cannot_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the file or the folder of a container that its host shares with it."""
    (tmp_path / "site").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path).name == "site")
    with pytest.raises(OutputError, match=f"site: {os.strerror(errno.EBUSY).lower()}"):
        try_place(tmp_path / "site")
    try_place(tmp_path / "site" / "inside")


def test_a_disk_that_is_full_is_found_before_the_work(tmp_path: Path, capsys: Capture) -> None:
    """A limit of the file's size is the nearest to a full disk that can be had without one."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: file too large"):
            check_writable(tmp_path / "a.spz", overwrite=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not any(tmp_path.iterdir())


def test_an_output_that_takes_more_than_is_free_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=1_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    try_place(tmp_path / "site", least=1_000_000)
    with pytest.raises(OutputError, match=r"site: it takes 2\.0 MB or more, and 1\.0 MB are free there"):
        try_place(tmp_path / "site", least=2_000_000)


def test_index_files_that_exist_are_found_before_the_first_frame(tmp_path: Path, capsys: Capture) -> None:
    lod = FIXTURES / "golden" / "tree-v3.spz"
    given = [
        "traverse",
        str(lod),
        "--orbit",
        "3",
        "--indices-out",
        str(tmp_path / "cuts"),
        "-o",
        str(tmp_path / "a.csv"),
    ]
    (tmp_path / "cuts").mkdir()
    (tmp_path / "cuts" / "000002.npy").write_bytes(b"former")
    assert run(given) == 1
    assert "000002.npy exists, add --overwrite to replace it" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "cuts").iterdir()] == ["000002.npy"]
    assert run([*given, "--overwrite"]) == 0
    assert len(list((tmp_path / "cuts").iterdir())) == 3


def test_an_input_that_is_only_read_needs_a_named_output(capsys: Capture) -> None:
    for source in ("https://example.org/scene.ply", "simplecache::http://example.org/scene.ply"):
        assert run(["build-lod", source]) == 2
        assert f"nothing can be written beside {source}; name the output with -o" in capsys.readouterr().err
