"""Files that are written window by window have the bytes of those that are written from memory."""

from __future__ import annotations

import functools
import pickle
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sparklod_cli.codecs import clamps, encoder, sh_palette, spz
from sparklod_cli.codecs.options import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import codec as rad
from sparklod_cli.codecs.rad import rad_encoder, rad_options
from sparklod_cli.codecs.sh_palette import cluster
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.support.progress import silent
from tests.node_streams import node_stream
from tests.scenes import random_splats

PALETTE = WriteOptions(rad=RadOptions(sh_codes=40))


@functools.cache
def tree_of(method: str, sh_degree: int) -> Scene:
    splats = random_splats(3_000, sh_degree=sh_degree, seed=sh_degree)
    splats.rgb[::50] *= 4
    splats.sh[::500] *= 60
    built = quick.build(splats, 1.5) if method == "quick" else quality.build(splats, 1.4)
    return Scene(*built, antialiased=sh_degree == 1)


@pytest.fixture(params=[None, 1_000, 4_096, 4_097], ids=lambda nodes: f"windows of {nodes or 'a chunk'}")
def window(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int | None:
    """Windows of other sizes than chunks have."""
    if request.param is not None:
        monkeypatch.setattr(encoder, "CHUNK_NODES", request.param)
    size: int | None = request.param
    return size


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("method", ["quick", "quality"])
@pytest.mark.parametrize("codec", [spz, rad])
def test_a_stream_of_nodes_gives_the_bytes_of_the_scene(
    codec: ModuleType, method: str, sh_degree: int, window: int | None, tmp_path: Path
) -> None:
    scene = tree_of(method, sh_degree)
    options = codec.settled(scene, DEFAULTS)
    whole = b"".join(codec.encode(scene, DEFAULTS))
    nodes = node_stream(scene)
    assert b"".join(codec.encode(nodes, options, threads=2, scratch=tmp_path)) == whole
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("version", [2, 3])
def test_the_windows_of_spz_are_of_any_size(version: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tree_of("quick", 1)
    whole = b"".join(spz.encode(scene, WriteOptions(version)))
    for size in (7, 2_000, 1 << 20):
        monkeypatch.setattr(encoder, "CHUNK_NODES", size)
        assert b"".join(spz.encode(scene, WriteOptions(version))) == whole


@pytest.mark.parametrize("options", [DEFAULTS, PALETTE])
def test_chunk_files_of_a_stream_are_those_of_the_scene(options: WriteOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder, "CHUNK_NODES", 1_500)
    scene = tree_of("quality", 2)
    nodes, settled = node_stream(scene), rad.settled(scene, options)
    whole = [(name, b"".join(pieces)) for name, pieces in rad.encode_chunked(scene, options, "town")]
    assert [name for name, _ in whole] == ["town-0.radc", "town-1.radc", "town-2.radc", "town.rad"]
    assert [(name, b"".join(pieces)) for name, pieces in rad.encode_chunked(nodes, settled, "town")] == whole
    made = rad.encoder(nodes, settled)
    found = list(encoder.results(made, nodes, 1, silent, "encoding"))
    assembled = rad.assemble_chunked(made, lambda number, name: found[number][name], "town")
    assert [(name, b"".join(pieces)) for name, pieces in assembled] == whole


@pytest.mark.parametrize("codec", [spz, rad])
def test_windows_are_encoded_anywhere_and_count_what_they_clamp(
    codec: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever encodes a window has the encoder as it was sent, and the nodes; in any order."""
    monkeypatch.setattr(encoder, "CHUNK_NODES", 900)
    scene = tree_of("quick", 3)
    nodes = node_stream(scene)
    options = codec.settled(scene, PALETTE)
    ranges = tuple(clamps.SPZ if codec is spz else rad_options.held(options, 3))
    sent = pickle.dumps(codec.encoder(nodes, options, ranges))
    found = {}
    for number, part in reversed(list(enumerate(encoder.windows_of(len(scene))))):
        found[number] = pickle.loads(sent).encode(*nodes.read(part.start, part.stop), part.start)
    pieces = pickle.loads(sent).pieces(lambda number, name: found[number][name], threads=1, progress=silent)
    assert b"".join(pieces) == b"".join(codec.encode(scene, PALETTE))
    tallies = [found[number][encoder.CLAMPED] for number in sorted(found)]
    expected = clamps.find(scene.splats, ranges=ranges, tree=scene.tree)
    assert clamps.clamps_of(clamps.merged(tallies), ranges) == expected
    assert set(expected.splats) >= {"sh"}


def test_a_palette_of_a_sample_is_nearly_as_good_as_one_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(*quick.build(random_splats(8_000, sh_degree=1), 1.5))
    nodes, options = node_stream(scene), rad.settled(scene, PALETTE)
    whole = rad_encoder.Palette.of(scene, 40, 1, silent)
    assert rad_encoder.Palette.of(nodes, 40, 1, silent).labels is not None  # of all nodes
    monkeypatch.setattr(rad_encoder, "SAMPLE", 2_048)
    monkeypatch.setattr(encoder, "CHUNK_NODES", 3_000)
    sampled = rad_encoder.Palette.of(nodes, 40, 1, silent)
    assert sampled.labels is None

    def error(found: rad_encoder.Palette) -> float:
        return float(np.square(found.codes[found.labels_of(scene.splats, 0)] - scene.splats.sh).mean())

    assert error(sampled) < 1.1 * error(whole)
    made = b"".join(rad.encode(nodes, options))
    assert made == b"".join(rad.encode(nodes, options, threads=2))
    assert made != b"".join(rad.encode(scene, options))


@pytest.mark.parametrize(("codes", "slack"), [(1, 0), (3, 0), (250, 0), (3_000, 0.02)])
def test_labels_name_the_nearest_code(codes: int, slack: float) -> None:
    sh = random_splats(8_000, sh_degree=1).sh
    table = cluster(sh[:6_000], codes).codes
    labels = sh_palette.labels_of(sh, table)
    rows, wide = sh.reshape(len(sh), -1).astype(np.float64), table.reshape(len(table), -1).astype(np.float64)
    half = np.square(wide).sum(axis=1) / 2
    nearest = np.concatenate([(half - part @ wide.T).argmin(axis=1) for part in np.array_split(rows, 8)])

    def error(index: np.ndarray) -> float:
        return float(np.square(rows - wide[index]).sum())

    assert error(labels) <= error(nearest) * (1 + slack)
    assert slack or (labels == nearest).all()


@pytest.mark.parametrize("codec", [spz, rad])
def test_a_stream_needs_options_that_leave_nothing_open(codec: ModuleType) -> None:
    with pytest.raises(ValueError, match="the options leave choices open"):
        next(codec.encode(node_stream(tree_of("quick", 0)), DEFAULTS))


def test_results_wait_in_a_file_of_the_folder(tmp_path: Path) -> None:
    arrays = [{"a": np.arange(6, dtype=np.uint8).reshape(3, 2), "none": np.empty((0, 4))}, {"a": np.array([2.5])}]
    with encoder.Kept(tmp_path) as kept:
        for each in arrays:
            kept.put(each)
        for number, name in ((1, "a"), (0, "none"), (0, "a"), (1, "a")):
            got = kept.get(number, name)
            np.testing.assert_array_equal(got, arrays[number][name])
            assert got.dtype == arrays[number][name].dtype
