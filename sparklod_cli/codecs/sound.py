"""What decoding adds to examining: a tree must be sound."""

from __future__ import annotations

from ..model.scene import Scene
from ..support.errors import FormatError, TreeError


def with_sound_tree(scene: Scene) -> Scene:
    """The scene, whose tree is valid if it has one.

    Raises:
        FormatError: its tree is broken.
    """
    if scene.tree is not None:
        try:
            scene.tree.validate()
        except TreeError as error:
            raise FormatError(f"its Level-of-Detail tree is broken: {error}") from error
    return scene
