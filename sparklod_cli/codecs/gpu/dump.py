"""Baked trees as arrays of words in the layouts of viewers, for engines that upload them as they are."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from . import data_texture, ext_splats, lod_tree, packed_splats

Arrays = dict[str, NDArray[Any]]


def _packed(scene: Scene, threads: int) -> Arrays:
    encoding = packed_splats.Encoding(lod_opacity=scene.tree is not None)
    return dict(packed_splats.pack(scene.splats, encoding, threads=threads))


def _ext(scene: Scene, threads: int) -> Arrays:
    return dict(ext_splats.pack(scene.splats, threads=threads))


def _lod_tree(scene: Scene, threads: int) -> Arrays:
    if scene.tree is None:
        raise ValueError("the scene has no tree")
    return dict(lod_tree.pack(scene.splats, scene.tree, threads=threads))


def _texture(scene: Scene, threads: int) -> Arrays:
    return dict(data_texture.pack(scene.splats, threads=threads))


#: By the name that the command line knows (`defaults.ENCODINGS`).
PACKERS: dict[str, Callable[[Scene, int], Arrays]] = {
    "packed": _packed,
    "ext": _ext,
    "lodtree": _lod_tree,
    "texture": _texture,
}


def pack(scene: Scene, encoding: str, threads: int = 1) -> Arrays:
    """The arrays of one of `PACKERS` by their names: uint32 words, see docs/formats.md."""
    return PACKERS[encoding](scene, threads)


def encode_npz(arrays: Arrays) -> Iterator[bytes]:
    """The bytes of a .npz file of these arrays; the same arrays give the same bytes."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    yield file.getvalue()


def encode_raw(arrays: Arrays) -> Iterator[bytes]:
    """The little-endian words of all the arrays, one after the other."""
    for words in arrays.values():
        yield words.astype("<u4", copy=False).tobytes()
