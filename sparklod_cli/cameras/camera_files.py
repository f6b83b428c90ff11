"""Files of cameras: their formats are recognised and parsed; and matrices of `--world-transform`."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..io.local_files import read_text, read_together
from ..system.errors import CameraPathError, SparklodError
from ..system.untrusted import Origin, parse_json
from . import sparklod_paths
from .camera import Matrix, Settings, rigid
from .camera_formats import FORMATS, NAMES, PathFormat
from .camera_json import CameraJson, Files, Parsed, finite
from .sources import CameraPath, cameras_of

#: Bytes of a camera path's file. COLMAP's images.txt has all points that its images see.
LARGEST = 1 << 31


def read(files: Files, *, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file.

    Args:
        files: the file, and those that belong to it.
        format: name of a row of `FORMATS`; None recognizes the format by the content.

    Raises:
        CameraPathError: the file has no known format or is broken, or a camera makes no sense.
    """
    settings = settings or Settings()
    if not any(files.contents.values()):
        raise CameraPathError("it is empty")
    form = _known(files) if format is None else next(form for form in FORMATS if form.name == format)
    if settings.axes and form.axes is None:
        raise CameraPathError(f"{form.title} has targets instead of axes, so --camera-axes cannot be used with it")
    parsed: Parsed = _function(form, "parse")(files, settings)
    if settings.up is not None and (parsed.turned or not form.looking):
        raise CameraPathError("its cameras have their own up axes, so --up cannot be used with them")
    notes = parsed.notes + ((form.world,) if form.world and settings.world is None else ())
    return cameras_of(parsed.frames, settings, form.title, form.axes, count=parsed.count, fps=parsed.fps, notes=notes)


def _known(files: Files) -> PathFormat:
    form = next((form for form in FORMATS if _function(form, "recognises")(files)), None)
    if form is None and sparklod_paths.resembles_csv(files):
        form = next(form for form in FORMATS if form.name == "csv")  # whose error names the missing columns
    if form is None:
        names = ", ".join(form.name for form in FORMATS)
        raise CameraPathError(f"its content is of no known format; name the format with --camera-format ({names})")
    return form


def _function(form: PathFormat, verb: str) -> Any:
    module = import_module(f".{form.module}", __package__)
    return getattr(module, f"{verb}_{form.name.replace('-', '_')}")


def read_path(path: Path, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file, or of a folder that COLMAP wrote; see `read`.

    A `CameraPathError`, also where it cannot be read, names the file.
    """
    try:
        contents = read_together(path, NAMES, LARGEST)
    except SparklodError as error:
        raise CameraPathError(str(error)) from None
    try:
        return read(Files(path, contents), format=format, settings=settings)
    except CameraPathError as error:
        raise CameraPathError(f"{path}: {error}") from None


def similarity(text: str) -> Matrix:
    """Return a (4, 4) matrix of a rotation, a uniform scale and a translation from 16 numbers, row by row.

    The numbers are separated by commas or white space, or JSON: a list of them or of rows. The text of a
    `CameraPathError` continues a sentence about them.
    """
    words = re.split(r"[\s,;]+", text.strip())
    try:
        if text.lstrip().startswith("["):
            numbers = CameraJson(parse_json(text), Origin("matrix", CameraPathError)).matrix(4)
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


def read_world_transform(path: Path) -> Matrix:
    """Return the `similarity` in a file; a `CameraPathError` names the file."""
    try:
        return similarity(read_text(path))
    except CameraPathError as error:
        raise CameraPathError(f"{path}: --world-transform {error}") from None
    except SparklodError as error:
        raise CameraPathError(str(error)) from None
