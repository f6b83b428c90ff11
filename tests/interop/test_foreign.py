"""sparklod, splat-transform, Spark, mkkellogg's viewer and Adobe's SPZ library read the same of each other's files."""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from sparklod_cli.codecs import ply, splat
from sparklod_cli.codecs import sog as sog_codec
from sparklod_cli.codecs.spz import SYSTEM_OF_UP, SYSTEMS
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.gaussian import rotation_matrices
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from tests.codecs.cases import rotation_degrees
from tests.conftest import FIXTURES, real_scene
from tests.interop.engines import Shot, counts_of
from tests.interop.foreign import Foreign, SplatTransform, SpzLibrary
from tests.interop.spark import Spark
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

GOLDEN = FIXTURES / "golden"
Floats = NDArray[np.floating[Any]]


def within(got: Floats, expected: Floats, tolerance: Floats | float) -> None:
    """Assert that each number is within its tolerance of the expected one."""
    assert got.shape == expected.shape
    excess = np.abs(got.astype(np.float64) - expected) - tolerance
    assert excess.max(initial=-1) <= 0, f"{np.count_nonzero(excess > 0)} of {got.size} are off by up to {excess.max()}"


# --- Files of every writer --------------------------------------------------------------------------------------------

#: Makes a file from a PLY file: takes the programs, the PLY file and a folder, and returns the path.
Writer = Callable[[Foreign, Path, Path], Path]


def by(action: str, name: str, **options: Any) -> Writer:
    return lambda foreign, source, folder: foreign.write(action, source, folder / name, **options)


def our_folder(_: Foreign, source: Path, folder: Path) -> Path:
    for name, content in sog_codec.encode_files(read_scene(source)):
        (folder / name).write_bytes(content)
    return folder / "meta.json"


def ours(codec: ModuleType, name: str) -> Writer:
    def write(_: Foreign, source: Path, folder: Path) -> Path:
        path = folder / name
        path.write_bytes(b"".join(codec.encode(read_scene(source))))
        return path

    return write


#: Sizes that give the fixtures several sections, each with full and partly filled buckets. mkkellogg's reader and
#: splat-transform's can read sections only if they begin at multiples of four bytes, which 20 splats ensure.
SECTIONS = {"section": 20, "block": 1.0, "bucket": 4}

WRITERS: dict[str, Writer] = {
    "compressed PLY": by("convert", "scene.compressed.ply"),
    "SOG": by("convert", "scene.sog"),
    "unpacked SOG": by("convert", "meta.json"),
    "SPZ 3": by("convert", "scene.spz", spz=3),
    "SPZ 4": by("convert", "scene.spz", spz=4),
    "SPLAT": by("splat", "scene.splat"),
    **{f"KSPLAT {level}": by("ksplat", "scene.ksplat", level=level) for level in range(3)},
    **{f"KSPLAT {level} in sections": by("ksplat", "scene.ksplat", level=level, **SECTIONS) for level in range(3)},
    "our PLY": ours(ply, "ours.ply"),
    "our SPLAT": ours(splat, "ours.splat"),
    "our SOG": ours(sog_codec, "ours.sog"),
    "our unpacked SOG": our_folder,
}
#: Files that fixtures/make_fixtures.py writes. No available program writes SOG of version 1 or the older chunks.
BY_HAND = [
    *("sh3-compressed.ply", "sh1-compressed-old.ply", "coincident-compressed.ply", "sh0.splat"),
    *("sh2-level0.ksplat", "sh2-level1.ksplat", "sh2-level2.ksplat"),
    *("sh2-v1.sog", "sh3-v2.sog", "sh1-sog/meta.json"),
]
#: Every writer gets a scene of SH degree 3 and one of a lower degree.
WRITTEN = [
    pytest.param((writer, f"sh{degree}.ply"), id=f"{writer}-sh{degree}")
    for number, writer in enumerate(WRITERS)
    for degree in (number % 3, 3)
]
FILES = [*WRITTEN, *(pytest.param((None, f"golden/{name}"), id=name) for name in BY_HAND)]
#: Scenes whose bounds of a chunk are all equal, and far apart.
HARD = [
    pytest.param((writer, source), id=f"{writer}-{source}")
    for number, writer in enumerate(WRITERS)
    for source in ("coincident.ply", "huge.ply")[number % 2 :]
]
REAL = [(None, "meadow.sog"), ("compressed PLY", "playbot-125k.ply"), ("KSPLAT 2", "playbot-125k.ply")]


