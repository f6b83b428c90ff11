"""What `sparklod inspect` reads: folders, devices, files of nothing, long chains, one scene at a time."""

from __future__ import annotations

import json
import shutil
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.api import inspect_jobs
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.commands.inspect.runs import FAULTS, FOLDER, inspect, records
from tests.conftest import Capture


def test_an_unpacked_sog_counts_as_one_file(tmp_path: Path, capsys: Capture) -> None:
    assert inspect(FOLDER, FOLDER / "meta.json", "--json") == 0
    folder, meta = records(capsys.readouterr().out)
    size = sum(path.stat().st_size for path in FOLDER.iterdir())
    assert (folder["bytes"], folder["splats"], folder["format"]) == (size, 60, "SOG 2")
    assert folder | {"file": ""} == meta | {"file": ""}
    assert inspect(FOLDER, "--check", "--max-bytes", size) == 0
    assert inspect(FOLDER, "--max-bytes", size - 1) == 3
    broken = tmp_path / "sog"
    shutil.copytree(FOLDER, broken)
    (broken / "quats.webp").unlink()
    capsys.readouterr()
    assert inspect(broken, tmp_path, "--check") == 3
    assert capsys.readouterr().out.splitlines() == [
        f"{broken}: error: container.corrupt: 'quats.webp', which it names, cannot be read: no such file or directory",
        f"{tmp_path}: error: file.unreadable: cannot be read: is a directory, without the meta.json of an"
        " unpacked SOG or a lod-meta.json",
    ]


def test_inspect_does_not_read_devices(capsys: Capture) -> None:
    assert inspect("/dev/null", "--check") == 3
    assert capsys.readouterr().out.count(": error: file.unreadable: ") == 1


@pytest.mark.parametrize("name", ["no-splats.ply", "no-splats.spz"])
def test_files_without_splats_have_a_report(name: str, capsys: Capture) -> None:
    assert inspect(FAULTS / name) == 0
    assert "0 splats, SH 0" in capsys.readouterr().out
    assert inspect(FAULTS / name, "--json", "--stats") == 0
    (record,) = records(capsys.readouterr().out)
    assert (record["splats"], record["values"]["box"], record["bytes_per_splat"]) == (0, None, None)
    assert inspect(FAULTS / name, "--check") == 3
    assert capsys.readouterr().out == f"{FAULTS / name}: error: values.empty: there are no splats\n"


def test_a_scene_is_freed_before_the_next_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    read = inspect_jobs.inspect
    seen: list[weakref.ref[object]] = []

    def look(*arguments: Any, **settings: Any) -> Any:
        assert not any(scene() for scene in seen[:-1])
        report, scene = read(*arguments, **settings)
        seen.append(weakref.ref(scene))
        return report, scene

    monkeypatch.setattr(inspect_jobs, "inspect", look)
    assert inspect(*[FOLDER] * 4, "--json") == 0
    assert len(seen) == 4


def chain(nodes: int) -> bytes:
    """A tree of nodes with a single child each: a file of bytes that are all alike, and as many levels as nodes."""
    splats = Splats.empty(nodes, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    count, start = np.ones(nodes, np.uint16), np.arange(1, nodes + 1, dtype=np.uint32)
    count[-1] = start[-1] = 0
    return b"".join(spz.encode(Scene(splats, LodTree(count, start)), WriteOptions(compression_level=1)))


@pytest.mark.parametrize("nodes", [999, 1000, 1001, 50_000])
def test_the_report_of_a_deep_chain_is_bounded(nodes: int, tmp_path: Path, capsys: Capture) -> None:
    """Reports do not grow with the levels of a tree, and say how many they leave out."""
    path, page = tmp_path / "chain.spz", tmp_path / "page.html"
    path.write_bytes(chain(nodes))
    left_out = max(0, nodes - 1000)
    assert inspect(path, "--html", page) == 0
    text = capsys.readouterr().out
    assert f"depth {nodes - 1}" in text
    assert f"and {nodes - 64:,} more" in text
    assert len(text) < 10_000
    html = page.read_text()
    assert len(html) < 600_000
    assert (f"{left_out:,} greater depths are not listed" in html) == bool(left_out)
    assert f"<dt>Depth</dt><dd>{nodes - 1:,}<" in html
    assert inspect(path, "--json") == 0
    out = capsys.readouterr().out
    tree = json.loads(out)["tree"]
    assert (tree["depth"], len(tree["levels"]), tree["levels_left_out"]) == (nodes - 1, min(nodes, 1000), left_out)
    assert len(out) < 100_000
