"""Files of a baked tree as arrays of words in the layouts of viewers, for engines that upload them as they are."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from ...support.progress import Progress, silent
from ..encoded import Encoded, EncodeOptions
from .encodings import layout

Arrays = dict[str, NDArray[Any]]


def check(scene: Scene, options: EncodeOptions) -> None:
    """Nothing is refused: what a code cannot hold is clamped."""


def encode(scene: Scene, options: EncodeOptions, *, progress: Progress = silent) -> Encoded:
    """A .npz of the arrays of `options.encoding`, or their words alone if the options say `raw`.

    Raises:
        FormatError: the layout has no place for something of the scene.
        ValueError: the scene has no tree, and the layout is one of trees.
    """
    if options.encoding is None:
        raise ValueError("an array file needs an encoding")
    arrays: Arrays = layout(options.encoding).arrays(scene, threads=options.threads)
    pieces = _raw(arrays) if options.raw else _npz(arrays)
    return Encoded(pieces, arrays={name: words.shape for name, words in arrays.items()})


def _npz(arrays: Arrays) -> Iterator[bytes]:
    """The same arrays give the same bytes."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    yield file.getvalue()


def _raw(arrays: Arrays) -> Iterator[bytes]:
    """Little-endian, one array after the other."""
    for words in arrays.values():
        yield words.astype("<u4", copy=False).tobytes()
