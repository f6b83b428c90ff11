"""Validation of splats and trees before they are written, and of trees that were read."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.selection import EXAMINED
from ..model.splats import COLUMNS, UNIT_TOLERANCE, Splats, describe_invalid
from ..support.errors import FormatError, InvalidSplatsError, TreeError
from ..support.parallel import blocks_of, ordered_map
from .kernels.drawable import count_doubtful


def with_sound_tree(scene: Scene) -> Scene:
    """The scene, whose tree is valid if it has one; its leaves have a `child_start` of 0.

    Raises:
        FormatError: its tree is broken.
    """
    if scene.tree is None:
        return scene
    try:
        scene.tree.validate()
    except TreeError as error:
        raise FormatError(f"its Level-of-Detail tree is broken: {error}") from error
    return dataclasses.replace(scene, tree=LodTree(scene.tree.child_count, scene.tree.first_child()))


def is_valid_and_visible(splats: Splats, threads: int) -> tuple[bool, bool]:
    """Whether splats are beyond doubt valid, and visible; where not, `Splats.invalid` and `Selection` tell.

    Rounding differs from theirs, so a rotation has to be nearer to a unit one.
    """
    tolerance = np.float32(UNIT_TOLERANCE / 2)

    def counts(part: slice) -> tuple[int, int]:
        columns = (getattr(splats, name)[part].reshape(-1) for name in COLUMNS)
        doubtful, invisible = count_doubtful(*columns, tolerance)
        return int(doubtful), int(invisible)

    found = list(ordered_map(counts, blocks_of(len(splats), EXAMINED), threads))
    return not any(doubtful for doubtful, _ in found), not any(invisible for _, invisible in found)


def check_valid(splats: Splats, threads: int) -> None:
    """Check that splats can be written.

    Raises:
        InvalidSplatsError: one is invalid.
    """
    if not is_valid_and_visible(splats, threads)[0] and (invalid := splats.invalid()):
        raise InvalidSplatsError(f"{describe_invalid(invalid)}; such splats are not written, leave them out")


def check_scene(scene: Scene, threads: int) -> None:
    """Check that a scene can be written: `check_valid`, and its tree if it has one.

    Raises:
        InvalidSplatsError: a splat is invalid.
        TreeError: the tree is broken, or of another number of nodes.
    """
    if scene.tree is not None:
        if len(scene.tree) != len(scene.splats):
            raise TreeError(f"the tree has {len(scene.tree):,} nodes, but there are {len(scene.splats):,} splats")
        scene.tree.validate()
    check_valid(scene.splats, threads)
