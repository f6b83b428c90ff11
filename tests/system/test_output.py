"""Outputs appear whole or not at all, alone or together, after errors, interrupts and kills at any step."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import re
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import pytest

from sparklod_cli.system import output
from sparklod_cli.system.errors import OutputError
from sparklod_cli.system.output import Output, Siblings
from tests.conftest import ROOT
from tests.scenes import write_files

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX only")


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


@pytest.fixture(autouse=True)
def first_run() -> None:
    """As in a new process, nothing has been swept yet."""
    output.sweep.cache_clear()


def refuse_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system without hard links."""

    def refused(*args: object, **how: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- One file ---------------------------------------------------------------------------------------------------------


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
    refuse_links(monkeypatch)
    target = tmp_path / "out"
    if overwrite:
        target.write_bytes(b"old")
    assert output.write_atomically(target, [b"a" * 3_000_000, b"b"], overwrite=overwrite) == 3_000_001
    assert target.read_bytes() == b"a" * 3_000_000 + b"b"
    with pytest.raises(FileExistsError):
        output.write_atomically(target, [b"c"], overwrite=False)
    assert names(tmp_path) == ["out"]


# --- Files that belong together ---------------------------------------------------------------------------------------

#: Chunks and what names them, as they were and as they are to be.
OLD = {"a-0": b"old 0", "a-1": b"old 1", "a-2": b"old 2", "a": b"old"}
NEW = {"a-0": b"new 0", "a-1": b"new 1", "a": b"new"}
OTHERS = {"b-0": b"precious", "a-9": b"precious"}

#: What a former header names.
FORMER = list(OLD)[:-1]


def files(content: dict[str, bytes]) -> Iterable[tuple[str, Iterable[bytes]]]:
    return ((name, [data[:2], data[2:]]) for name, data in content.items())


def write(
    folder: Path, content: Iterable[tuple[str, Iterable[bytes]]], *, overwrite: bool, former: Sequence[str] = ()
) -> int:
    """Write files whose header is "a"; those of a former output are removed."""
    is_member = re.compile(r"a-[0-3]|\d/[xy]").fullmatch
    siblings = Siblings(lambda name: is_member(name) is not None, str.isdigit, "0", lambda target: former)
    if not any("/" in name for name in former):
        siblings = Siblings(siblings.is_member, named=siblings.named)
    return write_files(Output(folder / "a", overwrite=overwrite, siblings=siblings), content)


def put(folder: Path, *contents: dict[str, bytes]) -> None:
    for content in contents:
        for name, data in content.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)