@dataclass(frozen=True)
class File:
    path: Path
    source: Path
    writer: str


@pytest.fixture(scope="session")
def make(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., File]:
    """Makes files, and each only once."""

    @cache
    def make(writer: str | None, source: Path) -> File:
        if writer is None:
            return File(source, source, "")
        foreign = request.getfixturevalue("foreign")
        return File(WRITERS[writer](foreign, source, tmp_path_factory.mktemp("file")), source, writer)

    return make


@pytest.fixture
def file(request: pytest.FixtureRequest, make: Callable[..., File]) -> File:
    """The file of a row of `FILES`."""
    writer, source = request.param
    return make(writer, FIXTURES / source)


def flipped(splats: Splats) -> Splats:
    """Rotate splats by 180 degrees about x, from the axes of PLY files to those of SPZ's specification.

    Their own axes are rotated, too, which does not change the ellipsoids.
    """
    turned = Transform(np.diag([1.0, -1.0, -1.0])).apply(splats)
    return replace(turned, quat_xyzw=splats.quat_xyzw * np.float32([1, -1, -1, 1]))


def check_same(ours: Splats, theirs: Splats, degrees: float = 1e-4) -> None:
    """Assert that splats are equal up to float32 arithmetic."""
    within(ours.center, theirs.center, 2.0**-22 * np.abs(theirs.center).max())
    within(np.log(ours.scale), np.log(theirs.scale), 2e-6)
    assert rotation_degrees(ours.quat_xyzw, theirs.quat_xyzw).max() <= degrees
    within(ours.opacity, theirs.opacity, 1.2e-6)  # splat-transform clamps it to 1e-6..1 - 1e-6, for its logarithm
    within(ours.rgb, theirs.rgb, 1e-6 * (1 + np.abs(theirs.rgb)))
    within(ours.sh, theirs.sh, 1e-6 * (1 + np.abs(theirs.sh)))


def check_with_splat_transform(foreign: Foreign, file: File) -> None:
    theirs = foreign.read(file.path)
    # splat-transform reads the bytes of .splat as 255 * (q / 2 + 1 / 2), but writers mean 128 * q + 128: each of the
    # four components is off by up to 1 / 128, together by 1 / 64, at a length of at least 1 - 1 / 64.
    degrees = np.degrees(2 / 63) if file.path.suffix == ".splat" else 1e-4
    check_same(read_scene(file.path, threads=2).splats, flipped(theirs) if "SPZ" in file.writer else theirs, degrees)


@pytest.mark.parametrize("file", [*FILES, *HARD], indirect=True)
def test_splat_transform_reads_the_same_splats(foreign: Foreign, file: File) -> None:
    check_with_splat_transform(foreign, file)


@pytest.mark.parametrize(("writer", "name"), REAL)
def test_splat_transform_reads_the_same_splats_of_real_scenes(
    foreign: Foreign, make: Callable[..., File], writer: str | None, name: str
) -> None:
    check_with_splat_transform(foreign, make(writer, real_scene(name)))


#: Changes to headers of KSPLAT: offset and type of a number, and what to add to it; 0 sets the number to 0.
HEADERS = {
    "fewer splats than there is room for": [(16, "<u4", -5), (4096, "<u4", -5)],
    "SH from -1.5 to 1.5 unless it says otherwise": [(36, "<f4", 0), (40, "<f4", 0)],
    "32767 steps unless it says otherwise": [(4096 + 24, "<u4", 0), (4096 + 1024 + 24, "<u4", 0)],
    "a newer minor version": [(1, "u1", 6)],
}


