"""The instances file: JSON that names splat files and says where they stand."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.pose import rotation_of
from ..io import is_file_name, read_text
from ..model.foveation import Cones, Foveation, Frustum
from ..model.instances import TOTAL, Instance, Matrix, names_of
from ..model.transforms import LARGEST, scale_of
from ..system.errors import SparklodError
from ..system.untrusted import parse_json, quoted_value, well_formed

#: What an instance may say, and how many numbers that is; 0 for something else.
KEYS = {"file": 0, "name": 0, "matrix": 16, "translation": 3, "rotation": 4, "scale": 1, "lod_scale": 1, "foveation": 0}

#: How far the axes of a matrix may be from right angles and one length.
SKEW = 1e-3

#: Degrees of a whole cone.
WIDEST = 180


class InstancesFileError(SparklodError):
    """An instances file cannot be understood."""


def read_instances(path: Path | str) -> list[Instance]:
    """Read the instances of a file; paths in it are relative to its folder.

    Raises:
        InstancesFileError: it says something that is not an instance; names the file and the instance.
        FormatError: it cannot be read.
    """
    path = Path(path)
    try:
        data = parse_json(read_text(path), keep_surrogates=True)  # files may be called so
    except ValueError as error:
        raise InstancesFileError(f"{path} is not JSON: {error}") from None
    instances = data.get("instances") if isinstance(data, dict) else None
    if not isinstance(instances, list) or not instances:
        raise InstancesFileError(f'{path} has no list of instances: {{"instances": [{{"file": ...}}, ...]}}')
    found: list[Instance] = []
    try:
        found.extend(_instance(instance, path.parent) for instance in instances)
    except ValueError as error:
        raise InstancesFileError(f"{path}: instance {len(found)} {error}") from None
    given = Counter(each.name for each in found if each.name)
    twice = next((name for name, count in given.items() if count > 1), None)
    if twice is not None:
        raise InstancesFileError(f"{path}: two instances are called {twice!r}")
    automatic = iter(names_of([each.file for each in found if each.file and not each.name], given))
    return [each if each.name else replace(each, name=next(automatic)) for each in found]


def _instance(data: Any, folder: Path) -> Instance:
    """Return one instance, its name empty where it has none; `ValueError` where it is none."""
    if not isinstance(data, dict):
        raise ValueError(f"is {quoted_value(data)}, not an object")
    for key in data:
        if key not in KEYS:
            raise ValueError(f"has {quoted_value(key)}, which is not one of {', '.join(KEYS)}")
    file, name = data.get("file"), data.get("name", "")
    if not isinstance(file, str) or not file:
        raise ValueError("names no file")
    if not is_file_name(file):
        raise ValueError(f"names the file {quoted_value(file)}, which no file can be called")
    if not isinstance(name, str) or name == TOTAL:
        raise ValueError(f"cannot be called {quoted_value(name)}")
    lod_scale = _numbers(data, "lod_scale", [1.0])[0]
    if lod_scale < 0:
        raise ValueError(f"has a lod_scale of {lod_scale:g}")
    return Instance(folder / file, well_formed(name), _matrix(data), lod_scale, _foveation(data.get("foveation")))


def _matrix(data: Mapping[str, Any]) -> Matrix:
    """Return the (4, 4) matrix of a matrix, or of scale, rotation and translation."""
    if "matrix" not in data:
        x, y, z, w = _numbers(data, "rotation", [0, 0, 0, 1])
        scale = _numbers(data, "scale", [1.0])[0]
        if not scale >= 1 / LARGEST:
            raise ValueError(f"has a scale of {scale:g}, which is {'too little' if scale > 0 else 'not more than 0'}")
        matrix = np.eye(4)
        matrix[:3, :3] = scale * rotation_of([w, x, y, z])
        matrix[:3, 3] = _numbers(data, "translation", [0, 0, 0])
        return matrix
    if data.keys() & {"translation", "rotation", "scale"}:
        raise ValueError("has a matrix, and parts of one too")
    matrix = np.array(_numbers(data, "matrix", [])).reshape(4, 4)
    found = scale_of(matrix, SKEW)
    if found is None or found < 1 / LARGEST:
        raise ValueError("has a matrix that is no rotation, uniform scale and translation, row by row")
    return matrix


def _foveation(data: Any) -> Foveation | None:
    if data is None:
        return None
    if not isinstance(data, dict):
        raise ValueError(f"has a foveation of {quoted_value(data)}")
    kinds: dict[type[Cones | Frustum], dict[str, str]] = {
        Frustum: {"outside_foveate": "outside", "behind_foveate": "behind"},
        Cones: {"cone_fov0": "fov0", "cone_fov": "fov", "cone_foveate": "foveate", "behind_foveate": "behind"},
    }
    kind = Frustum if "outside_foveate" in data else Cones
    for key in data:
        if key not in kinds[kind]:
            raise ValueError(f"has {quoted_value(key)} in its foveation, which is not one of {', '.join(kinds[kind])}")
    values = {field: _numbers(data, key, [0.0])[0] for key, field in kinds[kind].items() if key in data}
    if any(value < 0 for value in values.values()):
        raise ValueError("has a negative foveation")
    if max(values.get("fov0", 0), values.get("fov", 0)) > WIDEST:
        raise ValueError(f"has a cone of more than {WIDEST} degrees in its foveation")
    return kind(**values)


def _numbers(data: Mapping[str, Any], key: str, default: list[float]) -> list[float]:
    """Return the finite numbers of a key, as many as it has."""
    value = data.get(key, default)
    flat = value if isinstance(value, list) else [value]
    if key == "matrix" and len(flat) == 4 and all(isinstance(row, list) for row in flat):
        flat = [number for row in flat for number in row]
    count = KEYS.get(key, 1)
    plain = all(isinstance(number, (int, float)) and not isinstance(number, bool) for number in flat)
    if len(flat) != count or not plain or not all(-math.inf < number < math.inf for number in flat):
        raise ValueError(f"has {key} {quoted_value(value)}, which is not {count} finite number{'s' * (count > 1)}")
    if any(abs(number) > LARGEST for number in flat):
        raise ValueError(f"has {key} {quoted_value(value)}, which is beyond {LARGEST:g}")
    return [float(number) for number in flat]