def held(folder: Path) -> dict[str, bytes]:
    """All files in a folder and in folders there; an empty one is listed, too."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {
        name: b"empty folder" if path.is_dir() else path.read_bytes()
        for name, path in found.items()
        if not path.is_dir() or not any(path.iterdir())
    }


def test_files_appear_together(tmp_path: Path) -> None:
    seen: list[set[str]] = []

    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        for each in files(NEW):
            seen.append({name for name in names(tmp_path) if not name.startswith(".sparklod-")})
            yield each

    assert write(tmp_path, some(), overwrite=False) == sum(map(len, NEW.values()))
    assert seen == [set()] * len(NEW)
    assert held(tmp_path) == NEW


def test_files_are_replaced_together_and_outdated_ones_removed(tmp_path: Path) -> None:
    put(tmp_path, OLD, OTHERS)
    write(tmp_path, files(NEW), overwrite=True, former=FORMER)
    assert held(tmp_path) == NEW | OTHERS


@pytest.mark.parametrize("taken", NEW)
def test_nothing_is_replaced_without_leave(taken: str, tmp_path: Path) -> None:
    put(tmp_path, {taken: b"precious"})
    with pytest.raises(OutputError, match=f"^{tmp_path / taken} exists, add --overwrite"):
        write(tmp_path, files(NEW), overwrite=False, former=FORMER)
    assert held(tmp_path) == {taken: b"precious"}


@pytest.mark.parametrize("taken", NEW)
def test_a_name_that_is_taken_meanwhile_is_not_replaced(
    taken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def later(temporary: Path, target: Path, overwrite: bool) -> None:
        put(tmp_path, {taken: b"another's"})
        monkeypatch.undo()
        output.rename(temporary, target, overwrite)

    monkeypatch.setattr(output, "rename", later)
    with pytest.raises(OutputError, match=f"^{tmp_path / taken} exists, add --overwrite"):
        write(tmp_path, files(NEW), overwrite=False)
    assert held(tmp_path) == {taken: b"another's"}


def test_a_folder_with_the_name_of_a_file_is_left_alone(tmp_path: Path) -> None:
    put(tmp_path, OLD)
    (tmp_path / "a-1").unlink()
    (tmp_path / "a-1").mkdir()
    with pytest.raises(OutputError, match="a-1 is not a file"):
        write(tmp_path, files(NEW), overwrite=True, former=FORMER)
    (tmp_path / "a-1").rmdir()
    assert held(tmp_path) == {name: data for name, data in OLD.items() if name != "a-1"}


@pytest.mark.parametrize("error", [RuntimeError("broken"), KeyboardInterrupt(), OSError(errno.ENOSPC, "full")])
@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("existing", [False, True])
def test_an_error_while_they_are_filled_changes_nothing(
    error: BaseException, number: int, existing: bool, tmp_path: Path
) -> None:
    def pieces(fails: bool) -> Iterator[bytes]:
        yield b"half a"
        if fails:
            raise error

    before = OLD | OTHERS if existing else OTHERS
    put(tmp_path, before)
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)):
        some = ((name, pieces(place == number)) for place, name in enumerate(NEW))
        write(tmp_path, some, overwrite=existing, former=FORMER)
    assert held(tmp_path) == before


#: Where a call of the file system is broken off: before it has done its work, or after.
Broken = Callable[..., object]
STEPS = [(Path, "rename"), (Path, "replace"), (os, "link"), (Path, "chmod")]


def breaking(work: Broken, call: int, after: bool, error: BaseException) -> tuple[Broken, list[int]]:
    """A function that raises at a call, and what counts its calls."""
    calls: list[int] = []

    def wrapped(*args: object, **how: object) -> object:
        calls.append(1)
        if len(calls) == call + 1:
            if after:
                work(*args, **how)
            raise error
        return work(*args, **how)

    return wrapped, calls


def broken_off(
    step: tuple[object, str],
    after: bool,
    folders: Path,
    monkeypatch: pytest.MonkeyPatch,
    before: dict[str, bytes],
    new: dict[str, bytes],
    others: dict[str, bytes],
    former: Sequence[str],
) -> int:
    """Break a write off at each call of a step by turns: all is as before, or as it is to be; return the calls."""
    for call in range(20):
        folder, expected = folders / str(call), before | others
        folder.mkdir()
        put(folder, expected)
        with monkeypatch.context() as patch:
            wrapped, calls = breaking(getattr(*step), call, after, KeyboardInterrupt())
            patch.setattr(*step, wrapped)
            with contextlib.suppress(KeyboardInterrupt):
                write(folder, files(new), overwrite=bool(before), former=former)
                expected = new | others
        if len(calls) <= call:
            return call
        left = {name: data for name, data in held(folder).items() if not name.startswith(".sparklod-")}
        assert left == expected, call
        assert step[1] in ("mkdir", "rmdir") or left == held(folder)
    raise AssertionError("it has no end")


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("step", STEPS, ids=lambda step: step[1])
@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("links", [False, True])
def test_an_error_or_interrupt_at_any_step_leaves_what_was_there(
    step: tuple[object, str], existing: bool, after: bool, links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:
        refuse_links(monkeypatch)
    reached = broken_off(step, after, tmp_path, monkeypatch, OLD if existing else {}, NEW, OTHERS, FORMER)
    expected = {("rename", True): 4, ("replace", True): 3, ("chmod", True): 3, ("link", False): 3}
    assert reached == (3 if not links and step[1] == "replace" else expected.get((step[1], existing), 0))


#: The same in folders: one stays, one goes, one comes, and there is a file of somebody else's in one.
OLD_FOLDERS = {"0/x": b"old 0x", "0/y": b"old 0y", "1/x": b"old 1x", "3/x": b"old 3x", "a": b"old"}
NEW_FOLDERS = {"0/x": b"new 0x", "2/x": b"new 2x", "a": b"new"}
OTHER_FOLDERS = {"3/notes": b"precious", "4/x": b"precious"}
FORMER_FOLDERS = list(OLD_FOLDERS)[:-1]


def test_folders_are_made_and_removed_with_their_files_and_no_others_are(tmp_path: Path) -> None:
    put(tmp_path, OLD_FOLDERS, OTHER_FOLDERS)
    write(tmp_path, files(NEW_FOLDERS), overwrite=True, former=FORMER_FOLDERS)
    assert held(tmp_path) == NEW_FOLDERS | OTHER_FOLDERS
    assert not (tmp_path / "1").exists()


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("step", [*STEPS, (Path, "mkdir"), (Path, "rmdir")], ids=lambda step: step[1])
@pytest.mark.parametrize("existing", [False, True])
def test_an_interrupt_at_any_step_leaves_folders_as_they_were(
    step: tuple[object, str], existing: bool, after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = OLD_FOLDERS if existing else {}
    reached = broken_off(step, after, tmp_path, monkeypatch, before, NEW_FOLDERS, OTHER_FOLDERS, FORMER_FOLDERS)
    never = {("link", True), ("rename", False), ("replace", False), ("chmod", False), ("rmdir", False)}
    assert reached or (step[1], existing) in never


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_no_folder_is_left_alone(overwrite: bool, tmp_path: Path) -> None:
    put(tmp_path, {"2": b"precious", "elsewhere/x": b"precious"})
    before = held(tmp_path)
    with pytest.raises(OutputError, match="2 exists, and a there does not name it"):
        write(tmp_path, files(NEW_FOLDERS), overwrite=overwrite, former=FORMER_FOLDERS)
    (tmp_path / "2").rename(tmp_path / "moved")
    (tmp_path / "2").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="2 exists, and a there does not name it"):
        write(tmp_path, files(NEW_FOLDERS), overwrite=overwrite, former=FORMER_FOLDERS)
    (tmp_path / "2").unlink()
    (tmp_path / "moved").rename(tmp_path / "2")
    assert held(tmp_path) == before


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("link", [False, True])
def test_what_takes_the_name_of_a_folder_meanwhile_is_left_alone(overwrite: bool, link: bool, tmp_path: Path) -> None:
    put(tmp_path, {"elsewhere/x": b"precious"})

    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        yield from files(NEW_FOLDERS)
        if link:
            (tmp_path / "2").symlink_to(tmp_path / "elsewhere")
        else:
            put(tmp_path, {"2": b"another's"})

    with pytest.raises(OutputError, match=r"2 (exists|is not a file)"):
        write(tmp_path, some(), overwrite=overwrite, former=FORMER_FOLDERS)
    (tmp_path / "2").unlink()
    assert held(tmp_path) == {"elsewhere/x": b"precious"}


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_permissions_are_those_of_what_is_replaced_or_of_the_umask(mask: int, tmp_path: Path) -> None:
    put(tmp_path, {"a-1": b"old"})
    (tmp_path / "a-1").chmod(0o4640)
    seen: list[int] = []

    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        for each in files(NEW):
            seen.extend(stat.S_IMODE(path.stat().st_mode) for path in tmp_path.glob(output.STAGES.format("*")))
            yield each

    before = os.umask(mask)
    try:
        write(tmp_path, some(), overwrite=True)
    finally:
        os.umask(before)
    assert seen == [0o700] * 2  # there is none before the first file is written
    modes = {name: stat.S_IMODE((tmp_path / name).stat().st_mode) for name in NEW}
    assert modes == {"a-0": 0o666 & ~mask, "a-1": 0o640, "a": 0o666 & ~mask}


def stage(folder: Path, name: str = "0123456789abcdef") -> Path:
    """A hidden folder as a killed writer leaves it."""
    left = folder / output.STAGES.format(name)
    (left / output.FORMER).mkdir(parents=True)
    put(left, NEW)
    put(left / output.FORMER, OLD)
    return left


@pytest.mark.parametrize("one", [False, True])
def test_the_next_run_removes_what_killed_writers_left(one: bool, tmp_path: Path) -> None:
    stage(tmp_path)
    kept = stage(tmp_path, "precious")
    if one:
        output.write_atomically(tmp_path / "a", [b"x"], overwrite=False)
    else:
        write(tmp_path, files(NEW), overwrite=False)
    assert {path.name for path in tmp_path.iterdir()} == {kept.name, *(["a"] if one else NEW)}
    assert (kept / output.FORMER / "a").exists()


def test_the_folder_of_a_running_process_is_left_alone(tmp_path: Path) -> None:
    def some() -> Iterator[tuple[str, Iterable[bytes]]]:
        for each in files(NEW):
            output.sweep.cache_clear()
            output.write_atomically(tmp_path / "other", [b"inner"], overwrite=True)
            yield each

    write(tmp_path, some(), overwrite=False)
    assert held(tmp_path) == NEW | {"other": b"inner"}


@pytest.mark.parametrize("together", [False, True])
def test_a_part_or_folder_swept_before_it_is_locked_is_made_again(
    together: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not together:
        monkeypatch.setattr(output, "UNNAMED", None)
    lock = output.lock
    rounds: list[int] = []

    def late(descriptor: int) -> None:
        if not rounds:
            (part,) = tmp_path.iterdir()
            part.rmdir() if part.is_dir() else part.unlink()
        rounds.append(descriptor)
        lock(descriptor)

    monkeypatch.setattr(output, "lock", late)
    if together:
        write(tmp_path, files(NEW), overwrite=False)
    else:
        output.write_atomically(tmp_path / "a", [b"x"], overwrite=False)
    assert len(rounds) == 2
    assert held(tmp_path) == (NEW if together else {"a": b"x"})


# --- Writers that are killed ------------------------------------------------------------------------------------------

#: Writes until it is killed: new files, or the same files again and again, all of which say which round they are of.
WRITER = """
import itertools, pathlib, sys
from sparklod_cli.system import output
folder, unnamed, overwrite = pathlib.Path(sys.argv[1]), sys.argv[2] == "True", sys.argv[3] == "True"
if not unnamed:
    output.UNNAMED = None
