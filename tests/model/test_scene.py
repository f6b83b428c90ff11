"""Trees, scenes at several detail levels, instances, and several scenes read as one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sparklod_cli.codecs.merging import Placed, merged
from sparklod_cli.codecs.reader import Reader, RowBuffer
from sparklod_cli.model.gaussian import placed
from sparklod_cli.model.instances import DetailScene, Instance
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, TreeError
from sparklod_cli.system.progress import Progress
from tests.bake.jobs import reader_of
from tests.lod.trees import children, links
from tests.scenes import random_splats

# Trees


def tree_of(counts: list[int], starts: list[int]) -> LodTree:
    return LodTree(np.array(counts, np.uint16), np.array(starts, np.uint32))


#: Any tree in breadth-first order.
TREES = st.lists(st.integers(0, 4), max_size=30).map(links)


@given(TREES)
def test_depths_of_a_tree_are_those_of_its_edges(tree: LodTree) -> None:
    depth = tree.depths()
    assert depth[0] == 0
    for node in range(len(tree)):
        assert (depth[children(tree, node)] == depth[node] + 1).all()


@given(TREES, st.data())
def test_any_single_change_breaks_a_tree(tree: LodTree, data: st.DataObject) -> None:
    node = data.draw(st.integers(0, len(tree) - 1))
    count, start = tree.child_count.copy(), tree.child_start.copy()
    if data.draw(st.booleans()):
        count[node] = data.draw(st.integers(0, 9).filter(lambda value: value != count[node]))
    else:
        node = data.draw(st.sampled_from(np.flatnonzero(count).tolist() or [None]))
        assume(node is not None)
        start[node] = data.draw(st.integers(0, 99).filter(lambda value: value != start[node]))
    with pytest.raises(TreeError):
        LodTree(count, start).validate()


@pytest.mark.parametrize(
    ("counts", "starts", "message"),
    [
        ([], [], "no node"),
        ([0, 0], [0, 0], "node 1 has no parent"),
        ([1, 1], [1, 1], "node 1 comes after one of its children"),
        ([2, 0, 0], [0, 0, 0], "node 0 comes after one of its children"),
        ([3, 0, 0], [1, 0, 0], "node 0 has children past the last node"),
        ([2, 1, 1, 0], [1, 3, 3, 0], "shares children"),
        ([65535, 0], [1, 0], "past the last node"),
        ([1, 0], [4294967295, 0], "past the last node"),
        ([0, 0], [0], "2 child counts but 1"),
    ],
)
def test_each_fault_of_a_tree_is_named(counts: list[int], starts: list[int], message: str) -> None:
    with pytest.raises(TreeError, match=message):
        tree_of(counts, starts).validate()


def test_the_start_of_a_leaf_means_nothing() -> None:
    tree = tree_of([2, 0, 0], [1, 7, 2])
    tree.validate()
    assert tree.first_child().tolist() == [1, 0, 0]


# Detail levels

#: Three regions at two levels; the last one has no coarse level.
COUNTS = np.array([[5, 2], [4, 1], [3, 0]])


def detail_scene(**changes: object) -> DetailScene:
    """A scene of `COUNTS`."""
    columns = {
        "splats": random_splats(int(COUNTS.sum())),
        "counts": COUNTS,
        "bounds": np.zeros((3, 2, 3)),
        "children": np.array([[-1, 1], [-2, -3]]),
    }
    return DetailScene(**(columns | changes))  # type: ignore[arg-type]


def test_runs_lie_level_after_level_and_full_detail_ends_with_the_environment() -> None:
    sky = random_splats(2, seed=1)
    scene = detail_scene(environment=sky)
    runs = [scene.run(region, level) for level in range(2) for region in range(3)]
    assert [part.start for part in runs] == [0, 5, 9, 12, 14, 15]
    assert [part.stop for part in runs] == [5, 9, 12, 14, 15, 15]
    assert [scene.level(0), scene.level(1)] == [slice(0, 12), slice(12, 15)]
    assert np.array_equal(scene.scene().splats.center, np.concatenate([scene.splats.center[:12], sky.center]))
    assert len(detail_scene().scene()) == 12


@pytest.mark.parametrize(
    ("change", "message"),
    [({"bounds": np.zeros((2, 2, 3))}, "bounds has the shape"), ({"splats": random_splats(14)}, "there are 14")],
)
def test_columns_that_contradict_each_other_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        detail_scene(**change)


# Instances

TRANSFORMS = (
    Transform(),
    Transform.from_parts(up="z", rotate=(10, 20, 30), scale=2.5, translate=(1, -2, 3)),
    Transform(translation=np.array([100.0, 0, 0])),
)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_an_instance_places_splats_where_pictures_have_them(transform: Transform) -> None:
    """And turns their SH, which a picture does by turning the camera instead."""
    source = random_splats(50)
    found = Instance(Scene(source), object_to_world=transform.matrix).transform.apply(source)
    expected = placed(source, transform.matrix)
    np.testing.assert_allclose(found.center, expected.center, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-5)
    cosines = np.abs(np.einsum("ij,ij->i", found.quat_xyzw, expected.quat_xyzw))
    np.testing.assert_allclose(cosines, 1, atol=1e-5)


def test_a_matrix_that_is_slightly_skewed_gets_the_nearest_rotation() -> None:
    matrix = TRANSFORMS[1].matrix
    matrix[:3, :3] += 5e-4 * np.random.default_rng(3).normal(size=(3, 3))
    near = Instance(scenes()[0], object_to_world=matrix).transform
    np.testing.assert_allclose(near.rotation.T @ near.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(near.matrix, matrix, atol=2e-3)
    assert Instance(scenes()[0]).transform.is_identity
    for scale in (1e12, 1e-12):  # the largest and the smallest of an instances file
        matrix = dataclasses.replace(Transform.from_euler(1, 2, 3), scale=scale).matrix
        assert Instance(scenes()[0], object_to_world=matrix).transform.scale == pytest.approx(scale)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("place", "value"),
    [((0, 0), np.nan), ((0, 3), np.inf), ((1, 1), -1.0), ((2, 2), 0.0), ((3, 0), 1.0), ((0, 0), -1e300)],
)
def test_matrices_that_place_nothing_are_refused(place: tuple[int, int], value: float) -> None:
    matrix = np.eye(4)
    matrix[place] = value
    with pytest.raises(ValueError, match="object_to_world is no rotation, uniform scale and translation"):
        Instance(scenes()[0], object_to_world=matrix)


# Several scenes as one


def scenes() -> list[Scene]:
    """Of different sizes and degrees, one of them without splats."""
    return [Scene(random_splats(count, sh_degree=degree)) for count, degree in ((90, 1), (1, 3), (0, 0), (300, 0))]


def merge(scenes: Sequence[Scene], transforms: Sequence[Transform] = ()) -> Reader:
    places = [*transforms, *[Transform()] * len(scenes)]
    return merged([Placed(reader_of(each), f"no. {k}", places[k]) for k, each in enumerate(scenes)])


def assert_same(found: Splats, expected: Splats) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), column)


def padded(splats: Splats) -> Splats:
    sh = np.zeros((len(splats), 15, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)


def test_any_range_is_that_of_the_placed_scenes_one_after_the_other() -> None:
    found = merge(scenes(), TRANSFORMS)
    placements = zip((*TRANSFORMS, Transform()), scenes(), strict=True)
    expected = Splats.concat([transform.apply(padded(each.splats)) for transform, each in placements])
    assert (found.count, found.sh_degree) == (391, 3)
    assert_same(found.scene().splats, expected)
    assert list(found.blocks(5, 5)) == []
    for start, stop in ((0, 391), (89, 92), (90, 91), (91, 391), (390, 391)):
        assert_same(Splats.concat(list(found.blocks(start, stop))), expected.take(slice(start, stop)))


@pytest.mark.parametrize(("flags", "written"), [((1, 0, 0), False), ((0, 0, 1), True), ((1, 1, 0), False)])
def test_most_splats_say_whether_the_whole_is_antialiased(flags: Sequence[int], written: bool) -> None:
    counts = (10, 20, 31)
    parts = [Scene(random_splats(count), antialiased=bool(flag)) for count, flag in zip(counts, flags, strict=True)]
    found = merge(parts)
    assert found.antialiased is written
    some = sum(count for count, flag in zip(counts, flags, strict=True) if flag)
    kind = "antialiased" if written else "not antialiased"
    text = f"{some} of 61 splats are antialiased, and the others are not; all are written as {kind}"
    assert found.notes == (text,)
    alike = merge([dataclasses.replace(each, antialiased=written) for each in scenes()])
    assert (alike.antialiased, alike.notes) == (written, ())


def test_formats_notes_and_errors_name_their_files() -> None:
    one, other = (
        dataclasses.replace(scenes()[0], format=form, notes=notes)
        for form, notes in (("SPZ 3", ("cut to 3",)), ("PLY", ()))
    )
    found = merge([one, other, other])
    assert (found.format, found.notes) == ("PLY and SPZ 3", ("no. 0: cut to 3",))

    def broken(target: RowBuffer, threads: int, progress: Progress) -> None:
        raise FormatError("cut short")

    reader = dataclasses.replace(reader_of(one), fill=broken)
    with pytest.raises(FormatError, match=r"^tile\.ply: cut short$"):
        list(merged([Placed(reader_of(one), "whole.ply"), Placed(reader, "tile.ply")]).blocks())
