"""Whose results a scratch folder has: they are gone on with, refused or removed, and one run works there at a time."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.flow import SCRATCH, scratch_folder
from sparklod_cli.bake.identity import BakeIdentity, FileState
from sparklod_cli.bake.out_of_core.planning import LOCK, MANIFEST, at_work
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.system.errors import FormatError, ScratchError, UnreadableError
from sparklod_cli.system.stdio import DASH
from tests.conftest import ROOT

A = BakeIdentity((FileState("a.ply", 3, 5, "sample a"),), {"method": "quick", "base": 1.5})
VALUE = {"value": np.arange(5)}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / f"a.spz{SCRATCH}")


class Run:
    """A bake of two tasks, and what it heard."""

    def __init__(self, store: Store) -> None:
        self.store = Store(store.folder)
        self.said: list[str] = []

    @contextlib.contextmanager
    def begun(
        self, *, resume: bool = False, overwrite: bool = False, identity: BakeIdentity = A, block_splats: int = 100
    ) -> Iterator[int]:
        with at_work(
            self.store,
            identity,
            block_splats,
            resume=resume,
            overwrite=overwrite,
            say=self.said.append,
        ) as found:
            yield found

    def interrupted(self, error: BaseException | None = None, **how: bool) -> Run:
        """A run that ends in the middle."""
        error = error or KeyboardInterrupt()
        with pytest.raises(type(error)), self.begun(**how):
            self.store.put("first", VALUE)
            self.store.put("second", VALUE)
            raise error
        return self


def test_nothing_is_left_of_a_run_that_ended_well(store: Store, tmp_path: Path) -> None:
    run = Run(store)
    with run.begun() as block_splats:
        assert block_splats == 100
        run.store.put("some/first", VALUE)
        (store.folder / "unpacked").write_bytes(b"columns")
    assert list(tmp_path.iterdir()) == []
    assert run.said == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), UnreadableError("x"), SystemExit()])
def test_results_stay_after_an_interruption_and_are_gone_on_with(store: Store, error: BaseException) -> None:
    run = Run(store).interrupted(error)
    assert run.said == [f"finished work stays in {store}; run the command again with --resume to continue"]
    run = Run(store)
    with run.begun(resume=True, block_splats=50) as block_splats:
        assert block_splats == 100  # that of the run that began
        assert run.said == [f"continues with 2 results in {store}"]
        assert run.store.has("first")
        assert run.store.has("second")
    assert not store.folder.exists()


def test_results_are_removed_after_an_error_that_would_come_again(store: Store) -> None:
    assert Run(store).interrupted(FormatError("x")).said == []
    assert not store.folder.exists()


def test_nothing_stays_where_nothing_was_done(store: Store) -> None:
    run = Run(store)
    with pytest.raises(KeyboardInterrupt), run.begun():
        raise KeyboardInterrupt
    assert not store.folder.exists()
    assert run.said == []


def test_leftover_results_are_named_and_refused(store: Store) -> None:
    Run(store).interrupted()
    with (
        pytest.raises(ScratchError, match=r"an interrupted bake left .*scratch; .*--resume.*--overwrite"),
        Run(store).begun(),
    ):
        pass
    assert store.names() == ["first", MANIFEST, "second"]


def test_overwrite_begins_anew(store: Store) -> None:
    Run(store).interrupted()
    with Run(store).begun(overwrite=True, block_splats=50) as block_splats:
        assert block_splats == 50
        assert store.names() == [MANIFEST]


def test_resume_without_results_begins(store: Store) -> None:
    with Run(store).begun(resume=True) as block_splats:
        assert block_splats == 100


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (BakeIdentity((FileState("b.ply", 3, 5, "sample b"),), A.settings), r"b\.ply changed since"),
        (BakeIdentity(A.inputs, {"method": "quality", "base": 1.5}), "method was 'quick' and is 'quality'"),
        (BakeIdentity((*A.inputs, FileState("c.ply", 3, 5, "more")), A.settings), "it had 1 input files and has 2"),
        (BakeIdentity(A.inputs, {"method": "quick"}), "base was 1.5 and is None"),
    ],
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_another_identity_is_refused_with_what_differs(
    store: Store, other: BakeIdentity, words: str, overwrite: bool
) -> None:
    Run(store).interrupted()
    with (
        pytest.raises(ScratchError, match=f"results of another bake: {words}"),
        Run(store).begun(resume=True, overwrite=overwrite, identity=other),
    ):
        pass
    assert store.names() == ["first", MANIFEST, "second"]


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [flip, lambda path: path.write_bytes(path.read_bytes()[:-1])])
def test_damaged_results_are_removed_and_told(store: Store, damage: Callable[[Path], None]) -> None:
    Run(store).interrupted()
    damage(store.folder / "second.npy")
    run = Run(store)
    with run.begun(resume=True):
        assert not run.store.has("second")
        assert run.store.has("first")
    assert run.said == [f"continues with 1 result in {store}; 1 other that a failure damaged will be made again"]


def test_a_damaged_manifest_is_refused(store: Store) -> None:
    Run(store).interrupted()
    flip(store.folder / f"{MANIFEST}.npy")
    with pytest.raises(ScratchError, match="has no record of its bake"), Run(store).begun(resume=True):
        pass


def test_a_folder_of_somebody_else_is_refused(store: Store) -> None:
    store.folder.mkdir()
    (store.folder / "thesis.txt").write_text("mine")
    for how in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(ScratchError, match="is not a scratch folder"), Run(store).begun(**how):
            pass
    assert (store.folder / "thesis.txt").read_text() == "mine"


HOLDER = """
import sys
from pathlib import Path
from sparklod_cli.bake.out_of_core.planning import locked
with locked(Path(sys.argv[1])):
    print("at work", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks on Windows")
def test_a_folder_in_use_is_refused_until_its_run_is_killed(store: Store) -> None:
    command = [sys.executable, "-c", HOLDER, str(store.folder)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"at work\n"
        for how in ({}, {"overwrite": True}, {"resume": True}):
            with pytest.raises(ScratchError, match=r"another run is at work in .*wait for it"), Run(store).begun(**how):
                pass
        assert (store.folder / LOCK).exists()
        holder.kill()
    with Run(store).begun():
        pass
    assert not store.folder.exists()


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*--scratch-dir"),
        Run(Store(tmp_path / "file" / "scratch")).begun(),
    ):
        pass


def test_scratch_folders_have_names_of_their_own(tmp_path: Path) -> None:
    def folder_of(target: Path, parent: Path | None) -> Path:
        return Path(str(scratch_folder(ROOT / "fixtures" / "one.ply", target, BakeSettings(), parent)))

    assert folder_of(tmp_path / "web" / "a.spz", None) == tmp_path / "web" / f"a.spz{SCRATCH}"
    parent = tmp_path / "fast"
    names = {folder_of(tmp_path / folder / "a.spz", parent) for folder in ("web", "www")}
    assert len(names) == 2
    assert {name.parent for name in names} == {parent}
    assert folder_of(DASH, parent).parent == parent
    assert folder_of(DASH, None) == folder_of(DASH, None)
