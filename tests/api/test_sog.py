"""SOG of the public interface: a file, or a folder of images, and the size of the palette."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from tests.scenes import random_splats

SCENE = sparklod.Scene(random_splats(300, sh_degree=1))


@pytest.mark.parametrize("name", ["scene.sog", "web/meta.json"])
def test_a_scene_is_written_and_read_back(tmp_path: Path, name: str) -> None:
    written = sparklod.write(tmp_path / name, SCENE)
    again = sparklod.read(written.path)
    assert written.format == "SOG"
    assert written.bytes == sum(each.stat().st_size for each in written.path.parent.iterdir())
    assert len(again) == 300
    np.testing.assert_allclose(np.sort(again.splats.rgb, axis=0), np.sort(SCENE.splats.rgb, axis=0), atol=0.01)
    with pytest.raises(sparklod.OutputError, match="exists, add --overwrite"):
        sparklod.write(tmp_path / name, SCENE)
    smaller = sparklod.write(tmp_path / name, SCENE, sog=sparklod.SogOptions(sh_codes=2), overwrite=True)
    assert smaller.bytes < written.bytes
    assert len(np.unique(sparklod.read(smaller.path).splats.sh, axis=0)) == 2


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("x.sog", {"sog": {"sh_codes": 9}}, TypeError, "sog is {'sh_codes': 9}; give SogOptions"),
        ("x.spz", {"sog": sparklod.SogOptions()}, ValueError, "sog is of SOG; leave it out, or write a .sog"),
        ("x.sog", {"rad": sparklod.RadOptions()}, ValueError, "chunked and rad are of RAD"),
        ("x.json", {}, sparklod.FormatError, "a scene is written as .ply, .spz, .rad, .sog, meta.json, .glb, .splat"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(
    tmp_path: Path, name: str, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        sparklod.write(tmp_path / name, SCENE, **options)
    assert not list(tmp_path.iterdir())


def test_trees_and_merged_splats_are_refused(tmp_path: Path) -> None:
    tree = sparklod.build_lod(SCENE)
    with pytest.raises(sparklod.FormatError, match="a tree is written as"):
        sparklod.write(tmp_path / "x.sog", tree)
    merged = sparklod.Scene(dataclasses.replace(tree.splats, opacity=tree.splats.opacity * np.float32(2)))
    with pytest.raises(sparklod.FormatError, match=r"opacities reach [0-9.]+, and SOG holds 0 to 1"):
        sparklod.write(tmp_path / "x.sog", merged)
    assert not list(tmp_path.iterdir())