@pytest.mark.parametrize("changes", HEADERS.values(), ids=HEADERS)
@pytest.mark.parametrize("level", range(3))
def test_unusual_ksplat_headers_are_read_as_by_others(
    foreign: Foreign, make: Callable[..., File], tmp_path: Path, level: int, changes: list[tuple[int, str, int]]
) -> None:
    data = bytearray(make(f"KSPLAT {level} in sections", FIXTURES / "sh2.ply").path.read_bytes())
    for offset, kind, change in changes:
        number = np.frombuffer(data, kind, 1, offset)
        number[0] = int(number[0]) + change if change else 0
    path = tmp_path / "changed.ksplat"
    path.write_bytes(data)
    check_with_splat_transform(foreign, File(path, path, ""))


#: HALF: relative rounding error of a float16, half of the last of its 11 bits. TINY: absolute error below its normal
#: numbers, with room for float32 arithmetic that differs in last bits.
HALF, TINY = 2.0**-11, 2.0**-25 + 1e-6

#: Error of a rotation in ExtSplats, in degrees. The decoded axis is off by up to 1 / 1023 along x and y of the
#: octahedron, so by up to sqrt(1 + 1 + 2 ** 2) / 1023 in space; in the middle of a face, that is at sqrt(1 / 3) from
#: the origin. The rotation is off by up to twice that angle, if it is one by 180 degrees, and half a step of its angle.
EXT_DEGREES = np.degrees(2 * np.sqrt(18) / 1023 + np.pi / 4095 / 2)


def held_by_ext_sh(sh: Floats) -> tuple[Floats, Floats]:
    """Return SH coefficients (N, K, 3) as ExtSplats can hold them, and their largest error.

    The three channels share the exponent of the largest, rounded *down*, and each has a byte of magnitude for
    0..2 ** exponent. Larger magnitudes are clamped: Spark shows a coefficient with as little as half of its strength.
    """
    largest = np.maximum(np.abs(sh).max(axis=2, keepdims=True), 2.0**-15)
    most = 2.0 ** np.floor(np.log2(largest))
    return np.clip(sh, -most, most), most / 510


def spark_degrees(file: File, quat: Floats) -> Floats:
    """Return (N,) degrees by which Spark may be off; it does not normalize quaternions, and takes w as it is."""
    length = {".splat": 1 / 64, ".ksplat": 2.0**-9}.get(file.path.suffix, 0)  # off by that, see `LOSSES`
    w = np.abs(quat[:, 3].astype(np.float64)).clip(0, 1)
    half_angles = [np.arccos((w * (1 + change)).clip(0, 1)) for change in (-length, 0, length)]
    return EXT_DEGREES + np.degrees(2 * np.ptp(half_angles, axis=0))


def spark_can_read(writer: str | None, source: str) -> bool:
    """Whether Spark 2.2 can read it: not SPZ 4, nor several files, as its worker gets only one here."""
    return writer not in ("SPZ 4", "unpacked SOG", "our unpacked SOG") and not source.endswith("meta.json")


@pytest.mark.parametrize("file", [row for row in FILES if spark_can_read(*row.values[0])], indirect=True)
def test_spark_reads_the_same_splats(spark: Spark, file: File) -> None:
    got, splats = spark.load(file.path), read_scene(file.path).splats
    within(got.center, splats.center, 2.0**-21 * np.abs(splats.center).max())
    within(got.rgb, splats.rgb, HALF * np.abs(splats.rgb) + TINY)
    log_scale = np.log(splats.scale.astype(np.float64))
    within(np.log(got.scale), log_scale, HALF * np.abs(log_scale) + TINY)
    assert (rotation_degrees(got.quat_xyzw, splats.quat_xyzw) <= spark_degrees(file, splats.quat_xyzw)).all()
    within(got.opacity, splats.opacity, HALF * splats.opacity + TINY)
    sh = splats.sh
    if "compressed" in file.path.name:  # Spark maps bytes 0..255 to -4..4, not 256 parts
        sh = np.clip((sh.astype(np.float64) / 8 + 0.5) * 256 - 0.5, 0, 255) / 255 * 8 - 4
    held, tolerance = held_by_ext_sh(sh)
    within(got.sh, held, tolerance + TINY)


