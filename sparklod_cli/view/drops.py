"""Camera paths that somebody drops onto the page: parsed as those of `--camera-path`, and sent back as JSON."""

from __future__ import annotations

import binascii
import contextlib
import dataclasses
import math
import os
import tempfile
from base64 import b64decode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..cameras.formats.table import NAMES
from ..cameras.frame import Settings
from ..cameras.path import CameraPath
from ..cameras.sources import read_path
from ..io import write_whole
from ..io.paths import leads_away
from ..support.errors import CameraPathError
from ..support.untrusted import parse_json, quoted_value

#: Bytes of a request with camera files, in base64: COLMAP's images.txt of a large scene has 50 MB.
MAX_BYTES = 1 << 27

#: Files that are dropped together; COLMAP's models have three.
MAX_FILES = 16

#: Cameras that the page gets; of longer paths only so many, evenly spaced.
MAX_CAMERAS = 20_000


def parse_drop(body: bytes, settings: Settings) -> dict[str, Any]:
    """The path of some dropped files, as `frames_of` has it.

    Args:
        body: JSON, {"files": [{"name": text, "data": base64}]}.
        settings: of the cameras; `up` is left out of those of files whose cameras have up axes of their own.

    Raises:
        CameraPathError: they are no camera path that sparklod reads.
    """
    contents = _contents(body)
    first = next((names[0] for names in NAMES if names[0] in contents), next(iter(contents)))
    # Open3D reads files itself, and COLMAP's lie beside each other: they are read from a folder, as always.
    with tempfile.TemporaryDirectory(prefix="sparklod-") as folder:
        for name, data in contents.items():
            write_whole(Path(folder, name), [data], overwrite=True)
        try:
            return frames_of(_read(Path(folder, first), settings))
        except CameraPathError as error:
            raise CameraPathError(str(error).replace(f"{folder}{os.sep}", "")) from None


def _read(path: Path, settings: Settings) -> CameraPath:
    """The cameras of a file; those that have up axes of their own keep them."""
    if settings.up is not None:
        with contextlib.suppress(CameraPathError):
            return read_path(path, settings=settings)
    return read_path(path, settings=dataclasses.replace(settings, up=None))


def _contents(body: bytes) -> Mapping[str, bytes]:
    """The dropped files by their names, at least one."""
    try:
        files = parse_json(body)["files"]
        contents = {file["name"]: b64decode(file["data"], validate=True) for file in files[:MAX_FILES]}
    except (ValueError, KeyError, TypeError, binascii.Error):
        raise CameraPathError("the request holds no files") from None
    for name in contents:
        if not isinstance(name, str) or leads_away(name):
            raise CameraPathError(f"{quoted_value(name)} is no name of a file; rename it")
    if not contents:
        raise CameraPathError("the request holds no files")
    return contents


def frames_of(path: CameraPath) -> dict[str, Any]:
    """A camera path as the page plays it: matrices from camera to world, column by column, degrees and seconds."""
    every = -(-len(path) // MAX_CAMERAS)
    notes = [*path.notes]
    if every > 1:
        notes.append(f"It has {len(path):,} cameras; every {every}th is played.")
    frames = [
        {
            "matrix": [round(value, 9) for value in camera.camera_to_world.T.ravel().tolist()],
            "fov": round(math.degrees(camera.fov_y), 6),
            "time": camera.time,
            "name": camera.name,
        }
        for camera in path.cameras[::every]
    ]
    return {"format": path.format, "notes": notes, "frames": frames}
