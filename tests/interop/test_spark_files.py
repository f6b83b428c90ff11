"""Spark's words of a file, whole or chunk by chunk, are those of what sparklod reads of it; its JavaScript agrees.

Exceptions are ties that last bits decide (see `spark_words`); the tests bound their share of all codes by two to three
times the measured one. Laws in `tests/codecs` compare what sparklod reads with what was written. Spark's worker writes
no RAD, so the RAD files are those of sparklod, of `fixtures`, and real scenes of Spark's native program `build-lod`.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import sparklod_cli
from fixtures import by_hand_rad
from sparklod_cli.cli import run
from sparklod_cli.codecs import layouts, spz
from sparklod_cli.codecs.formats import DEFAULTS, RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_header import RadHeader, read_header
from sparklod_cli.codecs.rad.rad_reader import RadReader
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.lod_tree import CHUNK_NODES, MAX_CHILDREN
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, FloatArray, Splats
from tests.codecs.cases import encode, linear, rotation_degrees
from tests.codecs.writers import as_ply
from tests.conftest import FIXTURES, Capture, real_scene
from tests.interop.node import PROGRAMS
from tests.interop.spark import NODE, Spark
from tests.interop.spark_words import (
    Floats,
    Words,
    check,
    check_ext,
    check_file,
    check_packed,
    check_tree,
    ext_codes,
    ext_steps,
    packed_codes,
    packed_steps,
    spark_encoding,
)
from tests.references.chunk_orders import size_order, spark_order
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

#: Of codes that ties may decide, where a file has few distinct numbers, so that the same ties occur again and again.
SHARE = 2e-3
WIDE = SplatEncoding(rgb_min=-0.5, rgb_max=2, ln_scale_min=-8, ln_scale_max=1, sh1_max=0.5, sh2_max=2, sh3_max=0.25)


def put(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@cache
def tree(count: int = 2_000, sh_degree: int = 0, method: str = "quick", extent: float = 1.0) -> Scene:
    splats = random_splats(count, sh_degree=sh_degree, extent=extent)
    return Scene(*(quick if method == "quick" else quality).build(splats))


# --- PLY --------------------------------------------------------------------------------------------------------------


def edges() -> Splats:
    """Combine every hard rotation with hard values of the other columns, such as the ends of all ranges."""
    half = 0.5**0.5
    quats = [[0, 0, 0, 1], [0, 0, 0, -1], [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]]
    quats += [[0, 0, -1, 0], [half, 0, 0, half], [0, 0, -half, -half], [0, half, -half, 0], [-half, -half, 0, 0]]
    quats += [[0.5, 0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [half, half, 1e-7, 1e-4]]
    quats += [[1e-4, -1e-4, 1e-4, 1], [0, 0, -1e-7, 1], [3e-4, -5e-4, -1e-4, 1]]
    scales = [0, np.exp(-12), np.exp(-11.95), 1e-3, 1, np.exp(9), np.exp(9.2), 1e6]
    colors = [-3, -0.1, 0, 0.5, 1, 1.1, 2.5]
    count = len(quats) * 56
    rest = np.arange(count)
    splats = random_splats(count, sh_degree=3)
    splats.quat_xyzw[:] = np.repeat(quats, 56, axis=0)
    splats.scale[:] = np.stack([np.take(scales, rest // step, mode="wrap") for step in (1, 3, 8)], axis=1)
    splats.opacity[:] = np.take([0, 1e-6, 0.25, 0.5, 0.999999, 1], rest, mode="wrap")
    splats.rgb[:] = np.stack([np.take(colors, rest // step, mode="wrap") for step in (1, 2, 7)], axis=1)
    splats.center[:] = np.exp(np.linspace(-25, np.log(7e4), count))[:, None] * [1, -1, 0]
    numbers = np.array([-2, -1, -0.5, -1e-9, 0, 0.125, 0.25, 0.5, 1, 3, 8, 1e5], np.float32)
    numbers = np.concatenate([numbers, np.nextafter(numbers, np.float32(0))])  # below powers of two
    splats.sh[:] = np.random.default_rng(0).choice(numbers, splats.sh.shape)
    return splats


@pytest.mark.parametrize("sh_degree", range(4))
def test_words_of_random_splats_are_those_of_spark(spark: Spark, tmp_path: Path, sh_degree: int) -> None:
    splats = random_splats(50_000, sh_degree=sh_degree)
    check_file(spark, put(tmp_path / "random.ply", as_ply(Scene(splats))), share=2e-4)


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_words_at_the_ends_of_ranges_are_those_of_spark(spark: Spark, tmp_path: Path, encoding: SplatEncoding) -> None:
    """Ties are frequent here, as the numbers are round."""
    check_file(spark, put(tmp_path / "edges.ply", as_ply(Scene(edges()))), 0.2, encoding)


@pytest.mark.parametrize("name", ["biker.ply", "playbot-125k.ply"])
def test_words_of_a_real_scene_are_those_of_spark(spark: Spark, name: str) -> None:
    check_file(spark, real_scene(name), SHARE)


@pytest.mark.parametrize("layout", ["Packed", "Ext"])
def test_trees_of_sparks_own_builder_round_trip(spark: Spark, tmp_path: Path, layout: str) -> None:
    """Unpacking its merged splats and packing them again gives its nodes."""
    path = put(tmp_path / "random.ply", as_ply(Scene(random_splats(20_000))))
    words = spark.load_words(layout, path, lod=True)
    packed = layout == "Packed"
    held = layouts.unpack_packed(words, SplatEncoding(lod_opacity=True)) if packed else layouts.unpack_ext(words)
    nodes = layouts.unpack_nodes({"lod_tree": words["lodTree"]})
    nodes.tree.validate()
    check_tree(layouts.pack_nodes(held, nodes.tree)["lod_tree"], words["lodTree"], held, share=1e-3)
    # Spark's LoD design, by whose size its quick builder sorts, defines another size.
    design = 2 * held.scale.max(axis=1) * np.maximum(lod_opacity(held.opacity), 1)
    assert (nodes.size != design.astype(np.float16)).mean() > 0.9


def test_sparks_worker_packs_only_a_scale_of_0_as_zero(spark: Spark, tmp_path: Path) -> None:
    """Spark's documentation and its JavaScript make scales below e ** -30 zero, and so does sparklod."""
    splats = random_splats(1)
    splats.scale[:] = [0, np.exp(-31), np.exp(-29)]
    path = put(tmp_path / "tiny.ply", as_ply(Scene(splats)))
    theirs = spark.load_words("Packed", path)["packed"].view(layouts.PACKED)
    ours = layouts.pack_packed(read_scene(path).splats)["packed"].view(layouts.PACKED)
    assert (theirs["log_scale"].tolist(), ours["log_scale"].tolist()) == ([[[0, 1, 1]]], [[[0, 0, 1]]])


