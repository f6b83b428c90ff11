"""Baked trees as arrays of words in the layouts of viewers, for engines that upload them unchanged."""

from __future__ import annotations

import io
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from .table import ENCODINGS

Arrays = dict[str, NDArray[Any]]


def pack(scene: Scene, encoding: str, threads: int = 1) -> Arrays:
    """The arrays of a scene in one of `table.ENCODINGS`, by their names: uint32 words, see docs/formats.md."""
    module = import_module(f".{ENCODINGS[encoding]}", __package__)
    arrays: Arrays = module.dump(scene, threads=threads)
    return arrays


def encode_npz(arrays: Arrays) -> Iterator[bytes]:
    """The bytes of a .npz file of these arrays; the same arrays give the same bytes."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    yield file.getvalue()


def encode_raw(arrays: Arrays) -> Iterator[bytes]:
    """The little-endian words of all the arrays, one after the other."""
    for words in arrays.values():
        yield words.astype("<u4", copy=False).tobytes()
