"""Machine code as files: names, trust, damage, full disks, folders that vanish, and what comes with the package."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.system import jit, machine_code
from sparklod_cli.system.jit import f8
from sparklod_cli.system.machine_code import CHECKSUM, SUFFIX, cache_folders, is_trusted, name_of, needed_by
from sparklod_cli.warmup import units
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

# --- Files of the cache -----------------------------------------------------------------------------------------------

DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "garbage": lambda content: os.urandom(len(content)),
    "a bit in the code": lambda content: content[:-2000] + bytes([content[-2000] ^ 1]) + content[-1999:],
    "a bit in the checksum": lambda content: bytes([content[0] ^ 1]) + content[1:],
    "another file": lambda content: b"\x80\x04N.",
}


def is_whole(content: bytes) -> bool:
    """Whether the content of a file of the cache has its checksum."""
    return content[:CHECKSUM] == hashlib.blake2b(content[CHECKSUM:], digest_size=CHECKSUM).digest()


def twice(x: float) -> float:
    return x * 2


@dataclass
class Cache:
    """A cache of kernels, and what was said of it."""

    folder: Path
    begun: list[str] = field(default_factory=list)
    told: list[str] = field(default_factory=list)

    def files(self, suffix: str = "") -> list[Path]:
        return sorted(self.folder.glob(f"*{suffix}"))

    def compiles(self, argument: float = 2.0) -> bool:
        """Calls `twice` as in a new process; whether it had to be compiled."""
        before = len(self.begun)
        assert jit.kernel(f8, returns=f8)(twice)(argument) == argument * 2
        return len(self.begun) > before


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cache]:
    found = Cache(tmp_path / "cache")
    monkeypatch.setattr(jit, "CACHE_FOLDER", found.folder)
    jit.listeners.append((found.begun.append, lambda seconds: None, found.told.append))
    yield found
    jit.listeners.pop()


def level(flags: frozenset[str], tmp_path: Path, **variables: str) -> str:
    """The level of a processor with some flags, in a new process."""
    (tmp_path / "cpuinfo").write_text(f"processor: 0\nflags\t\t: fpu {' '.join(flags)} sse2\n")
    code = """
