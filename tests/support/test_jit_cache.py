"""The cache of compiled kernels survives what happens to files."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from sparklod_cli.support import atomic
from sparklod_cli.support.jit_cache import SUFFIX, KernelCache, pattern_of
from tests.conftest import ROOT

DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "garbage": lambda content: os.urandom(len(content)),
    "a bit in the code": lambda content: content[:-2000] + bytes([content[-2000] ^ 1]) + content[-1999:],
    "a bit in the checksum": lambda content: bytes([content[0] ^ 1]) + content[1:],
    "another file": lambda content: b"\x80\x04N.",
}


def twice(x: float) -> float:
    return x * 2


def compiled(folder: Path, told: list[str]) -> Any:
    """`twice`, compiled anew, with a cache."""
    kernel: Any = numba.njit(twice)
    kernel._cache = KernelCache(twice, folder, told.append)
    return kernel


def was_cached(kernel: Any) -> bool:
    return bool(kernel.stats.cache_hits) and not kernel.stats.cache_misses


def test_code_compiled_for_another_processor_is_not_used(tmp_path: Path) -> None:
    compiled(tmp_path, [])(2.0)
    assert list(tmp_path.glob(pattern_of("test_jit_cache.twice", Path(__file__))))
    call = f"pattern_of('test_jit_cache.twice', Path({__file__!r}))"
    code = f"from pathlib import Path; from sparklod_cli.support.jit_cache import pattern_of; print({call})"
    environment = {**os.environ, "NUMBA_CPU_NAME": "generic"}
    other = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert other.stdout.startswith("test_jit_cache.twice-")
    assert not list(tmp_path.glob(other.stdout.strip()))


def test_memory_that_runs_out_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    compiled(tmp_path, told)(2.0)

    def starved(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr("sparklod_cli.support.jit_cache.pickle.loads", starved)
    with pytest.raises(MemoryError):
        compiled(tmp_path, told)(2.0)
    assert told == []
    assert len(list(tmp_path.iterdir())) == 1


def test_a_second_process_finds_what_the_first_has_compiled(tmp_path: Path) -> None:
    told: list[str] = []
    for cached in (False, True):
        kernel = compiled(tmp_path, told)
        assert kernel(2.0) == 4
        assert was_cached(kernel) == cached
    assert kernel(2) == 4  # another signature, in a file of its own
    assert len(list(tmp_path.iterdir())) == 2
    assert told == []


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_told_of_and_compiled_again(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    told: list[str] = []
    compiled(tmp_path, told)(2.0)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    kernel = compiled(tmp_path, told)
    assert kernel(2.0) == 4
    assert not was_cached(kernel)
    assert told == [f"compiled code in {tmp_path} is damaged; the damaged kernels are compiled again"]
    kernel = compiled(tmp_path, told)
    assert kernel(2.0) == 4
    assert was_cached(kernel)
    assert len(told) == 1


def test_a_folder_that_takes_no_file_is_told_of_and_does_no_harm(tmp_path: Path) -> None:
    told: list[str] = []
    (tmp_path / "file").touch()
    assert compiled(tmp_path / "file" / "folder", told)(2.0) == 4
    assert len(told) == 1
    assert "not a directory" in told[0]


def test_a_folder_that_was_removed_is_made_again(tmp_path: Path) -> None:
    told: list[str] = []
    compiled(tmp_path / "gone", told)(2.0)
    assert len(list((tmp_path / "gone").glob(f"*{SUFFIX}"))) == 1
    assert told == []


def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: object, pieces: object, **_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic, "fill", full)
    told: list[str] = []
    assert compiled(tmp_path, told)(2.0) == 4
    assert "no space left on device" in told[0]
    assert list(tmp_path.iterdir()) == []


def test_a_bake_heals_a_cache_in_which_every_file_is_damaged(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    scene = ROOT / "fixtures" / "sh1-ascii.ply"
    tree = str(tmp_path / "tree.spz")
    subprocess.run([sys.executable, "-m", "sparklod_cli", "build-lod", str(scene), "-o", tree], check=True, cwd=ROOT)
    # inspect compiles the least
    command = [sys.executable, "-m", "sparklod_cli", "inspect", tree, "--check"]
    how: dict[str, Any] = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True, "check": True}
    subprocess.run(command, **how)
    files = sorted((tmp_path / "cache").rglob(f"*{SUFFIX}"))
    assert len(files) >= 4
    for number, path in enumerate(files):
        path.write_bytes([*DAMAGE.values()][number % len(DAMAGE)](path.read_bytes()))
    healed = subprocess.run(command, **how)
    assert healed.stderr.count("is damaged;") == 1  # for all of them
    assert "compiled 5 kernels" in healed.stderr
    again = subprocess.run(command, **how)
    assert "damaged" not in again.stderr
    assert "ompil" not in again.stderr
