"""Camera paths of every format, with changes to their structure and text."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fixtures import camera_files
from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.camera_files import LARGEST, Files, read
from sparklod_cli.cameras.camera_formats import FORMATS, NAMES
from sparklod_cli.io.files import read_together

from ..case import Case, LawError, Rng
from ..command import command
from ..containers import FIXTURES
from ..mutate import json_mutated, mutated, pick, text_mutated


@functools.cache
def groups() -> Mapping[str, Mapping[str, bytes]]:
    """Camera files by the file or folder that a command is given; a folder has several."""
    found: dict[str, dict[str, bytes]] = defaultdict(dict)
    for name, data in camera_files.files().items():
        found[name.partition("/")[0]][name] = data
    return found


@functools.cache
def tree() -> bytes:
    """A small tree for the cameras to see."""
    return (FIXTURES / "golden" / "tree-v3.spz").read_bytes()


def make(rng: Rng) -> Case:
    """Changes one of the camera files of a format, and picks options to read them with."""
    path = pick(rng, list(groups()))
    files = dict(groups()[path])
    name = pick(rng, list(files))
    files[name] = changed(rng, name, files[name])
    names = [form.name for form in FORMATS]
    run: dict[str, Any] = {
        "path": path,
        "format": pick(rng, (None, None, None, pick(rng, names))),
        "every": int(pick(rng, (1, 1, 2, 1000))),
        "fov": pick(rng, (None, None, 1.0)),
        "size": pick(rng, (None, None, [64, 48])),
        "fps": pick(rng, (None, None, 25.0)),
        "command": int(rng.integers(8)),
    }
    if run["command"] < 2:
        files["tree.spz"] = tree()
    return Case(f"{name}", files, run)


def changed(rng: Rng, name: str, data: bytes) -> bytes:
    """Changes a camera file by its kind: the structure of JSON, the words of a text, bytes."""
    if name.endswith(".json") and rng.integers(5):
        return json_mutated(rng, data)
    if not name.endswith(".bin") and rng.integers(4):
        return text_mutated(rng, data.decode()).encode("utf-8", "surrogatepass")
    return mutated(rng, data, header=64)


def check(case: Case, folder: Path) -> None:
    """The files are read as cameras with finite poses and focal lengths, or refused with an error."""
    run = case.run
    path = Path(run["path"])
    if run["command"] < 2:
        line = ["--camera-path", str(path), "--every", str(run["every"])]
        line += ["--fov", "60"] if run["fov"] else []
        start = ["traverse", "tree.spz", "--no-timing"] if run["command"] else ["render", "tree.spz", "--size", "16x12"]
        command([*start, *line, "-o", "out.csv" if run["command"] else "out.%04d.png"])
        return
    settings = Settings(every=run["every"], fov_y=run["fov"], size=run["size"] and tuple(run["size"]), fps=run["fps"])
    cameras = read(Files(path, read_together(path, NAMES, LARGEST)), format=run["format"], settings=settings).cameras
    for camera in cameras:
        if not (np.isfinite(camera.camera_to_world).all() and np.isfinite(camera.time) and min(camera.focal) > 0):
            raise LawError(f"a camera that cannot be used: {camera}")
