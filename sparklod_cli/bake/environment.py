"""The environment of a scene at several detail levels: splats of the scene that are far outside, or those of a file."""

from __future__ import annotations

from ..io import read_scene
from ..model.selection import Selection
from ..model.splats import Splats
from ..support.errors import FormatError, InvalidSplatsError
from ..support.progress import Progress
from .checks import transformed
from .settings import BakeSettings


def read_environment(settings: BakeSettings, *, threads: int, progress: Progress) -> Splats | None:
    """The environment of the file that the settings name, turned and moved as the scene; None where they name none.

    Raises:
        FormatError, InvalidSplatsError: it cannot be read, is a tree, or has invalid splats; names it.
    """
    path = settings.environment
    if path is None:
        return None
    try:
        scene = read_scene(path, threads=threads, progress=progress)
        if scene.tree is not None:
            raise FormatError("it is a Level-of-Detail file; give the splats that its tree was built from")
        selection = Selection(drop_invalid=settings.selection.drop_invalid)
        kept, _ = selection.apply(scene.splats.with_max_sh(settings.max_sh))
        return transformed(kept, settings.transform)
    except (FormatError, InvalidSplatsError) as error:
        raise type(error)(f"the environment {path}: {error}") from None


def divided(splats: Splats, settings: BakeSettings) -> tuple[Splats, Splats | None]:
    """The splats of a scene, and those that become its environment; None where there are none.

    Raises:
        InvalidSplatsError: all of them would.
    """
    if settings.environment_beyond is None:
        return splats, None
    from ..lod.regions import beyond

    far = beyond(splats, settings.environment_beyond)
    return (splats.take(~far), splats.take(far)) if far.any() else (splats, None)
