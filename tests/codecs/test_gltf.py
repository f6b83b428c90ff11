"""glTF with splats, binary or as JSON: what is written, nodes, buffers, drafts, scales as logarithms, and refusals."""

from __future__ import annotations

import dataclasses
import json
import os
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_glb
from sparklod_cli.codecs import gltf, gltf_container
from sparklod_cli.codecs.formats import PROFILES, WriteOptions
from sparklod_cli.codecs.gltf import READ_AS_LOGS
from sparklod_cli.codecs.gltf_container import TURNS
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.files import companions
from sparklod_cli.io.reading import open_reader, read_scene
from sparklod_cli.model.scene import AXES, Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, NotSplatsError, PromiseError, UnsupportedError, VersionError
from tests.codecs.cases import decode, encode, linear
from tests.conftest import FIXTURES
from tests.part_files import open_companion
from tests.scenes import random_splats

pytestmark = pytest.mark.filterwarnings("error")

SH2, SH0 = random_splats(40, sh_degree=2), random_splats(30, seed=2)
A, B = (by_hand_glb.glb(**linear(Scene(splats))) for splats in (SH2, SH0))
GOLDEN = (FIXTURES / "golden" / "sh2.glb").read_bytes()


def written(scene: Scene, profile: str = "khronos", threads: int = 1) -> bytes:
    return encode(gltf, scene, WriteOptions(glb_profile=profile), threads=threads)


def read(data: bytes, files: dict[str, bytes] | None = None) -> Scene:
    return decode(gltf, data, open_companion=open_companion(files or {}))


def root_of(data: bytes) -> dict[str, Any]:
    return by_hand_glb.split(data)[0]


def with_root(data: bytes, **changes: Any) -> bytes:
    root, content = by_hand_glb.split(data)
    return by_hand_glb.container(root | changes, content)


def placed(nodes: Any, **more: Any) -> bytes:
    """A GLB of `SH2` with these nodes."""
    return by_hand_glb.glb(**linear(Scene(SH2)), nodes=nodes, **more)


def with_sh(splats: Splats, coefficients: int) -> Splats:
    sh = np.zeros((len(splats), coefficients, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)


def assert_close(actual: Splats, expected: Splats, atol: float = 1e-5) -> None:
    for column in COLUMNS:
        np.testing.assert_allclose(getattr(actual, column), getattr(expected, column), atol=atol, err_msg=column)


# --- Writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES)
def test_the_primitive_follows_the_specification_of_its_profile(profile: str) -> None:
    data = written(Scene(SH2), profile)
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
        assert by_hand_glb.split(data)[1][: view["byteLength"]][:3] == b"\x1f\x8b\x08"
    assert names.keys() == {"POSITION", *own, *sh}
    assert all(accessor["count"] == 40 for accessor in root["accessors"])
    position = root["accessors"][names["POSITION"]]
    np.testing.assert_array_equal(np.float32(position["min"]), SH2.center.min(axis=0))
    np.testing.assert_array_equal(np.float32(position["max"]), SH2.center.max(axis=0))


@pytest.mark.parametrize("profile", PROFILES)
def test_threads_change_no_byte_and_opacities_above_1_are_refused(profile: str) -> None:
    splats = random_splats(20_000, sh_degree=1)
    assert written(Scene(splats), profile) == written(Scene(splats), profile, threads=3)
    with pytest.raises(FormatError, match="GLB holds no opacity above 1"):
        written(Scene(dataclasses.replace(splats, opacity=splats.opacity + 1)), profile)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("up", [None, *AXES])
def test_the_node_turns_the_up_axis_to_y_and_the_file_notes_it(up: str | None, profile: str) -> None:
    data = written(Scene(SH2, up=up), profile)
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
    np.testing.assert_allclose(back.splats.center, SH2.center, atol=0.01)


# --- One node and its axes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asset", "node", "up"),
    [
        ({}, {}, "y"),
        ({}, {"rotation": TURNS["z"]}, "y"),
        ({"generator": "another 1", "extras": {"up": "z"}}, {}, "y"),
        ({"generator": "sparklod 1"}, {}, None),  # unknown when it was written
        ({"generator": "sparklod 1", "extras": {"up": "z"}}, {"rotation": TURNS["z"]}, "z"),
        ({"generator": "sparklod 1", "extras": {"up": "z"}}, {"rotation": TURNS["x"]}, "y"),  # another program's
        ({"generator": "sparklod 1", "extras": {"up": "z"}}, {}, "y"),
    ],
)
def test_y_is_up_unless_sparklod_wrote_the_file(asset: dict[str, Any], node: dict[str, Any], up: str | None) -> None:
    assert read(placed([{"mesh": 0} | node], asset={"version": "2.0"} | asset)).up == up


