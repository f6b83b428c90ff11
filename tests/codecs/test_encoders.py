"""Files that are written window by window have the bytes of those that are written from memory."""

from __future__ import annotations

import functools
import pickle
from types import ModuleType

import numpy as np
import pytest

from sparklod_cli.codecs import clamps, encoder, sh_palette, spz
from sparklod_cli.codecs.options import DEFAULTS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad import rad_writer as rad_options
from sparklod_cli.codecs.sh_palette import cluster
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.progress import silent
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


@pytest.mark.parametrize("window", [None, 900, 4_097])
@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("method", ["quick", "quality"])
@pytest.mark.parametrize("codec", [spz, rad])
def test_windows_are_encoded_anywhere_and_count_what_they_clamp(
    codec: ModuleType, method: str, sh_degree: int, window: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever encodes a window has the encoder as it was sent, and the nodes; in any order."""
    if window is not None:
        monkeypatch.setattr(encoder, "CHUNK_NODES", window)
    scene = tree_of(method, sh_degree)
    nodes, options = node_stream(scene), codec.settled(scene, PALETTE)
    ranges = tuple(encoder.SPZ_RANGES if codec is spz else rad_options.held(options, sh_degree))
    sent = pickle.dumps(codec.encoder(nodes, options, counting=True))
    found = {}
    for number, part in reversed(list(enumerate(encoder.windows_of(len(scene))))):
        found[number] = pickle.loads(sent).encode(*nodes.read(part.start, part.stop), part.start)
    pieces = pickle.loads(sent).pieces(lambda number, name: found[number][name], threads=1, progress=silent)
    assert b"".join(pieces) == b"".join(codec.encode(scene, PALETTE, threads=2))
    tallies = [found[number][encoder.CLAMPED] for number in sorted(found)]
    expected = clamps.clamps_in(scene.splats, ranges=ranges, tree=scene.tree)
    assert clamps.clamps_of(tallies, ranges) == expected
    assert not sh_degree or set(expected[0]) >= {"sh"}


@pytest.mark.parametrize("version", [2, 3])
def test_the_windows_of_spz_are_of_any_size(version: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tree_of("quick", 1)
    whole = b"".join(spz.encode(scene, WriteOptions(version)))
    for size in (7, 2_000, 1 << 20):
        monkeypatch.setattr(encoder, "CHUNK_NODES", size)
        assert b"".join(spz.encode(scene, WriteOptions(version))) == whole


@pytest.mark.parametrize("options", [DEFAULTS, PALETTE])
def test_chunk_files_are_made_of_the_results_of_windows(options: WriteOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder, "CHUNK_NODES", 1_500)
    scene = tree_of("quality", 2)
    whole = [(name, b"".join(pieces)) for name, pieces in rad.encode_chunked(scene, options, "town")]
    assert [name for name, _ in whole] == ["town-0.radc", "town-1.radc", "town-2.radc", "town.rad"]
    chunks = rad.encoder(scene, rad.settled(scene, options))
    found = list(encoder.results(chunks, scene, 1, silent, "encoding"))
    assembled = chunks.files((each[rad.CHUNK].tobytes() for each in found), "town")
    assert [(name, b"".join(pieces)) for name, pieces in assembled] == whole


def test_a_palette_of_a_sample_is_nearly_as_good_as_one_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(*quick.build(random_splats(8_000, sh_degree=1), 1.5))
    nodes = node_stream(scene)
    whole = rad.Palette.of(scene, 40, 1, silent)
    assert rad.Palette.of(nodes, 40, 1, silent).labels is not None  # of all nodes
    monkeypatch.setattr(rad, "SAMPLE", 2_048)
    monkeypatch.setattr(encoder, "CHUNK_NODES", 3_000)
    sampled = rad.Palette.of(nodes, 40, 1, silent)
    assert sampled.labels is None

    def error(found: rad.Palette) -> float:
        return float(np.square(found.codes[found.labels_of(scene.splats, 0)] - scene.splats.sh).mean())

    assert error(sampled) < 1.1 * error(whole)


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
        codec.encoder(node_stream(tree_of("quick", 0)), DEFAULTS)
