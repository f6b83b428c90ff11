"""`sparklod traverse --indices-out`: the nodes of every cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.commands.traverse.runs import ORBIT, OTHER, TOWN, TREE, table, traverse
from tests.conftest import Capture


def cut_of(path: Path) -> np.ndarray:
    nodes: np.ndarray = np.load(path)
    assert nodes.dtype == np.uint32
    return nodes


def test_indices_out_writes_the_nodes_of_every_cut(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "new" / "cuts"
    assert traverse(TOWN, *ORBIT, "--budget", "20k", "--indices-out", folder) == 0
    rows = table(capsys.readouterr().out)
    assert sorted(path.name for path in folder.iterdir()) == ["000000.npy", "000001.npy", "000002.npy"]
    for row in rows:
        nodes = cut_of(folder / f"{int(row['frame']):06d}.npy")
        assert nodes.shape == (int(row["selected"]),)
        assert (np.diff(nodes.astype(np.int64)) > 0).all()
    padded = tmp_path / "padded"
    assert traverse(TOWN, *ORBIT, "--budget", "20k", "--indices-out", padded, "--padded") == 0
    for path in folder.iterdir():
        nodes, rows_of_texture = cut_of(path), cut_of(padded / path.name)
        assert rows_of_texture.shape == (2, 16_384)
        assert np.array_equal(rows_of_texture.ravel()[: len(nodes)], nodes)
        assert not rows_of_texture.ravel()[len(nodes) :].any()
    capsys.readouterr()
    assert traverse(TOWN, *ORBIT, "--indices-out", folder) == 1
    assert f"{folder / '000000.npy'} exists, add --overwrite" in capsys.readouterr().err
    assert traverse(TOWN, *ORBIT, "--indices-out", folder, "--overwrite", "--budget", "100", "-q") == 0
    assert len(cut_of(folder / "000000.npy")) <= 100


def test_indices_out_names_instances_and_frames(tmp_path: Path, capsys: Capture) -> None:
    cuts = tmp_path / "cuts"
    assert traverse(TREE, OTHER, *ORBIT, "--every", 2, "--indices-out", cuts, "--per-instance") == 0
    rows = table(capsys.readouterr().out)
    assert [(row["frame"], row["instance"]) for row in rows] == [
        (frame, name) for frame in "02" for name in ("total", "hand-tree-v3", "tree-v3")
    ]
    assert sorted(path.name for path in cuts.iterdir()) == [f"00000{frame}.{at}.npy" for frame in "02" for at in "01"]
    for row in rows:
        if row["instance"] != "total":
            at = 0 if row["instance"] == "hand-tree-v3" else 1
            assert len(cut_of(cuts / f"00000{row['frame']}.{at}.npy")) == int(row["selected"])


def test_indices_out_refuses_a_path_that_is_a_file(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "cuts").touch()
    assert traverse(TREE, *ORBIT, "--indices-out", tmp_path / "cuts") == 2
    assert "cuts" in capsys.readouterr().err
