"""The scratch folder of a bake out of core: its store of results, resumption, refusal, locks and names."""

from __future__ import annotations

import contextlib
import pickle
import resource
import signal
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from sparklod_cli.bake import store as store_module
from sparklod_cli.bake.flow import SCRATCH, scratch_folder
from sparklod_cli.bake.identity import BakeIdentity, FileState
from sparklod_cli.bake.planning import MANIFEST, at_work
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.bake.store import Store
from sparklod_cli.system.addresses import Address, Place
from sparklod_cli.system.errors import ScratchError, UnreadableError
from sparklod_cli.system.stdio import DASH
from tests.conftest import IS_ROOT, ROOT

DTYPES = st.sampled_from(["<f4", "<f8", "<i4", "<i8", "<u2", "<u8", "|u1", "|b1", "<f2"])
SHAPES = arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6)

ARRAYS = {
    "center": np.arange(300, dtype=np.float32).reshape(100, 3),
    "sh": np.empty((100, 0, 3), np.float32),
    "count": np.arange(100, dtype=np.uint16),
}
SMALL = {"value": np.arange(5)}

IDENTITY = BakeIdentity((FileState("a.ply", 3, 5, "sample a"),), {"method": "quick", "base": 1.5})

#: Ways to begin a bake whose scratch folder may exist.
BEGINNINGS: tuple[dict[str, bool], ...] = ({}, {"overwrite": True}, {"resume": True})


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / f"a.spz{SCRATCH}")


@pytest.fixture(params=["folder", pytest.param("address", marks=pytest.mark.slow)])
def any_store(request: pytest.FixtureRequest, store: Store) -> Store:
    if request.param == "folder":
        return store
    pytest.importorskip("fsspec")
    return Store(Address(f"memory://{uuid.uuid4().hex}/scratch"))


def file_of(store: Store, name: str = "x") -> Place:
    return store.folder / f"{name}.npy"


def data_of(store: Store, name: str = "x") -> bytes:
    with file_of(store, name).open("rb") as file:
        return bytes(file.read())


def replace(store: Store, data: bytes, name: str = "x") -> None:
    file = file_of(store, name)
    if isinstance(file, Path):
        file.write_bytes(data)
    else:
        file.write([data])


def same(got: dict[str, np.ndarray], put: dict[str, np.ndarray]) -> bool:
    return list(got) == list(put) and all(
        got[name].dtype == array.dtype and got[name].shape == array.shape and got[name].tobytes() == array.tobytes()
        for name, array in put.items()
    )


