"""A matrix that leads from one world to another."""

from __future__ import annotations

import re

import numpy as np

from ..support.errors import CameraPathError
from ..support.untrusted import parse_json
from .camera import Matrix
from .formats.source import Json, finite
from .pose import rigid


def similarity(text: str) -> Matrix:
    """(4, 4): a rotation, a uniform scale and a translation, of 16 numbers row by row.

    Args:
        text: the numbers, with commas or white space between, or JSON: a list of them, or of rows of them.

    Raises:
        CameraPathError: they are something else; its text goes on a sentence about them.
    """
    words = re.split(r"[\s,;]+", text.strip())
    try:
        if text.lstrip().startswith("["):
            numbers = Json(parse_json(text), "matrix").matrix(4)
        else:
            numbers = [finite(word, "matrix") for word in words]
    except ValueError:
        raise CameraPathError("is not JSON") from None
    if len(numbers) != 16:
        raise CameraPathError(f"has {len(numbers)} numbers, not 16")
    matrix = np.array(numbers).reshape(4, 4)
    try:
        rigid(matrix)
    except ValueError as error:
        raise CameraPathError(f"{error}") from None
    return matrix
