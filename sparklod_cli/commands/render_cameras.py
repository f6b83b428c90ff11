"""The cameras of `sparklod render`: those of the options that commands share, and views of its own."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import click

from .camera_options import SOURCES, cameras_from
from .usage import exclude, is_given

if TYPE_CHECKING:
    from ..cameras.path import CameraPath
    from ..model.balls import Balls
    from ..render.settings import RasterSettings

#: Sources of cameras that are chosen for the scene, where nobody says how far away they are.
CHOSEN = ("orbit", "dolly")

#: Options that say which frames a path has.
OF_PATHS = ("fps", "every")


def least_cameras(settings: Mapping[str, Any]) -> int:
    """How many cameras there are, or are at least, as far as that can be told before a file is read."""
    if settings["views"]:
        return len(settings["views"])
    if settings["dolly"] or settings["keyframes"]:
        return 2 if settings["every"] == 1 else 1
    return -(-(settings["orbit"] or 1) // settings["every"])


def check_cameras(ctx: click.Context, settings: Mapping[str, Any]) -> None:
    """Raises a `click.UsageError` where options of cameras contradict each other, or mean nothing here."""
    given = [option for name, option in SOURCES.items() if settings[name]]
    if settings["views"] and given:
        raise click.UsageError(f"--view and {' and '.join(given)} cannot go together")
    if settings["views"] or not given:
        exclude(ctx, OF_PATHS, "a camera that does not move")


def is_free(settings: Mapping[str, Any]) -> bool:
    """Whether nobody says where the camera is."""
    return not any(settings[name] for name in (*SOURCES, "views", "center", "distance"))


def framed(
    ctx: click.Context, settings: Mapping[str, Any], look: RasterSettings, scene: Callable[[], Balls]
) -> tuple[CameraPath, RasterSettings]:
    """The cameras, and a look in whose reach they have the scene where they were chosen for it.

    Args:
        ctx: of the command.
        settings: of its options.
        look: that they ask for.
        scene: gives what the splats cover; called only where cameras are chosen by it.
    """
    from ..cameras.framing import reach

    scene = functools.cache(scene)
    path = _cameras(settings, scene)
    chosen = not settings["views"] and all(name in CHOSEN for name in SOURCES if settings[name])
    if chosen and not settings["distance"] and not is_given(ctx, "near") and not is_given(ctx, "far"):
        near, far = reach(look.near, look.far, path.cameras, scene())
        look = dataclasses.replace(look, near=near, far=far)
    return path, look


def _cameras(settings: Mapping[str, Any], scene: Callable[[], Balls]) -> CameraPath:
    """The cameras of a source, or of each --view, named after it; without any, one that sees the whole scene."""
    if not settings["views"]:
        if not is_free(settings):
            return cameras_from(settings, scene, orbit=1)
        from ..cameras.framing import covered, fitted

        path = cameras_from({**settings, "center": (0.0, 0.0, 0.0), "distance": 1.0}, scene, orbit=1)
        return dataclasses.replace(path, cameras=(fitted(path.cameras[0], covered(scene())),))
    paths = [cameras_from({**settings, "look_at": view}, scene) for view in settings["views"]]
    cameras = [
        dataclasses.replace(path.cameras[0], name=" to ".join(", ".join(f"{x:g}" for x in point) for point in view))
        for path, view in zip(paths, settings["views"], strict=True)
    ]
    return dataclasses.replace(paths[0], cameras=tuple(cameras), numbers=tuple(range(len(cameras))))
