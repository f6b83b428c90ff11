"""Several scenes as one: the same as each of them placed, one after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from sparklod_cli.codecs.merging import Placed, merged
from sparklod_cli.codecs.reader import Reader, Target
from sparklod_cli.model.gaussian import placed
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError
from sparklod_cli.system.progress import Progress
from tests.bake.jobs import reader_of
from tests.scenes import random_splats

TRANSFORMS = (
    Transform(),
    Transform.from_parts(up="z", rotate=(10, 20, 30), scale=2.5, translate=(1, -2, 3)),
    Transform(translation=np.array([100.0, 0, 0])),
)


def scenes() -> list[Scene]:
    """Of different sizes and degrees, one of them without splats."""
    return [Scene(random_splats(count, sh_degree=degree)) for count, degree in ((90, 1), (1, 3), (0, 0), (300, 0))]


def merge(scenes: Sequence[Scene], transforms: Sequence[Transform] = ()) -> Reader:
    places = [*transforms, *[Transform()] * len(scenes)]
    return merged([Placed(reader_of(each), f"no. {k}", places[k]) for k, each in enumerate(scenes)])


def assert_same(found: Splats, expected: Splats) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), column)


def padded(splats: Splats, coefficients: int) -> Splats:
    sh = np.zeros((len(splats), coefficients, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)


def test_any_range_is_that_of_the_placed_scenes_one_after_the_other() -> None:
    given = scenes()
    found = merge(given, TRANSFORMS)
    parts = [padded(each.splats, 15) for each in given]
    expected = Splats.concat([place.apply(part) for place, part in zip((*TRANSFORMS, Transform()), parts, strict=True)])
    assert (found.count, found.sh_degree) == (391, 3)
    assert_same(found.scene().splats, expected)
    for start, stop in ((0, 391), (5, 5), (89, 92), (90, 91), (91, 391), (390, 391)):
        pieces = list(found.blocks(start, stop))
        if start < stop:
            assert_same(Splats.concat(pieces), expected.take(slice(start, stop)))
        else:
            assert pieces == []


def test_an_instance_places_splats_where_pictures_have_them() -> None:
    """And turns their SH, which a picture does by turning the camera instead."""
    for transform in TRANSFORMS:
        source = random_splats(50, sh_degree=0)
        instance = Instance(Scene(source), object_to_world=transform.matrix)
        found, expected = instance.transform.apply(source), placed(source, transform.matrix)
        np.testing.assert_allclose(found.center, expected.center, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-5)
        same = np.abs(np.einsum("ij,ij->i", found.quat_xyzw, expected.quat_xyzw))
        np.testing.assert_allclose(same, 1, atol=1e-5)


def test_a_matrix_that_is_a_bit_askew_gets_the_nearest_rotation() -> None:
    matrix = TRANSFORMS[1].matrix
    matrix[:3, :3] += 5e-4 * np.random.default_rng(3).normal(size=(3, 3))
    near = Instance(scenes()[0], object_to_world=matrix).transform
    np.testing.assert_allclose(near.rotation.T @ near.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(near.matrix, matrix, atol=2e-3)
    assert Instance(scenes()[0]).transform.is_identity


@pytest.mark.parametrize("scale", [1e12, 1e-12])
def test_the_largest_and_smallest_scales_of_an_instances_file_are_possible(scale: float) -> None:
    turned = Transform.from_euler(1, 2, 3)
    matrix = dataclasses.replace(turned, scale=scale).matrix
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


@pytest.mark.parametrize("antialiased", [False, True])
def test_scenes_that_agree_need_no_note(antialiased: bool) -> None:
    found = merge([dataclasses.replace(each, antialiased=antialiased) for each in scenes()])
    assert (found.antialiased, found.notes) == (antialiased, ())


def test_formats_notes_and_errors_tell_where_they_come_from() -> None:
    one, other = (
        dataclasses.replace(scenes()[0], format=form, notes=notes)
        for form, notes in (("SPZ 3", ("cut to 3",)), ("PLY", ()))
    )
    found = merge([one, other, other])
    assert (found.format, found.notes) == ("PLY and SPZ 3", ("no. 0: cut to 3",))

    def broken(target: Target, threads: int, progress: Progress) -> None:
        raise FormatError("cut short")

    reader = dataclasses.replace(reader_of(one), fill=broken)
    with pytest.raises(FormatError, match=r"^tile\.ply: cut short$"):
        list(merged([Placed(reader_of(one), "whole.ply"), Placed(reader, "tile.ply")]).blocks())
