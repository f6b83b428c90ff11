"""The cameras of `sparklod render`: those of the options that commands share, and views of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from .camera_options import SOURCES, cameras_from

if TYPE_CHECKING:
    from ..render.camera_path import CameraPath


def least_cameras(settings: Mapping[str, Any]) -> int:
    """How many cameras there are, or are at least, as far as that can be told before a file is read."""
    if settings["views"]:
        return len(settings["views"])
    if settings["dolly"] or settings["keyframes"]:
        return 2 if settings["every"] == 1 else 1
    return -(-(settings["orbit"] or 1) // settings["every"])


def is_free(settings: Mapping[str, Any]) -> bool:
    """Whether nobody says where the camera is."""
    return not any(settings[name] for name in (*SOURCES, "views", "center", "distance"))


def cameras(settings: Mapping[str, Any], centers: Callable[[], Any]) -> CameraPath:
    """The cameras of a source, or of each --view, named after it; without any, one that sees the whole scene."""
    if not settings["views"]:
        if not is_free(settings):
            return cameras_from(settings, centers, orbit=1)
        from ..preview.fitting import fitted

        path = cameras_from({**settings, "center": (0.0, 0.0, 0.0), "distance": 1.0}, centers, orbit=1)
        return dataclasses.replace(path, cameras=(fitted(path.cameras[0], centers()),))
    paths = [cameras_from({**settings, "look_at": view}, centers) for view in settings["views"]]
    cameras = [
        dataclasses.replace(path.cameras[0], name=" to ".join(", ".join(f"{x:g}" for x in point) for point in view))
        for path, view in zip(paths, settings["views"], strict=True)
    ]
    return dataclasses.replace(paths[0], cameras=tuple(cameras), numbers=tuple(range(len(cameras))))
