"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import stat
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.io.writing import parts_output
from sparklod_cli.system import output as outputs
from sparklod_cli.system.addresses import Address
from sparklod_cli.system.errors import FormatError, OutputError
from sparklod_cli.system.output import Output, check_writable, write_file
from sparklod_cli.system.stdio import write_stdout
from tests.conftest import FIXTURES, IS_ROOT
from tests.outputs import write_files
from tests.system.test_atomic import has_unnamed_files
from tests.test_io_together import output

posix = pytest.mark.skipif(os.name != "posix", reason="POSIX only")


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_pieces_become_a_file(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"
    assert write_file(target, [b"ab", b"", b"cde"], overwrite=False) == 5
    assert target.read_bytes() == b"abcde"
    assert names(tmp_path) == ["out.spz"]


def test_an_existing_file_is_replaced_only_when_asked_for(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"
    target.write_bytes(b"old")
    with pytest.raises(OutputError, match=r"out\.spz exists, add --overwrite to replace it"):
        write_file(target, [b"new"], overwrite=False)
    assert target.read_bytes() == b"old"
    assert write_file(target, [b"new"], overwrite=True) == 3
    assert target.read_bytes() == b"new"
    assert names(tmp_path) == ["out.spz"]


def failing(error: BaseException) -> Iterator[bytes]:
    yield b"half a"
    raise error


@pytest.mark.parametrize("write", [write_file, output, parts_output])
def test_folders_of_an_output_that_fails_are_removed(write: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    target = tmp_path / "a" / "b" / "c" / "lod-meta.json"

    def broken() -> Iterator[Any]:
        yield b"half a" if write is write_file else (target.name, [b"half a"])
        raise FormatError("too large for the format")

    with pytest.raises(FormatError, match="too large"):
        if write is write_file:
            write(target, broken(), overwrite=True)
        else:
            write_files(write(target, overwrite=True), broken())
    assert names(tmp_path) == ["a"] and names(tmp_path / "a") == []


def test_a_folder_that_vanishes_while_a_file_is_written_is_made_again(tmp_path: Path) -> None:
    target = tmp_path / "a" / "out.spz"

    def pieces() -> Iterator[bytes]:
        yield b"x"
        if has_unnamed_files(tmp_path):
            target.parent.rmdir()  # as another run does that made it, and failed

    write_file(target, pieces(), overwrite=False)
    assert target.read_bytes() == b"x"


@pytest.mark.parametrize("error", [RuntimeError("broken"), MemoryError(), KeyboardInterrupt(), SystemExit(3)])
@pytest.mark.parametrize("existing", [False, True])
def test_an_interruption_leaves_nothing_and_spoils_nothing(
    error: BaseException, existing: bool, tmp_path: Path
) -> None:
    target = tmp_path / "out.spz"
    if existing:
        target.write_bytes(b"old")
    with pytest.raises(type(error)):
        write_file(target, failing(error), overwrite=True)
    assert names(tmp_path) == (["out.spz"] if existing else [])
    if existing:
        assert target.read_bytes() == b"old"


@pytest.mark.parametrize("named", [False, True])
def test_no_file_has_the_final_name_before_it_is_whole(
    named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if named:
        monkeypatch.setattr(outputs, "UNNAMED", None)
    elif not has_unnamed_files(tmp_path):
        pytest.skip("no files without names here")
    target = tmp_path / "out.spz"
    seen: list[list[str]] = []

    def pieces() -> Iterator[bytes]:
        for _ in range(2):
            seen.append(names(tmp_path))
            yield b"x"

    write_file(target, pieces(), overwrite=False)
    assert [len(files) for files in seen] == [int(named)] * 2
    assert all("out.spz" not in files for files in seen)
    if named:  # hidden, and beside the target: a rename does not cross file systems
        assert seen[0][0].startswith(".sparklod-")


def test_two_at_once_do_not_share_a_temporary_file(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"

    def pieces() -> Iterator[bytes]:
        yield b"outer"
        write_file(target, [b"inner"], overwrite=True)

    write_file(target, pieces(), overwrite=True)
    assert target.read_bytes() == b"outer"
    assert names(tmp_path) == ["out.spz"]


@posix
@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_permissions_are_what_the_umask_says(mask: int, tmp_path: Path) -> None:
    before = os.umask(mask)
    try:
        write_file(tmp_path / "out.spz", [b"x"], overwrite=False)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out.spz").stat().st_mode) == 0o666 & ~mask


@posix
@pytest.mark.parametrize("there", [False, True])
def test_a_symbolic_link_is_followed(there: bool, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    real, link = tmp_path / "store" / "real.spz", tmp_path / "link.spz"
    if there:
        real.write_bytes(b"old")
    link.symlink_to(real)
    write_file(link, [b"new"], overwrite=there)
    assert link.is_symlink()
    assert real.read_bytes() == b"new"
    assert (names(tmp_path), names(tmp_path / "store")) == (["link.spz", "store"], ["real.spz"])


@posix
def test_a_device_is_written_to_and_not_replaced() -> None:
    null = Path(os.devnull)
    assert write_file(null, [b"gone"], overwrite=False) == 4
    assert stat.S_ISCHR(null.stat().st_mode)


@posix
def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        assert write_file(pipe, [b"through"], overwrite=False) == 7
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert names(tmp_path) == ["pipe"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="there is no /dev/fd here")
def test_a_pipe_by_its_number_is_written_to() -> None:
    """What a shell makes of `-o >(upload)`, and /dev/stdout in a pipeline: a link to nothing that has a path."""
    reader, writer = os.pipe()
    try:
        assert write_file(Path(f"/dev/fd/{writer}"), [b"through"], overwrite=False) == 7
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
        os.close(writer)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("size", [1, 1_000_000])
def test_a_full_disk_is_an_error(size: int) -> None:
    with pytest.raises(OutputError, match="cannot write /dev/full: no space left on device"):
        write_file(Path("/dev/full"), [bytes(size)], overwrite=False)
    assert stat.S_ISCHR(Path("/dev/full").stat().st_mode)


@posix
def test_a_file_that_may_not_grow_leaves_nothing(tmp_path: Path) -> None:
    """A limit of the file's size is the nearest to a full disk that can be had without one."""
    code = (
        "import resource, signal, sys, pathlib\n"
        "from sparklod_cli.system.errors import OutputError\n"
        "from sparklod_cli.system.output import write_file\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        "    write_file(pathlib.Path(sys.argv[1]), [bytes(400)] * 1000, overwrite=False)\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    target = tmp_path / "out.spz"
    done = subprocess.run([sys.executable, "-c", code, target], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"cannot write {target}: file too large\n", "")
    assert names(tmp_path) == []


def test_a_path_that_cannot_be_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "directory").mkdir()
    refused = {
        "directory": "is a directory",
        "file/out.spz": "is a file, not a folder",
        "file/missing/out.spz": "is a file, not a folder",
        "n" * 300: "file name too long",
    }
    for name, reason in refused.items():
        for check in (
            lambda path: check_writable(path, overwrite=True),
            lambda path: write_file(path, [b"x"], overwrite=True),
        ):
            with pytest.raises(OutputError, match=reason):
                check(tmp_path / name)
    assert names(tmp_path) == ["directory", "file"]


@pytest.mark.parametrize("length", [200, 241, 250, 255])
def test_every_name_that_the_file_system_takes_is_taken(length: int, tmp_path: Path) -> None:
    """The temporary file's name is made of it, and must not be too long because of that."""
    target = tmp_path / ("n" * (length - 4) + ".spz")
    write_file(target, [b"x"], overwrite=False)
    assert names(tmp_path) == [target.name]


@pytest.mark.skipif(IS_ROOT, reason="root may write everywhere")
def test_a_directory_that_may_not_be_written_to(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(0o500)
    with pytest.raises(OutputError, match=r"cannot write .*: permission denied"):
        write_file(closed / "out.spz", [b"x"], overwrite=False)
    closed.chmod(0)
    with pytest.raises(OutputError, match="permission denied"):
        check_writable(closed / "out.spz", overwrite=False)
    closed.chmod(0o700)


def test_folders_are_made_when_there_is_something_to_write(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "out.spz"
    check_writable(target, overwrite=False)
    assert names(tmp_path) == []
    write_file(target, [b"x"], overwrite=False)
    assert target.read_bytes() == b"x"
    link = tmp_path / "link.spz"
    link.symlink_to(tmp_path / "c" / "out.spz")
    write_file(link, [b"y"], overwrite=False)
    assert (tmp_path / "c" / "out.spz").read_bytes() == b"y"


def test_standard_output_gets_the_pieces(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    assert write_stdout([b"ab", b"\0c"]) == 4
    assert capfdbinary.readouterr().out == b"ab\0c"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_standard_output_that_is_full_is_one_line() -> None:
    code = (
        "from sparklod_cli.cli import main\nimport sys\n"
        f"sys.argv = ['sparklod', 'build-lod', {str(FIXTURES / 'one.ply')!r}, '-o', '-']\nmain()"
    )
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    lines = [line for line in done.stderr.splitlines() if not line.lower().startswith(("compiling", "compiled"))]
    assert done.returncode == 1
    assert len(lines) == 1, done.stderr
    assert "cannot write standard output: no space left on device" in lines[0]


def test_a_name_that_is_taken_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"

    def pieces() -> Iterator[bytes]:
        target.write_bytes(b"another's")
        yield b"ours"

    with pytest.raises(OutputError, match="exists, add --overwrite"):
        write_file(target, pieces(), overwrite=False)
    assert target.read_bytes() == b"another's"
    assert names(tmp_path) == ["out.spz"]


def test_a_replaced_file_keeps_its_permissions(tmp_path: Path) -> None:
    target = tmp_path / "out.spz"
    target.write_bytes(b"old")
    target.chmod(0o600)
    before = target.stat().st_ino
    write_file(target, [b"new"], overwrite=True)
    assert target.stat().st_mode & 0o777 == 0o600
    assert target.stat().st_ino != before  # renamed to, not written into


@pytest.mark.parametrize("kind", ["path", pytest.param("address", marks=pytest.mark.slow)])
def test_a_file_grows_by_each_call_and_appears_at_the_end(kind: str, tmp_path: Path) -> None:
    place: Path | Address = tmp_path / "out.spz"
    if kind == "address":
        pytest.importorskip("fsspec")
        place = Address(f"memory://{uuid.uuid4().hex}") / "out.spz"
    for content, error in ((b"whole", None), (b"other", KeyboardInterrupt()), (b"other", FormatError("too large"))):
        out = Output(place, overwrite=error is not None)
        with contextlib.suppress(KeyboardInterrupt, FormatError), out:
            assert [out.write("out.spz", [content[:2]]), out.write("out.spz", [content[2:4], content[4:]])] == [2, 3]
            assert place.exists() == (error is not None)
            if error is not None:
                raise error
        with place.open("rb") as file:
            assert file.read() == b"whole"
    assert names(tmp_path) == ([] if kind == "address" else ["out.spz"])


def test_an_output_that_nothing_is_written_to_is_no_file(tmp_path: Path) -> None:
    with Output(tmp_path / "new" / "out.spz", overwrite=False), output(tmp_path / "new" / "x.rad", overwrite=False):
        pass
    assert names(tmp_path) == []
