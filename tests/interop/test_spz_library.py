"""SPZ against the library of the format's authors: version 4, and the coordinate systems of extension records."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import sparklod_cli as sparklod
from sparklod_cli.codecs.spz import SYSTEM_OF_UP, SYSTEMS
from sparklod_cli.model.gaussian import normalized_quat, rotation_matrices
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from tests.conftest import real_scene
from tests.interop import npm
from tests.interop.node import Node
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

PACKAGE = {"@adobe/spz": "0.2.3"}


class Library:
    """One Node process with the library; `spz_library.mjs` describes its requests."""

    def __init__(self, packages: Path, scratch: Path) -> None:
        self._scratch = scratch
        program = Path(__file__).with_name("spz_library.mjs")
        self._node = Node([str(program), str(packages)], scratch / "stderr.txt")
        self.ask, self.close = self._node.ask, self._node.close

    def read(self, path: Path, to: str = "UNSPECIFIED") -> Scene:
        """Returns the splats of a file, turned into a coordinate system; by default they stay as they are."""
        answer = self.ask({"do": "read", "path": str(path), "to": to, "out": str(self._scratch / "column")})
        columns = {name: np.fromfile(file, "<f4").astype(np.float64) for name, file in answer["columns"].items()}
        count = answer["count"]

        def rows(name: str, *shape: int) -> NDArray[np.float64]:
            return columns[name].reshape(count, *shape)

        with np.errstate(over="ignore"):
            linear: dict[str, Any] = {
                "center": rows("positions", 3),
                "scale": np.exp(rows("scales", 3)),
                "quat_xyzw": normalized_quat(rows("rotations", 4).astype(np.float32)),
                "opacity": 1 / (1 + np.exp(-columns["alphas"])),
                "rgb": SH_C0 * rows("colors", 3) + 0.5,
                "sh": rows("sh", len(columns["sh"]) // (3 * count), 3),
            }
        arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in linear.items()}
        return Scene(Splats(**arrays), antialiased=answer["antialiased"])


@pytest.fixture(scope="module")
def library(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Library]:
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    packages = npm.folder_with(PACKAGE, variable="SPZ_DIR", request=request, tmp_path_factory=tmp_path_factory)
    process = Library(packages, tmp_path_factory.mktemp("spz-library"))
    yield process
    process.close()


def covariances(splats: Splats) -> NDArray[np.float64]:
    """(3, 3, N) in units of the largest variance of each splat; axes that a mirror turns round do not matter here."""
    axes = rotation_matrices(splats.quat_xyzw) * (splats.scale.T / splats.scale.max(axis=1))
    return np.einsum("ikn,jkn->ijn", axes, axes)


def same(one: Splats, other: Splats) -> None:
    assert one.sh_degree == other.sh_degree
    for column in COLUMNS:
        if column != "quat_xyzw":
            values = getattr(one, column), getattr(other, column)
            np.testing.assert_allclose(*values, rtol=2e-5, atol=2e-6, err_msg=column)
    # A rotation between two codes may get the other one when it is coded again, which turns it by 0.1 degrees.
    np.testing.assert_allclose(covariances(one), covariances(other), atol=2e-3)


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_library_reads_version_4_as_sparklod_does(
    library: Library, tmp_path: Path, sh_degree: int, antialiased: bool
) -> None:
    path = tmp_path / "scene.spz"
    sparklod.write(path, Scene(random_splats(70_000, sh_degree=sh_degree), antialiased=antialiased), spz_version=4)
    theirs, ours = library.read(path), sparklod.read(path)
    assert (ours.format, ours.antialiased) == ("SPZ 4", antialiased)
    assert theirs.antialiased is antialiased
    same(theirs.splats, ours.splats)


@pytest.mark.parametrize("up", SYSTEM_OF_UP)
def test_the_library_turns_upright_what_sparklod_notes(library: Library, tmp_path: Path, up: str) -> None:
    path = tmp_path / "scene.spz"
    sparklod.write(path, Scene(random_splats(100, sh_degree=3), up=up), spz_version=4)
    scene = sparklod.read(path)
    assert scene.up == up
    same(library.read(path, "RUB").splats, Transform.from_up(up).apply(scene.splats))


#: Directions by the letters of coordinate systems: right, left, up, down, back and front.
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_coordinate_system_says_what_is_up_and_nothing_is_turned(
    library: Library, tmp_path: Path, system: str, version: int
) -> None:
    source, path = tmp_path / "scene.spz", tmp_path / "other.spz"
    sparklod.write(source, Scene(random_splats(100, sh_degree=3), up="y"), spz_version=4)
    files = {"source": str(source), "path": str(path)}
    library.ask({"do": "write", **files, "from": "RUB", "version": version, "system": system})
    scene = sparklod.read(path)
    axes = np.array([DIRECTIONS[letter] for letter in system])  # where x, y and z point, as right, up and back
    assert scene.up == {1: "", -1: "-"}[axes[:, 1].sum()] + "xyz"[np.flatnonzero(axes[:, 1])[0]]
    assert any("left-handed" in note for note in scene.notes) is bool(np.linalg.det(axes) < 0)
    # It writes the records of older versions, but does not find them when it reads.
    same(library.read(path, system if version == 4 else "UNSPECIFIED").splats, scene.splats)
    if system == SYSTEM_OF_UP[scene.up]:
        upright, original = Transform.from_up(scene.up).apply(scene.splats), sparklod.read(source).splats
        np.testing.assert_allclose(upright.center, original.center, atol=2e-3)  # it writes 12 fractional bits
        np.testing.assert_allclose(upright.sh, original.sh, atol=0.02)


def test_a_real_file_of_version_4_is_read_and_written_alike(library: Library, tmp_path: Path) -> None:
    real, path = real_scene("biker.spz"), tmp_path / "again.spz"
    ours = sparklod.read(real)
    same(library.read(real).splats, ours.splats)
    assert ours.format == "SPZ 4"
    bits = int(ours.header["fractional_bits"])
    sparklod.write(path, ours, spz_version=4, fractional_bits=bits)
    again = dataclasses.replace(library.read(path).splats, opacity=ours.splats.opacity)  # makes up for rounded scales
    same(again, ours.splats)
