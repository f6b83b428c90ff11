"""A store at an address has the bytes and the laws of one in a folder."""

from __future__ import annotations

import pickle
import uuid
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fsspec")

from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.addresses import Address
from sparklod_cli.system.errors import ScratchError

pytestmark = pytest.mark.slow

ARRAYS = {"rows": np.arange(300_000, dtype=np.float32).reshape(-1, 3), "none": np.empty((0, 4), np.int64)}


@pytest.fixture
def store() -> Store:
    return Store(Address(f"memory://{uuid.uuid4().hex}/scratch"))


def test_it_has_the_bytes_of_a_folder(store: Store, tmp_path: Path) -> None:
    folder = Store(tmp_path)
    for each in (store, folder):
        each.put("stage/1", ARRAYS)
        assert each.names() == ["stage/1"]
    (path,) = tmp_path.rglob("*.npy")
    with (store.folder / "stage/1.npy").open() as file:
        assert file.read() == path.read_bytes()
    assert store.written == folder.written > 1_200_000


def test_what_is_put_is_got(store: Store) -> None:
    assert not store.has("stage/1") and store.names() == []
    store.put("stage/1", ARRAYS)
    for each in (store, pickle.loads(pickle.dumps(store))):
        assert each.has("stage/1") and each.is_sound("stage/1")
        got = each.get("stage/1")
        assert all(
            np.array_equal(got[name], array) and got[name].dtype == array.dtype for name, array in ARRAYS.items()
        )
        assert np.array_equal(each.rows("stage/1", "rows", 99_000, 99_010), ARRAYS["rows"][99_000:99_010])
        assert each.shape("stage/1", "none") == (0, 4)
    store.remove("stage/1")
    store.remove("stage/1")
    assert not store.has("stage/1") and not store.is_sound("stage/1")


def test_damage_is_found(store: Store) -> None:
    store.put("stage/1", ARRAYS)
    object_of = store.folder / "stage/1.npy"
    with object_of.open() as file:
        data = bytearray(file.read())
    data[5_000] ^= 1
    object_of.write([data])
    again = Store(store.folder)
    assert again.has("stage/1") and not again.is_sound("stage/1")
    with pytest.raises(ScratchError, match="damaged: its checksum does not match; run the command again with --resume"):
        again.get("stage/1")


def test_what_is_missing_is_said(store: Store) -> None:
    with pytest.raises(ScratchError, match=r"stage/1 is missing in .* memory://.*; begin anew with --overwrite"):
        store.get("stage/1")
