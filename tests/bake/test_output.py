"""An output that is given a stream of nodes writes, and says, what it does of the scene in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.clock import Clock
from sparklod_cli.bake.output import Output, output_of
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.bake.written import WrittenTree
from sparklod_cli.codecs import encoder
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.statistics import Statistics
from sparklod_cli.lod import quick
from sparklod_cli.lod.detail_rule import DetailSettings
from sparklod_cli.model.scene import Scene
from sparklod_cli.support.errors import FormatError, OutputError
from sparklod_cli.support.progress import silent
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


def streamed(output: Output, scene: Scene, found: Statistics, scratch: Path) -> WrittenTree:
    """Writes a tree window by window."""
    nodes = node_stream(scene)
    made = output.encoder(nodes, found, 2, silent)
    with encoder.Kept(scratch) as kept:
        for result in encoder.results(made, nodes, 2, silent, "encoding"):
            kept.put(result)
        return output.write_windows(made, kept.get, 2, silent)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_stream_is_written_as_the_scene(
    name: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoder, "CHUNK_NODES", 900)
    settings, scratch = SETTINGS[name], tmp_path / "scratch"
    scratch.mkdir()
    said: list[WrittenTree] = []
    for folder in ("scene", "stream"):
        target = tmp_path / folder / f"town{settings.suffix}"
        target.parent.mkdir()
        output = output_of(target, settings, overwrite=False)
        if folder == "scene":
            said.append(output.write(scene, None, Clock(), 2, silent))
            continue
        parts = np.array_split(np.arange(len(scene)), 3)
        leaf = scene.tree.is_leaf
        found = Statistics.merged([Statistics.of(scene.splats.take(at), leaf[at], output.needed) for at in parts])
        output.check_statistics(found)
        said.append(streamed(output, scene, found, scratch))
    assert said[0] == said[1] and said[0].clamped
    whole = files_of(tmp_path / "scene")
    assert len(whole) == (1 if name != "rad-chunked" else 1 + -(-len(scene) // 900))
    assert files_of(tmp_path / "stream") == whole
    assert not list(scratch.iterdir())


def test_windows_that_cannot_be_read_leave_no_output(scene: Scene, tmp_path: Path) -> None:
    def gone(number: int, name: str) -> np.ndarray:
        if number:
            raise OSError("gone")
        return encoded[name]

    for name in ("spz", "rad", "rad-chunked"):
        output = output_of(tmp_path / f"{name}{SETTINGS[name].suffix}", SETTINGS[name], overwrite=False)
        nodes = node_stream(scene)
        made = output.encoder(nodes, Statistics.of_scene(scene, output.needed), 1, silent)
        encoded = made.encode(*nodes.read(0, len(scene)), 0)
        with pytest.MonkeyPatch.context() as patch, pytest.raises(OutputError, match="gone"):
            patch.setattr(encoder, "CHUNK_NODES", 900)
            output.write_windows(made, gone, 1, silent)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("town.npz", BakeSettings(encoding="packed"), r"--encoding are packed in memory.*give more --memory"),
        ("lod-meta.json", BakeSettings(detail=DetailSettings()), r"levels are made in memory.*give more --memory"),
    ],
)
def test_what_is_made_in_memory_only_takes_no_stream(
    name: str, settings: BakeSettings, message: str, scene: Scene, tmp_path: Path
) -> None:
    output = output_of(tmp_path / name, settings, overwrite=False)
    assert output.needed == frozenset()
    found = Statistics.of_scene(scene, output.needed)
    with pytest.raises(FormatError, match=message):
        output.check_statistics(found)
    with pytest.raises(FormatError, match=message):
        output.encoder(node_stream(scene), found, 1, silent)
    assert not list(tmp_path.iterdir())
