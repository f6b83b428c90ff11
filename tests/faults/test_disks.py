"""Full disks and read-only folders: each is an error of one line, and no file has the final name.

Standard output that is full or closed is in tests/system/test_processes.py.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tests.faults.runs import CHUNKED, DEMO, SMALL, TREE, WRITERS, mounted, said_one_error, sparklod

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has other file systems")]

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="there is no /dev/full here")

#: Commands whose output is larger than a page of memory, the smallest size of such a disk.
LARGE = {
    "build-lod": WRITERS["build-lod"],
    "traverse": WRITERS["traverse"],
    "render": (["render", TREE, "--size", "320x200", "-o"], "picture.npy"),
    "inspect": WRITERS["inspect"],
}


@pytest.mark.parametrize("name", LARGE)
def test_a_full_disk_is_one_error_and_leaves_no_file(name: str, tmp_path: Path) -> None:
    arguments, output = LARGE[name]
    with mounted(tmp_path / "disk", "size=8k") as disk:
        done = sparklod(*arguments, disk / output)
        assert done.returncode == 1
        line = said_one_error(done.stderr)
        assert "no space left" in line
        assert str(disk / output) in line
        assert list(disk.iterdir()) == []


def test_a_disk_that_fills_up_keeps_the_file_to_be_replaced(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=16k") as disk:
        target = disk / "demo.spz"
        shutil.copy(TREE, target)
        done = sparklod("build-lod", DEMO, "-o", target, "--overwrite")
        assert done.returncode == 1
        assert "no space left" in said_one_error(done.stderr)
        assert target.read_bytes() == TREE.read_bytes()
        assert list(disk.iterdir()) == [target]


@pytest.mark.parametrize("existing", [False, True])
def test_chunks_on_a_disk_that_fills_up_change_nothing(existing: bool, tmp_path: Path) -> None:
    before = {"demo-0.radc": b"old chunk", "demo-7.radc": b"old chunk", "demo.rad": b"old header"} if existing else {}
    with mounted(tmp_path / "disk", "size=64k") as disk:
        for name, data in before.items():
            (disk / name).write_bytes(data)
        done = sparklod(*CHUNKED, disk / "demo.rad", "--overwrite")
        assert done.returncode == 1
        line = said_one_error(done.stderr)
        assert "no space left" in line
        assert str(disk / "demo.rad") in line
        assert {path.name: path.read_bytes() for path in disk.iterdir()} == before


def test_what_is_written_before_the_disk_is_full_is_whole(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=64k") as disk:
        done = sparklod("render", TREE, "--orbit", "40", "--size", "160x120", "-o", disk / "out.%04d.npy")
        assert done.returncode == 1
        assert "no space left" in said_one_error(done.stderr)
        sizes = {path.stat().st_size for path in disk.iterdir()}
        assert all(path.name.startswith("out.") for path in disk.iterdir())
        assert len(sizes) <= 1


@needs_full
@pytest.mark.parametrize("name", ["build-lod", "inspect", "traverse"])
def test_a_full_device_is_one_error_that_names_it(name: str) -> None:
    arguments, _ = LARGE[name]
    done = sparklod(*arguments, FULL)
    assert done.returncode == 1
    line = said_one_error(done.stderr)
    assert "no space left" in line
    assert str(FULL) in line


@pytest.mark.parametrize("name", ["build-lod", "build-lod in chunks", "traverse"])
def test_a_read_only_folder_is_one_error(name: str, tmp_path: Path) -> None:
    arguments, output = WRITERS.get(name, (CHUNKED, "demo.rad"))
    with mounted(tmp_path / "disk", "size=64k,ro") as disk:
        done = sparklod(*arguments, disk / output)
        assert done.returncode == 1
        line = said_one_error(done.stderr)
        assert "read-only" in line
        assert str(disk) in line
        assert list(disk.iterdir()) == []


def test_output_folders_that_cannot_be_made_are_one_error(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=64k,ro") as disk:
        for arguments in (
            ["build-lod", SMALL, "--output-dir", disk / "new"],
            ["traverse", TREE, "--orbit", "2", "-o", tmp_path / "t.csv", "--overwrite", "--indices-out", disk / "new"],
        ):
            done = sparklod(*arguments)
            assert done.returncode == 1
            assert "read-only" in said_one_error(done.stderr)