def test_nested_transforms_and_a_matrix_move_splats() -> None:
    half = TURNS["-z"]
    nodes = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "rotation": half, "scale": [2, 2, 2]}]
    back = read(placed(nodes))
    rotation = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    expected = Transform(rotation, 2.0, np.array([1.0, 2, 3])).apply(SH2)
    for column in ("center", "scale", "sh"):
        np.testing.assert_allclose(getattr(back.splats, column), getattr(expected, column), atol=1e-5)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * rotation, (1, 2, 3)
    same = read(placed([{"mesh": 0, "matrix": matrix.T.ravel().tolist()}]))
    np.testing.assert_allclose(same.splats.center, back.splats.center, atol=1e-5)


def chain(length: int, **fields: Any) -> list[dict[str, Any]]:
    """A chain of nodes with the same fields; the last one has the splats."""
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
        (chain(40, scale=[1e12] * 3), "multiply to numbers beyond"),
        (chain(40, scale=[1e-12] * 3), "is singular"),
        (chain(2, scale=[1e-10] * 3), r"the scale 1e-20 is out of range"),
        ([{"mesh": 0, "children": [1]}, {"children": [0]}], "linked in a circle"),
        ("none", "nodes of its JSON is no array of objects"),
    ],
)
def test_impossible_nodes_are_refused(nodes: Any, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        read(placed(nodes))


# --- Values and properties that are refused or noted ------------------------------------------------------------------


def changed(what: str, index: int, **changes: Any) -> bytes:
    """The golden file with some keys of an object of its JSON changed; None removes a key."""
    items = root_of(GOLDEN)[what]
    items[index] = {key: value for key, value in (items[index] | changes).items() if value is not None}
    return with_root(GOLDEN, **{what: items})


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (changed("accessors", 0, count=61), "accessor 0 has 61 values, more than its buffer view holds"),
        (changed("accessors", 0, count=-1), "count of accessors.0.: .* not -1"),
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


@pytest.mark.parametrize("name", ["SH_DEGREE_1_COEF_1", "SH_DEGREE_2_COEF_4"])
def test_incomplete_sh_of_a_degree_are_refused(name: str) -> None:
    meshes = root_of(GOLDEN)["meshes"]
    del meshes[0]["primitives"][0]["attributes"][f"{by_hand_glb.NAME}:{name}"]
    with pytest.raises(FormatError, match=r"SH of degree \d are incomplete"):
        read(with_root(GOLDEN, meshes=meshes))


def test_other_color_spaces_and_kernels_are_noted() -> None:
    data = written(Scene(SH2))
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


# --- Several primitives and nodes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("one_mesh", [False, True])
def test_primitives_are_one_scene_of_the_highest_sh_degree(one_mesh: bool) -> None:
    back = read(by_hand_glb.together([A, B, A], one_mesh=one_mesh))
    assert (back.format, back.notes, back.up) == ("GLB", (), "y")
    assert_close(back.splats, Splats.concat([SH2, with_sh(SH0, 8), SH2]))


def test_a_mesh_is_repeated_for_each_of_its_nodes() -> None:
    nodes = [
        {"mesh": 1, "translation": [1, 2, 3]},
        {"mesh": 0, "children": [2], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [5, 0, 0]},
    ]
    back = read(by_hand_glb.together([A, B], nodes=nodes, scenes=[{"nodes": [0, 1]}]))
    expected = [
        with_sh(Transform(translation=np.array([1.0, 2, 3])).apply(SH0), 8),
        Transform(scale=2.0).apply(SH2),
        Transform(scale=2.0, translation=np.array([10.0, 0, 0])).apply(SH2),
    ]
    assert_close(back.splats, Splats.concat(expected))


def test_nodes_that_viewers_do_not_show_are_left_out_and_noted() -> None:
    nodes = [{"mesh": 0}, {"mesh": 1}]
    data = by_hand_glb.together([A, B, B], nodes=nodes, scenes=[{"nodes": [1]}, {"nodes": [0]}], scene=1)
    back = read(data)
    assert_close(back.splats, SH2)
    assert back.notes == (
        "left out: 1 node with splats outside of the scene that viewers show",
        "left out: 2 meshes of splats that no node places",
    )


def test_all_primitives_are_read_without_a_scene_or_a_node() -> None:
    both = Splats.concat([SH2, with_sh(SH0, 8)])
    assert_close(read(by_hand_glb.together([A, B], scenes=[])).splats, both)
    assert_close(read(by_hand_glb.together([A, B], scenes=[{"nodes": [7]}])).splats, both)
    assert_close(read(by_hand_glb.together([A, B], nodes=[])).splats, both)


def spz_parts(**more: Any) -> tuple[bytes, list[Scene]]:
    """Two primitives with an SPZ inside, and what each holds."""
    files = [written(Scene(splats), "cesium") for splats in (SH2, SH0)]
    for number, data in enumerate(files):
        root, content = by_hand_glb.split(data)
        root["meshes"][0]["primitives"][0]["attributes"] = {}
        root["accessors"] = []
        files[number] = by_hand_glb.container(root, content)
    data = by_hand_glb.together(files, **more)
    root, content = by_hand_glb.split(data)
    for number, mesh in enumerate(root["meshes"]):
        mesh["primitives"][0]["extensions"][by_hand_glb.NAME]["extensions"][by_hand_glb.SPZ]["bufferView"] = number
    return by_hand_glb.container(root, content), [read(data) for data in files]


@pytest.mark.parametrize("make", [spz_parts, lambda **more: (by_hand_glb.together([A, B], **more), None)])
def test_blocks_of_several_primitives_are_rows_of_the_whole(make: Callable[..., Any], tmp_path: Path) -> None:
    nodes = [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 1]}, {"mesh": 0, "translation": [1, 0, 0]}]
    data, held = make(nodes=nodes, scenes=[{"nodes": [0, 1, 2]}])
    whole = read(data).splats
    if held is not None:
        assert_close(whole.take(slice(40)), held[0].splats)
    path = tmp_path / "scene.glb"
    path.write_bytes(data)
    with open_reader(path, scratch=tmp_path) as stream:
        blocks = [block for start in range(0, 110, 17) for block in stream.blocks(start, min(start + 17, 110))]
    assert_close(Splats.concat(blocks), whole, 0)