# --- SPZ --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("method", ["quick", "quality", None])
def test_spark_reads_spz(spark: Spark, tmp_path: Path, method: str | None, sh_degree: int, version: int) -> None:
    """Trees of both builders, and plain splats."""
    plain = Scene(random_splats(2_000, sh_degree=sh_degree))
    scene = tree(2_000, sh_degree, method) if method else plain
    path = put(tmp_path / "scene.spz", encode(spz, scene, WriteOptions(spz_version=version)))
    back = read_scene(path)
    assert (back.tree is None) == (method is None)
    assert (lod_opacity(back.splats.opacity).max() > 1) == (method is not None)
    check_file(spark, path, SHARE)


def limits() -> Scene:
    splats, limit = random_splats(2), spz.LAST_CODE
    splats.center[:] = [[limit, -limit, 0.4], [-limit, limit, -0.6]]
    return Scene(splats)


def coincident() -> Scene:
    """More coincident splats than a node may have children."""
    return Scene(*quick.build(random_splats(1).take(np.zeros(MAX_CHILDREN + 5_000, np.intp))))


@pytest.mark.parametrize(
    ("make", "options"),
    [
        *(
            (lambda extent=extent: tree(extent=extent), WriteOptions(fractional_bits=bits))
            for extent, bits in ((5e3, 0), (1, 12), (0.05, 24), (0.05, None), (1, None), (5e3, None))
        ),
        (limits, WriteOptions(fractional_bits=0)),
        (lambda: tree(1, 3), DEFAULTS),
        (coincident, DEFAULTS),
        (lambda: replace(tree(500), antialiased=True), DEFAULTS),
        (lambda: Scene(*quick.build(read_scene(real_scene("biker.ply")).splats)), WriteOptions(spz_version=2)),
        (lambda: Scene(*quick.build(read_scene(real_scene("playbot-125k.ply")).splats)), DEFAULTS),
        (lambda: Scene(*quality.build(read_scene(real_scene("biker.spz")).splats)), DEFAULTS),
    ],
)
def test_spark_reads_unusual_and_real_trees_of_spz(
    spark: Spark, tmp_path: Path, make: Any, options: WriteOptions
) -> None:
    check_file(spark, put(tmp_path / "scene.spz", encode(spz, make(), options)), SHARE)


