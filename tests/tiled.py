"""Writes scenes as 3D Tiles."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from sparklod_cli.codecs.formats import TILESET
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.tiles_3d import encode_files
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.splats import Splats
from tests.outputs import write_files


def tiled(splats: Splats, folder: Path, settings: TileSettings | None = None) -> Path:
    """Write a tileset.json of splats of which -y is up, and its tiles."""
    made = parts.make_tiles(*quality.build(splats, 2.0), settings or TileSettings())
    file = folder / TILESET
    write_files(parts_output(file, overwrite=False), encode_files(dataclasses.replace(made, up="-y"), WriteOptions()))
    return file
