"""Spark and sparklod read the same out of RAD files.

Spark's worker writes no RAD: its WebAssembly exports a reader alone. The files of the tests are therefore those of
sparklod, and those of Spark's native program `build-lod`, which are real scenes.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import packed_splats, quantize
from sparklod_cli.codecs.options import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_header import RadHeader, read_chunk_header, read_header
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.codecs.spark_codings import SplatEncoding, encode_lod_alpha
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import FloatArray
from tests.conftest import FIXTURES, real_scene
from tests.interop import laws
from tests.interop.laws import EXT_DEGREES, HALF, TINY, degrees_between, within
from tests.interop.spark import Spark
from tests.interop.ties import Words
from tests.interop.words import check_ext, check_packed
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: Spark's encoding of a chunk that it reads alone: the header that has the file's ranges is not there.
ALONE = SplatEncoding(lod_opacity=True)
#: Of codes that ties may decide, see `ties`.
SHARE = 2e-3
LAYOUTS = ("Packed", "Ext")

#: Error of a rotation in a file, in degrees. oct88r8: see `spark_codings.decode_axis_angle`. The others have x, y and
#: z, which are off by up to 2 ** -12 or 2 ** -25 each, together by r = sqrt(3) times that; as in `laws.SPZ_DEGREES`,
#: w is off by up to sqrt(2 * r).
DEGREES = {"oct88r8": 1.94} | {
    name: np.degrees(2 * np.hypot(np.sqrt(2 * r), r))
    for name, r in (("f16", np.sqrt(3) * 2.0**-12), ("f32", np.sqrt(3) * 2.0**-25))
}


def header_of(path: Path) -> RadHeader:
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


# --- Our files --------------------------------------------------------------------------------------------------------


def ways() -> Iterator[RadOptions]:
    """Options that have every encoding of every property at least once, and what is written where nobody chooses."""
    names = {field: RAD_ENCODINGS[field] for field in ("center", "alpha", "rgb", "scales", "orientation", "sh")}
    for number in range(max(map(len, names.values()))):
        yield RadOptions(**{field: each[number % len(each)] for field, each in names.items()})
    yield RadOptions()


WAYS = {
    "-".join(getattr(way, row) for row in ("center", "alpha", "rgb", "scales", "orientation", "sh")): way
    for way in ways()
}


@cache
def tree(sh_degree: int, count: int = 1_500) -> Scene:
    return Scene(*quick.build(random_splats(count, sh_degree=sh_degree)))


def written(path: Path, scene: Scene, options: RadOptions) -> Path:
    path.write_bytes(b"".join(rad.encode(scene, WriteOptions(rad=options), threads=2)))
    return path


def width_of(path: Path, name: str) -> float:
    """The width of the range of a property's codes, as the first chunk has it."""
    with path.open("rb") as file:
        read_header(file)
        (found,) = (each for each in read_chunk_header(file).properties if each.name == name)
    assert found.min is not None and found.max is not None
    return found.max - found.min


def test_spark_reads_a_tree_that_was_written_window_by_window(spark: Spark, tmp_path: Path) -> None:
    """Two chunks."""
    scene = Scene(*quick.build(random_splats(60_000, sh_degree=1), 1.5))
    assert CHUNK_NODES < len(scene) < 2 * CHUNK_NODES
    path = tmp_path / "streamed.rad"
    path.write_bytes(b"".join(rad.encode(scene)))
    check_close(spark, path, scene, RadOptions())


def check_close(spark: Spark, path: Path, scene: Scene, options: RadOptions) -> None:
    """Asserts that Spark reads the splats that were written, within the steps of the file and of Spark's layouts."""
    chosen = rad.settled(scene, WriteOptions(rad=options)).rad
    splats, got = scene.splats, spark.load(path)
    center = splats.center.astype(np.float64)
    step = HALF * np.abs(center) + TINY if chosen.center.startswith("f16") else 0
    within(got.center, center, step + (0 if chosen.center_bits is None else 2.0**-chosen.center_bits / 2))
    held = decode_file(rad, io.BytesIO(path.read_bytes())).splats.scale
    blur = 0.0 if chosen.center_bits is None else 2.0**-chosen.center_bits
    opacity = quantize.compensated(
        splats.opacity, splats.scale, held, blur
    )  # which makes up for the rounding of scales
    alpha = encode_lod_alpha(opacity) if scene.tree else opacity
    step = width_of(path, "alpha") / 510 if chosen.alpha == "r8" else HALF * alpha
    within(got.alpha, alpha.astype(np.float64), step + HALF * alpha + TINY)
    rgb = splats.rgb.astype(np.float64)
    step = width_of(path, "rgb") / 510 if chosen.rgb.startswith("r8") else HALF * np.abs(rgb)
    within(got.rgb, rgb, step + HALF * np.abs(rgb) + TINY)
    log = np.log(splats.scale.astype(np.float64))
    step = width_of(path, "scales") / 508 if chosen.scales == "ln_0r8" else HALF * np.abs(log)
    within(got.log_scale, log, step + HALF * np.abs(log) + 1e-6)
    assert degrees_between(got.quat_xyzw, splats.quat_xyzw).max() <= DEGREES[chosen.orientation] + EXT_DEGREES
    if scene.tree:
        laws.check_tree(got, scene.tree)
    else:
        assert got.nodes is None
    check_sh(spark, path, splats.sh, chosen.sh)


