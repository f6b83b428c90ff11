"""Spark and sparklod read the same out of RAD files.

Spark's worker writes no RAD: its WebAssembly exports a reader alone. The files of the tests are therefore those of
sparklod, and those of Spark's native program `build-lod`, which are real scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs import rad
from sparklod_cli.codecs.rad_header import Header, read_header
from sparklod_cli.codecs.splat_encoding import SplatEncoding
from sparklod_cli.io import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import FloatArray
from tests.conftest import FIXTURES, real_scene
from tests.interop.spark import Spark
from tests.interop.ties import Words
from tests.interop.words import check_ext, check_packed

#: Spark's encoding of a chunk that it reads alone: the header that has the file's ranges is not there.
ALONE = SplatEncoding(lod_opacity=True)
#: Of codes that ties may decide, see `ties`.
SHARE = 2e-3
LAYOUTS = ("Packed", "Ext")


def header_of(path: Path) -> Header:
    with path.open("rb") as file:
        return read_header(file)


def chunks_of(path: Path) -> Iterator[tuple[bytes, Scene, FloatArray | None]]:
    """The bytes of each chunk of a file, what sparklod reads out of them alone, and its part of the palette."""
    header = header_of(path)
    palette = None
    for entry in header.chunks:
        where = path if entry.filename is None else path.with_name(entry.filename)
        start = entry.offset + (header.bytes if entry.filename is None else 0)
        data = where.read_bytes()[start : start + entry.bytes]
        with where.open("rb") as file:
            chunk = rad.read_chunk(file, entry, header, palette)
        palette = palette if palette is not None else chunk.palette
        yield data, Scene(chunk.splats, chunk.tree), chunk.palette


def as_spark_turns(scene: Scene) -> Scene:
    """A scene whose turns by 180 degrees are about the opposite axis, and so the same, where they come from a byte.

    The cosine of a quarter of a turn is 6e-17 in sparklod's float64, and -4e-8 in Spark's float32, which turns the
    quaternion round to make it positive.
    """
    quat_xyzw = scene.splats.quat_xyzw.copy()
    w = quat_xyzw[:, 3]
    w[w == np.float32(np.cos(np.pi / 2))] = np.cos(np.float32(np.pi / 2))
    return replace(scene, splats=replace(scene.splats, quat_xyzw=quat_xyzw))


def as_ext_splats_show(scene: Scene, palette: bool) -> Scene:
    """A scene as Spark's ExtSplats have it: of a palette, the second coefficient of degree 2 stands for the first."""
    sh = scene.splats.sh.copy()
    if palette and scene.splats.sh_degree >= 2:
        sh[:, 3] = sh[:, 4]
    return replace(scene, splats=replace(scene.splats, sh=sh))


def check(words: dict[str, Words], scene: Scene, encoding: SplatEncoding, palette: bool) -> None:
    """Compares Spark's words of both layouts with ours of the scene that sparklod read."""
    scene = as_spark_turns(scene)
    check_packed(without_codes(words["Packed"]), scene, encoding, SHARE)
    check_ext(without_codes(words["Ext"]), as_ext_splats_show(scene, palette), SHARE)


def check_whole(spark: Spark, path: Path) -> None:
    """Compares what Spark and sparklod read out of a whole file."""
    header, scene = header_of(path), read_scene(path)
    words = {layout: spark.load_words(layout, path) for layout in LAYOUTS}
    check(words, scene, header.encoding or ALONE, header.sh_code_count is not None)


def check_chunks(spark: Spark, path: Path, tmp_path: Path) -> int:
    """Compares what Spark and sparklod read out of each chunk alone; returns how many chunks there are."""
    codes: dict[str, Words] = {layout: {} for layout in LAYOUTS}
    chunk = tmp_path / "chunk.radc"
    count = 0
    for data, scene, palette in chunks_of(path):
        chunk.write_bytes(data)
        words = {layout: spark.load_words(layout, chunk, codes=codes[layout]) for layout in LAYOUTS}
        if palette is not None:
            codes = {layout: {name: each[name] for name in each if "Codes" in name} for layout, each in words.items()}
        check(words, scene, ALONE, bool(codes["Ext"]))
        count += 1
    return count


def without_codes(words: Words) -> Words:
    return {name: values for name, values in words.items() if "Codes" not in name}


# --- Files of Spark's native program ----------------------------------------------------------------------------------


def test_both_read_the_same_out_of_sparks_own_file(spark: Spark) -> None:
    check_whole(spark, real_scene("rad/biker-spark.rad"))


@pytest.mark.parametrize("name", ["biker-spark.rad", "playbot-125k-spark/p-lod.rad"])
def test_both_read_the_same_out_of_each_chunk_of_sparks_own_files(spark: Spark, tmp_path: Path, name: str) -> None:
    path = real_scene(f"rad/{name}")
    assert check_chunks(spark, path, tmp_path) == len(header_of(path).chunks) == 3


def test_chunks_of_sparks_own_file_are_rows_of_the_whole(tmp_path: Path) -> None:
    path = real_scene("rad/playbot-125k-spark/p-lod.rad")
    whole = read_scene(path)
    parts = [scene for _, scene, _ in chunks_of(path)]
    for name in ("center", "scale", "quat_xyzw", "opacity", "rgb", "sh"):
        found = np.concatenate([getattr(part.splats, name) for part in parts])
        np.testing.assert_array_equal(found, getattr(whole.splats, name))


# --- Files written by hand --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sh1-tree.rad", "sh3-rad/sh3.rad"])
def test_both_read_the_same_out_of_files_written_by_hand(spark: Spark, tmp_path: Path, name: str) -> None:
    """The first is one file, the second has chunk files and a palette."""
    path = FIXTURES / "golden" / name
    assert check_chunks(spark, path, tmp_path) == 3
    if not header_of(path).chunked:
        check_whole(spark, path)
