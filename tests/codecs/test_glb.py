"""GLB: what KHR_gaussian_splatting promises is written, nodes place splats, and hostile files are refused."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_glb
from sparklod_cli.codecs import gltf as glb
from sparklod_cli.codecs.gltf_container import TURNS
from sparklod_cli.codecs.options import PROFILES, WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import AXES, Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES
from tests.scenes import random_splats

SPLATS = random_splats(50, sh_degree=2)


def written(scene: Scene, profile: str = "khronos", threads: int = 1) -> bytes:
    return b"".join(glb.encode(scene, WriteOptions(glb_profile=profile), threads=threads))


def read(data: bytes) -> Scene:
    scene = decode_file(glb, io.BytesIO(data))
    assert isinstance(scene, Scene)
    return scene


def root_of(data: bytes) -> dict[str, Any]:
    return by_hand_glb.split(data)[0]


def content_of(data: bytes) -> bytes:
    return by_hand_glb.split(data)[1]


def with_root(data: bytes, **changes: Any) -> bytes:
    return by_hand_glb.container(root_of(data) | changes, content_of(data))


def linear(splats: Splats) -> dict[str, Any]:
    wxyz = splats.quat_xyzw[:, [3, 0, 1, 2]]
    return {name: getattr(splats, name) for name in ("center", "scale", "opacity", "rgb", "sh")} | {"quat_wxyz": wxyz}


@pytest.mark.parametrize("profile", PROFILES)
def test_the_primitive_is_what_the_extension_says(profile: str) -> None:
    data = written(Scene(SPLATS), profile)
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    root = root_of(data)
    ((primitive,),) = (mesh["primitives"] for mesh in root["meshes"])
    names, extension = primitive["attributes"], primitive["extensions"][by_hand_glb.NAME]
    assert primitive["mode"] == 0
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    sh = [f"{by_hand_glb.NAME}:SH_DEGREE_{d}_COEF_{n}" for d in (1, 2) for n in range(2 * d + 1)]
    own = [f"{by_hand_glb.NAME}:{name}" for name in ("ROTATION", "SCALE")]
    if profile == "khronos":
        own += [f"{by_hand_glb.NAME}:{name}" for name in ("OPACITY", "SH_DEGREE_0_COEF_0")]
        assert "extensionsRequired" not in root, "it can be shown as points"
    else:
        own.append("COLOR_0")
        assert extension["extensions"] == {by_hand_glb.SPZ: {"bufferView": 0}}
        assert root["extensionsRequired"] == [by_hand_glb.NAME, by_hand_glb.SPZ]
        assert all("bufferView" not in accessor for accessor in root["accessors"])
        view = root["bufferViews"][0]
        assert content_of(data)[: view["byteLength"]][:3] == b"\x1f\x8b\x08"
    assert names.keys() == {"POSITION", *own, *sh}
    assert all(accessor["count"] == 50 for accessor in root["accessors"])
    position = root["accessors"][names["POSITION"]]
    np.testing.assert_array_equal(np.float32(position["min"]), SPLATS.center.min(axis=0))
    np.testing.assert_array_equal(np.float32(position["max"]), SPLATS.center.max(axis=0))


@pytest.mark.parametrize("profile", PROFILES)
def test_the_same_bytes_for_any_number_of_threads(profile: str) -> None:
    scene = Scene(random_splats(20_000, sh_degree=1))
    assert written(scene, profile) == written(scene, profile, threads=3)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("up", [None, *AXES])
def test_the_axis_that_points_up_is_turned_to_y_in_the_node_and_noted(up: str | None, profile: str) -> None:
    data = written(Scene(SPLATS, up=up), profile)
    node = root_of(data)["nodes"][0]
    if profile == "cesium":  # CesiumJS reads the matrix of the node of a tile, and nothing else
        assert set(node) == {"mesh", "matrix"}
        matrix = np.array(node["matrix"]).reshape(4, 4).T
        np.testing.assert_array_equal(matrix @ [*AXES[up or "y"], 1], [*AXES["y"], 1])
        assert np.linalg.det(matrix) == 1
    elif up is not None:
        x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]))
        axis, v = np.array([x, y, z]), np.array(AXES[up])
        turned = v + 2 * np.cross(axis, np.cross(axis, v) + w * v)
        np.testing.assert_allclose(turned, AXES["y"], atol=1e-12)
    assert ("rotation" in node) == (profile != "cesium" and up not in (None, "y"))
    back = read(data)
    assert back.up == up
    np.testing.assert_allclose(back.splats.center, SPLATS.center, atol=0.01)


@pytest.mark.parametrize(
    ("asset", "node", "up"),
    [
        ({}, {}, "y"),
        ({}, {"rotation": TURNS["z"]}, "y"),
        ({"generator": "another 1", "extras": {"up": "z"}}, {}, "y"),
        ({"generator": "sparklod 1"}, {}, None),  # nobody knew it
        ({"generator": "sparklod 1", "extras": {"up": "z"}}, {"rotation": TURNS["z"]}, "z"),
        (
            {"generator": "sparklod 1", "extras": {"up": "z"}},
            {"rotation": TURNS["x"]},
            "y",
        ),  # turned by another program
        ({"generator": "sparklod 1", "extras": {"up": "z"}}, {}, "y"),
    ],
)
def test_y_is_up_unless_sparklod_wrote_the_file(asset: dict[str, Any], node: dict[str, Any], up: str | None) -> None:
    back = read(by_hand_glb.glb(**linear(SPLATS), asset={"version": "2.0"} | asset, nodes=[{"mesh": 0} | node]))
    assert back.up == up


def test_nodes_place_the_splats_of_others() -> None:
    half = TURNS["-z"]
    nodes = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "rotation": half, "scale": [2, 2, 2]}]
    back = read(by_hand_glb.glb(**linear(SPLATS), nodes=nodes))
    rotation = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    expected = Transform(rotation, 2.0, np.array([1.0, 2, 3])).apply(SPLATS)
    for column in ("center", "scale", "sh"):
        np.testing.assert_allclose(getattr(back.splats, column), getattr(expected, column), atol=1e-5)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * rotation, (1, 2, 3)
    same = read(by_hand_glb.glb(**linear(SPLATS), nodes=[{"mesh": 0, "matrix": matrix.T.ravel().tolist()}]))
    np.testing.assert_allclose(same.splats.center, back.splats.center, atol=1e-5)


def chain(length: int, **fields: Any) -> list[dict[str, Any]]:
    """Nodes each below the one before, of which the last has the splats."""
    return [*({"children": [number + 1]} | fields for number in range(length - 1)), {"mesh": 0} | fields]


@pytest.mark.parametrize(
    ("nodes", "text"),
    [
        ([{"mesh": 0, "scale": [1, 2, 1]}], "stretches, shears or mirrors"),
        ([{"mesh": 0, "scale": [-1, 1, 1]}], "stretches, shears or mirrors"),
        ([{"mesh": 0, "scale": [0, 0, 0]}], "is singular"),
        ([{"mesh": 0, "matrix": [0] * 16}], "is not affine"),
        ([{"mesh": 0, "matrix": [1] * 15}], "expected a list of 16 numbers"),
        ([{"mesh": 0, "rotation": [0, 0, 0, 0]}], "no unit quaternion"),
        ([{"mesh": 0, "translation": [1e300, 0, 0]}], "expected a (list of 3 numbers|number up to)"),
        ([{"mesh": 0, "translation": "far"}], "expected a (list of 3 numbers|number up to)"),
        (chain(40, scale=[1e12] * 3), "multiply to numbers beyond"),
        (chain(40, translation=[1e12, 0, 0]), "multiply to numbers beyond"),
        (chain(40, scale=[1e-12] * 3), "is singular"),
        (chain(2, scale=[1e-10] * 3), r"the scale 1e-20 is out of range"),
        ([{"mesh": 0, "children": [1]}, {"children": [0]}], "linked in a circle"),
        ([{"mesh": 0, "children": [0]}], "linked in a circle"),
        ("none", "nodes of its JSON is no array of objects"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_nodes_that_cannot_be_followed_are_refused(nodes: Any, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        read(by_hand_glb.glb(**linear(SPLATS), nodes=nodes))


def changed(what: str, index: int, **changes: Any) -> bytes:
    """The golden file with some keys of an object of its JSON changed; None removes a key."""
    data = (FIXTURES / "golden" / "sh2.glb").read_bytes()
    items = root_of(data)[what]
    items[index] = {key: value for key, value in (items[index] | changes).items() if value is not None}
    return with_root(data, **{what: items})


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (changed("accessors", 0, count=61), "accessor 0 has 61 values, more than its buffer view holds"),
        (changed("accessors", 0, count=1 << 31), "more than its buffer view holds"),
        (changed("accessors", 0, count=-1), "count of accessors.0.: .* not -1"),
        (changed("accessors", 0, count=1e3), "count of accessors.0.: .* not 1000.0"),
        (changed("accessors", 0, count=59), "different numbers of values"),
        (changed("accessors", 0, byteOffset=4), "more than its buffer view holds"),
        (changed("accessors", 0, bufferView=99), "there is no 99 among the 13 bufferViews"),
        (changed("accessors", 0, bufferView=True), "there is no True"),
        (changed("accessors", 0, bufferView=None), "sparse, or has no buffer view"),
        (changed("accessors", 0, sparse={}), "sparse, or has no buffer view"),
        (changed("accessors", 0, type="VEC4"), "not VEC3 of"),
        (changed("accessors", 1, componentType=5121), "not VEC4 of"),
        (changed("bufferViews", 0, byteLength=1 << 31), "buffer view 0 ends beyond its buffer"),
        (changed("bufferViews", 0, byteOffset=-4), "byteOffset of bufferViews.0.: .* not -4"),
        (changed("bufferViews", 0, byteStride=4), "stride of accessor 0 is 4"),
        (changed("bufferViews", 0, byteStride=1 << 30), "stride of accessor 0 is"),
        (changed("bufferViews", 0, buffer=1), "there is no 1 among the 1 buffers"),
        (changed("buffers", 0, byteLength=100), "ends beyond its buffer"),
        (changed("buffers", 0, uri="http://example.org/x.bin"), "not a file below its folder"),
        (changed("meshes", 0, primitives=[]), "no primitive has the extension"),
        (b"glTF\1\0\0\0" + bytes(20), "version 1 is unknown"),
        (by_hand_glb.container({"meshes": [[]]}, b""), "no array of objects"),
        (by_hand_glb.glb_spz(b"not gzip", 3), "."),
    ],
)
def test_hostile_files_are_refused(data: bytes, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        read(data)


def test_sh_of_a_degree_are_complete_or_refused() -> None:
    data = (FIXTURES / "golden" / "sh2.glb").read_bytes()
    root = root_of(data)
    for name in ("SH_DEGREE_1_COEF_1", "SH_DEGREE_2_COEF_4"):
        meshes = json.loads(json.dumps(root["meshes"]))
        del meshes[0]["primitives"][0]["attributes"][f"{by_hand_glb.NAME}:{name}"]
        with pytest.raises(FormatError, match=r"SH of degree \d are incomplete"):
            read(with_root(data, meshes=meshes))


def test_what_is_not_finite_is_passed_on_for_others_to_refuse() -> None:
    splats = SPLATS.take(slice(None))
    columns = linear(splats)
    columns["scale"] = np.where(np.arange(50)[:, None] == 7, np.nan, columns["scale"])
    back = read(by_hand_glb.glb(**columns)).splats
    assert np.flatnonzero(~back.is_valid()).tolist() == [7]


def test_properties_of_other_kinds_are_noted() -> None:
    data = written(Scene(SPLATS))
    meshes = root_of(data)["meshes"]
    extension = meshes[0]["primitives"][0]["extensions"][by_hand_glb.NAME]
    extension |= {"colorSpace": "lin_rec709_display", "kernel": "custom"}
    notes = read(with_root(data, meshes=meshes)).notes
    assert [note.split(" is read as ")[1] for note in notes] == [
        "ellipse",
        "srgb_rec709_display, which makes its colours too dark",
    ]
    extension |= {"colorSpace": "BT.709-sRGB", "kernel": "ellipse"}  # as drafts called it
    assert read(with_root(data, meshes=meshes)).notes == ()


@pytest.mark.parametrize("profile", PROFILES)
def test_an_opacity_above_1_is_refused(profile: str) -> None:
    splats = dataclasses.replace(SPLATS, opacity=SPLATS.opacity + 1)
    with pytest.raises(FormatError, match="GLB holds no opacity above 1"):
        glb.settled(Scene(splats), WriteOptions(glb_profile=profile))


VALIDATE = """
const validator = require(process.argv[1]), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(
  (report) => console.log(JSON.stringify(report.issues.messages)));
