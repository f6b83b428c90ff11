"""Trees of which only the chunks are read that cuts need: the same cuts and pictures as of those read whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cameras import framing
from sparklod_cli.cli import run
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.lod import quick
from sparklod_cli.lod.chunk_order import arrange
from sparklod_cli.model.foveation import Frustum
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.lod_tree import CHUNK_NODES, LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import FormatError, TreeError
from sparklod_cli.viewers import paging
from sparklod_cli.viewers.paging import PagedScene
from sparklod_cli.viewers.scenes import CutFinder, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.conftest import FIXTURES
from tests.lod.trees import transform
from tests.scenes import random_splats
from tests.simulation.conftest import SPARK, around, camera, rows_of, without

pytestmark = pytest.mark.slow

HAND = FIXTURES / "golden" / "hand-tree-v3.spz"
NEAR = camera((0.05, -0.05, -0.3), (0.3, 0.1, 0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A tree of five chunks."""
    tree = Scene(*arrange(*quick.build(random_splats(240_000, sh_degree=1, seed=4))))
    assert 4 * CHUNK_NODES < len(tree) <= 5 * CHUNK_NODES
    return tree


def written(scene: Scene, path: Path) -> Path:
    path.write_bytes(b"".join(rad.encode(scene, WriteOptions(compression_level=1), threads=2)))
    return path


