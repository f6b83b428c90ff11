"""The instances file: JSON with splat files and their positions in the world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..cameras.camera import rotation_of
from ..io.files import is_file_name, read_text
from ..model import TOTAL
from ..model.foveation import Cones, Foveation, Frustum
from ..model.instances import Instance, Matrix, names_of
from ..model.transforms import LARGEST, scale_of
from ..system.errors import SparklodError
from ..system.untrusted import Json, Origin, quoted_value, well_formed

#: Keys of an instance.
PARTS = ("translation", "rotation", "scale")
KEYS = ("file", "name", "matrix", *PARTS, "lod_scale", "foveation")

#: Kinds of foveation: fields by their keys.
FRUSTUM = {"outside_foveate": "outside", "behind_foveate": "behind"}
CONES = {"cone_fov0": "fov0", "cone_fov": "fov", "cone_foveate": "foveate", "behind_foveate": "behind"}

#: Largest deviation of the axes of a matrix from right angles and one length, see `scale_of`.
SKEW = 1e-3

#: Degrees of a whole cone.
WIDEST = 180


class InstancesFileError(SparklodError):
    """An instances file is invalid."""


def read_instances(path: Path | str) -> list[Instance]:
    """Read the instances of a file; paths in it are relative to its folder.

    Raises:
        InstancesFileError: the file, or an instance in it, is invalid; the message names both.
        FormatError: the file cannot be read.
    """
    path = Path(path)

    def error(problem: str) -> InstancesFileError:
        return InstancesFileError(f"{path}: {problem}")

    root = Json.parse(read_text(path), Origin("", error), keep_surrogates=True)  # in names of files
    listed = root.value.get("instances") if isinstance(root.value, dict) else None
    if not isinstance(listed, list) or not listed:
        raise error('it has no list of instances: {"instances": [{"file": ...}, ...]}')
    found = [_instance(item, path.parent) for item in root.items("instances")]
    given = Counter(each.name for each in found if each.name)
    twice = next((name for name, count in given.items() if count > 1), None)
    if twice is not None:
        raise error(f"two instances are called {twice!r}")
    automatic = iter(names_of([each.file for each in found if each.file and not each.name], given))
    return [each if each.name else replace(each, name=next(automatic)) for each in found]


def _instance(item: Json, folder: Path) -> Instance:
    _check_keys(item, KEYS)
    file, name = item.text("file"), item.optional("name", Json.text, "")
    if not file or not is_file_name(file):
        raise item.get("file").unexpected("the name of a file")
    if name == TOTAL:
        raise item.get("name").unexpected("another name")
    lod_scale = item.optional("lod_scale", _at_least_0, 1.0)
    return Instance(folder / file, well_formed(name), _matrix(item), lod_scale, item.optional("foveation", _foveation))


def _check_keys(item: Json, known: Collection[str]) -> None:
    """Check that an object has known keys only, and that none but "foveation" is null."""
    if not isinstance(item.value, dict):
        raise item.unexpected("an object")
    for key, value in item.value.items():
        if key not in known:
            raise item.error(f"{quoted_value(key)} is not one of {', '.join(known)}")
        if value is None and key != "foveation":
            raise item.get(key).error("null is no value; leave it out")


def _matrix(item: Json) -> Matrix:
    if item.has("matrix"):
        if any(map(item.has, PARTS)):
            raise item.error("it has a matrix, and parts of one too")
        matrix = np.array(item.get("matrix").matrix(4, most=LARGEST)).reshape(4, 4)
        found = scale_of(matrix, SKEW)
        if found is None or found < 1 / LARGEST:
            raise item.get("matrix").error("it is no rotation, uniform scale and translation, row by row")
        return matrix
    x, y, z, w = item.optional("rotation", lambda each: each.numbers(4, most=LARGEST), [0.0, 0.0, 0.0, 1.0])
    scale = item.optional("scale", _number, 1.0)
    if not scale >= 1 / LARGEST:
        raise item.get("scale").unexpected(f"a number from {1 / LARGEST:g} on")
    matrix = np.eye(4)
    try:
        matrix[:3, :3] = scale * rotation_of([w, x, y, z])
    except ValueError as error:
        raise item.error(f"it {error}") from None
    matrix[:3, 3] = item.optional("translation", lambda each: each.numbers(3, most=LARGEST), [0.0, 0.0, 0.0])
    return matrix


def _foveation(item: Json) -> Foveation:
    is_frustum = item.has("outside_foveate")
    fields = FRUSTUM if is_frustum else CONES
    _check_keys(item, fields)
    values = {fields[key]: _at_least_0(value) for key, value in item.entries()}
    if max(values.get("fov0", 0), values.get("fov", 0)) > WIDEST:
        raise item.error(f"it has a cone of more than {WIDEST} degrees")
    return Frustum(**values) if is_frustum else Cones(**values)


def _number(item: Json) -> float:
    """Return a number, which may be the only item of a list."""
    return item.numbers(1, most=LARGEST)[0] if isinstance(item.value, list) else item.number(most=LARGEST)


def _at_least_0(item: Json) -> float:
    if (number := _number(item)) < 0:
        raise item.unexpected("a number of 0 or more")
    return number
