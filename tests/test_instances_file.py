"""Instances files, which --scene names: their keys, and errors of one line for everything else."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.instances import Instance
from sparklod_cli.system.errors import FormatError, SparklodError
from sparklod_cli.viewers.instances_file import KEYS, InstancesFileError, read_instances


def written(path: Path, *instances: object) -> list[Instance]:
    path.write_text(json.dumps({"instances": instances}))
    return read_instances(path)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return tmp_path / "scene.json"


def test_an_instance_needs_only_its_file_which_may_be_anywhere(scene: Path) -> None:
    place, *others = written(scene, {"file": "trees/door.spz"}, {"file": "/srv/a.spz"}, {"file": "../b.spz"})
    assert place.file == scene.parent / "trees" / "door.spz"
    assert (place.name, place.lod_scale, place.foveation) == ("door", 1.0, None)
    assert np.array_equal(place.object_to_world, np.eye(4))
    assert [other.file for other in others] == [Path("/srv/a.spz"), scene.parent / "../b.spz"]


def test_every_key_of_an_instance_is_used(scene: Path) -> None:
    turn = [0, math.sqrt(0.5), 0, math.sqrt(0.5)]  # a quarter around y: z goes to x
    foveation = {"outside_foveate": 0.25, "behind_foveate": 0.125}
    keys = {"name": "west wing", "translation": [1, 2, 3], "rotation": turn, "scale": 2, "lod_scale": 0.5}
    (place,) = written(scene, {"file": "a.spz", "foveation": foveation} | keys)
    assert (place.name, place.lod_scale, place.foveation) == ("west wing", 0.5, Frustum(0.25, 0.125))
    assert np.allclose(place.object_to_world, [[0, 0, 2, 1], [0, 2, 0, 2], [-2, 0, 0, 3], [0, 0, 0, 1]], atol=1e-12)
    assert set(KEYS) == {"file", "foveation", "matrix", *keys}


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"cone_fov0": 90, "cone_fov": 120, "cone_foveate": 0.4, "behind_foveate": 0.2}, Cones(90, 120, 0.4, 0.2)),
        ({}, Cones()),
        ({"behind_foveate": 0.5}, Cones(behind=0.5)),
        ({"outside_foveate": 0}, Frustum(0, 1)),
        (None, None),
    ],
)
def test_a_foveation_is_of_cones_or_a_frustum_by_its_keys(keys: Any, expected: Any, scene: Path) -> None:
    assert written(scene, {"file": "a.spz", "foveation": keys})[0].foveation == expected


numbers = st.floats(-1e3, 1e3)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.tuples(numbers, numbers, numbers),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda quat: math.hypot(*quat) > 1e-3),
    st.floats(1e-3, 1e3),
)
def test_a_matrix_says_the_same_as_its_parts(
    scene: Path, translation: tuple[float, ...], rotation: tuple[float, ...], scale: float
) -> None:
    parts = {"file": "a.spz", "translation": translation, "rotation": rotation, "scale": scale}
    (first,) = written(scene, parts)
    rows = first.object_to_world.tolist()
    for matrix in (rows, [number for row in rows for number in row]):
        (second,) = written(scene, {"file": "a.spz", "matrix": matrix})
        assert np.array_equal(second.object_to_world, first.object_to_world)
    x, y, z, w = np.array(rotation) / math.hypot(*rotation)
    for point in np.eye(3):  # turned by q p q*, multiplied out as cross products
        turned = point + 2 * np.cross([x, y, z], np.cross([x, y, z], point) + w * point)
        expected = scale * turned + translation
        assert np.allclose(first.object_to_world @ [*point, 1], [*expected, 1], rtol=1e-9, atol=1e-9)


def test_names_are_given_where_there_are_none(scene: Path) -> None:
    named = [{"file": "b.spz", "name": "a"}, {"file": "b.spz", "name": ""}]
    places = written(scene, *({"file": name} for name in ("a.spz", "x/a.spz", "total.spz", "a 2.spz")), *named)
    assert [place.name for place in places] == ["a 2", "a 3", "total.spz", "a 2 2", "a", "b"]
    many = written(scene, *({"file": "a.spz"} for _ in range(30_000)))  # in no time
    assert len({place.name for place in many}) == 30_000


WRONG: list[tuple[object, str]] = [
    ({}, "file: expected a text, but it is missing"),
    ({"file": ""}, "file: expected the name of a file, not ''"),
    ({"file": 3}, "file: expected a text, not 3"),
    ({"file": "a\0b.spz"}, "expected the name of a file"),
    ({"file": "a\ud800.spz"}, "expected the name of a file"),
    ("a.spz", "expected an object, not 'a.spz'"),
    (None, "expected an object, but it is missing"),
    ([], "expected an object, not []"),
    ({"path": "a.spz"}, "'path' is not one of file, name"),
    ({"file": "a.spz", "two\nlines": 1}, r"'two\nlines' is not one of"),
    ({"file": "a.spz", "name": 7}, "name: expected a text, not 7"),
    ({"file": "a.spz", "name": "total"}, "name: expected another name, not 'total'"),
    ({"file": "a.spz", "scale": 0}, "scale: expected a number from 1e-12 on, not 0"),
    ({"file": "a.spz", "scale": -2}, "scale: expected a number from 1e-12 on, not -2"),
    ({"file": "a.spz", "scale": 1e-300}, "scale: expected a number from 1e-12 on, not 1e-300"),
    ({"file": "a.spz", "scale": 1e300}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "scale": 10**400}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "scale": math.inf}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "scale": [1, 2, 3]}, "scale: expected a list of 1 numbers, not [1, 2, 3]"),
    ({"file": "a.spz", "scale": True}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "scale": None}, "scale: null is no value; leave it out"),
    ({"file": "a.spz", "translation": [1, 2]}, "translation: expected a list of 3 numbers, not [1, 2]"),
    ({"file": "a.spz", "translation": [1, 2, math.nan]}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "translation": ["1", 2, 3]}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "translation": [[1, 2, 3]]}, "expected a list of 3 numbers"),
    ({"file": "a.spz", "translation": [1, 2, 1e39]}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "rotation": [0, 0, 0]}, "expected a list of 4 numbers"),
    ({"file": "a.spz", "rotation": [0, 0, 0, 0]}, "has a quaternion of length 0"),
    ({"file": "a.spz", "lod_scale": -1}, "lod_scale: expected a number of 0 or more, not -1"),
    ({"file": "a.spz", "lod_scale": "x" * 1000}, "expected a number up to 1e+12"),
    ({"file": "a.spz", "matrix": [1] * 15}, "expected a list of 16 numbers"),
    ({"file": "a.spz", "matrix": [1] * 16}, "it is no rotation, uniform scale and translation, row by row"),
    ({"file": "a.spz", "matrix": [0] * 16}, "is no rotation"),
    ({"file": "a.spz", "matrix": np.diag([1, 1, -1, 1]).tolist()}, "is no rotation"),
    ({"file": "a.spz", "matrix": np.diag([1, 1, 1.01, 1]).tolist()}, "is no rotation"),
    ({"file": "a.spz", "matrix": np.diag([1e-200, 1e-200, 1e-200, 1]).tolist()}, "is no rotation"),
    ({"file": "a.spz", "matrix": [*np.eye(4)[:3].ravel(), 1, 2, 3, 1]}, "row by row"),
    ({"file": "a.spz", "matrix": np.eye(4).tolist(), "scale": 2}, "has a matrix, and parts of one too"),
    ({"file": "a.spz", "foveation": 0.5}, "foveation: expected an object, not 0.5"),
    ({"file": "a.spz", "foveation": {"cone": 1}}, "foveation: 'cone' is not one of cone_fov0"),
    ({"file": "a.spz", "foveation": {"outside_foveate": 1, "cone_fov": 90}}, "foveation: 'cone_fov' is not one of"),
    ({"file": "a.spz", "foveation": {"behind_foveate": -1}}, "behind_foveate: expected a number of 0 or more, not -1"),
    ({"file": "a.spz", "foveation": {"cone_fov": 181}}, "has a cone of more than 180 degrees"),
    ({"file": "a.spz", "foveation": {"cone_fov": "wide"}}, "expected a number up to 1e+12"),
]


@pytest.mark.parametrize(("wrong", "said"), WRONG, ids=[said[:30] for _, said in WRONG])
def test_a_mistake_is_told_in_a_line(wrong: object, said: str, scene: Path) -> None:
    with pytest.raises(InstancesFileError) as caught:
        written(scene, {"file": "good.spz"}, wrong)
    text = str(caught.value)
    assert text.startswith(f"{scene}: instances[1]")
    assert said in text
    assert "\n" not in text
    assert len(text) < len(str(scene)) + 250


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ('{"instances": [{"file": "a.spz"}', "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("9" * 10_000, ""),
        *(
            ('{"instances": [{"file": "a", "scale": ' + "[" * depth + "]" * depth + "}]}", "")
            for depth in range(900, 1000, 7)
        ),
        ("[]", "has no list of instances"),
        ("{}", "has no list of instances"),
        ('{"instances": []}', "has no list of instances"),
        ('{"instances": {"file": "a.spz"}}', "has no list of instances"),
        ('{"instances": [{"file": "a", "name": "b"}, {"file": "c", "name": "b"}]}', "two instances are called 'b'"),
    ],
    ids=lambda value: value[:20],
)
def test_files_that_are_not_instances_files_are_refused_in_one_line(text: str, said: str, scene: Path) -> None:
    scene.write_text(text)
    with pytest.raises(InstancesFileError) as caught:
        read_instances(scene)
    assert str(caught.value).startswith(str(scene))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unreadable_instances_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "missing.json", tmp_path, tmp_path / "bytes.json"):
        with pytest.raises(FormatError, match="cannot be read") as caught:
            read_instances(path)
        assert str(caught.value).startswith(str(path))
    with pytest.raises(SparklodError, match="it is a pipe or a device"):
        read_instances(Path("/dev/zero"))
    monkeypatch.setattr("sparklod_cli.io.files.MAX_TEXT", 100)
    (tmp_path / "large.json").write_bytes(b" " * 101)
    with pytest.raises(SparklodError, match=r"large\.json is larger than"):
        read_instances(tmp_path / "large.json")


def test_a_byte_order_mark_is_no_mistake(scene: Path) -> None:
    scene.write_bytes(b'\xef\xbb\xbf{"instances": [{"file": "a.spz"}]}')
    assert len(read_instances(scene)) == 1


cells = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
anything = st.recursive(
    cells, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
)
lists = st.lists(st.integers(-2, 2) | st.floats(), min_size=1, max_size=16)
some_instances = st.dictionaries(st.sampled_from([*KEYS, "cone_fov", "outside_foveate"]), anything | lists, max_size=5)
optional = dict.fromkeys(list(KEYS)[1:], anything | lists)
plausible = st.fixed_dictionaries({"file": st.text(min_size=1)}, optional=optional)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@given(anything | st.fixed_dictionaries({"instances": st.lists(some_instances | plausible | anything, max_size=3)}))
def test_any_instances_file_is_read_or_refused_in_one_line(scene: Path, data: Any) -> None:
    scene.write_text(json.dumps(data))
    try:
        places = read_instances(scene)
    except SparklodError as error:
        assert str(error).startswith(str(scene))
        assert "\n" not in str(error)
    else:
        assert len({place.name for place in places}) == len(places)
        for place in places:
            assert np.isfinite(np.linalg.inv(place.object_to_world).astype(np.float32)).all()