def test_the_noted_turn_is_undone_if_all_primitives_have_it() -> None:
    asset = {"version": "2.0", "generator": "sparklod 1", "extras": {"up": "-y"}}
    turned = {"rotation": [1, 0, 0, 0]}
    for second, up in ((turned, "-y"), ({}, "y")):
        nodes = [{"mesh": 0} | turned, {"mesh": 1} | second]
        back = read(by_hand_glb.together([A, B], nodes=nodes, asset=asset))
        assert back.up == up
        np.testing.assert_allclose(back.splats.center[:40, 1], (1 if up == "-y" else -1) * SH2.center[:, 1], atol=1e-6)


def test_primitives_repeated_beyond_the_size_of_the_file_are_refused() -> None:
    splats = {name: np.repeat(column, 5_000, axis=0) for name, column in linear(Scene(SH0.take(slice(1)))).items()}
    nodes = [{"mesh": 0} for _ in range(9_000)]
    with pytest.raises(PromiseError, match="more than a file of"):
        read(by_hand_glb.glb(**splats, nodes=nodes, scenes=[{"nodes": list(range(9_000))}]))
    with pytest.raises(UnsupportedError, match="more than 16,384 primitives"):
        read(by_hand_glb.glb(**splats, nodes=nodes * 2, scenes=[{"nodes": list(range(18_000))}]))


# --- Buffers ----------------------------------------------------------------------------------------------------------


def as_json(buffer: str | None = None, **changes: Any) -> bytes:
    """The JSON of a file whose buffer has other fields; those that are None are left out."""
    root = json.loads(by_hand_glb.as_json(A, buffer)[0])
    fields = root["buffers"][0] | changes
    root["buffers"][0] = {key: value for key, value in fields.items() if value is not None}
    return json.dumps(root).encode()


CONTENT = by_hand_glb.split(A)[1]


@pytest.mark.parametrize(
    ("uri", "name"),
    [("scene.bin", "scene.bin"), ("./a/../b%20c.bin", "b c.bin"), ("%C3%A4/x.bin", "\u00e4/x.bin")],
)
def test_buffers_are_files_below_the_folder(uri: str, name: str) -> None:
    back = read(as_json(uri), {name: CONTENT + b"more"})
    assert (back.format, back.up, back.header["bytes"]) == ("glTF", "y", len(as_json(uri)) + len(CONTENT) + 4)
    assert_close(back.splats, SH2)


