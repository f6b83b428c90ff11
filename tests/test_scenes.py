"""Scenes for viewing: trees and plain files, read once and placed by their instances, in full and in cuts."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.framing import COVERED, covered, fitted
from sparklod_cli.codecs import layouts, ply
from sparklod_cli.codecs.formats import DEFAULTS
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.images.metrics import psnr
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.budget import Budget, parse_budget
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.gaussian import moved, placed, spark_size
from sparklod_cli.model.instances import DetailScene, Instance, names_of
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.color_scales import numbers_of, scale_of_splats, values_of
from sparklod_cli.render.render_settings import RenderSettings
from sparklod_cli.render.renderer import Renderer
from sparklod_cli.system.errors import FormatError, InvalidSplatsError, SparklodError, TreeError
from sparklod_cli.viewers import scenes as reading
from sparklod_cli.viewers.loaded_scene import TRAVERSED
from sparklod_cli.viewers.playcanvas import LoadedDetail
from sparklod_cli.viewers.scenes import Cut, CutFinder, Part, Scenes, read_scenes
from sparklod_cli.viewers.viewer_settings import PLAYCANVAS_BUDGET, DetailRule, LodSettings
from tests.conftest import FIXTURES
from tests.lod.trees import row_of_regions, transform
from tests.part_files import write_streamed
from tests.references import gaussians
from tests.render.drawables import camera
from tests.scenes import random_splats

# Reading

TREE, HAND = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
TOWN, PLAIN = FIXTURES / "traverse" / "town.spz", FIXTURES / "sh1.ply"
SHIFTED = np.array([[0.0, 0, 2, 5], [0, 2, 0, -6], [-2, 0, 0, 7], [0, 0, 0, 1]])  # a quarter turn, twice the size


def matrices(count: int = 6) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    halves = [np.diag([*signs, 1.0]) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    return [*halves, SHIFTED, *(transform(rng, scale=float(np.exp(rng.normal())), spread=9) for _ in range(count))]


@pytest.mark.parametrize("matrix", matrices())
def test_placed_splats_have_the_covariance_of_the_matrix(matrix: np.ndarray) -> None:
    """M cov M^T, however the rotation is turned; half turns have quaternions whose w is 0."""
    splats = random_splats(200, sh_degree=1)
    there = placed(splats, matrix)
    axes = matrix[:3, :3]
    expected = axes @ gaussians.covariance(splats.scale, splats.quat_xyzw) @ axes.T
    found = gaussians.covariance(there.scale, there.quat_xyzw)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert (np.abs(found - expected) <= 2e-6 * size).all()
    assert np.allclose(np.linalg.norm(there.quat_xyzw, axis=1), 1, atol=1e-6)
    homogeneous = np.concatenate([splats.center, np.ones((200, 1))], axis=1)
    assert np.allclose(there.center, (homogeneous @ matrix.T)[:, :3], rtol=1e-6, atol=1e-5)
    assert np.array_equal(there.center, moved(splats.center, matrix))
    for name in ("opacity", "rgb", "sh"):
        assert np.array_equal(getattr(there, name), getattr(splats, name))


def five() -> list[Instance]:
    """Three trees, two of them twice."""
    spots = [np.eye(4), SHIFTED, *matrices(3)[-3:]]
    files = [TREE, TOWN, TREE, HAND, HAND]
    return [
        Instance(file, f"{number}", spot, 1 + number)
        for number, (file, spot) in enumerate(zip(files, spots, strict=True))
    ]


def test_centres_are_those_of_all_leaves_in_the_world() -> None:
    instances = five()
    parts = []
    for instance in instances:
        scene = read_scene(instance.source)
        assert scene.tree is not None
        leaves = scene.splats.center[scene.tree.child_count == 0].astype(np.float64)
        parts.append(leaves @ instance.object_to_world[:3, :3].T + instance.object_to_world[:3, 3])
    centers = read_scenes(instances, columns=TRAVERSED, trees_only=True).balls().center
    assert np.allclose(centers, np.concatenate(parts), rtol=1e-6, atol=1e-5)


def test_splats_of_an_instance_are_placed() -> None:
    instances = five()
    made = read_scenes(instances)
    for number, instance in enumerate(instances):
        splats = read_scene(instance.source).splats
        nodes = np.array([5, 0, 3], np.uint32)
        expected = splats.take(nodes) if number == 0 else placed(splats.take(nodes), instance.object_to_world)
        part = Part(made.of_instance[number], nodes, None, instance.object_to_world)
        for column in dataclasses.fields(expected):
            found = getattr(Cut((part,)).splats, column.name)
            assert np.array_equal(found, getattr(expected, column.name)), column.name


def test_the_forest_has_the_nodes_of_the_files() -> None:
    made = read_scenes(five())
    instances = made.viewer(LodSettings()).instances
    assert [tree.file for tree in made.with_cuts] == [TREE, TOWN, HAND]
    assert [instance.tree for instance in instances] == [0, 1, 0, 2, 2]
    assert [instance.lod_scale for instance in instances] == [1, 2, 3, 4, 5]
    for tree, (start, end) in zip(made.with_cuts, itertools.pairwise(made.forest.node_base), strict=True):
        scene = read_scene(tree.file)
        assert scene.tree is not None
        part = made.forest.nodes[start:end]
        for axis, values in zip("xyz", scene.splats.center.T, strict=True):
            assert np.array_equal(part[axis], values)
        assert np.array_equal(part["size"], spark_size(scene.splats))
        assert np.array_equal(part["child_count"], scene.tree.child_count)
        assert np.array_equal(part["child_start"], scene.tree.child_start)
        assert np.array_equal(tree.depth, scene.tree.depths())


def test_precision_float16_rounds_centres_and_sizes() -> None:
    exact, half = (
        read_scenes([Instance(TOWN, "town")], precision=name).forest.nodes for name in ("float32", "float16")
    )
    for name in ("x", "y", "z", "size"):
        assert np.array_equal(half[name], exact[name].astype(np.float16).astype(np.float32))
    assert not np.array_equal(half["size"], exact["size"])
    for name in ("child_count", "child_start"):
        assert np.array_equal(half[name], exact[name])


def test_a_file_is_opened_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []
    original = reading.opened

    def counted(file: Path, *rest: Any) -> contextlib.AbstractContextManager[Any]:
        read.append(file)
        return original(file, *rest)

    monkeypatch.setattr(reading, "opened", counted)
    assert len(read_scenes(five()).with_cuts) == 3
    assert read == [TREE, TOWN, HAND]


def test_chunks_share_the_bytes_of_a_file() -> None:
    made = read_scenes(five())
    for tree in made.with_cuts:
        sizes = np.array([sum(each) for each in tree.requests])
        assert tree.file is not None
        assert sizes.sum() == tree.bytes == tree.file.stat().st_size
        assert len(sizes) == -(-len(tree.splats) // CHUNK_NODES)
        nodes = np.minimum(len(tree.splats) - CHUNK_NODES * np.arange(len(sizes)), CHUNK_NODES)
        assert (np.abs(sizes - nodes * tree.bytes / len(tree.splats)) <= 1).all()  # each its share of the nodes
    assert made.forest.chunks == sum(tree.chunks for tree in made.loaded) == 1 + 3 + 1
    for nodes in (1, CHUNK_NODES - 1, CHUNK_NODES, CHUNK_NODES + 1, 3 * CHUNK_NODES):
        tree = dataclasses.replace(made.with_cuts[0], splats=Splats.zeros(nodes, 0), bytes=10**12 + 7)
        sizes = np.array(tree.requests)
        assert len(sizes) == -(-nodes // CHUNK_NODES)
        assert sizes.sum() == 10**12 + 7 and sizes.min() > 0


def test_chunks_of_rad_have_the_sizes_that_they_have_in_the_file(tmp_path: Path) -> None:
    """Those that follow the header in one file, and those that are files of their own."""
    scene = read_scene(TOWN)
    (tmp_path / "whole.rad").write_bytes(b"".join(rad.encode(scene)))
    for name, pieces in rad.encode_chunked(scene, DEFAULTS, "parts"):
        (tmp_path / name).write_bytes(b"".join(pieces))
    whole, parts, town = read_scenes(
        [Instance(path) for path in (tmp_path / "whole.rad", tmp_path / "parts.rad", TOWN)]
    ).loaded
    assert whole.scene.header["header_bytes"] + sum(map(sum, whole.requests)) == (tmp_path / "whole.rad").stat().st_size
    assert parts.scene.header["header_bytes"] == (tmp_path / "parts.rad").stat().st_size
    files = [(tmp_path / f"parts-{number}.radc").stat().st_size for number in range(3)]
    assert [sum(each) for each in parts.requests] == [sum(each) for each in whole.requests] == files
    assert town.headers == ()


def test_chunks_of_another_size_than_sparks_are_not_those_that_it_streams() -> None:
    """Spark's pages have 65,536 nodes; a file of smaller chunks counts as if it were cut evenly."""
    (tree,) = read_scenes([Instance(FIXTURES / "golden" / "sh1-tree.rad")]).with_cuts
    assert tree.scene.chunk_bytes is not None
    assert tree.scene.header["chunk_size"] != CHUNK_NODES
    assert [sum(each) for each in tree.requests] == [tree.bytes]
    assert tree.headers == ()