def check_sh(spark: Spark, path: Path, sh: FloatArray, encoding: str) -> None:
    """Asserts that SH in Spark's PackedSplats are within the steps of the file and of that layout.

    ExtSplats clamp them to a power of two, see `laws.held_by_ext_sh`.
    """
    ranges = header_of(path).encoding
    assert ranges is not None
    words = without_codes(spark.load_words("Packed", path))
    got = packed_splats.unpack({name: words[name] for name in words if name != "lodTree"}, ranges).sh
    assert got.shape == sh.shape
    for degree in range(1, 1 + COEFFICIENTS.index(sh.shape[1])):
        part = slice(COEFFICIENTS[degree - 1], COEFFICIENTS[degree])
        most, values = float(ranges.sh_max(degree)), sh[:, part].astype(np.float64)
        step = HALF * most if encoding in ("f16", "f32") else width_of(path, f"sh{degree}") / 508
        within(got[:, part], values.clip(-most, most), step + most / (2.0 ** packed_splats.SH_BITS[degree] - 2) + TINY)


@pytest.mark.parametrize(
    "way, sh_degree", [(way, degree) for at, way in enumerate(WAYS) for degree in {at % 3, 3}], ids=str
)
def test_spark_reads_every_encoding_as_it_was_written(spark: Spark, tmp_path: Path, way: str, sh_degree: int) -> None:
    """Whole, and each chunk alone; and as sparklod reads it."""
    path = written(tmp_path / "tree.rad", tree(sh_degree), WAYS[way])
    check_close(spark, path, tree(sh_degree), WAYS[way])
    check_whole(spark, path)
    assert check_chunks(spark, path, tmp_path) == 1


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_spark_reads_splats_without_a_tree(spark: Spark, tmp_path: Path, sh_degree: int) -> None:
    scene = Scene(random_splats(1_500, sh_degree=sh_degree))
    path = written(tmp_path / "plain.rad", scene, RadOptions())
    check_close(spark, path, scene, RadOptions())
    check_whole(spark, path)


def test_spark_reads_each_of_several_chunks(spark: Spark, tmp_path: Path) -> None:
    """The same in one file, and in files of their own."""
    scene = tree(2, 60_000)
    assert len(scene) > CHUNK_NODES
    path = written(tmp_path / "whole.rad", scene, RadOptions())
    check_close(spark, path, scene, RadOptions())
    check_whole(spark, path)
    assert check_chunks(spark, path, tmp_path) == 2
    for name, pieces in rad.encode_chunked(scene, WriteOptions(), "tree", threads=2):
        (tmp_path / name).write_bytes(b"".join(pieces))
    assert check_chunks(spark, tmp_path / "tree.rad", tmp_path) == 2


def test_spark_reads_a_real_scene_as_build_lod_writes_it(spark: Spark, tmp_path: Path) -> None:
    """In one file, and in chunk files, whose chunks are the same."""
    whole, header = tmp_path / "whole.rad", tmp_path / "scene-lod.rad"
    for output, form in ((whole, "rad"), (header, "rad-chunked")):
        assert run(["build-lod", str(real_scene("playbot-125k.ply")), "--format", form, "-o", str(output)]) == 0
    check_whole(spark, whole)
    assert check_chunks(spark, header, tmp_path) == len(header_of(header).chunks) > 2
    assert [data for data, _, _ in chunks_of(whole)] == [data for data, _, _ in chunks_of(header)]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_both_read_the_same_palette(spark: Spark, tmp_path: Path, degree: int) -> None:
    """It has as many codes as the first chunk has splats, since Spark takes so many whatever the header says."""
    path = written(tmp_path / "scene.rad", tree(degree), RadOptions(sh_codes=300))
    assert header_of(path).sh_code_count == len(tree(degree)) > 300
    check_whole(spark, path)
    assert check_chunks(spark, path, tmp_path) == 1