@dataclass(frozen=True)
class Loss:
    """The largest errors of a format.

    Attributes:
        center: in world units.
        scale: relative.
        degrees: of rotations, in degrees.
        color: of rgb, clamped to 0..1, and of opacity.
        sh: returns the error of SH (N, K, 3).
        sh_degree: the largest degree that it holds.
    """

    center: float = 0
    scale: float = 1e-6
    degrees: float = 1e-4
    color: float = 1e-6
    sh: Callable[[Floats], Floats | float] = lambda sh: 1e-6
    sh_degree: int = 3


#: Errors of rounding to float16 towards zero, as three.js does: the last of 11 bits, and that of subnormal numbers.
CUT, SMALL = 2.0**-10, 2.0**-24
#: Rotations have a byte a component, off by up to 1 / 256; 1 becomes 255 / 128 - 1, which is off by 1 / 128.
SPLAT = Loss(degrees=np.degrees(2 * (np.sqrt(3) / 256 + 1 / 128)), color=1 / 510 + 1e-6, sh_degree=0)
#: Positions are rounded to 32767 steps in half a block, colours are rounded down to bytes.
KSPLAT = Loss(5 / 2 / 32767 / 2 + 1e-6, CUT + 1e-6, np.degrees(2 * CUT), 1 / 255 + 1e-6, sh_degree=2)
#: Fixtures span 3.3 units, whose logarithms have 65,535 steps; books of scales and colours are nearly exact, that of SH
#: is less so.
OUR_SOG = Loss(4 / 65535, 0.01, 1.1, 0.005, sh=lambda sh: 0.05)
LOSSES = {
    "our SOG": OUR_SOG,
    "our unpacked SOG": OUR_SOG,
    "our PLY": Loss(),
    "our SPLAT": SPLAT,
    "SPLAT": SPLAT,
    "KSPLAT 0": Loss(color=KSPLAT.color, sh_degree=2),
    "KSPLAT 1": replace(KSPLAT, sh=lambda sh: CUT * np.abs(sh) + SMALL),
    "KSPLAT 2": replace(KSPLAT, sh=lambda sh: np.ptp(sh) / 255 + 1e-6 if sh.size else 0),
}


@pytest.mark.parametrize(
    "file", [row for row in WRITTEN if row.values[0][0].removesuffix(" in sections") in LOSSES], indirect=True
)
def test_splats_of_other_writers_are_near_their_source(file: File) -> None:
    loss = LOSSES[file.writer.removesuffix(" in sections")]
    got, source = read_scene(file.path).splats, read_scene(file.source).splats
    assert got.sh_degree == min(source.sh_degree, loss.sh_degree)
    order = np.linalg.norm(got.center[:, None] - source.center, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(source)))
    source = source.take(order)
    within(got.center, source.center, loss.center)
    within(got.scale, source.scale, loss.scale * source.scale)
    assert rotation_degrees(got.quat_xyzw, source.quat_xyzw).max() <= loss.degrees
    within(got.rgb, source.rgb if loss.color < 1e-5 else source.rgb.clip(0, 1), loss.color)
    within(got.opacity, source.opacity, loss.color)
    sh = source.with_max_sh(got.sh_degree).sh
    within(got.sh, sh, loss.sh(sh))


@pytest.mark.parametrize("file", [*WRITTEN[1::2], *FILES[len(WRITTEN) :]], indirect=True)
def test_files_of_other_writers_can_be_baked(file: File, tmp_path: Path) -> None:
    assert run(["build-lod", str(file.path), "-o", str(tmp_path / "out.spz")]) == 0


@pytest.mark.parametrize("suffix", [".spz", ".ply", ".sog"])
def test_a_noted_up_axis_does_not_change_what_splat_transform_reads(
    foreign: Foreign, suffix: str, tmp_path: Path
) -> None:
    found = []
    for up in (None, "y"):
        path = tmp_path / f"{up}{suffix}"
        sparklod.write(path, Scene(random_splats(300, sh_degree=1), up=up))
        found.append(foreign.read(path))
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(found[0], column), getattr(found[1], column), column)