@given(st.dictionaries(st.text("abc_", min_size=1), arrays_of.arrays(DTYPES, SHAPES), max_size=4))
@settings(max_examples=60)
def test_arrays_are_read_as_written(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> None:
    store = Store(tmp_path_factory.mktemp("scratch"))
    store.put("stage/1", arrays)
    assert same(store.get("stage/1"), arrays)
    assert store.is_sound("stage/1")
    for name, array in arrays.items():
        assert store.shape("stage/1", name) == array.shape
        if array.ndim:
            assert store.rows("stage/1", name, 1, 3).tobytes() == array[1:3].tobytes()


@given(st.sets(st.integers(0, 1999), min_size=1), st.sampled_from([0, 5, 128]))
def test_selected_rows_are_those_of_the_whole_array(
    tmp_path_factory: pytest.TempPathFactory, rows: set[int], gap: int
) -> None:
    array, index = np.arange(4000, dtype=np.float32).reshape(-1, 2), np.array(sorted(rows), np.int64)
    store = Store(tmp_path_factory.mktemp("scratch"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "GAP", gap)
        store.put("stage/1", {"key": np.zeros(3), "rows": array})
        store.read = 0
        assert np.array_equal(store.rows_at("stage/1", "rows", index), array[index])
        assert store.read >= 8 * len(index)
        assert gap or store.read == 8 * len(index)


def test_results_are_named_counted_and_removed(any_store: Store, tmp_path: Path) -> None:
    turned = np.arange(12).reshape(3, 4).T[::2]
    assert any_store.names() == []
    for name in ("stage/1", "stage/1/families", "survey/0"):
        assert not any_store.has(name)
        any_store.put(name, ARRAYS | {"turned": turned})
        assert any_store.has(name)
    assert any_store.names() == ["stage/1", "stage/1/families", "survey/0"]
    assert any_store.written == 3 * len(data_of(any_store, "survey/0"))
    folder = Store(tmp_path / "same")
    folder.put("survey/0", ARRAYS | {"turned": turned})
    assert data_of(any_store, "survey/0") == data_of(folder, "survey/0")
    assert any_store.read == 0
    copy = pickle.loads(packed := pickle.dumps(any_store))
    assert len(packed) < 500
    assert same(copy.get("stage/1"), ARRAYS | {"turned": turned})
    assert copy.written == 0
    assert same(any_store.get("stage/1", ["count", "sh"]), {"count": ARRAYS["count"], "sh": ARRAYS["sh"]})
    assert np.array_equal(any_store.rows("stage/1", "center", 10, 20), ARRAYS["center"][10:20])
    assert any_store.read == 100 * 2 + 10 * 12
    any_store.remove("stage/1")
    any_store.remove("stage/1")
    assert any_store.names() == ["stage/1/families", "survey/0"]
    assert not any_store.has("stage/1") and not any_store.is_sound("stage/1")
    with pytest.raises(ScratchError, match=r"stage/1 is missing in the scratch folder .*scratch: .*--overwrite"):
        any_store.get("stage/1")


def test_a_result_is_replaced(store: Store) -> None:
    store.put("x", ARRAYS)
    for value in (np.arange(3), np.arange(3)[::-1]):  # the latter of the same size
        store.put("x", {"other": value})
        assert same(store.get("x"), {"other": value})


def test_a_write_that_fails_leaves_no_file(store: Store) -> None:
    class Broken:
        """Stands for an array; fails as the second of a result."""

    with pytest.raises(Exception, match="Broken"):
        store.put("x", {"center": ARRAYS["center"], "broken": Broken()})  # type: ignore[dict-item]
    assert not store.has("x")
    with pytest.raises(TypeError, match="plain numbers"):
        store.put("x", {"names": np.array(["a"])})
    assert [path for path in Path(str(store)).rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("at", [0, 9, 14, 20, 60, 200, -1])
def test_a_flipped_byte_is_found(any_store: Store, at: int) -> None:
    any_store.put("x", ARRAYS)
    data = bytearray(data_of(any_store))
    data[at] ^= 0x10
    replace(any_store, data)
    assert not any_store.is_sound("x")
    with pytest.raises(ScratchError, match=r"x in the scratch folder .* is damaged: .*--resume"):
        Store(any_store.folder).get("x")


@pytest.mark.parametrize("left", [0, 10, 30, 200, -1])
def test_a_truncated_file_is_no_result(store: Store, left: int) -> None:
    store.put("x", ARRAYS)
    replace(store, data_of(store)[:left])
    assert not store.has("x")  # though its table was read before
    assert not store.is_sound("x")
    with pytest.raises(ScratchError, match="damaged"):
        store.rows("x", "center", 0, 1)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_limit_of_file_size_is_an_error(store: Store) -> None:
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # as Python does where it starts as a program
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(ScratchError, match=r"no room left in the scratch folder .*: file too large"):
            store.put("x", {"center": np.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not store.has("x")


@pytest.mark.skipif(IS_ROOT or sys.platform == "win32", reason="root may write everywhere")
def test_a_folder_without_permission_is_an_error(store: Store) -> None:
    Path(str(store)).mkdir(0o500)
    with pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*: permission denied.*--scratch-dir"):
        store.put("x", ARRAYS)


def test_a_file_in_place_of_the_folder_is_an_error(store: Store) -> None:
    Path(str(store)).write_text("a file")
    assert not store.has("x")
    with pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*--scratch-dir"):
        store.put("x", ARRAYS)
    with (
        pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*--scratch-dir"),
        Run(Store(store.folder / "scratch")).begun(),
    ):
        pass


class Run:
    """A bake of two tasks, and its messages."""

    def __init__(self, store: Store) -> None:
        self.store = Store(store.folder)
        self.said: list[str] = []

    @contextlib.contextmanager
    def begun(
        self,
        *,
        resume: bool = False,
        overwrite: bool = False,
        identity: BakeIdentity = IDENTITY,
        block_splats: int = 100,
    ) -> Iterator[int]:
        say = self.said.append
        with at_work(self.store, identity, block_splats, resume=resume, overwrite=overwrite, say=say) as size:
            yield size

    def interrupted(self, error: BaseException | None = None) -> Run:
        """Fail after both tasks."""
        error = error or KeyboardInterrupt()
        with pytest.raises(type(error)), self.begun():
            self.store.put("first", SMALL)
            self.store.put("second", SMALL)
            raise error
        return self


def refused(store: Store, message: str, **beginning: Any) -> None:
    with pytest.raises(ScratchError, match=message), Run(store).begun(**beginning):
        pass


def test_a_bake_that_succeeds_removes_its_folder(store: Store, tmp_path: Path) -> None:
    run = Run(store)
    with run.begun(resume=True) as block_splats:  # without results, it begins
        assert block_splats == 100
        run.store.put("some/first", SMALL)
        (tmp_path / f"a.spz{SCRATCH}" / "unpacked").write_bytes(b"columns")
    assert list(tmp_path.iterdir()) == []
    assert run.said == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), UnreadableError("x"), SystemExit()])
def test_results_are_kept_after_an_interruption_and_used_by_resume(store: Store, error: BaseException) -> None:
    run = Run(store).interrupted(error)
    assert run.said == [f"finished work stays in {store}; run the command again with --resume to continue"]
    refused(store, r"an interrupted bake left .*scratch; .*--resume.*--overwrite")
    assert store.names() == ["first", MANIFEST, "second"]
    run = Run(store)
    with run.begun(resume=True, block_splats=50) as block_splats:
        assert block_splats == 100  # of the interrupted run
        assert run.said == [f"continues with 2 results in {store}"]
        assert run.store.has("first") and run.store.has("second")
    assert not Path(str(store)).exists()


def test_an_interruption_before_the_first_result_leaves_no_folder(store: Store) -> None:
    run = Run(store)
    with pytest.raises(KeyboardInterrupt), run.begun():
        raise KeyboardInterrupt
    assert not Path(str(store)).exists()
    assert run.said == []


@pytest.mark.parametrize(
    ("other", "difference"),
    [
        (BakeIdentity((FileState("b.ply", 3, 5, "sample b"),), IDENTITY.settings), r"b\.ply changed since"),
        (BakeIdentity(IDENTITY.inputs, {"method": "quality", "base": 1.5}), "method was 'quick' and is 'quality'"),
        (
            BakeIdentity((*IDENTITY.inputs, FileState("c.ply", 3, 5, "more")), IDENTITY.settings),
            "it had 1 input files and has 2",
        ),
        (BakeIdentity(IDENTITY.inputs, {"method": "quick"}), "base was 1.5 and is None"),
    ],
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_results_of_another_bake_are_refused_with_the_difference(
    store: Store, other: BakeIdentity, difference: str, overwrite: bool
) -> None:
    Run(store).interrupted()
    refused(store, f"results of another bake: {difference}", resume=True, overwrite=overwrite, identity=other)
    assert store.names() == ["first", MANIFEST, "second"]


def flipped(data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 1])


@pytest.mark.parametrize("damage", [flipped, lambda data: data[:-1]])
def test_damaged_results_are_removed_and_reported(store: Store, damage: Callable[[bytes], bytes]) -> None:
    Run(store).interrupted()
    replace(store, damage(data_of(store, "second")), "second")
    run = Run(store)
    with run.begun(resume=True):
        assert not run.store.has("second")
        assert run.store.has("first")
    assert run.said == [f"continues with 1 result in {store}; 1 other that a failure damaged will be made again"]


def test_a_damaged_manifest_is_refused(store: Store) -> None:
    Run(store).interrupted()
    replace(store, flipped(data_of(store, MANIFEST)), MANIFEST)
    refused(store, "has no record of its bake", resume=True)


@pytest.mark.parametrize("beginning", BEGINNINGS)
def test_a_folder_of_other_files_is_refused(store: Store, beginning: dict[str, bool]) -> None:
    file = Path(str(store)) / "thesis.txt"
    file.parent.mkdir()
    file.write_text("mine")
    refused(store, "is not a scratch folder", **beginning)
    assert file.read_text() == "mine"


def test_scratch_folders_of_different_outputs_have_different_names(tmp_path: Path) -> None:
    def folder_of(target: Path, parent: Path | None) -> Path:
        return Path(str(scratch_folder(ROOT / "fixtures" / "one.ply", target, BakeSettings(), parent)))

    assert folder_of(tmp_path / "web" / "a.spz", None) == tmp_path / "web" / f"a.spz{SCRATCH}"
    parent = tmp_path / "fast"
    names = {folder_of(tmp_path / folder / "a.spz", parent) for folder in ("web", "www")}
    assert len(names) == 2
    assert {name.parent for name in names} == {parent}
    assert folder_of(DASH, parent).parent == parent
    assert folder_of(DASH, None) == folder_of(DASH, None)
