"""From a file to the nodes of a cut: `--precision` has Spark's numbers of that very file, and so draws its nodes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_writer import HALF
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.gaussian import linear_opacity, spark_size
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.lod_tree import CHUNK_NODES, Nodes
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import FloatArray
from sparklod_cli.viewers.cut import TreeInstance
from sparklod_cli.viewers.loaded_scene import nodes_of
from sparklod_cli.viewers.scenes import read_scenes
from sparklod_cli.viewers.spark import SparkViewer
from tests.conftest import FIXTURES, real_scene
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in
from tests.interop.spark import NODE, Spark
from tests.interop.test_paged_traversal import Paged
from tests.interop.test_rad import chunks_of
from tests.interop.test_traversal import BUDGETS, FOV_Y, FOVEATIONS, LIMITS, LOD_SCALES, SPARKS_CONES, Tree, cameras
from tests.interop.ties import Words
from tests.lod.sights import CutView
from tests.references.dynamic_cuts import dynamic_limit
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: What Spark's worker is asked for, by precision.
LAYOUTS = {"ext": "Ext", "packed": "Packed"}
#: Precisions of the chunks of a RAD file that are loaded alone, as pages are.
PAGES = {"ext": "Ext", "packed-pages": "Packed"}
#: Ranges that are not Spark's own, so that splats in pages have other codes than those of the whole file.
NARROW = SplatEncoding(ln_scale_min=-8.3, ln_scale_max=1.7, rgb_min=-0.5, rgb_max=2)


def node_words(nodes: Nodes) -> Words:
    """The words of nodes whose numbers are half floats."""
    words = np.zeros((len(nodes.size), 4), np.uint32)
    rows = words.view(NODE)[:, 0]
    rows["center"], rows["size"] = nodes.center, nodes.size
    rows["child_count"], rows["child_start"] = nodes.tree.child_count, nodes.tree.child_start
    return words


def held(scene: Scene, precision: str) -> Words:
    assert scene.tree is not None
    return node_words(nodes_of(scene.splats, scene.tree, scene.coding, precision=precision, threads=2))


def check_whole(spark: Spark, path: Path) -> None:
    """Asserts that all words of a file are those that Spark has after loading it."""
    scene = read_scene(path)
    for precision, layout in LAYOUTS.items():
        np.testing.assert_array_equal(held(scene, precision), spark.load_words(layout, path)["lodTree"], precision)


def check_pages(spark: Spark, path: Path, tmp_path: Path) -> int:
    """Asserts it of each chunk of a file, loaded alone; returns how many chunks there are."""
    scene, chunk = read_scene(path), tmp_path / "chunk.radc"
    words = {precision: held(scene, precision) for precision in PAGES}
    count = 0
    for count, (data, _, _) in enumerate(chunks_of(path), 1):
        chunk.write_bytes(data)
        part = slice((count - 1) * CHUNK_NODES, count * CHUNK_NODES)
        for precision, layout in PAGES.items():
            np.testing.assert_array_equal(words[precision][part], spark.load_words(layout, chunk)["lodTree"], precision)
    return count


def check_cuts(spark: Spark, path: Path, precision: str, views: int) -> None:
    """Asserts that cuts of a file are those of Spark, which loads it itself."""
    scenes = read_scenes([Instance(path, "tree")], precision=precision, threads=2)
    (loaded,) = scenes.with_cuts
    assert loaded.scene.tree is not None
    tree = spark.keep_tree(spark.load_words(LAYOUTS[precision], path)["lodTree"])
    splats = loaded.scene.splats
    for number, camera in enumerate(
        cameras(Nodes(splats.center, spark_size(splats), loaded.scene.tree), views, seed=len(splats))
    ):
        cones, lod_scale = FOVEATIONS[number % len(FOVEATIONS)], LOD_SCALES[number % 5]
        budget = BUDGETS[number % len(BUDGETS)]
        smallest = LIMITS[number // 2 % len(LIMITS)] if number % 4 else 0.0
        found = SparkViewer(scenes.forest, [TreeInstance(0, np.eye(4), lod_scale, cones)])
        ours = found.cut(CutView(camera, FOV_Y, FOV_Y), budget=budget, smallest=smallest)
        asked = {"lodId": tree, "viewToObjectCols": camera.T.ravel().tolist(), "lodScale": lod_scale}
        asked |= {"coneFov0": cones.fov0, "coneFov": cones.fov, "coneFoveate": cones.foveate}
        theirs = spark.traverse(budget, smallest, [asked | {"behindFoveate": cones.behind}])
        np.testing.assert_array_equal(ours.indices()[0], np.sort(theirs.indices[0]))


def check_paged_cuts(spark: Spark, path: Path, tmp_path: Path, precision: str, frames: int) -> None:
    """Asserts that cuts of a file of which chunks are missing are those of Spark, which loads the chunks itself."""
    scenes = read_scenes([Instance(path, "tree")], precision=precision, threads=2)
    chunk, loaded = tmp_path / "chunk.radc", []
    for data, _, _ in chunks_of(path):
        chunk.write_bytes(data)
        loaded.append(spark.load_words(PAGES[precision], chunk)["lodTree"])
    tree = Tree.of(np.concatenate(loaded))
    paged = Paged(spark, [tree], pages=len(loaded) + 1)
    paged.forest = scenes.forest
    rng = np.random.default_rng(frames)
    reasons = set()
    for number, camera in enumerate(cameras(tree.nodes, frames, seed=len(loaded))):
        resident = rng.random(len(loaded)) < rng.choice([0.4, 0.7])
        resident[0] = True
        paged.keep(resident, rng)
        instance = TreeInstance(0, np.eye(4), LOD_SCALES[number % 5], FOVEATIONS[number % len(FOVEATIONS)])
        for budget in (1_000, 20_000, 150_000):
            reasons.add(paged.check([instance], camera, budget, LIMITS[number % len(LIMITS)]).reason)
    assert "missing" in reasons


def check_dynamic_cuts(spark: Spark, path: Path, precision: str, views: int) -> None:
    """Asserts that a dynamic cut of Spark is the cut of all nodes above the pixel scale at which it ends."""
    scenes = read_scenes([Instance(path, "tree")], precision=precision, threads=2)
    (loaded,) = scenes.with_cuts
    assert loaded.scene.tree is not None
    tree = spark.keep_tree(spark.load_words(LAYOUTS[precision], path)["lodTree"])
    splats, count = loaded.scene.splats, loaded.count
    cones, limit = SPARKS_CONES, LIMITS[2]
    found = SparkViewer(scenes.forest, [TreeInstance(0, foveation=cones)])
    for number, camera in enumerate(
        cameras(Nodes(splats.center, spark_size(splats), loaded.scene.tree), views, seed=count)
    ):
        budget, view = BUDGETS[1 + number % 4], CutView(camera, FOV_Y, FOV_Y)

        def nodes_at(scale: float, view: CutView = view) -> int:
            return len(found.cut(view, budget=count, smallest=scale))

        ours = found.cut(view, budget=count, smallest=dynamic_limit(nodes_at, budget, limit))
        asked = {"lodId": tree, "viewToObjectCols": camera.T.ravel().tolist(), "lodScale": 1.0}
        asked |= {"coneFov0": cones.fov0, "coneFov": cones.fov, "coneFoveate": cones.foveate}
        theirs = spark.traverse(budget, limit, [asked | {"behindFoveate": cones.behind}], mode="dynamic")
        np.testing.assert_array_equal(ours.indices()[0], np.sort(theirs.indices[0]))


# --- Trees that builders make -----------------------------------------------------------------------------------------


@cache
def baked(folder: Path, name: str, method: str, suffix: str) -> Path:
    source = FIXTURES / name if name == "demo.ply" else real_scene(name)
    made = folder / f"{source.stem}-{method}{suffix}"
    assert run(["build-lod", str(source), "--method", method, "--quiet", "-o", str(made)]) == 0
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("trees")


BAKED = [
    ("demo.ply", "quality", ".spz"),
    ("demo.ply", "quality", ".rad"),
    ("biker.ply", "quick", ".spz"),
    ("meadow.sog", "quick", ".rad"),
]


@pytest.mark.parametrize(("name", "method", "suffix"), BAKED)
def test_files_and_their_cuts_are_those_of_spark(
    spark: Spark, folder: Path, tmp_path: Path, name: str, method: str, suffix: str
) -> None:
    path = baked(folder, name, method, suffix)
    check_whole(spark, path)
    for precision in LAYOUTS:
        check_cuts(spark, path, precision, views=8)
    if suffix == ".rad":
        assert check_pages(spark, path, tmp_path) == -(-len(read_scene(path)) // CHUNK_NODES)


@pytest.mark.parametrize("precision", PAGES)
def test_cuts_of_files_with_missing_chunks_are_those_of_spark(
    spark: Spark, folder: Path, tmp_path: Path, precision: str
) -> None:
    check_paged_cuts(spark, baked(folder, "meadow.sog", "quick", ".rad"), tmp_path, precision, frames=12)


@pytest.mark.parametrize("suffix", [".spz", ".rad"])
def test_refined_trees_and_their_cuts_are_those_of_spark(
    spark: Spark, tmp_path: Path, stand_in: StandIn, suffix: str
) -> None:
    """Refined as they stand in their file, so that scales come from no code before they are written again."""
    made, refined = tmp_path / f"made{suffix}", tmp_path / f"refined{suffix}"
    source = FIXTURES / "demo.ply"
    assert run(["build-lod", str(source), "--method", "quality", "--quiet", "-o", str(made)]) == 0
    assert run(["build-lod", str(made), "--refine", "--quiet", "-o", str(refined)]) == 0
    assert len(stand_in.calls) == 1
    assert refined.read_bytes() != made.read_bytes()
    check_whole(spark, refined)
    for precision in LAYOUTS:
        check_cuts(spark, refined, precision, views=8)
    if suffix == ".rad":
        assert check_pages(spark, refined, tmp_path) == 1


@pytest.mark.parametrize("precision", LAYOUTS)
@pytest.mark.parametrize("suffix", [".spz", ".rad"])
def test_dynamic_cuts_are_those_of_spark(spark: Spark, folder: Path, suffix: str, precision: str) -> None:
    check_dynamic_cuts(spark, baked(folder, "demo.ply", "quality", suffix), precision, views=12)


def test_a_file_of_sparks_native_program_and_its_cuts_are_those_of_spark(spark: Spark, tmp_path: Path) -> None:
    path = real_scene("rad/biker-spark.rad")
    check_whole(spark, path)
    for precision in LAYOUTS:
        check_cuts(spark, path, precision, views=8)
    assert check_pages(spark, path, tmp_path) == 3
    for precision in PAGES:
        check_paged_cuts(spark, path, tmp_path, precision, frames=8)


def test_chunk_files_of_sparks_native_program_are_those_of_spark(spark: Spark, tmp_path: Path) -> None:
    assert check_pages(spark, real_scene("rad/playbot-125k-spark/p-lod.rad"), tmp_path) == 3


def test_files_written_by_hand_are_those_of_spark(spark: Spark, tmp_path: Path) -> None:
    """Chunks of few splats, each with encodings and ranges of its own."""
    path = FIXTURES / "golden" / "sh1-tree.rad"
    scene = read_scene(path)
    assert scene.coding is not None and len(scene.coding.scales) == 3
    check_whole(spark, path)


# --- Trees that nobody would build ------------------------------------------------------------------------------------


def extreme(count: int = 30_000) -> Scene:
    """A tree whose nodes have any size, shape and opacity: needles, huge and tiny splats, the ends of half floats.

    Many numbers are ties of one of the codings, or next to one.
    """
    rng = np.random.default_rng(5)
    splats, tree = quick.build(random_splats(count))
    count = len(splats)
    logs = rng.uniform(-14, 10, (count, 3)).astype(np.float32)
    some = rng.integers(8, size=count)
    logs[some == 1] = rng.uniform(-60, 60, (np.sum(some == 1), 3))
    logs[some == 2, 0] -= 12  # needles
    logs[some == 3] = half_ways(rng, np.float32(21 / 254), -12, np.sum(some == 3))
    logs[some == 4] = half_ways(rng, np.float32(2**-7), -10, np.sum(some == 4))
    scale = np.exp(logs.astype(np.float64)).astype(np.float32)
    scale[some == 5, 1] = 0
    alpha = rng.choice([0, 0.3, 1, 1.2, 1.9, 2], count).astype(np.float32)
    alpha[some == 6] = rng.uniform(1, 2, np.sum(some == 6))
    alpha[some == 7] = 1 + (rng.integers(1024, size=np.sum(some == 7)) + 0.5) / 1024  # ties of half floats
    d = np.where(alpha > 1, 4 * alpha - 3, alpha)
    center = splats.center * np.exp(rng.uniform(-18, 12, (count, 1))).astype(np.float32)
    return Scene(replace(splats, center=center, scale=scale, opacity=linear_opacity(d)), tree)


def half_ways(rng: np.random.Generator, step: np.float32, low: int, count: int) -> FloatArray:
    """(count, 3) numbers half-way between two codes of logarithms, and next to those."""
    found = (low + (rng.integers(240, size=(count, 3)) + 0.5) * step).astype(np.float32)
    return np.nextafter(found, rng.choice([-np.inf, np.inf], found.shape).astype(np.float32))


WAYS = [
    RadOptions(scales=scales, alpha=alpha, center=center, ranges=ranges)
    for scales, alpha, center, ranges in (
        ("ln_0r8", "f16", "f32", None),
        ("ln_0r8", "r8", "f16", NARROW),
        ("ln_f16", "f32", "f32_lebytes", NARROW),
        ("f32", "f32", "f16_lebytes", None),
        ("f32", "r8", "f32", NARROW),
    )
]


def test_the_ways_have_every_encoding() -> None:
    for field in ("scales", "alpha", "center"):
        assert {getattr(way, field) for way in WAYS} == set(RAD_ENCODINGS[field])


@pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way.scales}-{way.alpha}")
def test_extreme_trees_in_rad_are_those_of_spark(spark: Spark, tmp_path: Path, way: RadOptions) -> None:
    scene, reach = extreme(), 65_000 if way.center in HALF else np.inf
    scene = replace(scene, splats=replace(scene.splats, center=scene.splats.center.clip(-reach, reach)))
    path = tmp_path / "tree.rad"
    path.write_bytes(b"".join(rad.encode(scene, WriteOptions(rad=way), threads=2)))
    check_whole(spark, path)
    assert check_pages(spark, path, tmp_path) == 1


@pytest.mark.parametrize("version", [2, 3])
def test_extreme_trees_in_spz_are_those_of_spark(spark: Spark, tmp_path: Path, version: int) -> None:
    scene = extreme()
    scene = replace(scene, splats=replace(scene.splats, center=scene.splats.center.clip(-2000, 2000)))
    path = tmp_path / "tree.spz"
    path.write_bytes(b"".join(spz.encode(scene, WriteOptions(spz_version=version), threads=2)))
    check_whole(spark, path)
    for precision in LAYOUTS:
        check_cuts(spark, path, precision, views=16)