# --- SPZ --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["hand-v1.spz", "sh3-v2.spz", "sh3-v3.spz", "hand-v4.spz", "tree-v2.spz", "tree-v3.spz"]
)
def test_mkkelloggs_viewer_reads_only_spz_1_and_2_without_a_tree(foreign: Foreign, name: str) -> None:
    """As docs/formats/spz.md says: once this fails, its table has changed."""
    if name in ("hand-v1.spz", "sh3-v2.spz"):
        centers = read_scene(GOLDEN / name).splats.center
        np.testing.assert_allclose(foreign.spz_centers(GOLDEN / name), centers, rtol=1e-6)
    else:
        with pytest.raises(AssertionError, match="reading 'shDegree'"):
            foreign.spz_centers(GOLDEN / name)


@pytest.mark.parametrize("name", ["hand-v1.spz", "tree-v2.spz", "tree-v3.spz", "hand-v4.spz"])
def test_splat_transform_reads_all_nodes_of_any_spz(foreign: Foreign, name: str) -> None:
    theirs = flipped(foreign.read(GOLDEN / name)).center
    np.testing.assert_allclose(theirs, read_scene(GOLDEN / name).splats.center, rtol=1e-6)


def covariances(splats: Splats) -> NDArray[np.float64]:
    """(3, 3, N) in units of the largest variance of each splat, which axes reversed by a mirror do not change."""
    axes = rotation_matrices(splats.quat_xyzw) * (splats.scale.T / splats.scale.max(axis=1))
    return np.einsum("ikn,jkn->ijn", axes, axes)


def check_shapes(one: Splats, other: Splats) -> None:
    """Assert that splats are equal up to the axes of their ellipsoids."""
    assert one.sh_degree == other.sh_degree
    for column in set(COLUMNS) - {"quat_xyzw"}:
        values = getattr(one, column), getattr(other, column)
        np.testing.assert_allclose(*values, rtol=2e-5, atol=2e-6, err_msg=column)
    # A rotation between two codes may get the other one when it is coded again, which turns it by 0.1 degrees.
    np.testing.assert_allclose(covariances(one), covariances(other), atol=2e-3)


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_spz_library_reads_version_4_as_sparklod_does(
    spz_library: SpzLibrary, tmp_path: Path, sh_degree: int, antialiased: bool
) -> None:
    path = tmp_path / "scene.spz"
    sparklod.write(path, Scene(random_splats(70_000, sh_degree=sh_degree), antialiased=antialiased), spz_version=4)
    theirs, found = spz_library.read(path), sparklod.read(path)
    assert (found.format, found.antialiased, theirs.antialiased) == ("SPZ 4", antialiased, antialiased)
    check_shapes(theirs.splats, found.splats)


@pytest.mark.parametrize("up", SYSTEM_OF_UP)
def test_the_spz_library_turns_a_noted_up_axis_upright(spz_library: SpzLibrary, tmp_path: Path, up: str) -> None:
    path = tmp_path / "scene.spz"
    sparklod.write(path, Scene(random_splats(100, sh_degree=3), up=up), spz_version=4)
    scene = sparklod.read(path)
    assert scene.up == up
    check_shapes(spz_library.read(path, "RUB").splats, Transform.from_up(up).apply(scene.splats))


#: Directions by the letters of coordinate systems: right, left, up, down, back and front.
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_coordinate_system_sets_the_up_axis_and_turns_nothing(
    spz_library: SpzLibrary, tmp_path: Path, system: str, version: int
) -> None:
    source, path = tmp_path / "scene.spz", tmp_path / "other.spz"
    sparklod.write(source, Scene(random_splats(100, sh_degree=3), up="y"), spz_version=4)
    files = {"source": str(source), "path": str(path)}
    spz_library.ask({"do": "write", **files, "from": "RUB", "version": version, "system": system})
    scene = sparklod.read(path)
    axes = np.array([DIRECTIONS[letter] for letter in system])  # where x, y and z point, as right, up and back
    assert scene.up == {1: "", -1: "-"}[axes[:, 1].sum()] + "xyz"[np.flatnonzero(axes[:, 1])[0]]
    assert any("left-handed" in note for note in scene.notes) is bool(np.linalg.det(axes) < 0)
    # It writes the records of older versions, but does not find them when it reads.
    check_shapes(spz_library.read(path, system if version == 4 else "UNSPECIFIED").splats, scene.splats)
    if system == SYSTEM_OF_UP[scene.up]:
        upright, original = Transform.from_up(scene.up).apply(scene.splats), sparklod.read(source).splats
        np.testing.assert_allclose(upright.center, original.center, atol=2e-3)  # it writes 12 fractional bits
        np.testing.assert_allclose(upright.sh, original.sh, atol=0.02)


