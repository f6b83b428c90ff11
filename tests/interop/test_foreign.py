"""sparklod, splat-transform and Spark read the same splats from files of sparklod and of other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply, sog, splat
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.splats import Splats
from tests.conftest import FIXTURES, real_scene
from tests.interop.foreign import Foreign
from tests.interop.laws import EXT_DEGREES, HALF, TINY, Floats, degrees_between, held_by_ext_sh, within
from tests.interop.spark import Spark

pytestmark = pytest.mark.slow

#: Makes a file from a PLY file: takes the programs, the PLY file and a folder, and returns the path.
Writer = Callable[[Foreign, Path, Path], Path]


def by(action: str, name: str, **options: Any) -> Writer:
    return lambda foreign, source, folder: foreign.write(action, source, folder / name, **options)


def our_folder(_: Foreign, source: Path, folder: Path) -> Path:
    for name, content in sog.encode_files(read_scene(source)):
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
    "our SOG": ours(sog, "ours.sog"),
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
REAL = [
    *((None, "meadow.sog"), ("compressed PLY", "playbot-125k.ply"), ("KSPLAT 2", "playbot-125k.ply")),
]


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
    """Rotates splats by 180 degrees about x, from the axes of PLY files to those of SPZ's specification."""
    signs = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1]  # -1 for SH that are odd in y and z together
    return replace(
        splats,
        center=splats.center * np.float32([1, -1, -1]),
        quat_xyzw=splats.quat_xyzw * np.float32([1, -1, -1, 1]),
        sh=splats.sh * np.float32(signs)[None, : splats.sh.shape[1], None],
    )


def check_same(ours: Splats, theirs: Splats, degrees: float) -> None:
    """Asserts that splats are equal up to float32 arithmetic."""
    within(ours.center, theirs.center, 2.0**-22 * np.abs(theirs.center).max())
    within(np.log(ours.scale), np.log(theirs.scale), 2e-6)
    assert degrees_between(ours.quat_xyzw, theirs.quat_xyzw).max() <= degrees
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


@pytest.mark.parametrize("writer, scene", REAL)
def test_splat_transform_reads_the_same_splats_of_real_scenes(
    foreign: Foreign, make: Callable[..., File], writer: str | None, scene: str
) -> None:
    check_with_splat_transform(foreign, make(writer, real_scene(scene)))


#: Changes to headers of KSPLAT: offset and type of a number, and what to add to it; 0 sets the number to 0.
HEADERS = {
    "fewer splats than there is room for": [(16, "<u4", -5), (4096, "<u4", -5)],
    "SH from -1.5 to 1.5 unless it says otherwise": [(36, "<f4", 0), (40, "<f4", 0)],
    "32767 steps unless it says otherwise": [(4096 + 24, "<u4", 0), (4096 + 1024 + 24, "<u4", 0)],
    "a newer minor version": [(1, "u1", 6)],
}


@pytest.mark.parametrize("changes", HEADERS.values(), ids=HEADERS.keys())
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


def spark_degrees(file: File, quat: Floats) -> Floats:
    """(N,) degrees by which Spark may be off; it does not give quaternions their length, and takes w as it is."""
    length = {".splat": 1 / 64, ".ksplat": 2.0**-9}.get(file.path.suffix, 0)  # off by that, see `LOSSES`
    w = np.abs(quat[:, 3].astype(np.float64)).clip(0, 1)
    half_angles = [np.arccos((w * (1 + change)).clip(0, 1)) for change in (-length, 0, length)]
    return EXT_DEGREES + np.degrees(2 * np.ptp(half_angles, axis=0))


def seen_by_spark(file: File, splats: Splats) -> Floats:
    """Returns (N, K, 3) SH as Spark reads them: it maps bytes 0..255 of compressed PLY to -4..4, not 256 parts."""
    if "compressed" not in file.path.name:
        return splats.sh
    codes = np.clip((splats.sh.astype(np.float64) / 8 + 0.5) * 256 - 0.5, 0, 255)
    return codes / 255 * 8 - 4


def spark_can_read(writer: str | None, source: str) -> bool:
    """Whether Spark 2.2 can read it: not SPZ 4, nor several files, as its worker gets only one here."""
    return writer not in ("SPZ 4", "unpacked SOG", "our unpacked SOG") and not source.endswith("meta.json")


@pytest.mark.parametrize("file", [row for row in FILES if spark_can_read(*row.values[0])], indirect=True)
def test_spark_reads_the_same_splats(spark: Spark, file: File) -> None:
    got, splats = spark.load(file.path), read_scene(file.path).splats
    within(got.center, splats.center, 2.0**-21 * np.abs(splats.center).max())
    within(got.rgb, splats.rgb, HALF * np.abs(splats.rgb) + TINY)
    log_scale = np.log(splats.scale.astype(np.float64))
    within(got.log_scale, log_scale, HALF * np.abs(log_scale) + TINY)
    within(
        degrees_between(got.quat_xyzw, splats.quat_xyzw), np.zeros(len(splats)), spark_degrees(file, splats.quat_xyzw)
    )
    within(got.alpha, splats.opacity, HALF * splats.opacity + TINY)
    held, tolerance = held_by_ext_sh(seen_by_spark(file, splats))
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
    """Splats are read as they were written, up to the precision of the format."""
    loss = LOSSES[file.writer.removesuffix(" in sections")]
    got, source = read_scene(file.path).splats, read_scene(file.source).splats
    assert got.sh_degree == min(source.sh_degree, loss.sh_degree)
    order = np.linalg.norm(got.center[:, None] - source.center, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(source)))
    source = source.take(order)
    within(got.center, source.center, loss.center)
    within(got.scale, source.scale, loss.scale * source.scale)
    assert degrees_between(got.quat_xyzw, source.quat_xyzw).max() <= loss.degrees
    within(got.rgb, source.rgb if loss.color < 1e-5 else source.rgb.clip(0, 1), loss.color)
    within(got.opacity, source.opacity, loss.color)
    sh = source.with_max_sh(got.sh_degree).sh
    within(got.sh, sh, loss.sh(sh))


@pytest.mark.parametrize("file", [*WRITTEN[1::2], *FILES[len(WRITTEN) :]], indirect=True)
def test_files_of_other_writers_can_be_baked(file: File, tmp_path: Path) -> None:
    assert run(["build-lod", str(file.path), "-o", str(tmp_path / "out.spz")]) == 0


@pytest.mark.parametrize("name", ["hand-v1.spz", "sh3-v2.spz"])
def test_mkkelloggs_viewer_reads_spz_1_and_2(foreign: Foreign, name: str) -> None:
    path = FIXTURES / "golden" / name
    np.testing.assert_allclose(foreign.spz_centers(path), read_scene(path).splats.center, rtol=1e-6)


@pytest.mark.parametrize("name", ["sh3-v3.spz", "hand-v4.spz", "tree-v2.spz", "tree-v3.spz"])
def test_mkkelloggs_viewer_refuses_other_spz(foreign: Foreign, name: str) -> None:
    """As docs/formats/spz.md says: once this fails, its table has changed."""
    with pytest.raises(AssertionError, match="reading 'shDegree'"):
        foreign.spz_centers(FIXTURES / "golden" / name)


@pytest.mark.parametrize("name", ["hand-v1.spz", "tree-v2.spz", "tree-v3.spz", "hand-v4.spz"])
def test_splat_transform_reads_all_nodes_of_any_spz(foreign: Foreign, name: str) -> None:
    path = FIXTURES / "golden" / name
    theirs = flipped(foreign.read(path)).center
    np.testing.assert_allclose(theirs, read_scene(path).splats.center, rtol=1e-6)