import pathlib, sys
read = pathlib.Path.read_text
pathlib.Path.read_text = lambda path: read(pathlib.Path(sys.argv[1]) if str(path) == "/proc/cpuinfo" else path)
from sparklod_cli.system import machine_code
machine_code.PLATFORM = "linux-x86_64"
print(machine_code.level())
"""
    command, environment = [sys.executable, "-c", code, str(tmp_path / "cpuinfo")], {**os.environ, **variables}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_machine_code_is_for_the_best_level_of_the_processor_or_a_lower_one_that_is_named(tmp_path: Path) -> None:
    best, middle = needed_by("x86-64-v3"), needed_by("x86-64-v2")
    assert level(best, tmp_path) == level(best, tmp_path, NUMBA_CPU_NAME="nosuchcpu") == "x86-64-v3"
    assert level(best - {"fma"}, tmp_path) == level(best, tmp_path, NUMBA_CPU_NAME="x86-64-v2") == "x86-64-v2"
    assert level(middle, tmp_path, NUMBA_CPU_NAME="x86-64-v3") == "x86-64-v2"
    assert level(middle - {"ssse3"}, tmp_path) == level(best, tmp_path, NUMBA_CPU_NAME="x86-64") == "x86-64"


def test_variables_of_numba_that_can_change_the_code_change_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    name = name_of(twice, 0)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert name_of(twice, 0) == name
    monkeypatch.setenv("NUMBA_OPT", "1")
    assert name_of(twice, 0) not in (name, name_of(twice, 1))


# --- Trust ------------------------------------------------------------------------------------------------------------


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    given = cache_folders()[0]
    assert given is not None
    assert given.parent == tmp_path / "given"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/dev/null/no/folder")
    assert cache_folders() == (None, (), ())


posix = pytest.mark.skipif(os.name != "posix", reason="POSIX only")


@posix
@pytest.mark.parametrize("mode", [0o777, 0o775, 0o707])
def test_a_folder_that_others_can_write_is_not_used(mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = cache_folders()[0]
    assert folder is not None
    folder.chmod(mode)
    written, read, (message,) = cache_folders()
    assert (written, read) == (None, ())
    assert message.startswith(f"compiled code in {folder} is not used: another user owns it or can write it")
    folder.chmod(0o755)
    assert cache_folders() == (folder, (), ())


@posix
@pytest.mark.parametrize(("user", "owner", "trusted"), [(7, 0, True), (7, 7, True), (7, 8, False), (0, 7, False)])
def test_what_another_user_owns_is_not_trusted(
    user: int, owner: int, trusted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give files away")
    (tmp_path / "file").touch(0o644)
    os.chown(tmp_path / "file", owner, owner)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert is_trusted((tmp_path / "file").stat()) is trusted
    monkeypatch.setattr(machine_code, "PACKAGE", tmp_path / "package")
    (tmp_path / "package").mkdir()
    os.chown(tmp_path / "package", owner, owner)
    assert is_trusted((tmp_path / "file").stat())


@posix
def test_a_new_folder_is_readable_by_others_only_if_the_superuser_made_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for user, mode in ((0, 0o755), (os.geteuid() or 7, 0o700)):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / str(user)))
        monkeypatch.setattr(os, "geteuid", lambda user=user: user)
        cache_folders()
        (folder,) = (tmp_path / str(user)).iterdir()
        assert folder.stat().st_mode & 0o777 == mode


@posix
@pytest.mark.parametrize(("folder", "is_read"), [(0o700, True), (0o755, False)])
def test_a_file_that_others_can_write_is_not_read_unless_they_cannot_reach_it(
    folder: int, is_read: bool, cache: Cache
) -> None:
    assert cache.compiles()
    cache.folder.chmod(folder)
    for path in cache.files():
        path.chmod(0o666)
    assert cache.compiles() is not is_read
    assert bool(cache.told) is not is_read


def test_a_cache_that_can_only_be_read_is_read(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache.compiles()
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert cache.compiles()
    monkeypatch.setattr(jit, "READ_FOLDERS", (cache.folder,))
    before = cache.files()
    assert not cache.compiles()
    assert (cache.files(), cache.told) == (before, [])


@posix
def test_a_folder_that_cannot_be_written_is_read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = cache_folders()[0]
    assert folder is not None
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert cache_folders() == (None, (folder,), ())


# --- Damage -----------------------------------------------------------------------------------------------------------


def test_a_second_process_finds_what_the_first_has_compiled(cache: Cache) -> None:
    assert [cache.compiles(), cache.compiles()] == [True, False]
    assert len(cache.files()) == 1
    assert cache.told == []


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_files_are_told_of_and_compiled_again(cache: Cache, damage: Callable[[bytes], bytes]) -> None:
    cache.compiles()
    for path in cache.files():
        path.write_bytes(damage(path.read_bytes()))
    assert cache.compiles()
    assert set(cache.told) == {f"compiled code in {cache.folder} is damaged; the damaged kernels are compiled again"}
    before = len(cache.told)
    assert not cache.compiles()
    assert len(cache.told) == before == 1


def test_a_folder_that_takes_no_file_is_told_of_and_does_no_harm(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.folder.touch()
    monkeypatch.setattr(jit, "CACHE_FOLDER", cache.folder / "folder")
    assert cache.compiles()
    assert len(cache.told) == 1
    assert "not a directory" in cache.told[0]


def test_a_full_disk_leaves_no_part_of_a_file(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert cache.compiles()
    assert "no space left on device" in cache.told[0]
    assert cache.files() == []


def test_a_command_heals_a_cache_in_which_every_file_is_damaged(tmp_path: Path) -> None:
    assert jit.CACHE_FOLDER is not None
    copy = tmp_path / "cache" / jit.CACHE_FOLDER.name
    copy.mkdir(parents=True)
    for unit in units():
        if unit.name.partition(".")[0] == "tree_links":  # those of inspect
            for path in [jit.CACHE_FOLDER / f"{name_of(unit.kernel.py_func, unit.number)}{SUFFIX}"]:
                shutil.copy(path, copy)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    scene = ROOT / "fixtures" / "sh1-ascii.ply"
    tree = str(tmp_path / "tree.spz")
    subprocess.run([sys.executable, "-m", "sparklod_cli", "build-lod", str(scene), "-o", tree], check=True, cwd=ROOT)
    # inspect compiles the least
    command = [sys.executable, "-m", "sparklod_cli", "inspect", tree, "--check"]
    how: dict[str, Any] = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True, "check": True}
    assert "ompil" not in subprocess.run(command, **how).stderr
    files = sorted(copy.iterdir())
    assert len(files) >= 4
    for number, path in enumerate(files):
        path.write_bytes([*DAMAGE.values()][number % len(DAMAGE)](path.read_bytes()))
    healed = subprocess.run(command, **how)
    assert healed.stderr.count("is damaged;") == 1  # for all of them
    compiled = re.search(r"compiled (\d+) kernels", healed.stderr)
    assert compiled and int(compiled[1]) >= 4
    again = subprocess.run(command, **how)
    assert "damaged" not in again.stderr
    assert "ompil" not in again.stderr


# --- What comes with the package --------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("cc") is None or sys.platform == "win32", reason="no linker")
def test_machine_code_that_is_shipped_is_used_unless_its_source_differs(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cache.compiles()
    objects = [tmp_path / path.name for path in cache.files()]
    for path, copy in zip(cache.files(), objects, strict=True):
        copy.write_bytes(path.read_bytes()[CHECKSUM:])
    library = tmp_path / f"{machine_code.PLATFORM}-{machine_code.level()}.so"
    subprocess.run(["cc", "-shared", "-o", library, *objects, "-lm"], check=True)
    monkeypatch.setattr(machine_code, "SHIPPED", tmp_path)
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    machine_code.shipped_library.cache_clear()
    try:
        assert not cache.compiles()
        monkeypatch.setattr(machine_code, "digest_of", lambda path: "another")
        assert cache.compiles()
    finally:
        machine_code.shipped_library.cache_clear()


def test_a_package_in_a_zip_finds_its_sources(tmp_path: Path) -> None:
    """Without them, code of another version would be taken for its own."""
    shutil.make_archive(str(tmp_path / "package"), "zip", ROOT, "sparklod_cli")
    code = """
from pathlib import Path
from sparklod_cli.lod.kernels import sort
from sparklod_cli.system import machine_code
print(machine_code.PACKAGE.parent.name, machine_code.name_of(sort.fill_box.py_func, 0))
"""
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "package.zip")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    from sparklod_cli.lod.kernels import sort

    assert done.stdout.split() == ["package.zip", name_of(sort.fill_box.py_func, 0)]