def test_a_glb_may_have_buffers_in_files() -> None:
    root, content = by_hand_glb.split(by_hand_glb.together([A, B]))
    views = [view for view in root["bufferViews"] if view["byteOffset"] >= len(by_hand_glb.split(A)[1])]
    start = min(view["byteOffset"] for view in views)
    for view in views:
        view |= {"buffer": 1, "byteOffset": view["byteOffset"] - start}
    root["buffers"] = [{"byteLength": start}, {"byteLength": len(content) - start, "uri": "b.bin"}]
    back = read(by_hand_glb.container(root, content[:start]), {"b.bin": content[start:]})
    assert_close(back.splats, Splats.concat([SH2, with_sh(SH0, 8)]))


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        *(
            (as_json(uri), FormatError, "not a file below its folder")
            for uri in (
                *("../scene.bin", "%2e%2e/scene.bin", "a/../../scene.bin", "/etc/passwd", ""),
                *("https://a.example/scene.bin", "file:scene.bin", "a\\b.bin", "scene%00.bin"),
            )
        ),
        (as_json("none.bin"), FormatError, "there is no 'none.bin'"),
        (as_json("short.bin"), FormatError, "of which 'short.bin' holds 5"),
        (as_json(uri=3), FormatError, "uri of buffer 0 is 3, not a text"),
        (as_json(uri=None), FormatError, "neither a BIN chunk nor names a file"),
        (as_json(uri=None, extensions={"EXT_meshopt_compression": {}}), UnsupportedError, "'EXT_meshopt_compression'"),
        (as_json(uri="data:;base64,AAA"), FormatError, "no base64"),
        (as_json(uri="data:;base64,\u00e4AAA"), FormatError, "no base64"),
        (as_json(uri="data:;base64,AAAA"), FormatError, "holds 3"),
        (as_json(uri="data:7"), FormatError, "holds 0"),
        (as_json().replace(b'"version": "2.0"', b'"version": "1.0"'), VersionError, "glTF version '1.0' is unknown"),
        (b"[" + as_json() + b"]", FormatError, "its JSON is no object"),
        (as_json()[:-1], FormatError, "its content is not JSON"),
        (b'{"asset": {"version": "2.0"}, "meshes": []}', NotSplatsError, "a glTF without splats"),
    ],
)
def test_unreadable_buffers_are_refused(data: bytes, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        read(data, {"short.bin": b"short"})


def test_data_within_the_json_may_be_large_but_the_json_without_them_may_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf_container, "MAX_JSON", 8_000)
    assert len(as_json()) > 8_000
    assert_close(read(b"\xef\xbb\xbf" + as_json()).splats, SH2)
    with pytest.raises(UnsupportedError, match="larger than the 8,000 that are read"):
        read(as_json(name="x" * 8_000))
    monkeypatch.setattr(gltf_container, "MAX_TEXT", 9_000)
    with pytest.raises(UnsupportedError, match="write it as GLB"):
        read(as_json())


@pytest.mark.parametrize("kind", ["data:application/gltf-buffer;base64,", "data:;base64,", "data:text/plain;base64,"])
def test_data_may_have_any_type(kind: str) -> None:
    uri = json.loads(as_json())["buffers"][0]["uri"]
    assert_close(read(as_json(uri=kind + uri.partition(",")[2])).splats, SH2)
    escaped = as_json(uri=kind + uri.partition(",")[2]).replace(b"/", b"\\/")  # as some writers of JSON do
    assert_close(read(escaped).splats, SH2)


def test_buffer_files_are_companions_of_a_gltf_and_of_its_tileset(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    path, buffer = tmp_path / "scene.gltf", tmp_path / "a" / "b.bin"
    path.write_bytes(as_json("a/b.bin"))
    buffer.write_bytes(CONTENT)
    assert companions(path, ()) == [buffer]
    assert_close(read_scene(path).splats, SH2)
    root = {"refine": "REPLACE", "boundingVolume": {"sphere": [0, 0, 0, 99]}, "geometricError": 0}
    tileset = {"asset": {"version": "1.1"}, "geometricError": 9, "root": root | {"content": {"uri": "t/scene.gltf"}}}
    (tmp_path / "t" / "a").mkdir(parents=True)
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))
    path.rename(tmp_path / "t" / "scene.gltf")
    moved = buffer.rename(tmp_path / "t" / "a" / "b.bin")
    assert companions(tmp_path / "tileset.json", ()) == [tmp_path / "t" / "scene.gltf", moved]
    assert_close(read_scene(tmp_path).splats, SH2)
    assert read_scene(tmp_path).format == "3D Tiles 1.1 of glTF"


