"""A store of results in a folder: what is put is what is got, whole or not at all, and damage is found."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from sparklod_cli.bake.out_of_core import store as store_module
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.errors import ScratchError
from tests.conftest import IS_ROOT
from tests.faults.runs import mounted

DTYPES = st.sampled_from(["<f4", "<f8", "<i4", "<i8", "<u2", "<u8", "|u1", "|b1", "<f2"])
SHAPES = arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6)

ARRAYS = {
    "center": np.arange(300, dtype=np.float32).reshape(100, 3),
    "sh": np.empty((100, 0, 3), np.float32),
    "count": np.arange(100, dtype=np.uint16),
}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "scratch")


def file_of(store: Store) -> Path:
    """The one file of a store."""
    (path,) = (path for path in store.folder.rglob("*") if path.is_file())
    return path


def same(got: dict[str, np.ndarray], put: dict[str, np.ndarray]) -> bool:
    return list(got) == list(put) and all(
        got[name].dtype == array.dtype and got[name].shape == array.shape and got[name].tobytes() == array.tobytes()
        for name, array in put.items()
    )


@given(st.dictionaries(st.text("abc_", min_size=1), arrays_of.arrays(DTYPES, SHAPES), max_size=4))
@settings(max_examples=60)
def test_what_is_put_is_got(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> None:
    store = Store(tmp_path_factory.mktemp("scratch"))
    store.put("stage/1", arrays)
    assert same(store.get("stage/1"), arrays)
    assert store.is_sound("stage/1")
    for name, array in arrays.items():
        assert store.shape("stage/1", name) == array.shape
        if array.ndim:
            assert store.rows("stage/1", name, 1, 3).tobytes() == array[1:3].tobytes()


@given(st.sets(st.integers(0, 1999), min_size=1), st.sampled_from([0, 5, 128]))
def test_some_rows_are_those_of_the_whole_array(
    tmp_path_factory: pytest.TempPathFactory, some: set[int], gap: int
) -> None:
    array, index = np.arange(4000, dtype=np.float32).reshape(-1, 2), np.array(sorted(some), np.int64)
    store = Store(tmp_path_factory.mktemp("scratch"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "GAP", gap)
        store.put("stage/1", {"key": np.zeros(3), "rows": array})
        store.read = 0
        assert np.array_equal(store.rows_at("stage/1", "rows", index), array[index])
        assert store.read >= 8 * len(index)
        assert gap or store.read == 8 * len(index)


def test_arrays_that_are_not_contiguous_are_put_as_they_look(store: Store) -> None:
    turned = np.arange(12).reshape(3, 4).T[::2]
    store.put("x", {"turned": turned})
    assert (store.get("x")["turned"] == turned).all()


def test_some_arrays_are_got(store: Store) -> None:
    store.put("x", ARRAYS)
    assert list(store.get("x", ["count"])) == ["count"]
    assert list(store.get("x", [])) == []


def test_results_are_named_and_removed(store: Store) -> None:
    assert store.names() == []
    for name in ("stage/1", "stage/1/families", "survey/0"):
        assert not store.has(name)
        store.put(name, ARRAYS)
        assert store.has(name)
    assert store.names() == ["stage/1", "stage/1/families", "survey/0"]
    store.remove("stage/1")
    store.remove("stage/1")
    assert store.names() == ["stage/1/families", "survey/0"]
    assert not store.has("stage/1")


def test_a_result_is_replaced(store: Store) -> None:
    store.put("x", ARRAYS)
    store.put("x", {"other": np.arange(3)})
    assert same(store.get("x"), {"other": np.arange(3)})
    store.put("x", {"other": np.arange(3)[::-1]})  # of the same size
    assert same(store.get("x"), {"other": np.arange(3)[::-1]})


def test_a_copy_for_another_process_is_small_and_finds_the_results(store: Store) -> None:
    store.put("x", ARRAYS)
    packed = pickle.dumps(store)
    assert len(packed) < 500
    copy = pickle.loads(packed)
    assert same(copy.get("x"), ARRAYS)
    assert copy.written == 0


def test_bytes_are_counted(store: Store) -> None:
    store.put("x", ARRAYS)
    assert store.written == file_of(store).stat().st_size
    assert store.read == 0
    store.get("x")
    assert store.read == 100 * 12 + 100 * 2
    store.rows("x", "center", 10, 20)
    assert store.read == 100 * 14 + 10 * 12


def test_nothing_is_left_where_writing_fails(store: Store) -> None:
    class Broken:
        """Stands for an array; fails as the second of a result."""

    with pytest.raises(Exception, match="Broken"):
        store.put("x", {"center": ARRAYS["center"], "broken": Broken()})  # type: ignore[dict-item]
    assert not store.has("x")
    with pytest.raises(TypeError, match="plain numbers"):
        store.put("x", {"names": np.array(["a"])})
    assert [path for path in store.folder.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("at", [0, 9, 14, 20, 60, 200, -1])
def test_a_flipped_byte_is_found(store: Store, at: int) -> None:
    store.put("x", ARRAYS)
    data = bytearray(file_of(store).read_bytes())
    data[at] ^= 0x10
    file_of(store).write_bytes(data)
    assert not store.is_sound("x")
    fresh = Store(store.folder)
    with pytest.raises(ScratchError, match=r"x in the scratch folder .* is damaged: .*--resume"):
        fresh.get("x")


@pytest.mark.parametrize("left", [0, 10, 30, 200, -1])
def test_a_cut_file_is_no_result(store: Store, left: int) -> None:
    store.put("x", ARRAYS)
    path = file_of(store)
    os.truncate(path, left if left >= 0 else path.stat().st_size - 1)
    assert not store.has("x")  # though its table was read before
    assert not store.is_sound("x")
    with pytest.raises(ScratchError, match="damaged"):
        store.rows("x", "center", 0, 1)


def test_a_missing_result_is_an_error_that_names_the_folder(store: Store) -> None:
    with pytest.raises(ScratchError, match=r"x is missing in the scratch folder .*scratch: .*--overwrite"):
        store.get("x")


def test_a_full_disk_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=64k") as disk:
        store = Store(disk / "scratch")
        store.put("small", ARRAYS)
        with pytest.raises(ScratchError, match=r"no room left in the scratch folder .*: no space left.*--resume"):
            store.put("x", {"center": np.zeros(100_000)})
        assert store.names() == ["small"]
        assert store.is_sound("small")


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
    store.folder.mkdir(0o500)
    with pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*: permission denied.*--scratch-dir"):
        store.put("x", ARRAYS)


def test_a_file_in_place_of_the_folder_is_an_error(store: Store) -> None:
    store.folder.write_text("a file")
    assert not store.has("x")
    with pytest.raises(ScratchError, match=r"cannot write in the scratch folder .*--scratch-dir"):
        store.put("x", ARRAYS)
