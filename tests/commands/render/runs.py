"""Runs of `sparklod render`, what it reads, and the pictures that come of them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from sparklod_cli.cli import run
from tests.conftest import FIXTURES

TOWN, TREE = FIXTURES / "traverse" / "town.spz", FIXTURES / "golden" / "hand-tree-v3.spz"
DEMO, PLAIN = FIXTURES / "demo.ply", FIXTURES / "sh2.ply"
FAULTS, CAMERAS = FIXTURES / "faults", FIXTURES / "cameras"
SIZE = ("--size", "160x90")
AT = ("--look-at", "0,-3,9:0,0,0")


def render(*arguments: object) -> int:
    return run(["render", *map(str, arguments)])


def pixels(path: Path | io.BytesIO) -> np.ndarray:
    with Image.open(path) as picture:
        return np.array(picture)


def floats(path: Path) -> np.ndarray:
    image: np.ndarray = np.load(path)
    assert image.dtype == np.float32
    return image