def test_foveation_is_that_of_all_or_its_own() -> None:
    own, of_all = Frustum(0.5, 0.1), Cones(90, 120, 0.4, 0.2)
    instances = [Instance(TREE, "a"), Instance(TREE, "b", SHIFTED, 3.0, own), Instance(HAND, "c")]
    made = read_scenes(instances)
    instances = made.viewer(LodSettings(foveation=of_all)).instances
    assert [instance.foveation for instance in instances] == [of_all, own, of_all]
    assert [instance.lod_scale for instance in instances] == [1, 3, 1]
    assert np.array_equal(instances[1].object_to_world, SHIFTED)
    assert made.viewer(LodSettings()).instances[1].foveation == own


@pytest.mark.parametrize(
    ("file", "kind", "said"),
    [
        (
            FIXTURES / "sh2.ply",
            FormatError,
            "it is not a Level-of-Detail tree, Streamed SOG or 3D Tiles; bake it first",
        ),
        (FIXTURES / "golden" / "sh3-v3.spz", FormatError, "it is not a Level-of-Detail tree"),
        (FIXTURES / "faults" / "tree-cycle.spz", TreeError, "its tree is broken: node"),
        (FIXTURES / "faults" / "tree-orphan.spz", TreeError, "its tree is broken: node 9 has no parent"),
        (FIXTURES / "faults" / "spz-flipped-bit.spz", FormatError, "corrupt gzip data"),
        (FIXTURES / "faults" / "missing.spz", FormatError, "cannot be read: no such file or directory"),
        (FIXTURES / "points.ply", FormatError, ""),
        (FIXTURES, FormatError, "is a directory"),
        (Path("/dev/null"), FormatError, "pipe or a device"),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_an_unreadable_file_of_an_instance_is_named(file: Path, kind: type[SparklodError], said: str) -> None:
    with pytest.raises(kind) as caught:
        read_scenes([Instance(TREE, "good"), Instance(file, "bad")], columns=TRAVERSED, trees_only=True)
    assert str(caught.value).startswith(f"{file}: {said}") or said in str(caught.value)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", sorted((FIXTURES / "faults").glob("tree-*.spz")), ids=lambda file: file.name)
def test_faulty_trees_are_refused_or_traversed(file: Path) -> None:
    """Whatever a file's tree is, it is refused in a line, or sound."""
    try:
        made = read_scenes([Instance(file, "tree")])
    except SparklodError as error:
        assert str(error).startswith(f"{file}: ")
    else:
        assert made.with_cuts[0].depth.max() < len(made.forest.nodes)


stems = st.sampled_from(["a", "a 2", "a 2 2", "a 3", "total", "total.spz", "total.spz 2", "b"])


@given(st.lists(stems, max_size=12), st.lists(stems, max_size=4))
def test_instances_get_unique_names(names: list[str], taken: list[str]) -> None:
    given_names = names_of([Path(f"{name}.spz") for name in names], taken)
    assert len(set(given_names)) == len(names)
    assert names_of([Path("a/door.spz"), Path("b/door.ply"), Path("wall.spz")]) == [
        "door",
        "door 2",
        "wall",
    ]  # as of the files
    assert not {"total", *taken} & set(given_names)


# Cuts


def at(*files: Path) -> list[Instance]:
    return [Instance(file, f"{number}") for number, file in enumerate(files)]


def seen(scenes: Scenes, size: tuple[int, int] = (160, 120)) -> Camera:
    return fitted(camera(*size), covered(scenes.balls()))


def test_a_cut_is_that_of_the_traversal() -> None:
    settings = LodSettings(3000)
    scenes = read_scenes(at(TOWN, PLAIN, HAND))
    view = seen(scenes)
    cut = CutFinder(scenes, settings).cut(view)
    town, plain, tree = cut.parts
    viewer = read_scenes(at(TOWN, HAND), trees_only=True).viewer(settings)
    found = viewer.cut(view, budget=3000, smallest=settings.limit(view.fov_y, view.height))
    expected = found.indices()
    assert (cut.reason, cut.pixel_scale) == (found.reason, found.least)
    assert len(cut) == len(found) + len(plain.index) == len(cut.splats)
    assert np.array_equal(town.index, expected[0])
    assert np.array_equal(tree.index, expected[1])
    assert len(plain.index) == len(scenes.loaded[1].splats)
    assert np.array_equal(town.splats.center, scenes.loaded[0].splats.center[town.index])
    assert len(town.index) + len(tree.index) <= 3000


@pytest.mark.parametrize("by", ["level", "chunk"])
@pytest.mark.parametrize("budget", [50, 3000, 50_000])
def test_colours_of_whole_numbers_span_what_the_cuts_have(by: str, budget: int) -> None:
    finder = CutFinder(read_scenes(at(TOWN, HAND)), LodSettings(budget))
    views = [camera(160, 120, z) for z in (3.0, 20.0)]
    scale = Renderer(finder, RenderSettings(color_by=by), views).scale
    assert scale is not None
    parts = [part for view in views for part in finder.cut(view).parts]
    values = np.concatenate([values_of(by, part) for part in parts])
    assert (scale.low, scale.high) == (values.min(), values.max())
    assert (scale.marks[0][1], scale.marks[-1][1]) == (f"{scale.low}", f"{scale.high}")


def test_full_detail_of_trees_is_their_leaves() -> None:
    scenes = read_scenes(at(TOWN, PLAIN))
    town, plain = CutFinder(scenes, None).cut(seen(scenes)).parts
    loaded = scenes.loaded[0]
    assert loaded.depth is not None
    assert np.array_equal(town.index, loaded.leaves)
    assert len(scenes.balls().center) == len(town.index) + len(plain.index)
    assert plain.scene.first_chunk == loaded.chunks


def test_a_scene_in_memory_is_that_of_its_file() -> None:
    scene = read_scene(HAND)
    held, read = (read_scenes([Instance(source, "tree")]) for source in (scene, HAND))
    view = seen(read)
    cuts = [CutFinder(scenes, LodSettings(20)).cut(view) for scenes in (held, read)]
    assert np.array_equal(cuts[0].nodes[0], cuts[1].nodes[0])
    assert np.array_equal(cuts[0].splats.center, cuts[1].splats.center)
    assert len(read_scenes([Instance(scene, "a"), Instance(scene, "b")]).loaded) == 1


def test_continuous_cuts_fade_what_the_weights_say() -> None:
    scenes = read_scenes(at(TOWN))
    view = seen(scenes)
    cut = CutFinder(scenes, LodSettings(3000, continuous=1.25)).cut(view)
    (part,) = cut.parts
    assert part.weight is not None
    whole = part.weight == 1
    assert 0 < whole.sum() < len(whole)
    opacity = scenes.loaded[0].splats.opacity[part.index]
    assert np.array_equal(part.splats.opacity[whole], opacity[whole])
    assert (part.splats.opacity[~whole] < opacity[~whole]).all()
    assert part.weight.sum() == pytest.approx(3000, rel=1e-3)


def test_through_an_encoding_splats_are_rounded_and_the_cut_stays() -> None:
    scenes = {through: read_scenes(at(TOWN), through=through) for through in (None, "packed", "ext", "spz")}
    finders = {through: CutFinder(each, LodSettings(2000)) for through, each in scenes.items()}
    view = seen(scenes[None])
    cuts = [finder.cut(view).nodes[0] for finder in finders.values()]
    assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
    original = scenes[None].loaded[0].splats
    encoding = SplatEncoding(lod_opacity=True)
    expected = layouts.unpack_packed(layouts.pack_packed(original, encoding), encoding)
    assert np.array_equal(scenes["packed"].loaded[0].splats.scale, expected.scale)
    assert expected.opacity.max() > 1
    expected = layouts.unpack_ext(layouts.pack_ext(original))
    assert np.array_equal(scenes["ext"].loaded[0].splats.quat_xyzw, expected.quat_xyzw)
    # The file is an SPZ already, with other fractional bits.
    rounded = scenes["spz"].loaded[0].splats
    assert np.allclose(rounded.center, original.center, atol=2**-9)
    assert np.array_equal(rounded.scale, original.scale)
    images = {
        through: Renderer(finder, RenderSettings(), [view]).draw(view).image for through, finder in finders.items()
    }
    qualities = {through: psnr(images[None][..., :3], image[..., :3]) for through, image in images.items()}
    assert qualities[None] > qualities["spz"] > 30
    assert 30 < qualities["packed"] < qualities["ext"]


def test_an_encoding_says_what_spz_cannot_hold(tmp_path: Path) -> None:
    splats = random_splats(30)
    splats.center[3] = 1e9
    (tmp_path / "far.ply").write_bytes(b"".join(ply.encode(Scene(splats))))
    with pytest.raises(FormatError, match=r"far.ply: coordinates reach"):
        read_scenes(at(tmp_path / "far.ply"), through="spz")


def test_splats_that_cannot_be_drawn_are_left_out() -> None:
    file = FIXTURES / "faults" / "nan.ply"
    scenes = read_scenes(at(file))
    assert scenes.loaded[0].splats.is_valid().all()
    assert any(note.startswith(f"{file}: left out ") and "not finite" in note for note in scenes.notes)
    with pytest.raises(InvalidSplatsError, match=r"no-splats.ply: it has no splats"):
        read_scenes(at(FIXTURES / "faults" / "no-splats.ply"))


@pytest.mark.parametrize("size", [(160, 90), (90, 160)])
@pytest.mark.parametrize("file", [TOWN, PLAIN, FIXTURES / "demo.ply"], ids=lambda path: path.name)
def test_a_fitted_camera_sees_the_scene(file: Path, size: tuple[int, int]) -> None:
    """All of it that is dense, and nearly all that there is: of the demo all but its stars."""
    scenes = read_scenes(at(file))
    view = fitted(camera(*size), covered(scenes.balls()))
    center = covered(scenes.balls()).center
    local = (center - view.position) @ view.camera_to_world[:3, :3]
    places = np.abs(local[:, :2] / -local[:, 2:]) * view.focal / (np.array(size) / 2)
    inside = (places <= 1).all(axis=1) & (local[:, 2] < 0)
    assert inside.all()
    assert places[inside].max() > 0.7  # and it fills that
    assert len(center) >= 0.9 * COVERED * len(scenes.balls().center)


# Detail levels

#: Six regions along z, seen from before the first one: 64, 32 and 16 splats each.
AT = Camera.look_at([0, 0, -6], [0, 0, 0], size=(64, 48))


@pytest.fixture(scope="module")
def row() -> DetailScene:
    return row_of_regions(environment=5)


def scenes_of(*instances: Instance | Scene | DetailScene) -> Scenes:
    return read_scenes(
        [each if isinstance(each, Instance) else Instance(each, f"{at}") for at, each in enumerate(instances)]
    )


def levels_of(scene: DetailScene, index: np.ndarray) -> list[int]:
    """The level of each region in a cut, all of whose splats must be there; -1 where nothing is drawn."""
    drawn, left = [], set(index.tolist())
    for region in range(scene.regions):
        runs = [set(range(*scene.run(region, level).indices(len(scene.splats)))) for level in range(scene.levels)]
        found = [level for level, run in enumerate(runs) if run and run <= left]
        assert len(found) <= 1
        drawn.append(found[0] if found else -1)
        left -= runs[found[0]] if found else set()
    around = 0 if scene.environment is None else len(scene.environment)
    assert left == set(range(len(scene.splats), len(scene.splats) + around))
    return drawn


@pytest.mark.parametrize("budget", [1, 96, 130, 200, 300, 383, 384, 10_000])
def test_a_cut_is_one_level_of_each_region_and_the_environment(row: DetailScene, budget: int) -> None:
    cut = CutFinder(scenes_of(row), LodSettings(budget)).cut(AT)
    (index,) = cut.nodes
    levels = levels_of(row, index)
    assert levels == sorted(levels), "farther regions are as coarse or coarser"
    assert len(cut) - 5 <= max(budget, 6 * 16)
    assert cut.reason == ("exhausted" if budget >= 384 else "budget") and cut.pixel_scale is None
    every = row.splats if row.environment is None else Splats.concat([row.splats, row.environment])
    np.testing.assert_array_equal(cut.splats.center, every.take(index).center)


def test_budgets_are_shares_of_full_detail_or_the_default_of_playcanvas(row: DetailScene) -> None:
    scenes = scenes_of(row)
    assert scenes.splats_of(parse_budget("50%")) == (6 * 64 + 5) // 2
    default = replace(Budget.of_count(7), by_default=True)
    assert scenes.splats_of(default) == PLAYCANVAS_BUDGET
    assert scenes.splats_of(replace(default, scale=0.5)) == PLAYCANVAS_BUDGET // 2
    assert scenes_of(Scene(row.splats)).splats_of(default) == 7


def test_a_camera_at_the_other_end_sees_that_end_in_detail(row: DetailScene) -> None:
    finder = CutFinder(scenes_of(row), LodSettings(200))
    (near,), (far,) = (finder.cut(view).nodes for view in (AT, Camera.look_at([0, 0, 16], [0, 0, 0], size=(64, 48))))
    assert levels_of(row, near) == levels_of(row, far)[::-1]


def test_instances_share_a_budget_by_where_they_stand_and_by_their_lod_scale(row: DetailScene) -> None:
    away = np.eye(4)
    away[:3, 3] = [0, 0, 30]

    def sizes(*, lod_scale: float = 1.0) -> list[int]:
        scenes = scenes_of(Instance(row, "near"), Instance(row, "far", away, lod_scale=lod_scale))
        cut = CutFinder(scenes, LodSettings(500)).cut(AT)
        assert len(scenes.loaded) == 1
        return [len(part.index) for part in cut.parts]

    near, far = sizes()
    assert near > far and near + far <= 500 + 10
    assert sizes(lod_scale=100.0)[0] < sizes(lod_scale=100.0)[1]


def test_splats_of_plain_scenes_count_against_the_budget(row: DetailScene) -> None:
    plain = Scene(random_splats(100))
    with_plain = CutFinder(scenes_of(row, plain), LodSettings(300)).cut(AT)
    alone = CutFinder(scenes_of(row), LodSettings(200)).cut(AT)
    assert with_plain.nodes[0].tolist() == alone.nodes[0].tolist() and len(with_plain.nodes[1]) == 100


def test_a_limit_keeps_to_distances(row: DetailScene) -> None:
    rule = DetailRule(mode="limit", base_distance=8.0, multiplier=1.5, shrink=0.0)
    view = Camera.look_at([0, 0, -6], [0, 0, 0], fov_y=45, size=(64, 64))
    cut = CutFinder(scenes_of(row), LodSettings(10_000, detail=rule)).cut(view)
    distances = 5 + 2 * np.arange(6)  # to the front of each region
    assert levels_of(row, cut.nodes[0]) == [0 if near < 8 else 1 if near < 12 else 2 for near in distances]
    assert cut.reason == "distance"


def test_trees_and_detail_levels_are_shown_together_in_full_only(row: DetailScene) -> None:
    scenes = scenes_of(row, Instance(FIXTURES / "golden" / "hand-tree-v3.spz", "tree"))
    with pytest.raises(ValueError, match=r"hand-tree-v3\.spz is a Level-of-Detail tree and scene is Streamed SOG"):
        CutFinder(scenes, LodSettings())
    assert len(CutFinder(scenes, None).cut(AT)) > 6 * 64 + 5


def test_settings_and_foveation_of_trees_are_refused(row: DetailScene) -> None:
    with pytest.raises(ValueError, match="scene is Streamed SOG; continuous cuts are of trees alone"):
        CutFinder(scenes_of(row), LodSettings(continuous=1.25))
    with pytest.raises(ValueError, match="row is Streamed SOG, and has a foveation, which is for trees alone"):
        CutFinder(scenes_of(Instance(row, "row", foveation=Cones())), LodSettings())


def test_colours_are_of_detail_levels_and_chunk_files(row: DetailScene, tmp_path: Path) -> None:
    scenes = read_scenes([Instance(write_streamed(tmp_path, row), "row")])
    finder = CutFinder(scenes, LodSettings(250))
    (part,) = finder.cut(AT).parts
    levels = numbers_of("level", part.scene, part.index)
    assert set(levels[:-5].tolist()) == {0, 1} and (levels[-5:] == 0).all()
    assert scale_of_splats("level", finder, [AT]).title == "detail level"
    chunks = numbers_of("chunk", part.scene, part.index)
    assert chunks[-1] == 9 and (chunks[:-5] // 3 == levels[:-5]).all()


def test_files_are_read_with_the_bytes_of_their_chunks(row: DetailScene, tmp_path: Path) -> None:
    manifest = write_streamed(tmp_path / "web", row)
    for path in (manifest, manifest.parent):
        (loaded,) = read_scenes([Instance(path, "row")]).loaded
        assert isinstance(loaded, LoadedDetail)
        assert loaded.files.of_run.tolist() == [[at // 2 + 3 * level for level in range(3)] for at in range(6)]
        assert loaded.files.environment == 9 and loaded.files.manifest == manifest.stat().st_size
        folders = [*(f"{level}_{number}" for level in range(3) for number in range(3)), "env"]
        sizes = [sum(each.stat().st_size for each in (manifest.parent / name).iterdir()) for name in folders]
        assert [sum(each) for each in loaded.requests] == sizes and loaded.bytes == sum(sizes) + manifest.stat().st_size
        np.testing.assert_array_equal(loaded.detail.counts, row.counts)
