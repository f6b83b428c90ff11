"""`--world-transform`: a matrix from the world of cameras to that of splats."""

from __future__ import annotations

import re

import numpy as np

from ..support.errors import CameraPathError
from ..support.untrusted import parse_json
from .camera import Matrix
from .formats.source import Json, finite
from .pose import rigid


def similarity(text: str) -> Matrix:
    """A (4, 4) matrix of a rotation, a uniform scale and a translation from 16 numbers, row by row.

    Args:
        text: the numbers, separated by commas or white space, or JSON: a list of them or of rows.

    Raises:
        CameraPathError: the text is something else; that of the error continues a sentence about it.
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
