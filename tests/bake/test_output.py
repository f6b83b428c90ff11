"""An output that is given a stream of nodes writes, and says, what it does of the scene in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.settings import Baked, BakeSettings
from sparklod_cli.bake.tree_output import BuiltTree, output_of, write_windows
from sparklod_cli.codecs import encoder
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.statistics import Statistics
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import NodeStream
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import OutputError
from sparklod_cli.system.progress import silent
from tests.node_streams import node_stream
from tests.scenes import random_splats

SETTINGS = {
    "spz": BakeSettings(),
    "rad": BakeSettings(suffix=".rad"),
    "rad-chunked": BakeSettings(suffix=".rad", options=WriteOptions(rad=RadOptions(chunked=True))),
    "a palette": BakeSettings(suffix=".rad", options=WriteOptions(rad=RadOptions(sh_codes=50))),
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    splats = random_splats(2_000, sh_degree=1)
    splats.rgb[7], splats.scale[3, 1] = 40, 1e-20
    return Scene(*quick.build(splats, 1.5))


def files_of(folder: Path) -> dict[str, bytes]:
    return {each.name: each.read_bytes() for each in folder.iterdir()}


def written(tree: BuiltTree, scene: Scene, nodes: Scene | NodeStream, found: Statistics) -> Baked:
    """Writes a tree window by window."""

    def encode(tree: BuiltTree, made: encoder.Encoder) -> encoder.Windows:
        read = nodes.read if isinstance(nodes, NodeStream) else node_stream(nodes).read
        parts = encoder.windows_of(len(scene))
        windows = [made.encode(*read(part.start, part.stop), part.start) for part in parts]
        return lambda number, name: windows[number][name]

    tree.nodes, tree.baked.nodes, tree.baked.sh_degree, tree.statistics = nodes, len(scene), 1, found
    write_windows(tree, encode, 2, silent)
    tree.baked.seconds.clear()
    return tree.baked


@pytest.mark.parametrize("name", SETTINGS)
def test_a_stream_is_written_as_the_scene(
    name: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoder, "CHUNK_NODES", 900)
    settings, said = SETTINGS[name], []
    for folder, nodes in (("scene", scene), ("stream", node_stream(scene))):
        target = tmp_path / folder / f"town{settings.suffix}"
        target.parent.mkdir()
        tree = output_of(target, settings, overwrite=False)
        needed = tree.form.codec().needed(tree.options)
        parts = np.array_split(np.arange(len(scene)), 3)
        leaf = scene.tree.is_leaf
        found = Statistics.merged([Statistics.of(scene.splats.take(at), leaf[at], needed) for at in parts])
        said.append(written(tree, scene, nodes, found))
    assert said[0] == said[1] and said[0].clamped
    whole = files_of(tmp_path / "scene")
    assert len(whole) == (1 if name != "rad-chunked" else 1 + -(-len(scene) // 900))
    assert files_of(tmp_path / "stream") == whole


def test_windows_that_cannot_be_read_leave_no_output(scene: Scene, tmp_path: Path) -> None:
    for name in ("spz", "rad", "rad-chunked"):
        tree = output_of(tmp_path / f"{name}{SETTINGS[name].suffix}", SETTINGS[name], overwrite=False)
        tree.nodes, tree.baked.nodes, tree.baked.sh_degree = node_stream(scene), len(scene), 1
        tree.statistics = Statistics.of_scene(scene, tree.form.codec().needed(tree.options))

        def encode(tree: BuiltTree, made: encoder.Encoder) -> encoder.Windows:
            encoded = made.encode(*tree.nodes.read(0, len(scene)), 0)

            def read(number: int, array: str) -> np.ndarray:
                if number:
                    raise OSError("gone")
                return encoded[array]

            return read

        with pytest.MonkeyPatch.context() as patch, pytest.raises(OutputError, match="gone"):
            patch.setattr(encoder, "CHUNK_NODES", 900)
            write_windows(tree, encode, 1, silent)
    assert not list(tmp_path.iterdir())
