"""Values of JSON that say that something is not there, by whatever writer: "", null, false, or an empty object."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fixtures import by_hand_sog
from sparklod_cli.cli import run
from sparklod_cli.io.reading import read_parts, read_scene
from tests.conftest import FIXTURES, Capture

GOLDEN = FIXTURES / "golden"

#: What viewers take for false, and what means nothing else.
NOTHING = ("", None, False, [], {})


def nodes(tree: Any) -> Iterator[dict[str, Any]]:
    yield tree
    for child in tree.get("children") or []:
        yield from nodes(child)


def copied(folder: Path, name: str) -> tuple[Path, Any]:
    shutil.copytree((GOLDEN / name).parent, folder, dirs_exist_ok=True)
    path = folder / Path(name).name
    return path, json.loads(path.read_text())


@pytest.mark.parametrize("nothing", NOTHING)
def test_an_empty_environment_is_none(nothing: Any, tmp_path: Path, capsys: Capture) -> None:
    path, root = copied(tmp_path, "sh1-streamed-sog/lod-meta.json")
    path.write_text(json.dumps(root | {"environment": nothing}))
    parts = read_parts(path)
    assert parts is not None
    assert len(read_scene(path).splats) == 60
    assert run(["inspect", "--check", str(path)]) == 0
    assert run(["view", str(path), "--export", str(tmp_path / "site")]) == 0
    assert "streamed-sog.environment" not in capsys.readouterr().out


@pytest.mark.parametrize("nothing", NOTHING[:-1])
def test_empty_children_of_a_region_are_none(nothing: Any, tmp_path: Path) -> None:
    path, root = copied(tmp_path, "sh1-streamed-sog/lod-meta.json")
    for node in nodes(root["tree"]):
        if node.get("children"):
            node["lods"] = node["errors"] = None
        else:
            node["children"] = nothing
    for key in ("asset", "lodErrors"):
        root[key] = None
    path.write_text(json.dumps(root))
    assert len(read_scene(path).splats) == 66
    assert run(["inspect", "--check", str(path)]) == 0


@pytest.mark.parametrize("nothing", NOTHING)
@pytest.mark.parametrize("zipped", [False, True])
def test_empty_sh_of_a_sog_are_none(nothing: Any, zipped: bool, tmp_path: Path) -> None:
    path, root = copied(tmp_path, "sh1-sog/meta.json")
    path.write_text(json.dumps(root | {"shN": nothing, "asset": nothing}))
    if zipped:
        path = tmp_path / "scene.sog"
        path.write_bytes(by_hand_sog.zipped({each.name: each.read_bytes() for each in tmp_path.iterdir()}))
    scene = read_scene(path)
    assert (len(scene.splats), scene.splats.sh_degree) == (60, 0)


def test_nulls_in_a_tileset_are_none(tmp_path: Path) -> None:
    path, root = copied(tmp_path, "sh1-tiles/tileset.json")
    root |= {"extensionsRequired": None, "properties": None}
    for tile in nodes(root["root"]):
        for key in ("children", "content", "transform", "refine", "extensions", "viewerRequestVolume", "contents"):
            tile.setdefault(key, None)
    path.write_text(json.dumps(root))
    expected = read_scene(GOLDEN / "sh1-tiles")
    assert (read_scene(path).splats.center == expected.splats.center).all()
    found, parts = read_parts(path), read_parts(GOLDEN / "sh1-tiles")
    assert found is not None
    assert parts is not None
    assert (found.counts == parts.counts).all()