# --- Drafts and what is left out --------------------------------------------------------------------------------------


def renamed(change: Callable[[dict[str, Any]], object], data: bytes = A, **more: Any) -> bytes:
    """A file whose primitive is changed."""
    meshes = by_hand_glb.split(data)[0]["meshes"]
    change(meshes[0]["primitives"][0])
    return with_root(data, meshes=meshes, **more)


def test_a_draft_of_old_cesium_is_read() -> None:
    """The layout of GaussianSplats/synthetic of CesiumJS's tests: the names of the draft, and bytes for colours."""
    colors = np.array([[255, 0, 51, 102]], np.uint8)
    columns = [("_ROTATION", "VEC4", np.float32([[0, 0, 0, 1]])), ("_SCALE", "VEC3", np.float32([[1, 2, 3]]))]
    columns += [("POSITION", "VEC3", np.float32([[4, 5, 6]])), ("COLOR_0", "VEC4", colors)]
    content, views, accessors = b"", [], []
    for name, kind, values in columns:
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": values.nbytes})
        integers = {"componentType": 5121, "normalized": True} if name == "COLOR_0" else {"componentType": 5126}
        accessors.append({"bufferView": len(accessors), "count": 1, "type": kind} | integers)
        content += values.tobytes()
    root = by_hand_glb.document(
        {name: number for number, (name, _, _) in enumerate(columns)},
        {},
        accessors=accessors,
        bufferViews=views,
        buffers=[{"byteLength": len(content)}],
        nodes=[{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 2, 12, -7, 1]}],
    )
    back = read(by_hand_glb.container(root, content))
    assert back.notes == ()
    np.testing.assert_allclose(back.splats.rgb, [[1, 0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(back.splats.opacity, [0.4], atol=1e-6)
    np.testing.assert_allclose(back.splats.center, [[6, 18, -12]], atol=1e-5)


def attributes(**more: int) -> bytes:
    return renamed(lambda primitive: primitive["attributes"].update(more))


@pytest.mark.parametrize(
    ("data", "note"),
    [
        (attributes(COLOR_0=0), "its attribute COLOR_0 is left out"),
        (attributes(COLOR_0=0, _LABEL=0), "its attributes COLOR_0 and _LABEL are left out"),
        (
            attributes(**{f"_{number}": 0 for number in range(8)}),
            "its attributes _0 to _7 are left out",
        ),
        (attributes(**{f"{by_hand_glb.NAME}:SH_DEGREE_4_COEF_0": 0}), "SH degree 4 is cut to 3"),
        (renamed(lambda each: each["extensions"].update(X_y={})), "its extension X_y is left out"),
        (
            renamed(lambda each: each["extensions"][by_hand_glb.NAME].update(extensions={"X_kernel": {}})),
            "its extension X_kernel is left out",
        ),
        (renamed(lambda each: each.update(targets=[{}])), "left out: the morph targets of its splats"),
        (with_root(A, animations=[{}]), "left out: its animations"),
        (
            with_root(A, meshes=[*by_hand_glb.split(A)[0]["meshes"], {"primitives": [{"attributes": {}}]}]),
            "left out: 1 primitive without splats",
        ),
        (
            with_root(A, nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]),
            "its extension EXT_mesh_gpu_instancing is left out",
        ),
    ],
)
def test_unread_parts_are_noted_and_reported(data: bytes, note: str, tmp_path: Path) -> None:
    back = read(data)
    assert_close(back.splats, SH2)
    (told,) = back.notes
    assert note in told
    path = tmp_path / "scene.glb"
    path.write_bytes(data)
    findings = inspect(path, ReportSettings(check=True))[0].findings or []
    assert [(found.code, found.message) for found in findings] == [("container.left-out", told)]


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_draco_mesh_compression", "X_unknown", 7])
def test_unknown_required_extensions_are_refused(name: Any) -> None:
    with pytest.raises(UnsupportedError, match=rf"requires the extension {name!r}, which is not read") as raised:
        read(with_root(A, extensionsRequired=[by_hand_glb.NAME, name]))
    assert raised.value.code == "container.unsupported"


def test_extensions_that_change_no_splats_may_be_required() -> None:
    required = [by_hand_glb.NAME, "KHR_materials_unlit", "KHR_mesh_quantization"]
    assert read(with_root(A, extensionsRequired=required)).notes == ()


def test_an_spz_of_the_first_draft_is_read() -> None:
    data = written(Scene(SH2), "cesium")
    old = "KHR_spz_gaussian_splats_compression"

    def change(primitive: dict[str, Any]) -> None:
        primitive["extensions"] = {old: {"bufferView": 0}}

    changed = renamed(change, data, extensionsRequired=[old])
    assert_close(read(changed).splats, read(data).splats, 0)


# --- Logarithms as scales ---------------------------------------------------------------------------------------------


def with_scales(splats: Splats, scales: Any, generator: str = "another 1") -> bytes:
    return by_hand_glb.glb(
        **linear(Scene(splats)) | {"scale": scales}, asset={"version": "2.0", "generator": generator}
    )


SCALES = random_splats(2_000).scale.astype(np.float64)
MIRRORED = SCALES * [-1, 1, 1]


@pytest.mark.parametrize(
    ("scales", "generator", "are_logs"),
    [
        (np.log(SCALES), "another 1", True),
        (np.log(20 * SCALES), "another 1", True),
        (np.tile([0.0, 0.5, -0.5], (30, 1)), "another 1", True),  # as in test data of the extension's draft
        (MIRRORED, "another 1", False),
        (np.where(np.arange(2_000)[:, None] % 50 == 0, MIRRORED, SCALES), "another 1", False),
        (np.abs(np.log(SCALES)), "gsbox v4.8.4", True),  # no logarithm is below 0: the generator decides
        (np.abs(np.log(SCALES)), "gsbox v5.0.0", False),
        (np.abs(np.log(SCALES)), "splat-transform 1.10.2", True),
        (np.abs(np.log(SCALES)), "splat-transform 2.6.0", True),
        (np.abs(np.log(SCALES)), "splat-transform 2.7.0", False),
        (np.abs(np.log(SCALES)), "splat-transform v3.2.0", False),
    ],
)
def test_scales_that_are_logarithms_are_recognised(scales: Any, generator: str, are_logs: bool) -> None:
    back = read(with_scales(random_splats(len(scales)), scales, generator))
    assert (back.notes == (READ_AS_LOGS,)) == are_logs
    np.testing.assert_allclose(back.splats.scale, np.exp(scales) if are_logs else scales, rtol=1e-5)


@pytest.mark.parametrize("extent", [1.0, 200.0, 4_000.0])
def test_scales_that_may_be_logarithms_are_noted_and_others_are_not(extent: float) -> None:
    splats = random_splats(3_000, extent=extent)
    logs = np.random.default_rng(3).normal(1.4, 0.3, (3_000, 3))
    if extent < 1_000:
        (note,) = read(with_scales(splats, logs)).notes
        assert "look like logarithms" in note and "are read as linear ones" in note
    for linear_scales in (splats.scale, np.full_like(splats.scale, extent / 100)):
        assert read(with_scales(splats, linear_scales)).notes == ()


@pytest.mark.parametrize("value", [-3e38, -np.inf, np.nan, 3e38, np.inf])
def test_extreme_scales_are_read_without_a_warning(value: float) -> None:
    for splats in (SH0, random_splats(500)):
        scales = np.full_like(splats.scale, value)
        assert len(read(with_scales(splats, scales)).splats) == len(splats)
        scales[::2] = 1.0
        assert len(read(with_scales(splats, scales)).splats) == len(splats)


# --- Other programs ---------------------------------------------------------------------------------------------------


VALIDATE = """
const validator = require(process.argv[1]), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(
  (report) => console.log(JSON.stringify(report.issues.messages)));
"""


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_the_validator_of_khronos_reports_only_unknown_extensions(profile: str, tmp_path: Path) -> None:
    folder = os.environ.get("FOREIGN_DIR")
    package = Path(folder or "").absolute() / "node_modules" / "gltf-validator"
    if not folder or not package.is_dir():
        pytest.skip("FOREIGN_DIR names no folder whose node_modules has gltf-validator")
    path = tmp_path / "scene.glb"
    path.write_bytes(written(Scene(SH2, up="-y"), profile))
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
