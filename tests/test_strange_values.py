"""Files with values at the ends of what viewers hold: reported by a check, and drawn or refused without a warning."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from tests.scenes import random_splats

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def tree() -> Scene:
    return Scene(*quick.build(random_splats(200)))


def written(scene: Scene, path: Path, **encodings: str) -> Path:
    path.write_bytes(b"".join(rad.encode(scene, WriteOptions(rad=RadOptions(**encodings)))))  # type: ignore[arg-type]
    return path


def draw(path: Path, *options: str) -> int:
    return run(["render", str(path), "-o", str(path.with_suffix(".png")), "--size", "64x48", "-f", *options])


def test_leaves_with_a_start_are_the_same_tree_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tree()
    assert scene.tree is not None
    start = np.where(scene.tree.is_leaf, np.arange(len(scene), dtype=np.uint32), scene.tree.child_start)
    plain = written(scene, tmp_path / "plain.rad")
    strange = written(Scene(scene.splats, LodTree(scene.tree.child_count, start)), tmp_path / "strange.rad")
    raw, read = read_scene(strange, validate=False).tree, read_scene(strange).tree
    assert raw is not None and read is not None
    assert np.array_equal(raw.child_start, start)
    assert np.array_equal(read.child_start, scene.tree.child_start)
    assert run(["inspect", "--check", str(strange)]) == 0
    assert "tree.leaf-start" in capsys.readouterr().out
    for command in (["render", "--size", "64x48", "-o", "out.png"], ["build-lod", "--format", "spz", "-o", "out.spz"]):
        outputs = []
        for path in (plain, strange):
            output = path.with_suffix(Path(command[-1]).suffix)
            assert run([*command[:-1], str(output), str(path)]) == 0
            outputs.append(output.read_bytes())
        assert outputs[0] == outputs[1]


def test_centres_at_the_end_of_float32_are_drawn_or_refused(tmp_path: Path) -> None:
    scene = tree()
    far = np.full_like(scene.splats.center, np.finfo(np.float32).max)
    scene = dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, center=far))
    path = written(scene, tmp_path / "far.rad")
    assert draw(path) == 0
    assert run(["build-lod", str(path), "-o", str(tmp_path / "lod-meta.json")]) == 0


@pytest.mark.parametrize("through", [None, "packed", "ext", "spz", "rad"])
def test_a_tree_with_numbers_that_are_none_goes_through_no_encoding(
    through: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tree()
    quats = scene.splats.quat_xyzw.copy()
    quats[7] = np.nan
    scene = dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, quat_xyzw=quats))
    path = written(scene, tmp_path / "strange.rad", orientation="f32")
    options = [] if through is None else ["--through", through]
    assert draw(path, *options) == (0 if through is None else 1)
    assert through is None or "1 of" in capsys.readouterr().err
