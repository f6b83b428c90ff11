"""Streamed SOG: its manifest, reading of full detail and of all levels, writing, and damage."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fixtures import by_hand_sog, by_hand_streamed_sog
from sparklod_cli.codecs import sog, streamed_manifest, streamed_sog
from sparklod_cli.codecs.formats import DEFAULTS, is_of_streamed_sog, sniff
from sparklod_cli.codecs.merging import SceneFiles
from sparklod_cli.codecs.streamed_manifest import LARGEST, Manifest, ManifestNode, parse, serialise
from sparklod_cli.io.reading import open_reader, read_parts, read_scene
from sparklod_cli.io.writing import parts_output
from sparklod_cli.model import morton
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError, VersionError
from tests.codecs.cases import assert_same, decode, linear
from tests.codecs.damage import VALUES, attempt, places_of, replaced
from tests.codecs.test_laws import assert_close
from tests.codecs.writers import sog_precision
from tests.conftest import FIXTURES
from tests.part_files import CHILDREN, COUNTS, detail_scene, open_companion, put_files, regions_of
from tests.scenes import random_splats, write_files

pytestmark = pytest.mark.filterwarnings("error")

GOLDEN = FIXTURES / "golden" / "sh1-streamed-sog"

#: Chunks of each level of `COUNTS` are closed when they have more splats than this.
DIVISION = 45, 2.5, 10


@functools.cache
def golden() -> dict[str, bytes]:
    return {path.relative_to(GOLDEN).as_posix(): path.read_bytes() for path in GOLDEN.rglob("*") if path.is_file()}


def with_manifest(change: Callable[[Any], object]) -> dict[str, bytes]:
    """The golden files with a changed manifest."""
    meta = json.loads(golden()["lod-meta.json"])
    change(meta)
    return golden() | {"lod-meta.json": json.dumps(meta).encode()}


def first_leaf(meta: Any) -> Any:
    node = meta["tree"]
    while "children" in node:
        node = node["children"][0]
    return node


def written(scene: DetailScene, **more: Any) -> dict[str, bytes]:
    files = streamed_sog.encode_files(scene, DEFAULTS, *DIVISION, **more)
    return {name: b"".join(pieces) for name, pieces in files}


def read_full(files: Mapping[str, bytes], **more: Any) -> Scene:
    return decode(streamed_sog, files["lod-meta.json"], open_companion=open_companion(files), **more)


def read_levels(files: Mapping[str, bytes], **more: Any) -> DetailScene:
    manifest = io.BytesIO(files["lod-meta.json"])
    return streamed_sog.decode_parts(manifest, open_companion=open_companion(files), **more)


# --- Reading ----------------------------------------------------------------------------------------------------------


def test_the_golden_folder_has_its_levels_regions_and_splats() -> None:
    scene = read_parts(GOLDEN)
    assert scene.counts.tolist() == [[25, 9], [20, 7], [15, 0]]
    assert scene.children.tolist() == [[-1, 1], [-2, -3]]
    assert scene.errors.tolist() == [[0, 0.0125], [0, 0.02], [0, 0]]
    assert (len(scene.environment), scene.environment.sh_degree) == (6, 1)
    assert not scene.environment.sh.any()  # of degree 0 in its file
    assert scene.splats.sh.any()
    for level in range(2):
        for region in range(3):
            center = scene.splats.center[scene.run(region, level)]
            assert (center >= scene.bounds[region, 0]).all() and (center <= scene.bounds[region, 1]).all()
    plain = read_scene(FIXTURES / "sh1.ply").splats
    expected = plain.take(np.argsort(plain.center[:, 0], kind="stable"))
    assert_close(scene.splats.take(scene.level(0)), expected, sog_precision(Scene(expected), 2))
    assert dict(scene.header) == {"version": 1, "levels": 2, "regions": 3, "bytes": sum(map(len, golden().values()))}
    assert read_parts(FIXTURES / "golden" / "sh1-sog") is None


def test_full_detail_is_level_0_and_the_environment_and_needs_no_other_chunk() -> None:
    whole = read_scene(GOLDEN)
    assert_same(whole.splats, read_parts(GOLDEN / "lod-meta.json").scene().splats)
    assert (len(whole), whole.format) == (60 + 6, "Streamed SOG 1")
    assert (whole.tree, whole.antialiased, whole.notes) == (None, False, ())
    files = {name: data for name, data in golden().items() if not name.startswith("1_0/")}
    assert_same(read_full(files).splats, whole.splats)
    with pytest.raises(FormatError, match="there is no '1_0"):
        read_levels(files)


def test_blocks_decode_each_chunk_once(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = list[str]()
    read = SceneFiles.read

    def counted(self: SceneFiles, chunks: Any, *rest: Any, **more: Any) -> None:
        decoded.extend(chunk.name for chunk in chunks)
        read(self, chunks, *rest, **more)

    monkeypatch.setattr(SceneFiles, "read", counted)
    with open_reader(GOLDEN) as reader:
        for start in range(0, 66, 5):
            list(reader.blocks(start, min(start + 5, 66)))
    assert decoded == ["0_0/meta.json", "0_1/meta.json", "env/meta.json"]


@pytest.mark.parametrize("together", [1, 2, 5])
@pytest.mark.parametrize("threads", [1, 3])
def test_runs_in_any_order_are_sorted(together: int, threads: int) -> None:
    made = [
        by_hand_streamed_sog.streamed_sog_files(
            regions_of(detail_scene()), by_hand_sog.sog_files, together=together, backwards=backwards
        )
        for backwards in (False, True)
    ]
    assert (made[0] == made[1]) == (together == 1)
    forwards, backwards = (read_levels(files, threads=threads) for files in made)
    np.testing.assert_array_equal(forwards.counts, COUNTS)
    np.testing.assert_array_equal(backwards.counts, COUNTS)
    np.testing.assert_array_equal(backwards.bounds, forwards.bounds)
    np.testing.assert_array_equal(backwards.splats.center, forwards.splats.center)
    np.testing.assert_allclose(backwards.splats.rgb, forwards.splats.rgb)


def test_manifests_without_a_version_or_errors_and_bundled_chunks_are_read() -> None:
    old = by_hand_streamed_sog.streamed_sog_files(regions_of(detail_scene()), by_hand_sog.sog_files, version=None)
    assert "version" not in json.loads(old["lod-meta.json"])
    assert read_levels(old).counts.sum() == 136
    assert read_levels(with_manifest(lambda meta: first_leaf(meta).pop("errors"))).errors is None
    chunk = {name.removeprefix("0_0/"): data for name, data in golden().items() if name.startswith("0_0/")}
    bundled = with_manifest(lambda meta: meta["filenames"].__setitem__(0, "chunks/0.sog"))
    bundled["chunks/0.sog"] = by_hand_sog.zipped(chunk)
    assert_same(read_full(bundled).splats, read_scene(GOLDEN).splats)


# --- Manifests and chunks that are refused ----------------------------------------------------------------------------


def change_run(**changes: Any) -> Callable[[Any], object]:
    return lambda meta: first_leaf(meta)["lods"]["0"].update(changes)


def name_first(name: str) -> Callable[[Any], object]:
    return lambda meta: meta["filenames"].__setitem__(0, name)


#: Changes of the golden manifest, and the error of a reader of full detail.
REFUSED: list[tuple[Callable[[Any], object], str]] = [
    (change_run(offset=1), r"tree\.children\[0\]\.lods\.0 begins at splat 1 of '0_0/meta"),
    (change_run(count=26), r"begins at splat 25 of '0_0/meta.json', but the run before it ends at 26"),
    (lambda meta: meta["tree"]["children"][1]["children"][1]["lods"]["0"].update(count=14), "14"),
    (name_first("9_0/meta.json"), "there is no '9_0/meta.json'"),
    (lambda meta: meta["filenames"].__setitem__(1, "0_0/meta.json"), "names '0_0/meta.json' twice"),
    (name_first("lod-meta.json"), "'lod-meta.json': its meta.json is not that of a SOG"),
    (name_first("0_0/sh0.webp"), r"'0_0/sh0.webp': meta\.json is not"),
    (lambda meta: meta.update(tree={"bound": meta["tree"]["bound"], "lods": {}}), "has no splats of level 0"),
]


@pytest.mark.parametrize(("change", "message"), REFUSED)
def test_manifests_that_do_not_fit_their_chunks_are_refused(change: Callable[[Any], object], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_full(with_manifest(change))


@pytest.mark.parametrize(
    "name", ["../x/meta.json", "/etc/meta.json", "0_0/../../x", "http://x/meta.json", "0_0\\meta.json"]
)
def test_chunk_names_outside_the_folder_are_refused(name: str, tmp_path: Path) -> None:
    put_files(tmp_path, {"lod-meta.json": with_manifest(name_first(name))["lod-meta.json"]})
    with pytest.raises(FormatError, match="which is not a file beside it"):
        read_scene(tmp_path)


def test_image_names_outside_the_folder_of_their_chunk_are_refused(tmp_path: Path) -> None:
    meta = golden()["0_0/meta.json"].replace(b"means_l.webp", b"../0_1/means_l.webp")
    put_files(tmp_path, golden() | {"0_0/meta.json": meta})
    with pytest.raises(FormatError, match=r"'0_0/meta.json': it names '0_0/../0_1/means_l.webp', which is not a file"):
        read_scene(tmp_path)


def test_errors_name_the_chunk_of_a_broken_image_and_of_files_that_cannot_be_opened() -> None:
    with pytest.raises(FormatError, match=r"'0_1/meta.json': 'quats.webp' is a corrupt WebP image"):
        read_full(golden() | {"0_1/quats.webp": golden()["0_1/quats.webp"][:50]})
    with pytest.raises(FormatError, match=r"names '0_0/meta.json', but other files cannot be opened here"):
        decode(streamed_sog, golden()["lod-meta.json"])


def test_a_chunk_that_changes_while_it_is_read_is_refused() -> None:
    opened = 0
    other = by_hand_sog.sog_files(**linear(Scene(random_splats(44, sh_degree=1))))

    def changing(name: str) -> Any:
        nonlocal opened
        opened += name == "0_0/meta.json"
        files = golden() if opened < 2 else golden() | {f"0_0/{each}": data for each, data in other.items()}
        return open_companion(files)(name)

    with pytest.raises(FormatError, match=r"'0_0/meta.json': it was changed while it was read; start again"):
        decode(streamed_sog, golden()["lod-meta.json"], open_companion=changing)


# --- The manifest -----------------------------------------------------------------------------------------------------

BOUND = {"min": [-1, 0, 0.5], "max": [1, 2, 3e5]}
LEAF = {"bound": BOUND, "lods": {"0": {"file": 0, "offset": 0, "count": 3}, "1": {"file": 1, "offset": 4, "count": 2}}}
TREE = {"bound": BOUND, "children": [LEAF, {"bound": BOUND, "children": [LEAF, LEAF]}]}
META = {"version": 1, "lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"], "tree": TREE}


def parsed(**changes: Any) -> Manifest:
    """Parse `META` with changes; `...` leaves a key out."""
    return parse(json.dumps({key: value for key, value in (META | changes).items() if value is not ...}).encode())


def leaf(**changes: Any) -> dict[str, Any]:
    return {"bound": BOUND, "lods": {"1": {"file": 0, "offset": 0, "count": 3} | changes}}


LEVELS, SPLATS = "expected a whole number from 1 to 32", "expected a whole number from 0 to 268,435,456"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lodLevels": ...}, f"lodLevels of lod-meta.json: {LEVELS}, but it is missing"),
        ({"filenames": "x"}, "filenames of lod-meta.json: expected a list, not 'x'"),
        ({"environment": 7}, "environment of lod-meta.json: expected a text, not 7"),
        ({"tree": ...}, "tree of lod-meta.json: expected an object, but it is missing"),
        ({"tree": {"children": 0}}, "tree.children of lod-meta.json: expected a list, not 0"),
        (
            {"tree": {"children": [LEAF, {"children": [LEAF, {"lods": 1}]}]}},
            "tree.children[1].children[1].lods of lod-meta.json: expected an object, not 1",
        ),
        ({"tree": {"lods": {"2": {}}}}, "tree.lods.2 of lod-meta.json: there is no such level, only 0 to 1"),
        ({"tree": leaf(file=2)}, "tree.lods.1.file of lod-meta.json: expected a whole number from 0 to 1, not 2"),
        ({"tree": leaf(offset=-1)}, f"tree.lods.1.offset of lod-meta.json: {SPLATS}, not -1"),
        ({"tree": leaf(count=2**40)}, f"tree.lods.1.count of lod-meta.json: {SPLATS}, not {2**40}"),
    ],
)
def test_wrong_values_are_refused_with_their_place(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError) as raised:
        parsed(**changes)
    assert str(raised.value).startswith(message)


@pytest.mark.parametrize("version", [0, 2, "1", 1.0, True])
def test_another_version_is_refused(version: Any) -> None:
    with pytest.raises(VersionError, match=r"Streamed SOG version .* is unknown, only 1 is read"):
        parsed(version=version)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"null", b'"lodLevels"', b"\xff"])
def test_anything_but_a_json_object_is_refused(data: bytes) -> None:
    with pytest.raises(FormatError, match=r"lod-meta\.json(: expected an object, | is not JSON)"):
        parse(data)


def chain(depth: int) -> bytes:
    """A manifest whose tree is a chain."""
    beginning = b'{"lodLevels":1,"filenames":[],"tree":'
    return beginning + b'{"children":[' * depth + b'{"lods":{}}' + b"]}" * depth + b"}"


def test_a_deep_tree_is_parsed_and_written() -> None:
    manifest = parse(chain(250))
    assert len(manifest.nodes) == 251
    assert manifest.place(250) == "tree" + ".children[0]" * 250
    assert parse(serialise(manifest)) == manifest
    for depth in (300, 5_000, 100_000):
        with pytest.raises(FormatError, match="nested more than 512 deep"):
            parse(chain(depth))


@pytest.mark.parametrize(
    ("name", "limit", "message"), [("MAX_NODES", 5, "more than 5 nodes"), ("MAX_MANIFEST", 100, "more than 100 bytes")]
)
def test_a_manifest_that_is_too_large_is_refused(
    name: str, limit: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(parsed().nodes) == 5
    monkeypatch.setattr(streamed_manifest, name, limit)
    with pytest.raises(FormatError, match=message):
        parsed(tree={"children": [TREE, LEAF]})


@given(st.floats(-LARGEST, LARGEST), st.floats(-1e9, 1e9))
def test_bounds_are_rounded_outward_to_7_digits(low: float, high: float) -> None:
    manifest = Manifest(1, (), (ManifestNode(((low, low, low), (high, high, high)), (), {}),))
    bound = parse(serialise(manifest)).nodes[0].bound
    assert bound is not None  # also at the end of float32
    (found_low, _, _), (found_high, _, _) = bound
    assert low - 1e-6 * abs(low) - 1e-320 <= found_low <= low
    assert high <= found_high <= high + 1e-6 * abs(high) + 1e-320
    assert parse(serialise(Manifest(1, (), (ManifestNode(bound, (), {}),)))).nodes[0].bound == bound


OWN_NAMES = ("0_0/meta.json", "12_345/means_l.webp", "env/env.sog", "env/meta.json")
OTHER_NAMES = ("meta.json", "00_0/meta.json", "env.sog", "0_0/env.sog", "0_0/x.webp", "0_0/", "0_0/../meta.json")


@pytest.mark.parametrize("name", [*OWN_NAMES, *OTHER_NAMES, "x/meta.json", "0_0/0_0/meta.json"])
def test_only_names_of_chunks_and_their_images_belong_to_an_output(name: str) -> None:
    assert is_of_streamed_sog(name) == (name in OWN_NAMES)


# --- Writing ----------------------------------------------------------------------------------------------------------


def in_morton_order(scene: DetailScene, region: int, level: int) -> Splats:
    run = scene.splats.take(scene.run(region, level))
    return run.take(morton.order(run.center))


@pytest.mark.parametrize("errors", [False, True])
@pytest.mark.parametrize("environment", [0, 6])
@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_a_scene_round_trips(sh_degree: int, environment: int, errors: bool) -> None:
    scene = detail_scene(sh_degree=sh_degree, environment=environment, errors=errors)
    files = written(scene)
    back = read_levels(files)
    np.testing.assert_array_equal(back.counts, COUNTS)
    np.testing.assert_array_equal(back.children, CHILDREN)
    assert (back.environment is None, back.errors is None) == (not environment, not errors)
    if errors:
        np.testing.assert_allclose(back.errors, scene.errors)
    assert (back.bounds[:, 0] <= scene.bounds[:, 0]).all() and (back.bounds[:, 1] >= scene.bounds[:, 1]).all()
    np.testing.assert_allclose(back.bounds, scene.bounds, rtol=2e-6)
    for level in range(3):
        for region in range(5):
            expected, found = in_morton_order(scene, region, level), back.splats.take(back.run(region, level))
            np.testing.assert_allclose(found.center, expected.center, atol=1e-3)
            np.testing.assert_allclose(found.opacity, expected.opacity, atol=0.5 / 255 + 1e-6)
            assert found.sh_degree == sh_degree
    again = written(back)
    assert again["lod-meta.json"] == files["lod-meta.json"] and again.keys() == files.keys()


def test_each_chunk_is_the_sog_of_its_runs() -> None:
    scene = detail_scene()
    files = written(scene)
    manifest = parse(files["lod-meta.json"])
    expected = {"lod-meta.json": files["lod-meta.json"]}
    for number, name in enumerate(manifest.filenames):
        runs = [
            (run.offset, region, level)
            for region, (_, node) in enumerate(manifest.regions())
            for level, run in (node.runs or {}).items()
            if run.file == number
        ]
        assert len({level for *_, level in runs}) == 1
        parts = [in_morton_order(scene, region, level) for _, region, level in sorted(runs)]
        for other, data in sog.encode_files(Scene(Splats.concat(parts)), in_order=True):
            expected[name.removesuffix("meta.json") + other] = data
    assert scene.environment is not None
    expected["env/env.sog"] = b"".join(sog.encode(Scene(scene.environment)))
    assert files == expected
    assert [name for name in files if name.endswith("meta.json")] == [
        *("0_0/meta.json", "0_1/meta.json", "1_0/meta.json", "2_0/meta.json", "lod-meta.json")
    ]  # of 40 + 1 + 30, 25, 22 and 18 splats


def test_the_manifest_begins_with_the_keys_of_viewers_and_bounds_enclose_their_children() -> None:
    data = written(detail_scene())["lod-meta.json"]
    assert data.index(b'"lodLevels"') < 400
    form = sniff(data[:400], ".json")
    assert form is not None and form.name == "Streamed SOG"
    meta = json.loads(data)
    assert list(meta) == [
        *("version", "asset", "count", "counts", "lodLevels", "lodErrors", "environment", "filenames", "tree")
    ]
    assert (meta["version"], meta["count"], meta["counts"], meta["lodErrors"]) == (1, 136, [96, 22, 18], True)
    assert meta["asset"].pop("generator").startswith("sparklod ")
    assert meta["asset"] == {"chunkGaussians": 45, "chunkExtent": 2.5, "chunkMinGaussians": 10}
    nodes = parse(data).nodes
    for node in nodes:
        if node.children:
            bounds = np.array([nodes[child].bound for child in node.children])
            np.testing.assert_array_equal(node.bound, [bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


def test_threads_change_no_byte_and_no_splat() -> None:
    files = written(detail_scene())
    expected = read_levels(files).splats
    for threads in (2, 5):
        assert list(written(detail_scene(), threads=threads).items()) == list(files.items())
        assert_same(read_levels(files, threads=threads).splats, expected)


def test_progress_of_reading_and_writing_ends_with_all_splats() -> None:
    done = list[tuple[int, int]]()
    read_full(golden(), threads=2, progress=lambda what, count, total, unit: done.append((count, total)))
    assert done[-1] == (66, 66)
    written(detail_scene(), progress=lambda what, count, total, unit: done.append((count, total)))
    assert done[-1] == (142, 142)


def test_an_output_is_read_by_its_folder_and_by_its_manifest(tmp_path: Path) -> None:
    files = streamed_sog.encode_files(detail_scene(), DEFAULTS, *DIVISION)
    size = write_files(parts_output(tmp_path / "lod-meta.json", overwrite=False), files)
    assert size == sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    whole, levels = read_scene(tmp_path), read_parts(tmp_path / "lod-meta.json", threads=2)
    assert_same(levels.scene().splats, whole.splats)
    assert (len(whole), levels.format) == (96 + 6, "Streamed SOG 1")
    assert dict(levels.header) == {"version": 1, "levels": 3, "regions": 5, "bytes": size}


# --- Damage -----------------------------------------------------------------------------------------------------------


def levels_are_read(files: Mapping[str, bytes]) -> bool:
    try:
        scene = read_levels(files)
    except FormatError as error:
        assert "\n" not in str(error)
        return False
    assert scene.starts.shape == scene.counts.shape
    assert scene.scene().splats.sh_degree == scene.splats.sh_degree
    return True


def full_detail_is_read(files: Mapping[str, bytes]) -> bool:
    return attempt("golden/sh1-streamed-sog/lod-meta.json", files["lod-meta.json"], files=files) == "scene"


def test_a_changed_manifest_gives_a_scene_or_a_format_error() -> None:
    meta = json.loads(golden()["lod-meta.json"])
    refused = tried = 0
    for number, path in enumerate(places_of(meta)[1:]):
        for value in (..., *VALUES)[number % 16 :: 16]:  # all of them at neighbouring places
            files = golden() | {"lod-meta.json": json.dumps(replaced(meta, path, value)).encode()}
            refused += not (levels_are_read(files) if tried % 2 else full_detail_is_read(files))
            tried += 1
    assert refused > 0.3 * tried


def test_changed_swapped_and_missing_files_give_a_scene_or_a_format_error() -> None:
    rng = np.random.default_rng(7)
    names = sorted(golden().keys() - {"lod-meta.json"})
    assert levels_are_read(golden())
    for number, name in enumerate(names):
        data = golden()[name]
        end, other = int(rng.integers(len(data))), names[int(rng.integers(len(names)))]
        assert not levels_are_read({each: content for each, content in golden().items() if each != name})
        assert not levels_are_read(golden() | {name: data[:end]})
        changed = bytearray(data)
        changed[end] ^= 1 << number % 8
        full_detail_is_read(golden() | {name: bytes(changed)})
        full_detail_is_read(golden() | {name: golden()[other]})


def test_a_manifest_that_names_itself_is_refused() -> None:
    assert not full_detail_is_read(
        with_manifest(lambda meta: (name_first("lod-meta.json")(meta), meta.update(environment="lod-meta.json")))
    )
