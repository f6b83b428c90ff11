"""Streamed SOG as it is written: what comes back, which chunk has which runs, and the same bytes every time."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.codecs.formats import sniff
from sparklod_cli.codecs.options import DEFAULTS
from sparklod_cli.codecs.sog import codec as sog
from sparklod_cli.codecs.streamed_manifest import parse
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.io.writing import parts_output
from sparklod_cli.model import morton
from sparklod_cli.model.scene import DetailScene, Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.outputs import write_files

from .scenes import CHILDREN, COUNTS, SETTINGS, detail_scene, files_of, levels_of


def in_morton_order(scene: DetailScene, region: int, level: int) -> Splats:
    run = scene.splats.take(scene.run(region, level))
    return run.take(morton.order(run.center))


@pytest.mark.parametrize("errors", [False, True])
@pytest.mark.parametrize("environment", [0, 6])
@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_a_scene_comes_back(sh_degree: int, environment: int, errors: bool) -> None:
    scene = detail_scene(sh_degree=sh_degree, environment=environment, errors=errors)
    back = levels_of(files_of(scene))
    np.testing.assert_array_equal(back.counts, COUNTS)
    np.testing.assert_array_equal(back.children, CHILDREN)
    assert (back.environment is None) == (not environment)
    assert (back.errors is None) == (not errors)
    if errors:
        np.testing.assert_allclose(back.errors, scene.errors)
    low, high = back.bounds.transpose(1, 0, 2)
    assert (low <= scene.bounds[:, 0]).all()
    assert (high >= scene.bounds[:, 1]).all()
    np.testing.assert_allclose(back.bounds, scene.bounds, rtol=2e-6)
    for level in range(3):
        for region in range(5):
            expected, found = in_morton_order(scene, region, level), back.splats.take(back.run(region, level))
            np.testing.assert_allclose(found.center, expected.center, atol=1e-3)
            np.testing.assert_allclose(found.opacity, expected.opacity, atol=0.5 / 255 + 1e-6)
            assert found.sh_degree == sh_degree


def test_each_chunk_is_the_sog_of_its_runs_side_by_side() -> None:
    scene = detail_scene()
    files = files_of(scene)
    manifest = parse(files["lod-meta.json"])
    seen = set[str]()
    for number, name in enumerate(manifest.filenames):
        runs = [
            (run.offset, region, level)
            for region, (_, node) in enumerate(manifest.regions())
            for level, run in (node.runs or {}).items()
            if run.file == number
        ]
        parts = [in_morton_order(scene, region, level) for _, region, level in sorted(runs)]
        folder = name.removesuffix("meta.json")
        for other, data in sog.encode_files(Scene(Splats.concat(parts)), in_order=True):
            assert files[folder + other] == data
            seen.add(folder + other)
        assert len({level for *_, level in runs}) == 1
    assert scene.environment is not None
    around = {"env/env.sog": b"".join(sog.encode(Scene(scene.environment)))}
    assert {name: files[name] for name in around} == around
    assert files.keys() == seen | around.keys() | {"lod-meta.json"}


def test_a_chunk_is_closed_when_it_has_more_splats_than_wanted() -> None:
    assert [name for name in files_of(detail_scene()) if name.endswith("meta.json")] == [
        *("0_0/meta.json", "0_1/meta.json", "1_0/meta.json", "2_0/meta.json", "lod-meta.json")
    ]  # of 40 + 1 + 30, 25, 22 and 18 splats


def test_the_manifest_says_first_what_a_viewer_must_know() -> None:
    files = files_of(detail_scene())
    data = files["lod-meta.json"]
    assert list(files)[-1] == "lod-meta.json"
    assert data.index(b'"lodLevels"') < 400
    form = sniff(data[:400], ".json")
    assert form is not None
    assert form.name == "Streamed SOG"
    meta = json.loads(data)
    assert list(meta) == [
        *("version", "asset", "count", "counts", "lodLevels", "lodErrors", "environment", "filenames", "tree")
    ]
    assert (meta["version"], meta["count"], meta["counts"], meta["lodErrors"]) == (1, 136, [96, 22, 18], True)
    assert meta["asset"].pop("generator").startswith("sparklod ")
    assert meta["asset"] == {"chunkGaussians": 45, "chunkExtent": 2.5, "chunkMinGaussians": 10}


def test_the_bound_of_an_inner_node_is_the_union_of_those_below() -> None:
    nodes = parse(files_of(detail_scene())["lod-meta.json"]).nodes
    for node in nodes:
        if node.children:
            bounds = np.array([nodes[child].bound for child in node.children])
            np.testing.assert_array_equal(node.bound, [bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


def test_any_number_of_threads_gives_the_same_bytes() -> None:
    scene = detail_scene()
    expected = files_of(scene)
    for threads in (2, 5):
        files = files_of(scene, threads=threads)
        assert list(files) == list(expected)
        assert files == expected


def test_what_was_read_is_written_the_same_but_for_codings() -> None:
    files = files_of(detail_scene())
    again = files_of(levels_of(files))
    assert again["lod-meta.json"] == files["lod-meta.json"]
    assert again.keys() == files.keys()


def test_one_region_has_a_tree_of_one_node() -> None:
    scene = detail_scene()
    one = DetailScene(
        scene.splats, COUNTS.sum(axis=0)[None], scene.bounds[:1], np.empty((0, 2), np.int64), antialiased=True
    )
    back = levels_of(files_of(one))
    assert (back.regions, back.levels, back.children.shape, back.antialiased) == (1, 3, (0, 2), True)


def test_splats_that_sog_cannot_hold_are_refused() -> None:
    scene = detail_scene()
    scene.splats.opacity[3] = 1.5
    with pytest.raises(FormatError, match=r"opacities reach 1\.5"):
        files_of(scene)


def test_progress_ends_with_all_splats() -> None:
    told = list[tuple[int, int]]()
    scene = detail_scene()
    files = codec.encode_files(
        scene, DEFAULTS, SETTINGS, progress=lambda what, done, total, unit: told.append((done, total))
    )
    for _ in files:
        pass
    assert told[-1] == (142, 142)


def test_an_output_is_read_by_its_folder_and_by_its_manifest(tmp_path: Path) -> None:
    scene = detail_scene()
    files = codec.encode_files(scene, DEFAULTS, SETTINGS)
    assert write_files(parts_output(tmp_path / "lod-meta.json", overwrite=False), files) == sum(
        path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()
    )
    whole, levels = read_scene(tmp_path), read_parts(tmp_path / "lod-meta.json", threads=2)
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(levels.scene().splats, column), getattr(whole.splats, column), column)
    assert len(whole) == 96 + 6
    assert dict(whole.header) | {"bytes": 0} == {"version": 1, "levels": 3, "regions": 5, "bytes": 0}
    assert dataclasses.replace(levels, header={}).format == "Streamed SOG 1"
