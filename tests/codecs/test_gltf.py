"""glTF of several primitives and nodes, with buffers anywhere, of drafts, and with logarithms as scales."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_glb
from sparklod_cli.codecs import gltf as glb
from sparklod_cli.codecs import gltf_container
from sparklod_cli.codecs.gltf_attributes import READ_AS_LOGS
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.reader import OpenFile, decode_file
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.local_files import companions
from sparklod_cli.io.reading import open_reader, read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.errors import FormatError, NotSplatsError, PromiseError, UnsupportedError, VersionError
from tests.codecs.cases import linear
from tests.codecs.test_glb import with_root
from tests.part_files import open_companion
from tests.scenes import random_splats

SH2, SH0 = random_splats(40, sh_degree=2), random_splats(30, seed=2)
A, B = (by_hand_glb.glb(**linear(Scene(splats))) for splats in (SH2, SH0))


def read(data: bytes, files: dict[str, bytes] | None = None) -> Scene:
    scene = decode_file(glb, io.BytesIO(data), open_companion=open_companion(files or {}))
    assert isinstance(scene, Scene)
    return scene


def with_sh(splats: Splats, coefficients: int) -> Splats:
    sh = np.zeros((len(splats), coefficients, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return Splats(splats.center, splats.scale, splats.quat_xyzw, splats.opacity, splats.rgb, sh)


def assert_same(actual: Splats, expected: Splats, atol: float = 1e-5) -> None:
    for column in COLUMNS:
        np.testing.assert_allclose(getattr(actual, column), getattr(expected, column), atol=atol, err_msg=column)


# --- Several primitives and nodes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("one_mesh", [False, True])
def test_primitives_are_one_scene_of_the_highest_sh_degree(one_mesh: bool) -> None:
    back = read(by_hand_glb.together([A, B, A], one_mesh=one_mesh))
    assert (back.format, back.notes, back.up) == ("GLB", (), "y")
    assert_same(back.splats, Splats.concat([SH2, with_sh(SH0, 8), SH2]))


def test_a_mesh_is_where_each_of_its_nodes_is() -> None:
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
    assert_same(back.splats, Splats.concat(expected))


def test_what_viewers_do_not_show_is_left_out_and_named() -> None:
    nodes = [{"mesh": 0}, {"mesh": 1}]
    data = by_hand_glb.together([A, B, B], nodes=nodes, scenes=[{"nodes": [1]}, {"nodes": [0]}], scene=1)
    back = read(data)
    assert_same(back.splats, SH2)
    assert back.notes == (
        "left out: 1 node with splats outside of the scene that viewers show",
        "left out: 2 meshes of splats that no node places",
    )


def test_without_a_scene_or_a_node_all_is_read() -> None:
    both = Splats.concat([SH2, with_sh(SH0, 8)])
    assert_same(read(by_hand_glb.together([A, B], scenes=[])).splats, both)
    assert_same(read(by_hand_glb.together([A, B], scenes=[{"nodes": [7]}])).splats, both)
    assert_same(read(by_hand_glb.together([A, B], nodes=[])).splats, both)


def spz_parts(**more: Any) -> tuple[bytes, list[Scene]]:
    """Two primitives with an SPZ inside, and what each holds."""
    files = [b"".join(glb.encode(Scene(splats), WriteOptions(glb_profile="cesium"))) for splats in (SH2, SH0)]
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
def test_parts_are_read_in_blocks_as_they_are_read_whole(make: Callable[..., Any], tmp_path: Path) -> None:
    nodes = [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 1]}, {"mesh": 0, "translation": [1, 0, 0]}]
    data, held = make(nodes=nodes, scenes=[{"nodes": [0, 1, 2]}])
    whole = read(data).splats
    if held is not None:
        assert_same(whole.take(slice(40)), held[0].splats)
    path = tmp_path / "scene.glb"
    path.write_bytes(data)
    with open_reader(path, scratch=tmp_path) as stream:
        blocks = [block for start in range(0, 110, 17) for block in stream.blocks(start, min(start + 17, 110))]
    assert_same(Splats.concat(blocks), whole, 0)


def test_the_turn_of_a_file_of_sparklod_is_undone_for_all_its_parts() -> None:
    asset = {"version": "2.0", "generator": "sparklod 1", "extras": {"up": "-y"}}
    turned = {"rotation": [1, 0, 0, 0]}
    for second, up in ((turned, "-y"), ({}, "y")):
        nodes = [{"mesh": 0} | turned, {"mesh": 1} | second]
        back = read(by_hand_glb.together([A, B], nodes=nodes, asset=asset))
        assert back.up == up
        np.testing.assert_allclose(back.splats.center[:40, 1], (1 if up == "-y" else -1) * SH2.center[:, 1], atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_more_splats_than_a_file_can_stand_for_are_refused() -> None:
    splats = {name: np.repeat(column, 5_000, axis=0) for name, column in linear(Scene(SH0.take(slice(1)))).items()}
    nodes = [{"mesh": 0} for _ in range(9_000)]
    with pytest.raises(PromiseError, match="more than a file of"):
        read(by_hand_glb.glb(**splats, nodes=nodes, scenes=[{"nodes": list(range(9_000))}]))
    with pytest.raises(UnsupportedError, match="more than 16,384 primitives"):
        read(by_hand_glb.glb(**splats, nodes=nodes * 2, scenes=[{"nodes": list(range(18_000))}]))


# --- Buffers ----------------------------------------------------------------------------------------------------------


def gltf(buffer: str | None = None, **changes: Any) -> bytes:
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
    back = read(gltf(uri), {name: CONTENT + b"more"})
    assert (back.format, back.up, back.header["bytes"]) == ("glTF", "y", len(gltf(uri)) + len(CONTENT) + 4)
    assert_same(back.splats, SH2)


def test_a_glb_may_have_buffers_in_files() -> None:
    root, content = by_hand_glb.split(by_hand_glb.together([A, B]))
    half = root["buffers"][0]["byteLength"] // 2
    views = [view for view in root["bufferViews"] if view["byteOffset"] >= len(by_hand_glb.split(A)[1])]
    start = min(view["byteOffset"] for view in views)
    for view in views:
        view |= {"buffer": 1, "byteOffset": view["byteOffset"] - start}
    root["buffers"] = [{"byteLength": start}, {"byteLength": len(content) - start, "uri": "b.bin"}]
    assert half
    back = read(by_hand_glb.container(root, content[:start]), {"b.bin": content[start:]})
    assert_same(back.splats, Splats.concat([SH2, with_sh(SH0, 8)]))


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        (gltf("../scene.bin"), FormatError, "not a file below its folder"),
        (gltf("%2e%2e/scene.bin"), FormatError, "not a file below its folder"),
        (gltf("a/../../scene.bin"), FormatError, "not a file below its folder"),
        (gltf("/etc/passwd"), FormatError, "not a file below its folder"),
        (gltf("https://a.example/scene.bin"), FormatError, "not a file below its folder"),
        (gltf("file:scene.bin"), FormatError, "not a file below its folder"),
        (gltf("a\\b.bin"), FormatError, "not a file below its folder"),
        (gltf("scene%00.bin"), FormatError, "not a file below its folder"),
        (gltf(""), FormatError, "not a file below its folder"),
        (gltf("none.bin"), FormatError, "there is no 'none.bin'"),
        (gltf("short.bin"), FormatError, "of which 'short.bin' holds 5"),
        (gltf(uri=3), FormatError, "uri of buffer 0 is 3, not a text"),
        (gltf(uri=None), FormatError, "neither a BIN chunk nor names a file"),
        (gltf(uri=None, extensions={"EXT_meshopt_compression": {}}), UnsupportedError, "'EXT_meshopt_compression'"),
        (gltf(uri="data:;base64,AAA"), FormatError, "no base64"),
        (gltf(uri="data:;base64,\u00e4AAA"), FormatError, "no base64"),
        (gltf(uri="data:;base64,AAAA"), FormatError, "holds 3"),
        (gltf(uri="data:7"), FormatError, "holds 0"),
        (gltf().replace(b'"version": "2.0"', b'"version": "1.0"'), VersionError, "glTF version '1.0' is unknown"),
        (b"[" + gltf() + b"]", FormatError, "its JSON is no object"),
        (gltf()[:-1], FormatError, "its content is not JSON"),
        (b'{"asset": {"version": "2.0"}, "meshes": []}', NotSplatsError, "a glTF without splats"),
    ],
)
def test_buffers_that_cannot_be_read_are_refused(data: bytes, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        read(data, {"short.bin": b"short"})


def test_data_within_the_json_may_be_large_and_the_rest_of_it_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf_container, "MAX_JSON", 8_000)
    assert len(gltf()) > 8_000
    assert_same(read(b"\xef\xbb\xbf" + gltf()).splats, SH2)
    with pytest.raises(UnsupportedError, match="larger than the 8,000 that are read"):
        read(gltf(name="x" * 8_000))
    monkeypatch.setattr(gltf_container, "MAX_TEXT", 9_000)
    with pytest.raises(UnsupportedError, match="write it as GLB"):
        read(gltf())


@pytest.mark.parametrize("kind", ["data:application/gltf-buffer;base64,", "data:;base64,", "data:text/plain;base64,"])
def test_data_may_have_any_type(kind: str) -> None:
    uri = json.loads(gltf())["buffers"][0]["uri"]
    assert_same(read(gltf(uri=kind + uri.partition(",")[2])).splats, SH2)
    escaped = gltf(uri=kind + uri.partition(",")[2]).replace(b"/", b"\\/")  # as some writers of JSON do
    assert_same(read(escaped).splats, SH2)


def test_a_file_names_its_buffers_so_that_no_output_replaces_them(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    path, buffer = tmp_path / "scene.gltf", tmp_path / "a" / "b.bin"
    path.write_bytes(gltf("a/b.bin"))
    buffer.write_bytes(CONTENT)
    assert companions(path, ()) == [buffer]
    assert_same(read_scene(path).splats, SH2)
    root = {"refine": "REPLACE", "boundingVolume": {"sphere": [0, 0, 0, 99]}, "geometricError": 0}
    tileset = {"asset": {"version": "1.1"}, "geometricError": 9, "root": root | {"content": {"uri": "t/scene.gltf"}}}
    (tmp_path / "t" / "a").mkdir(parents=True)
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))
    path.rename(tmp_path / "t" / "scene.gltf")
    moved = buffer.rename(tmp_path / "t" / "a" / "b.bin")
    assert companions(tmp_path / "tileset.json", ()) == [tmp_path / "t" / "scene.gltf", moved]
    assert_same(read_scene(tmp_path).splats, SH2)
    assert read_scene(tmp_path).format == "3D Tiles 1.1 of glTF"


# --- Drafts and what is left out --------------------------------------------------------------------------------------


def renamed(change: Callable[[dict[str, Any]], object], data: bytes = A, **more: Any) -> bytes:
    """A file whose primitive is changed."""
    meshes = by_hand_glb.split(data)[0]["meshes"]
    change(meshes[0]["primitives"][0])
    return with_root(data, meshes=meshes, **more)


def test_a_sample_of_an_old_cesium_is_read() -> None:
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
def test_what_is_left_out_is_named(data: bytes, note: str, tmp_path: Path) -> None:
    back = read(data)
    assert_same(back.splats, SH2)
    (told,) = back.notes
    assert note in told
    path = tmp_path / "scene.glb"
    path.write_bytes(data)
    findings = inspect(path, ReportSettings(check=True))[0].findings or []
    assert [(found.code, found.message) for found in findings] == [("container.left-out", told)]


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_draco_mesh_compression", "X_unknown", 7])
def test_extensions_that_are_required_and_not_read_are_refused_by_name(name: Any) -> None:
    with pytest.raises(UnsupportedError, match=rf"requires the extension {name!r}, which is not read") as raised:
        read(with_root(A, extensionsRequired=[by_hand_glb.NAME, name]))
    assert raised.value.code == "container.unsupported"


def test_extensions_that_change_no_splats_may_be_required() -> None:
    required = [by_hand_glb.NAME, "KHR_materials_unlit", "KHR_mesh_quantization"]
    assert read(with_root(A, extensionsRequired=required)).notes == ()


def test_an_spz_of_the_first_draft_is_read() -> None:
    data = b"".join(glb.encode(Scene(SH2), WriteOptions(glb_profile="cesium")))
    old = "KHR_spz_gaussian_splats_compression"

    def change(primitive: dict[str, Any]) -> None:
        primitive["extensions"] = {old: {"bufferView": 0}}

    changed = renamed(change, data, extensionsRequired=[old])
    assert_same(read(changed).splats, read(data).splats, 0)


# --- Logarithms as scales ---------------------------------------------------------------------------------------------


def with_scales(splats: Splats, scales: Any, generator: str = "another 1") -> bytes:
    return by_hand_glb.glb(
        **linear(Scene(splats)) | {"scale": scales}, asset={"version": "2.0", "generator": generator}
    )


@pytest.mark.parametrize("factor", [1, 20])
def test_logarithms_are_read_as_such(factor: float) -> None:
    splats = random_splats(2_000)
    logs = np.log(splats.scale.astype(np.float64) * factor)
    assert (logs < 0).any(axis=1).mean() > 0.3
    back = read(with_scales(splats, logs))
    assert back.notes == (READ_AS_LOGS,)
    np.testing.assert_allclose(back.splats.scale, splats.scale * factor, rtol=1e-5)


@pytest.mark.parametrize(
    ("generator", "are_logs"),
    [
        ("gsbox v4.8.4", True),
        ("gsbox v5.0.0", False),
        ("splat-transform 1.10.2", True),
        ("splat-transform 2.6.0", True),
        ("splat-transform 2.7.0", False),
        ("splat-transform v3.2.0", False),
    ],
)
def test_the_writer_tells_where_no_logarithm_is_below_0(generator: str, are_logs: bool) -> None:
    splats = random_splats(2_000)
    scales = np.exp(np.abs(np.log(splats.scale.astype(np.float64))))
    back = read(with_scales(splats, np.log(scales), generator))
    assert (back.notes == (READ_AS_LOGS,)) == are_logs
    np.testing.assert_allclose(back.splats.scale, scales if are_logs else np.log(scales), rtol=1e-5)


@pytest.mark.parametrize("extent", [1.0, 200.0])
def test_what_may_be_logarithms_is_said(extent: float) -> None:
    rng = np.random.default_rng(3)
    splats = random_splats(3_000, extent=extent)
    scales = np.exp(rng.normal(1.4, 0.3, (3_000, 3)))
    (note,) = read(with_scales(splats, np.log(scales))).notes
    assert "look like logarithms" in note and "are read as linear ones" in note


@pytest.mark.parametrize("scale", [0.01, 1.0, 40.0])
def test_linear_scales_of_any_size_are_not_doubted(scale: float) -> None:
    splats = random_splats(3_000, extent=scale * 100)
    assert read(with_scales(splats, splats.scale)).notes == ()
    even = np.full_like(splats.scale, scale)
    assert read(with_scales(splats, even)).notes == ()


def test_one_logarithm_below_0_in_each_splat_is_enough() -> None:
    scales = np.tile([0.0, 0.5, -0.5], (30, 1))  # as a file of test data for the extension's draft has them
    back = read(with_scales(SH0, scales))
    np.testing.assert_allclose(back.splats.scale, np.exp(scales), rtol=1e-6)


@pytest.mark.parametrize("broken", [slice(0, None, 50), slice(None)], ids=["some", "mirrored"])
def test_linear_scales_below_0_are_no_logarithms(broken: slice) -> None:
    splats = random_splats(2_000)
    scales = splats.scale.copy()
    scales[broken, 0] *= -1
    back = read(with_scales(splats, scales))
    assert back.notes == () and (back.splats.scale[broken, 0] < 0).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [-3e38, -np.inf, np.nan, 3e38, np.inf])
def test_scales_of_any_size_are_looked_at_without_a_warning(value: float) -> None:
    for splats in (SH0, random_splats(500)):
        scales = np.full_like(splats.scale, value)
        assert len(read(with_scales(splats, scales)).splats) == len(splats)
        scales[::2] = 1.0
        assert len(read(with_scales(splats, scales)).splats) == len(splats)


def test_an_empty_primitive_has_no_scales_to_tell() -> None:
    data = by_hand_glb.split(A)[0]["accessors"]
    content = glb.open_content(OpenFile(io.BytesIO(with_root(A, accessors=[each | {"count": 0} for each in data]))))
    assert content.count == 0 and content.notes == ()