siblings = output.Siblings(lambda name: name != "a")
print("ready", flush=True)
for number in itertools.count():
    {write}
"""
WRITE_ONE = """name = "out" if overwrite else f"out-{number}"
    output.write_atomically(folder / name, [bytes([number % 256]) * 100_000] * 4, overwrite=overwrite)"""
WRITE_SET = """with output.Output(folder / "a", overwrite=True, siblings=siblings) as out:
        for name in ("a-0", "a-1", "a-2", "a"):
            out.write(name, [str(number).encode() * 1000])"""


def kill_writers(write: str, folder: Path, *, unnamed: bool = True, overwrite: bool = True) -> Iterator[None]:
    """Start a writer 12 times and kill it at a random moment, the later the longer nothing has been written."""
    chance = random.Random(1)
    command = [sys.executable, "-c", WRITER.replace("{write}", write), str(folder), str(unnamed), str(overwrite)]
    for number in range(12):
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            time.sleep(chance.uniform(0, 0.1) * (1 if any(folder.iterdir()) else 1.5**number))
            process.kill()
        output.sweep.cache_clear()
        yield


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.slow
def test_a_killed_writer_leaves_whole_files_only(overwrite: bool, unnamed: bool, tmp_path: Path) -> None:
    seen = 0
    for _ in kill_writers(WRITE_ONE, tmp_path, unnamed=unnamed, overwrite=overwrite):
        parts = [name for name in names(tmp_path) if not name.startswith("out")]
        if unnamed and not overwrite:
            assert parts == []
        for name in set(names(tmp_path)) - set(parts) - {"out-last"}:
            data = (tmp_path / name).read_bytes()
            assert data == data[:1] * 400_000
            seen += 1
        output.write_atomically(tmp_path / "out-last", [b"x"], overwrite=True)  # another run, which sweeps
        assert [name for name in names(tmp_path) if not name.startswith("out")] == []
        for path in tmp_path.glob("out-*"):
            path.unlink()
    assert seen  # not all were killed before they had written anything


def test_a_killed_writer_never_leaves_two_sets_under_one_header(tmp_path: Path) -> None:
    whole = 0
    for _ in kill_writers(WRITE_SET, tmp_path):
        if (tmp_path / "a").exists():
            whole += 1
            assert len({(tmp_path / name).read_bytes() for name in ("a-0", "a-1", "a-2", "a")}) == 1
        output.sweep(tmp_path)
        assert set(names(tmp_path)) <= {"a-0", "a-1", "a-2", "a"}
    assert whole