def test_spark_keeps_the_tree_of_a_file_if_the_page_asks_for_one(spark: Spark) -> None:
    """`SplatMesh({lod: true})` decodes in another way, and builds a tree if the file has none."""
    scene = tree(2_000, 3)
    nodes = spark.load_words("Ext", encode(spz, scene), lod=True)["lodTree"].view(NODE)[:, 0]
    assert scene.tree is not None
    np.testing.assert_array_equal(nodes["child_count"], scene.tree.child_count)
    np.testing.assert_array_equal(nodes["child_start"], scene.tree.child_start)


def test_spark_refuses_version_4_and_truncated_files(spark: Spark) -> None:
    """As docs/formats/spz.md says of version 4: once this fails, its table has changed."""
    data = encode(spz, tree(500))
    for broken in (encode(spz, random_splats(2), WriteOptions(spz_version=4)), data[: len(data) // 2]):
        with pytest.raises(AssertionError, match="failed: "):
            spark.load(broken)


# --- RAD --------------------------------------------------------------------------------------------------------------

#: Spark's encoding of a chunk that it reads alone, without the ranges in the header of the file.
ALONE = SplatEncoding(lod_opacity=True)


def header_of(path: Path) -> RadHeader:
    with path.open("rb") as file:
        return read_header(file)


def chunks_of(path: Path) -> Iterator[tuple[bytes, Scene, FloatArray | None]]:
    """Yield the bytes of each chunk of a file, what sparklod reads of it alone, and its part of the palette."""
    header = header_of(path)
    palette = None
    for number, entry in enumerate(header.chunks):
        where = path if entry.filename is None else path.with_name(entry.filename)
        with path.open("rb") as file:
            chunk = RadReader(header, file, lambda name: path.with_name(name).open("rb"), palette).read_chunk(number)
        palette = palette if palette is not None else chunk.palette
        start = entry.start(header)
        yield where.read_bytes()[start : start + entry.bytes], Scene(chunk.splats, chunk.tree), chunk.palette


def check_rad(words: dict[str, Words], scene: Scene, encoding: SplatEncoding, *, palette: bool) -> None:
    """Compare Spark's words of both layouts with those of a scene, apart from two peculiarities of Spark.

    The cosine of a quarter of a turn is 6e-17 in sparklod's float64, and -4e-8 in Spark's float32, which turns the
    quaternion round to make it positive: rotations of 180 degrees from a byte are about the opposite axis. And of a
    palette, ExtSplats show the second coefficient of degree 2 in place of the first.
    """
    quat_xyzw, sh = scene.splats.quat_xyzw.copy(), scene.splats.sh.copy()
    w = quat_xyzw[:, 3]
    w[w == np.float32(np.cos(np.pi / 2))] = np.cos(np.float32(np.pi / 2))
    scene = replace(scene, splats=replace(scene.splats, quat_xyzw=quat_xyzw))
    packed, ext = (without_codes(words[layout]) for layout in ("Packed", "Ext"))
    check_packed(packed, scene, encoding, SHARE)
    if palette and scene.splats.sh_degree >= 2:
        sh[:, 3] = sh[:, 4]
    check_ext(ext, replace(scene, splats=replace(scene.splats, sh=sh)), SHARE)


def without_codes(words: Words) -> Words:
    return {name: values for name, values in words.items() if "Codes" not in name}


def check_whole(spark: Spark, path: Path) -> None:
    header = header_of(path)
    words = {layout: spark.load_words(layout, path) for layout in ("Packed", "Ext")}
    check_rad(words, read_scene(path), header.encoding or ALONE, palette=header.sh_code_count is not None)


def check_chunks(spark: Spark, path: Path) -> int:
    """Compare each chunk alone, and return the number of chunks."""
    codes: dict[str, Words] = {"Packed": {}, "Ext": {}}
    chunk, chunks = path.with_name("chunk alone.radc"), list(chunks_of(path))
    for data, scene, palette in chunks:
        put(chunk, data)
        words = {layout: spark.load_words(layout, chunk, codes=own) for layout, own in codes.items()}
        if palette is not None:
            codes = {layout: {name: each[name] for name in each if "Codes" in name} for layout, each in words.items()}
        check_rad(words, scene, ALONE, palette=bool(codes["Ext"]))
    chunk.unlink()
    return len(chunks)


def ways() -> dict[str, RadOptions]:
    """Return options with every encoding of every property at least once, and the automatic ones."""
    count = max(map(len, RAD_ENCODINGS.values()))
    chosen = [{name: each[number % len(each)] for name, each in RAD_ENCODINGS.items()} for number in range(count)]
    return {"auto": RadOptions(), **{"-".join(each.values()): RadOptions(**each) for each in chosen}}


@pytest.mark.parametrize(
    ("way", "sh_degree"), [(way, degree) for at, way in enumerate(ways()) for degree in {at % 3, 3}], ids=str
)
def test_spark_reads_every_encoding_of_rad(spark: Spark, tmp_path: Path, way: str, sh_degree: int) -> None:
    options = WriteOptions(rad=ways()[way])
    path = put(tmp_path / "tree.rad", encode(rad, tree(1_500, sh_degree), options))
    check_whole(spark, path)
    assert check_chunks(spark, path) == 1


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_spark_reads_rad_without_a_tree(spark: Spark, tmp_path: Path, sh_degree: int) -> None:
    check_whole(spark, put(tmp_path / "plain.rad", encode(rad, random_splats(1_500, sh_degree=sh_degree))))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_spark_reads_palettes_of_rad(spark: Spark, tmp_path: Path, degree: int) -> None:
    """A palette has as many codes as the first chunk has splats, since Spark takes so many whatever the header says."""
    options = WriteOptions(rad=RadOptions(sh_codes=300))
    path = put(tmp_path / "scene.rad", encode(rad, tree(1_500, degree), options))
    assert header_of(path).sh_code_count == len(tree(1_500, degree)) > 300
    check_whole(spark, path)
    assert check_chunks(spark, path) == 1


def test_spark_reads_two_chunks_of_rad_in_one_file_and_in_chunk_files(spark: Spark, tmp_path: Path) -> None:
    scene = tree(60_000, 2)
    assert CHUNK_NODES < len(scene) < 2 * CHUNK_NODES
    path = put(tmp_path / "whole.rad", encode(rad, scene))
    check_whole(spark, path)
    assert check_chunks(spark, path) == 2
    for name, pieces in rad.encode_chunked(scene, DEFAULTS, "tree", threads=2):
        put(tmp_path / name, b"".join(pieces))
    assert check_chunks(spark, tmp_path / "tree.rad") == 2


def test_spark_reads_rad_of_build_lod(spark: Spark, tmp_path: Path) -> None:
    """In one file, and in chunk files, whose chunks are the same."""
    whole, header = tmp_path / "whole.rad", tmp_path / "scene-lod.rad"
    for output, form in ((whole, "rad"), (header, "rad-chunked")):
        assert run(["build-lod", str(real_scene("playbot-125k.ply")), "--format", form, "-o", str(output)]) == 0
    check_whole(spark, whole)
    assert check_chunks(spark, header) == len(header_of(header).chunks) > 2
    assert [data for data, _, _ in chunks_of(whole)] == [data for data, _, _ in chunks_of(header)]


@pytest.mark.parametrize("name", ["sh1-tree.rad", "sh3-rad/sh3.rad", "biker-spark.rad", "playbot-125k-spark/p-lod.rad"])
def test_spark_and_sparklod_read_the_same_of_rad_by_others(spark: Spark, tmp_path: Path, name: str) -> None:
    """Of `fixtures`, one file and chunk files with a palette; and of Spark's native program, the same."""
    source = real_scene(f"rad/{name}") if "spark" in name else FIXTURES / "golden" / name
    for beside in source.parent.glob("*.rad*"):
        (tmp_path / beside.name).symlink_to(beside)
    path = tmp_path / source.name
    assert check_chunks(spark, path) == len(header_of(path).chunks) == 3
    if not header_of(path).chunked:
        check_whole(spark, path)
    whole, parts = read_scene(path).splats, [scene.splats for _, scene, _ in chunks_of(path)]
    for column in COLUMNS:
        np.testing.assert_array_equal(np.concatenate([getattr(part, column) for part in parts]), getattr(whole, column))


def test_limits_of_spark_with_rad(spark: Spark, tmp_path: Path) -> None:
    """As docs/streaming.md says: chunk files are read paged only, and a page that asks for a tree gets no palette."""
    with pytest.raises(AssertionError, match="Incomplete RAD chunk"):
        spark.load(FIXTURES / "golden" / "sh3-rad" / "sh3.rad")
    splats = random_splats(50, sh_degree=1)
    children = [49, *[0] * 49], [1, *[0] * 49]
    files = by_hand_rad.rad(**linear(Scene(splats)), tree=children, palette=(splats.sh, np.arange(50)))
    path = put(tmp_path / "scene.rad", files["scene.rad"])
    assert np.abs(spark.load(path).sh).max() > 0.2
    assert np.abs(spark.load(path, lod=True).sh).max() < 1e-4


@pytest.mark.parametrize("name", ["rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_the_reference_of_sparks_chunk_order_fills_its_chunks_with_the_same_nodes(name: str) -> None:
    """All but a few: the file has sizes in steps of 8 %, so that nodes of similar size change places."""
    scene = sparklod_cli.read(real_scene(name))
    assert scene.tree is not None
    shares = [
        min(
            float(np.mean(part // CHUNK_NODES == number))
            for number, part in enumerate(np.split(order, range(CHUNK_NODES, len(order), CHUNK_NODES)))
        )
        for order in (spark_order(scene.splats, scene.tree), size_order(scene.splats, scene.tree))
    ]
    assert shares[0] > 0.88 and shares[1] < 0.75


@pytest.mark.parametrize("lod", [False, True])
@pytest.mark.parametrize("suffix", [".spz", ".rad", ".ply"])
def test_a_noted_up_axis_changes_no_word(spark: Spark, suffix: str, lod: bool, tmp_path: Path) -> None:
    if lod and suffix == ".ply":
        pytest.skip("PLY holds no tree")
    scene = tree(300, 1) if lod else Scene(random_splats(300, sh_degree=1))
    words = []
    for up in (None, "y"):
        path = tmp_path / f"{up}{suffix}"
        sparklod_cli.write(path, dataclasses.replace(scene, up=up))
        assert read_scene(path).up == up
        words.append(spark.load_words("Ext", path))
    assert words[0].keys() == words[1].keys()
    for name, values in words[0].items():
        np.testing.assert_array_equal(words[1][name], values, name)


# --- Trees of Spark's builders ----------------------------------------------------------------------------------------

#: Values of Spark's option `lod` for its two builders, the tiny one and Bhattacharyya's, by sparklod's methods.
BUILDERS: dict[str, Any] = {"quick": True, "quality": "quality"}


def spark_tree(spark: Spark, source: Path, builder: str) -> Scene:
    """Return the tree that Spark builds from a file, as it has it in memory."""
    words = spark.load_words("Ext", source, lod=BUILDERS[builder])
    nodes = layouts.unpack_nodes({"lod_tree": words.pop("lodTree")})
    return Scene(layouts.unpack_ext(words), nodes.tree)


def inspected(path: Path, capsys: Capture, *options: str) -> tuple[int, dict[str, Any]]:
    """Run `inspect --check`, and return its exit status and its report."""
    code = run(["inspect", str(path), "--json", "--check", *options])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("name", "builder"),
    [("sh2.ply", "quality"), ("demo.ply", "quality"), ("demo.ply", "quick"), ("biker.ply", "quick")],
)
def test_trees_of_spark_have_no_faults(spark: Spark, tmp_path: Path, capsys: Capture, name: str, builder: str) -> None:
    """A fixture with SH, one without, and a real scene with more nodes than a chunk."""
    source = FIXTURES / name if (FIXTURES / name).exists() else real_scene(name)
    path = put(tmp_path / "tree.spz", encode(spz, spark_tree(spark, source, builder), threads=2))
    code, report = inspected(path, capsys, "--fail-on", "warning")
    scene = read_scene(path)
    assert scene.tree is not None and code == 0
    facts, leaves = report["tree"], len(read_scene(source).splats)
    assert (report["splats"], facts["leaves"], facts["inner"]) == (len(scene), leaves, len(scene) - leaves)
    assert facts["depth"] == scene.tree.depths().max()
    # The first 65,536 nodes are coarse before fine. The others follow part by part of the scene, which is a note.
    assert [finding["code"] for finding in report["findings"]] == ["tree.coarse-first"] * (len(scene) > CHUNK_NODES)
    assert all(finding["index"] > CHUNK_NODES for finding in report["findings"])


@pytest.mark.parametrize("builder", BUILDERS)
def test_leaves_of_sparks_trees_are_the_splats_except_for_small_rotations(
    spark: Spark, tmp_path: Path, capsys: Capture, builder: str
) -> None:
    """Spark's builders hold the w of a rotation as float16, which rounds it to 1 below 2.5 degrees."""
    source = FIXTURES / "demo.ply"
    scene = spark_tree(spark, source, builder)
    path = put(tmp_path / "tree.spz", encode(spz, scene))
    code, report = inspected(path, capsys, "--leaves-of", str(source))
    original = read_scene(source).splats
    by_center = {tuple(center): quat for center, quat in zip(original.center.tolist(), original.quat_xyzw, strict=True)}
    assert scene.tree is not None
    leaves = scene.splats.take(scene.tree.is_leaf)
    quats = np.array([by_center[tuple(center)] for center in leaves.center.tolist()], np.float64)
    turned = rotation_degrees(leaves.quat_xyzw, quats)
    assert code == 3
    (finding,) = (each for each in report["findings"] if each["code"] == "expect.leaves")
    assert 0 < np.count_nonzero(turned > 1) <= np.count_nonzero(turned > 0.5) < 1e-3 * len(leaves)
    # They hold scales as float16, too, so that a few are rounded to other codes, and opacities compensate for that.
    assert np.count_nonzero(turned > 1) <= finding["count"] < 1e-2 * len(leaves)
    assert turned.max() < 2.6
    # Without such small rotations, the leaves are the splats.
    needle = put(tmp_path / "needle.spz", encode(spz, spark_tree(spark, FIXTURES / "needle.ply", builder)))
    code, report = inspected(needle, capsys, "--leaves-of", str(FIXTURES / "needle.ply"))
    assert (code, report["tree"]["leaves"]) == (0, 60)


# --- JavaScript -------------------------------------------------------------------------------------------------------


def cut_off(values: Floats) -> NDArray[np.float16]:
    """Round to float16 towards zero."""
    nearest = values.astype(np.float16)
    return np.where(np.abs(nearest.astype(np.float64)) > np.abs(values), np.nextafter(nearest, np.float16(0)), nearest)


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE, SplatEncoding(lod_opacity=True)])
def test_words_are_those_of_sparks_encoders_in_javascript(
    spark_dir: Path, tmp_path: Path, encoding: SplatEncoding
) -> None:
    """Spark's JavaScript has float64; in a Node without Float16Array it rounds float16 towards zero."""
    splats = random_splats(20_000, sh_degree=3, seed=1)
    splats.scale[:100] = np.exp(np.linspace(-40, -20, 300)).reshape(-1, 3)
    numbers = [splats.center, splats.scale, splats.quat_xyzw, splats.opacity[:, None], splats.rgb]
    np.concatenate([*numbers, splats.sh.reshape(len(splats), -1)], axis=1).astype("<f4").tofile(tmp_path / "in")
    command = ["node", PROGRAMS / "spark_encode.mjs", spark_dir, tmp_path / "in", tmp_path / "out"]
    command.append(json.dumps(spark_encoding(encoding)))
    done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    to_half = cut_off if done.stdout.strip() == "cuts" else np.float16

    def words(name: str, width: int, dtype: str = "<u4") -> NDArray[Any]:
        return np.fromfile(tmp_path / f"out.{name}", dtype).reshape(-1, width)

    ours = layouts.pack_packed(splats, encoding)
    codes, steps = packed_codes(ours), packed_steps(splats, encoding)
    codes["center"] = to_half(splats.center)
    check(codes, packed_codes({"packed": words("packed", 4)}), steps, share=2e-4)
    for name in ("sh1", "sh2", "sh3"):
        np.testing.assert_array_equal(ours[name], words(name, layouts.SH_WORDS[int(name[2])]))

    ext = {name: words(name, 4) for name in ("ext0", "ext1")}
    codes, steps = ext_codes(layouts.pack_ext(splats)), ext_steps(splats)
    codes |= {"alpha": to_half(splats.opacity), "rgb": to_half(splats.rgb), "log_scale": to_half(np.log(splats.scale))}
    if to_half is cut_off:  # then ties of float32 logarithms are at whole steps
        value, error = steps["log_scale"]
        steps["log_scale"] = value + 0.5, error
    check(codes, ext_codes(ext), steps, share=2e-4)
    assert (layouts.encode_ext_sh(splats.sh) != words("ext-sh", 15)).mean() < 1e-4

    for layout, held in (
        ("packed", layouts.unpack_packed({"packed": words("packed", 4)}, encoding)),
        ("ext", layouts.unpack_ext(ext)),
    ):
        d = lod_opacity(held.opacity)
        alpha = np.where(d > 1, (d + 3) / 4, d)
        back = np.split(words(f"{layout}-back", 14, "<f4"), [3, 6, 10, 11], axis=1)
        for one, other in zip((held.center, held.scale, held.quat_xyzw, alpha[:, None], held.rgb), back, strict=True):
            np.testing.assert_allclose(one, other, rtol=2e-6, atol=2e-7)