"""


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_the_validator_of_khronos_finds_nothing_but_names_that_it_does_not_know(profile: str, tmp_path: Path) -> None:
    folder = os.environ.get("FOREIGN_DIR")
    package = Path(folder or "").absolute() / "node_modules" / "gltf-validator"
    if not folder or not package.is_dir():
        pytest.skip("FOREIGN_DIR names no folder whose node_modules has gltf-validator")
    path = tmp_path / "scene.glb"
    path.write_bytes(written(Scene(SPLATS, up="-y"), profile))
    done = subprocess.run(["node", "-e", VALIDATE, package, path], capture_output=True, text=True, check=True)
    # It knows no attributes of extensions, and no extension that has them.
    unknown = ("MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION", "UNUSED_OBJECT")
    found = [each for each in json.loads(done.stdout) if each["code"] not in unknown or each["severity"] == 1]
    assert not found
    names = [each["pointer"] for each in json.loads(done.stdout) if each["code"] == unknown[0]]
    assert all(f"/{by_hand_glb.NAME}:" in name for name in names)


@pytest.mark.slow
def test_splats_of_splat_transform_are_read(tmp_path: Path) -> None:
    folder = os.environ.get("ENGINES_DIR")
    program = Path(folder or "").absolute() / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    if not folder or not program.is_file():
        pytest.skip("ENGINES_DIR names no folder whose node_modules has @playcanvas/splat-transform")
    path, source = tmp_path / "scene.glb", FIXTURES / "sh2.ply"
    subprocess.run(["node", program, "-q", "-w", "-g", "cpu", source, path], check=True)
    # It turns splats by half a turn about z on their way from PLY to glTF.
    expected = Transform.from_euler(0, 0, 180).apply(read_scene(source).splats)
    back = read_scene(path).splats
    for column in ("center", "scale", "opacity", "rgb", "sh"):
        np.testing.assert_allclose(getattr(back, column), getattr(expected, column), atol=2e-6)
    assert np.abs(np.einsum("ij,ij->i", back.quat_xyzw, expected.quat_xyzw)).min() > 1 - 1e-6
