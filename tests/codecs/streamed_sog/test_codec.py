"""Streamed SOG as it is read: full detail, streams, all levels, other writers' layouts, and what is refused."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fixtures import by_hand_sog, by_hand_streamed_sog
from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.codecs.merging import SceneFiles
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.io.reading import open_reader, read_parts, read_scene
from sparklod_cli.model.scene import DetailScene, Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import linear
from tests.codecs.test_laws import assert_close
from tests.codecs.writers import sog_precision
from tests.conftest import FIXTURES
from tests.scenes import random_splats

from .scenes import detail_scene, files_of, levels_of, open_companion

GOLDEN = FIXTURES / "golden" / "sh1-streamed-sog"


@functools.cache
def golden() -> dict[str, bytes]:
    return {path.relative_to(GOLDEN).as_posix(): path.read_bytes() for path in GOLDEN.rglob("*") if path.is_file()}


def with_meta(change: Callable[[Any], object], files: dict[str, bytes] | None = None) -> dict[str, bytes]:
    """Files whose manifest is changed."""
    files = golden() if files is None else files
    meta = json.loads(files["lod-meta.json"])
    change(meta)
    return files | {"lod-meta.json": json.dumps(meta).encode()}


def scene_of(files: dict[str, bytes]) -> Scene:
    return decode_file(codec, io.BytesIO(files["lod-meta.json"]), open_companion=open_companion(files))


def assert_same(one: Splats, other: Splats) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one, column), getattr(other, column), column)


def first_leaf(meta: Any) -> Any:
    node = meta["tree"]
    while "children" in node:
        node = node["children"][0]
    return node


# --- What is read -----------------------------------------------------------------------------------------------------


def test_the_golden_folder() -> None:
    scene = read_parts(GOLDEN)
    assert scene.counts.tolist() == [[25, 9], [20, 7], [15, 0]]
    assert scene.children.tolist() == [[-1, 1], [-2, -3]]
    assert scene.errors is not None
    assert scene.errors.tolist() == [[0, 0.0125], [0, 0.02], [0, 0]]
    assert scene.environment is not None
    assert (len(scene.environment), scene.environment.sh_degree) == (6, 1)
    assert not scene.environment.sh.any()  # of degree 0 in its file
    assert scene.splats.sh.any()
    for level in range(2):
        for region in range(3):
            center = scene.splats.center[scene.run(region, level)]
            assert (center >= scene.bounds[region, 0]).all()
            assert (center <= scene.bounds[region, 1]).all()
    plain = read_scene(FIXTURES / "sh1.ply").splats
    expected = plain.take(np.argsort(plain.center[:, 0], kind="stable"))
    assert_close(scene.splats.take(scene.level(0)), expected, sog_precision(Scene(expected), 2))
    assert dict(scene.header) == {
        "version": 1,
        "levels": 2,
        "regions": 3,
        "bytes": sum(map(len, golden().values())),
    }


def test_full_detail_is_level_0_and_the_environment() -> None:
    whole = read_scene(GOLDEN)
    assert_same(whole.splats, read_parts(GOLDEN / "lod-meta.json").scene().splats)
    assert len(whole) == 60 + 6
    assert whole.format == "Streamed SOG 1"
    assert (whole.tree, whole.antialiased, whole.notes) == (None, False, ())


def test_full_detail_needs_no_chunk_of_other_levels() -> None:
    files = {name: data for name, data in golden().items() if not name.startswith("1_0/")}
    assert_same(scene_of(files).splats, read_scene(GOLDEN).splats)
    with pytest.raises(FormatError, match="there is no '1_0"):
        levels_of(files)


@pytest.mark.parametrize("block", [7, 60, 1 << 17])
def test_a_stream_has_the_same_splats_from_any_on(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.codecs.reader.BLOCK_SPLATS", block)
    expected = read_scene(GOLDEN).splats
    with open_reader(GOLDEN / "lod-meta.json", threads=2) as stream:
        assert (stream.count, stream.sh_degree) == (66, 1)
        for start, stop in ((0, 66), (20, 30), (44, 66), (59, 61), (5, 6), (3, 3), (0, 45), (45, 60), (60, 66)):
            blocks = list(stream.blocks(start, stop))
            assert all(len(each) <= block for each in blocks)
            if start < stop:
                assert_same(Splats.concat(blocks), expected.take(slice(start, stop)))


def test_a_stream_decodes_each_chunk_once(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = list[str]()
    read = SceneFiles.read

    def counted(self: SceneFiles, chunks: Any, *rest: Any, **more: Any) -> None:
        decoded.extend(chunk.name for chunk in chunks)
        read(self, chunks, *rest, **more)

    monkeypatch.setattr(SceneFiles, "read", counted)
    with open_reader(GOLDEN) as stream:
        for start in range(0, 66, 5):
            list(stream.blocks(start, min(start + 5, 66)))
    assert decoded == ["0_0/meta.json", "0_1/meta.json", "env/meta.json"]


def regions_of(scene: DetailScene) -> list[list[dict[str, Any]]]:
    """The splats of each region at each level, as arguments of the writers in `fixtures`."""
    return [
        [linear(Scene(scene.splats.take(scene.run(region, level)))) for level in range(scene.levels)]
        for region in range(scene.regions)
    ]


@pytest.mark.parametrize("together", [1, 2, 5])
@pytest.mark.parametrize("threads", [1, 3])
def test_runs_in_any_order_are_put_into_ours(together: int, threads: int) -> None:
    regions = regions_of(detail_scene())
    made = [
        by_hand_streamed_sog.streamed_sog_files(regions, by_hand_sog.sog_files, together=together, backwards=backwards)
        for backwards in (False, True)
    ]
    forwards, backwards = (levels_of(files, threads=threads) for files in made)
    np.testing.assert_array_equal(forwards.counts, detail_scene().counts)
    np.testing.assert_array_equal(backwards.counts, forwards.counts)
    np.testing.assert_array_equal(backwards.bounds, forwards.bounds)
    np.testing.assert_array_equal(backwards.splats.center, forwards.splats.center)
    np.testing.assert_allclose(backwards.splats.rgb, forwards.splats.rgb)
    assert (made[0] == made[1]) == (together == 1)


def test_a_manifest_from_before_versions_is_read() -> None:
    files = by_hand_streamed_sog.streamed_sog_files(regions_of(detail_scene()), by_hand_sog.sog_files, version=None)
    assert "version" not in json.loads(files["lod-meta.json"])
    assert levels_of(files).counts.sum() == 136


def test_chunks_may_be_bundled() -> None:
    chunk = {name.removeprefix("0_0/"): data for name, data in golden().items() if name.startswith("0_0/")}
    files = with_meta(lambda meta: meta["filenames"].__setitem__(0, "chunks/0.sog"))
    files |= {"chunks/0.sog": by_hand_sog.zipped(chunk)}
    assert_same(scene_of(files).splats, read_scene(GOLDEN).splats)


def test_regions_without_errors_have_none() -> None:
    assert levels_of(with_meta(lambda meta: first_leaf(meta).pop("errors"))).errors is None


# --- What is refused --------------------------------------------------------------------------------------------------


def change_run(**changes: Any) -> Callable[[Any], object]:
    return lambda meta: first_leaf(meta)["lods"]["0"].update(changes)


REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "a gap": (change_run(offset=1), r"tree\.children\[0\]\.lods\.0 begins at splat 1 of '0_0/meta"),
    "an overlap": (change_run(count=26), r"begins at splat 25 of '0_0/meta.json', but the run before it ends at 26"),
    "too few": (lambda meta: meta["tree"]["children"][1]["children"][1]["lods"]["0"].update(count=14), "14"),
    "no such chunk": (lambda meta: meta["filenames"].__setitem__(0, "9_0/meta.json"), "there is no '9_0/meta.json'"),
    "twice": (lambda meta: meta["filenames"].__setitem__(1, "0_0/meta.json"), "names '0_0/meta.json' twice"),
    "not a SOG": (
        lambda meta: meta["filenames"].__setitem__(0, "lod-meta.json"),
        "'lod-meta.json': its meta.json is not that of a SOG",
    ),
    "an image": (lambda meta: meta["filenames"].__setitem__(0, "0_0/sh0.webp"), r"'0_0/sh0.webp': meta\.json is not"),
    "no splats": (
        lambda meta: meta.update(tree={"bound": meta["tree"]["bound"], "lods": {}}),
        "lod-meta.json has no splats of level 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_together_is_refused(name: str) -> None:
    change, message = REFUSED[name]
    with pytest.raises(FormatError, match=message):
        scene_of(with_meta(change))


REFUSED_LEVELS: dict[str, tuple[Callable[[Any], object], str]] = {
    "a node with both": (lambda meta: meta["tree"].update(lods={}), "tree has 2 children and lods; a node has two"),
    "no bound": (
        lambda meta: first_leaf(meta).pop("bound"),
        r"tree\.children\[0\] has no bound of six numbers that are finite in float32",
    ),
    "a bound beyond float32": (
        lambda meta: first_leaf(meta)["bound"]["max"].__setitem__(0, 1e39),
        r"tree\.children\[0\] has no bound of six numbers that are finite in float32",
    ),
    "three children": (
        lambda meta: meta["tree"]["children"].append({"bound": meta["tree"]["bound"], "lods": {}}),
        "tree has 3 children and no lods; a node has two children or lods",
    ),
    "errors": (
        lambda meta: first_leaf(meta).update(errors=[0]),
        r"tree\.children\[0\]\.errors is \[0\], not one for each of 2 levels",
    ),
    "a negative error": (lambda meta: first_leaf(meta).update(errors=[0, -1]), r"\[0, -1\], not finite numbers from"),
}


@pytest.mark.parametrize("name", REFUSED_LEVELS)
def test_what_only_levels_need_is_refused_by_them(name: str) -> None:
    change, message = REFUSED_LEVELS[name]
    files = with_meta(change)
    assert len(scene_of(files)) == 66
    with pytest.raises(FormatError, match=message):
        levels_of(files)


AWAY = ["../x/meta.json", "/etc/meta.json", "0_0/../../x", "http://x/meta.json", "0_0\\meta.json"]


@pytest.mark.parametrize("name", AWAY)
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "lod-meta.json").write_bytes(
        with_meta(lambda meta: meta["filenames"].__setitem__(0, name))["lod-meta.json"]
    )
    with pytest.raises(FormatError, match="which is not a file beside it"):
        read_scene(tmp_path)


def test_images_of_a_chunk_cannot_lead_elsewhere(tmp_path: Path) -> None:
    files = golden() | {"0_0/meta.json": golden()["0_0/meta.json"].replace(b"means_l.webp", b"../0_1/means_l.webp")}
    for name, data in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match=r"'0_0/meta.json': it names '0_0/../0_1/means_l.webp', which is not a file"):
        read_scene(tmp_path)


def test_a_broken_image_is_named_with_its_chunk() -> None:
    files = golden() | {"0_1/quats.webp": golden()["0_1/quats.webp"][:50]}
    with pytest.raises(FormatError, match=r"'0_1/meta.json': 'quats.webp' is a corrupt WebP image"):
        scene_of(files)


def test_other_files_have_no_detail_levels() -> None:
    assert read_parts(FIXTURES / "golden" / "sh1-sog") is None


def test_without_other_files_the_first_one_is_named() -> None:
    with pytest.raises(FormatError, match=r"names '0_0/meta.json', but other files cannot be opened here"):
        decode_file(codec, io.BytesIO(golden()["lod-meta.json"]))


def test_a_chunk_that_changes_meanwhile_is_refused() -> None:
    opened = 0
    other = by_hand_sog.sog_files(**linear(Scene(random_splats(44, sh_degree=1))))

    def changing(name: str) -> Any:
        nonlocal opened
        opened += name == "0_0/meta.json"
        files = golden() if opened < 2 else golden() | {f"0_0/{each}": data for each, data in other.items()}
        return open_companion(files)(name)

    with pytest.raises(FormatError, match=r"'0_0/meta.json': it was changed while it was read; start again"):
        decode_file(codec, io.BytesIO(golden()["lod-meta.json"]), open_companion=changing)


def test_progress_ends_with_all_splats() -> None:
    told = list[tuple[int, int]]()
    decode_file(
        codec,
        io.BytesIO(golden()["lod-meta.json"]),
        threads=2,
        open_companion=open_companion(golden()),
        progress=lambda what, done, total, unit: told.append((done, total)),
    )
    assert told[-1] == (66, 66)


def test_written_files_are_read_with_any_threads() -> None:
    files = files_of(detail_scene())
    expected = levels_of(files)
    for threads in (2, 5):
        assert_same(levels_of(files, threads=threads).splats, expected.splats)