def test_a_real_file_of_version_4_is_read_and_written_alike(spz_library: SpzLibrary, tmp_path: Path) -> None:
    real, path = real_scene("biker.spz"), tmp_path / "again.spz"
    scene = sparklod.read(real)
    check_shapes(spz_library.read(real).splats, scene.splats)
    assert scene.format == "SPZ 4"
    sparklod.write(path, scene, spz_version=4, fractional_bits=int(scene.header["fractional_bits"]))
    opacity = scene.splats.opacity  # compensates for rounded scales in the file
    check_shapes(dataclasses.replace(spz_library.read(path).splats, opacity=opacity), scene.splats)


# --- SOG and Streamed SOG ---------------------------------------------------------------------------------------------


def sorted_splats(splats: Splats) -> Splats:
    def steps(values: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.round(values.astype(np.float64), 4)

    x, y, z = steps(splats.center).T
    return splats.take(np.lexsort((*steps(splats.rgb).T, *steps(splats.scale).T, x, y, z)))


def test_splat_transform_reads_every_level_of_streamed_sog(splat_transform: SplatTransform, shot: Shot) -> None:
    """Of sparklod, and of a file written by hand, which has spherical harmonics."""
    assert [len(level) for level in splat_transform.levels(shot.file)] == counts_of(shot.file)
    for file in (shot.file, GOLDEN / "sh1-streamed-sog" / "lod-meta.json"):
        scene = read_parts(file)
        for level, splats in enumerate(splat_transform.levels(file)):
            check_same(sorted_splats(scene.splats.take(scene.level(level))), sorted_splats(splats), 0.2)


@pytest.mark.parametrize("name", ["scene.sog", "meta.json"])
def test_splat_transform_3_reads_sog(splat_transform: SplatTransform, sog: dict[str, Path], name: str) -> None:
    (theirs,) = splat_transform.levels(sog[name])
    check_same(sorted_splats(read_scene(sog[name]).splats), sorted_splats(theirs), 0.2)


def test_streamed_sog_of_splat_transform_has_no_errors(engines_dir: Path, tmp_path: Path) -> None:
    """Two levels in several regions and chunk files, and an environment."""
    programs = engines_dir / "node_modules" / ".bin"
    environment = os.environ | {"PATH": os.pathsep.join([str(programs), os.environ.get("PATH", "")])}
    divided = ["--lod-chunk-count", "8", "--lod-chunk-extent", "4", "--lod-chunk-min", "1"]
    splats = sparklod.read(FIXTURES / "demo.ply").splats
    levels: list[Path | str] = []
    for level, step in enumerate((1, 4)):
        sparklod.write(tmp_path / f"{level}.ply", Scene(splats.take(slice(0, None, step))))
        levels += [tmp_path / f"{level}.ply", "-l", str(level)]
    levels += [tmp_path / "1.ply", "-l", "-1"]
    command = [programs / "splat-transform", "-q", "-w", "-g", "cpu", *divided, *levels, tmp_path / "lod-meta.json"]
    subprocess.run(list(map(str, command)), env=environment, check=True, timeout=300)
    report, _ = inspect(tmp_path, ReportSettings(check=True))
    assert report.streamed_sog is not None
    assert len(report.streamed_sog.levels) == 2
    assert report.streamed_sog.files > 2
    assert [finding for finding in report.findings or [] if finding.severity == "error"] == []
    assert report.streamed_sog.environment is not None
