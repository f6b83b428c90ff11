"""Scenes and where they stand: what is read of files, against plain matrices."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.codecs.options import DEFAULTS
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.gaussian import moved, placed, spark_size
from sparklod_cli.model.instances import Instance, names_of
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError, SparklodError, TreeError
from sparklod_cli.viewers import scenes as reading
from sparklod_cli.viewers.loaded_scene import TRAVERSED
from sparklod_cli.viewers.scenes import Cut, Part, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.conftest import FIXTURES
from tests.lod.forests import transform
from tests.references import gaussians
from tests.scenes import random_splats

TREE, TOWN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "traverse" / "town.spz"
HAND = FIXTURES / "golden" / "hand-tree-v3.spz"
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
    for column in dataclasses.fields(there):
        assert getattr(there, column.name).dtype == getattr(splats, column.name).dtype


def test_the_identity_moves_no_splat() -> None:
    splats = random_splats(50)
    there = placed(splats, np.eye(4))
    assert np.array_equal(there.center, splats.center)
    assert np.array_equal(there.scale, splats.scale)
    assert np.allclose(np.abs((there.quat_xyzw * splats.quat_xyzw).sum(axis=1)), 1, atol=1e-6)


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
        level = np.zeros(len(part), int)
        for node in np.flatnonzero(scene.tree.child_count):
            first = int(scene.tree.child_start[node])
            level[first : first + int(scene.tree.child_count[node])] = level[node] + 1
        assert np.array_equal(tree.depth, level)


def test_precision_float16_is_what_float16_holds() -> None:
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


@pytest.mark.parametrize("nodes", [1, CHUNK_NODES - 1, CHUNK_NODES, CHUNK_NODES + 1, 3 * CHUNK_NODES])
def test_chunks_end_where_nodes_do(nodes: int) -> None:
    (tree,) = read_scenes([Instance(TREE, "tree")]).with_cuts
    sizes = np.array(dataclasses.replace(tree, splats=Splats.zeros(nodes, 0), bytes=10**12 + 7).requests)
    assert len(sizes) == -(-nodes // CHUNK_NODES)
    assert sizes.sum() == 10**12 + 7
    assert sizes.min() > 0


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


def test_names_are_those_of_files() -> None:
    files = [Path("a/door.spz"), Path("b/door.spz"), Path("wall.spz"), Path("c/door.ply")]
    assert names_of(files) == ["door", "door 2", "wall", "door 3"]
    assert names_of([Path("total.spz"), Path("x/total.spz")]) == ["total.spz", "total.spz 2"]


stems = st.sampled_from(["a", "a 2", "a 2 2", "a 3", "total", "total.spz", "total.spz 2", "b"])


@given(st.lists(stems, max_size=12), st.lists(stems, max_size=4))
def test_instances_get_unique_names(names: list[str], taken: list[str]) -> None:
    given_names = names_of([Path(f"{name}.spz") for name in names], taken)
    assert len(set(given_names)) == len(names)
    assert not {"total", *taken} & set(given_names)