@pytest.fixture(scope="module")
def file(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(scene, tmp_path_factory.mktemp("pages") / "a.rad")


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As if files did not fit into memory."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("codecs.rad.rad_reader", "viewers.paging"):
            patch.setattr(f"sparklod_cli.{module}.available_memory", lambda: 1 << 20)
        yield


def instances(file: Path) -> list[Instance]:
    """The file twice, and a small tree between."""
    there = transform(np.random.default_rng(1), scale=1.5, spread=3)
    return [Instance(file, "here"), Instance(HAND, "hand"), Instance(file, "there", there, 0.5, Frustum(0.3, 0.1))]


def both(chosen: list[Instance], **settings: str) -> tuple[Scenes, Scenes]:
    """Read whole, and as cuts need them."""
    whole, paged = (read_scenes(chosen, paged=paged, threads=2, **settings) for paged in (False, True))  # type: ignore[arg-type]
    assert not any(isinstance(loaded, PagedScene) for loaded in whole.loaded)
    assert any(isinstance(loaded, PagedScene) for loaded in paged.loaded)
    return whole, paged


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("precision", ["float32", "packed"])
@pytest.mark.parametrize(
    ("budget", "streaming"),
    [
        (2_000, StreamingSettings()),
        (300_000, StreamingSettings()),
        (60_000, StreamingSettings(Network(2e6, 0.05), 5)),
    ],
)
def test_frames_are_those_of_a_tree_read_whole(
    file: Path, budget: int, streaming: StreamingSettings, precision: str
) -> None:
    whole, paged = both(instances(file), precision=precision)
    settings = LodSettings(budget, SPARK)
    path = around(4)
    rows = [rows_of(scenes, settings, path, streaming, by_instance=True, threads=2) for scenes in (whole, paged)]
    expected, found = ([without(row, {"traverse_ms"}) for row in each] for each in rows)
    assert found == expected


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("budget", [1, 50, 5_000, 100_000, 1 << 30])
@pytest.mark.parametrize("limit", [None, 0.0])
def test_cuts_are_those_of_a_tree_read_whole(file: Path, budget: int, limit: float | None) -> None:
    whole, paged = both([Instance(file, "a")])
    settings = LodSettings(budget, SPARK, pixel_scale_limit=limit)
    for at in (NEAR, *around(2).cameras):
        smallest = settings.limit(at.fov_y, at.height)
        one, other = (scenes.viewer(settings).cut(at, budget=budget, smallest=smallest) for scenes in (whole, paged))
        for name in ("views", "reason", "missing", "least", "stop", "demand"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        for name in ("node", "limit"):  # whose order is that of the search
            assert np.array_equal(*(getattr(cut, name)[np.argsort(cut.node)] for cut in (one, other))), name
        drawn = [scenes.cut_of(cut) for scenes, cut in ((whole, one), (paged, other))]
        for column in COLUMNS:
            assert np.array_equal(*(getattr(cut.splats, column) for cut in drawn)), column
        assert np.array_equal(*(cut.parts[0].depth for cut in drawn))


@pytest.mark.usefixtures("little_memory")
def test_only_chunks_are_read_that_cuts_need_and_few_are_cached(file: Path) -> None:
    whole, paged = both([Instance(file, "a")])
    viewer = paged.viewer(LodSettings(3_000))
    (loaded,) = paged.loaded
    assert isinstance(loaded, PagedScene)
    assert loaded.pages.present.sum() == 1  # the root's
    demand = np.zeros(paged.forest.chunks, np.bool_)
    for at in (NEAR, NEAR, *around(3).cameras):
        demand |= viewer.cut(at, budget=3_000).demand > 0
    assert demand.sum() <= loaded.pages.present.sum() < len(demand)
    loaded.pages._kept = 2
    rng = np.random.default_rng(0)
    for _ in range(3):
        index = np.sort(rng.choice(loaded.count, 500, replace=False))
        found, expected = loaded.rows(index), whole.loaded[0].rows(index)
        assert all(np.array_equal(getattr(found, name), getattr(expected, name)) for name in COLUMNS)
        assert len(loaded.pages._cache) == 2
    assert len(loaded.rows(index[:0])) == 0
    assert np.array_equal(loaded.leaves, whole.loaded[0].leaves)
    assert loaded.leaf_count == len(loaded.leaves)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("bad", [False, True])
def test_cameras_see_what_they_see_of_scenes_read_whole(
    scene: Scene, file: Path, bad: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though of large scenes they look at a sample only, some splats of which have no finite centre."""
    if bad:
        assert scene.tree is not None
        center = scene.splats.center.copy()
        center[np.flatnonzero(scene.tree.is_leaf)[::1000]] = np.nan
        file = written(Scene(dataclasses.replace(scene.splats, center=center), scene.tree), tmp_path / "b.rad")
    for module in (framing, paging):
        monkeypatch.setattr(module, "SAMPLE", 50_000)
    whole, paged = (scenes.balls() for scenes in both(instances(file)))
    assert len(paged.radius) < len(whole.radius) / 4
    for one, other in zip(*(vars(framing.covered(balls)).values() for balls in (whole, paged)), strict=True):
        assert np.array_equal(one, other)
    assert framing.reach(1, 2, [NEAR], whole) == framing.reach(1, 2, [NEAR], paged)


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "--budget", "20k", "--size", "64x48", "-o", "{}.npy"],
        ["render", "--budget", "5%", "--orbit", "2", "--size", "48x32", "--color-by", "level", "-o", "{}.%d.png"],
        ["traverse", "--orbit", "3", "--budget", "9k", "--no-timing", "-o", "{}.csv", "--indices-out", "{}"],
    ],
    ids=["picture", "sequence", "traverse"],
)
def test_commands_write_the_same_files(arguments: list[str], file: Path, tmp_path: Path, little_memory: None) -> None:
    del little_memory
    written = []
    for name in ("paged", "whole"):
        (tmp_path / name).mkdir()
        given = [argument.format(tmp_path / name / "a") for argument in arguments]
        with pytest.MonkeyPatch.context() as patch:
            if name == "whole":
                patch.setattr("sparklod_cli.codecs.rad.rad_reader.available_memory", lambda: None)
            assert run([given[0], str(file), *given[1:], "-q"]) == 0
        files = sorted(each for each in (tmp_path / name).rglob("*") if each.is_file())
        written.append({str(each.relative_to(tmp_path / name)): each.read_bytes() for each in files})
    assert written[0] == written[1]
    assert written[0]


@pytest.mark.usefixtures("little_memory")
def test_links_are_checked_in_chunks_that_are_read(scene: Scene, tmp_path: Path) -> None:
    assert scene.tree is not None
    inner = np.flatnonzero(scene.tree.child_count)
    near, far = int(inner[5]), int(inner[inner >= 3 * CHUNK_NODES][-1])
    second, count = int(inner[1]), len(scene.tree)
    for node, start, what in (
        (near, near, f"node {near} comes after one of its children"),
        (near, count, f"node {near} has children past the last node"),
        (second, int(scene.tree.child_start[inner[0]]) + 1, "shares children with another node"),
        (far, far, None),
    ):
        child_start = scene.tree.child_start.copy()
        child_start[node] = start
        path = written(Scene(scene.splats, LodTree(scene.tree.child_count, child_start)), tmp_path / "broken.rad")
        paged = read_scenes([Instance(path, "a")], paged=True)
        if what is None:
            CutFinder(paged, LodSettings(300)).cut(NEAR)
            continue
        with pytest.raises(TreeError, match=what) as raised:
            CutFinder(paged, LodSettings(10_000_000, pixel_scale_limit=0.0)).cut(NEAR)
        assert "broken.rad" in str(raised.value)


@pytest.mark.usefixtures("little_memory")
def test_damage_is_an_error_that_names_the_file(file: Path, tmp_path: Path) -> None:
    data = bytearray(file.read_bytes())
    data[-2_000:-1_000] = bytes(1_000)
    path = tmp_path / "damaged.rad"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"damaged\.rad: "):
        read_scenes([Instance(path, "a")], paged=True).balls()
