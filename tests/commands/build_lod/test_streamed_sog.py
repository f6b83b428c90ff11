"""Streamed SOG out of `sparklod build-lod`: names, counts, levels, the environment, trees, refusals, interruptions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import ply
from sparklod_cli.codecs.formats import ENVIRONMENT_FILE
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from tests.commands.build_lod.runs import ONE, SMALL, build
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

TREE = FIXTURES / "golden" / "tree-v3.spz"
MANIFEST = "lod-meta.json"


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plain scene of several regions."""
    return written(tmp_path_factory.mktemp("town") / "town.ply", 3_000, extent=30)


def written(path: Path, count: int, *, extent: float = 4, seed: int = 0) -> Path:
    """A plain scene."""
    splats = random_splats(count, extent=extent, seed=seed, sh_degree=1)
    path.write_bytes(b"".join(ply.encode(Scene(splats), WriteOptions())))
    return path


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def manifest(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / MANIFEST).read_text())
    return found


def regions(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for child in node["children"] for each in regions(child)] if "children" in node else [node]


def splats_in(folder: Path) -> int:
    """Of an unpacked SOG."""
    return int(json.loads((folder / "meta.json").read_text())["count"])


def record_of(capsys: Capture) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_what_is_reported_is_what_the_files_hold(town: Path, tmp_path: Path, capsys: Capture) -> None:
    web = tmp_path / "new" / "web"
    options = ["--levels", "50%,20%,5%", "--region-min-splats", 200, "--region-extent", 8, "--chunk-splats", 900]
    assert build(town, "-o", web / MANIFEST, "--json", *options) == 0
    out, err = capsys.readouterr()
    record, found = json.loads(out), manifest(web)
    detail = record["detail"]
    assert (record["output_format"], record["method"], record["splats"]) == ("streamed-sog", "quality", 3_000)
    assert record["bytes"] == sum(map(len, files(web).values()))
    assert [level["splats"] for level in detail["levels"]] == found["counts"]
    assert found["counts"][0] == record["splats"] and found["count"] == sum(found["counts"])
    np.testing.assert_allclose(np.divide(found["counts"], 3_000), [1, 0.5, 0.2, 0.05], atol=0.01)
    np.testing.assert_allclose([level["share"] for level in detail["levels"]], np.divide(found["counts"], 3_000))
    leaves = regions(found["tree"])
    assert detail["regions"] == len(leaves) > 4
    worst = np.max([leaf["errors"] for leaf in leaves], axis=0)
    np.testing.assert_allclose([level["worst_error"] for level in detail["levels"]], worst, rtol=1e-6)
    assert detail["levels"][0]["worst_error"] == 0 < detail["levels"][1]["worst_error"]
    folders = {path.parent.name for path in web.glob("*/meta.json")}
    assert detail["chunks"] == len(folders) == len(found["filenames"]) > 4
    assert sum(splats_in(web / folder) for folder in folders) == found["count"]
    assert detail["environment"] == 0 and "environment" not in found
    assert {"read", "build", "levels", "errors", "write"} <= set(record["seconds"])
    assert f"4 detail levels of {len(leaves)} regions, {len(folders)} chunk files, " in err
    assert f"levels below full detail: {found['counts'][1]:,} splats (" in err


@pytest.mark.parametrize("directory", [False, True])
def test_the_default_name_is_that_of_a_folder(directory: bool, scene: Path, tmp_path: Path) -> None:
    options = ["--output-dir", tmp_path / "out"] if directory else []
    assert build(scene, "--format", "streamed-sog", *options) == 0
    web = (tmp_path / "out" if directory else scene.parent) / "scene-lod"
    assert manifest(web)["counts"][0] == len(read_scene(scene))
    assert build(scene, "--format", "streamed-sog", *options) == 1
    assert build(scene, "--format", "streamed-sog", *options, "--overwrite") == 0


def test_threads_do_not_change_the_files(town: Path, tmp_path: Path) -> None:
    for threads in (1, 2):
        assert build(town, "-o", tmp_path / f"{threads}" / MANIFEST, "--threads", threads) == 0
    assert files(tmp_path / "1") == files(tmp_path / "2")


def test_the_tree_is_of_quality_unless_another_one_is_asked_for(town: Path, tmp_path: Path, capsys: Capture) -> None:
    made = {}
    for name, options in {"none": [], "quality": ["--method", "quality"], "quick": ["--method", "quick"]}.items():
        assert build(town, "-o", tmp_path / name / MANIFEST, "--json", *options) == 0
        assert record_of(capsys)["method"] == ("quick" if name == "quick" else "quality")
        made[name] = files(tmp_path / name)
    assert made["none"] == made["quality"] != made["quick"]


def test_levels_can_be_made_of_an_existing_tree(town: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(town, "-o", tmp_path / "town-lod.rad", "--method", "quality", "--rad-center", "f32") == 0
    capsys.readouterr()
    assert build(tmp_path / "town-lod.rad", "--format", "streamed-sog", "--json") == 0
    record = record_of(capsys)
    assert (record["method"], record["splats"]) == (None, 3_000)
    assert "build" not in record["seconds"]
    assert manifest(tmp_path / "town-lod")["counts"][0] == 3_000
    for option in (["--method", "quality"], ["--growth", "1.4"], ["--environment-beyond", "9"], ["--up", "-y"]):
        assert build(TREE, "-o", tmp_path / "x" / MANIFEST, *option) == 1
        assert f"it has a tree, which is written as it is; leave out {option[0]}, " in capsys.readouterr().err


def test_several_files_become_one_scene(tmp_path: Path) -> None:
    tiles = [written(tmp_path / f"{seed}.ply", 300, seed=seed) for seed in (1, 2)]
    assert build(*tiles, "--merge", "-o", tmp_path / "web" / MANIFEST) == 0
    assert manifest(tmp_path / "web")["counts"][0] == 600


def test_an_environment_is_a_file_or_what_is_far_away(town: Path, tmp_path: Path, capsys: Capture) -> None:
    sky = written(tmp_path / "sky.ply", 70, extent=100)
    assert build(town, "-o", tmp_path / "file" / MANIFEST, "--environment", sky, "--json", "--translate", "5,0,0") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["detail"]["environment"] == 70 == len(read_scene(tmp_path / "file" / ENVIRONMENT_FILE))
    assert ", environment of 70 splats" in err
    lowest = read_scene(tmp_path / "file" / ENVIRONMENT_FILE).splats.center.min(axis=0)
    np.testing.assert_allclose(lowest, read_scene(sky).splats.center.min(axis=0) + np.array([5, 0, 0]), rtol=1e-3)
    assert build(town, "-o", tmp_path / "far" / MANIFEST, "--environment-beyond", 20, "--json") == 0
    record, found = record_of(capsys), manifest(tmp_path / "far")
    far = len(read_scene(tmp_path / "far" / ENVIRONMENT_FILE))
    assert 0 < record["detail"]["environment"] == far < 3_000
    assert found["counts"][0] + far == 3_000 == record["splats"] + far
    assert build(town, "-o", tmp_path / "none" / MANIFEST, "--environment-beyond", 1e4, "--json") == 0
    assert record_of(capsys)["detail"]["environment"] == 0
    assert build(town, "-o", tmp_path / "all" / MANIFEST, "--environment-beyond", 1e-3) == 1
    assert "no splat is within 0.001 of the middle of the scene" in capsys.readouterr().err


def test_an_environment_that_cannot_be_one_is_named(tmp_path: Path, capsys: Capture) -> None:
    for path, said in {
        tmp_path / "missing.ply": f"{tmp_path / 'missing.ply'} cannot be read: no such file",
        TREE: f"the environment {TREE}: it is a Level-of-Detail file; give the splats that its tree was built from",
    }.items():
        assert build(SMALL, "-o", tmp_path / "web" / MANIFEST, "--environment", path) == 1
        assert f"sh2.ply: {said}" in capsys.readouterr().err
    assert not (tmp_path / "web").exists()


def test_full_detail_and_environment_are_what_is_read(town: Path, tmp_path: Path, capsys: Capture) -> None:
    web = tmp_path / "web"
    assert build(town, "-o", web / MANIFEST, "--environment-beyond", 20) == 0
    capsys.readouterr()
    for source in (web, web / MANIFEST):
        assert build(source, "-o", tmp_path / "x.spz", "--overwrite", "--json") == 0
        assert (record_of(capsys)["read"]) == 3_000
    assert build(web, "-o", tmp_path / "again" / MANIFEST) == 0
    assert manifest(tmp_path / "again")["counts"][0] == 3_000


@pytest.mark.parametrize("source", [".", MANIFEST, "0_0", "0_0/meta.json"])
def test_an_output_does_not_replace_its_input(source: str, town: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(town, "-o", tmp_path / MANIFEST) == 0
    before = files(tmp_path)
    assert build(tmp_path / source, "-o", tmp_path / MANIFEST, "--overwrite") == 2
    assert "is an input; name another output" in capsys.readouterr().err
    assert files(tmp_path) == before


def test_a_smaller_output_removes_the_files_of_a_larger_one(town: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(town, "-o", tmp_path / MANIFEST, "--chunk-splats", 500, "--region-min-splats", 100) == 0
    (tmp_path / "index.html").write_text("precious")
    assert build(ONE, "-o", tmp_path / MANIFEST) == 1
    assert "lod-meta.json exists, add --overwrite" in capsys.readouterr().err
    assert build(ONE, "-o", tmp_path / MANIFEST, "--overwrite") == 0
    assert build(ONE, "-o", tmp_path / "fresh" / MANIFEST) == 0
    found = files(tmp_path / "fresh")
    assert {name: data for name, data in files(tmp_path).items() if not name.startswith("fresh/")} == {
        **found,
        "index.html": b"precious",
    }


@pytest.mark.parametrize("before", [False, True])
def test_an_interruption_leaves_what_was_there(
    before: bool, town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparklod_cli.codecs import streamed_sog as codec

    web = tmp_path / "web"
    if before:
        assert build(ONE, "-o", web / MANIFEST) == 0
    former = files(tmp_path)
    whole = codec.encode_files

    def broken(*arguments: Any, **how: Any) -> Any:
        yield next(iter(whole(*arguments, **how)))
        raise KeyboardInterrupt

    monkeypatch.setattr(codec, "encode_files", broken)
    assert build(town, "-o", web / MANIFEST, "--overwrite") == 130
    assert files(tmp_path) == former


def test_the_same_bake_is_skipped(town: Path, tmp_path: Path, capsys: Capture) -> None:
    web, sky = tmp_path / "web", written(tmp_path / "sky.ply", 40)
    given = [town, "-o", web / MANIFEST, "--skip-existing", "--environment", sky]
    assert build(*given) == 0
    before = files(web)
    assert f"{MANIFEST}.sparklod.json" in before
    assert build(*given) == 0
    assert "exists already" in capsys.readouterr().err
    assert build(*given, "--levels", "30%") == 1
    assert "detail.levels was None and is [0.3]; add --overwrite" in capsys.readouterr().err
    image = next(web.glob("0_0/*.webp"))
    image.write_bytes(image.read_bytes() + b"?")
    assert build(*given) == 1
    assert f"{image.parent.name}/{image.name} was changed since it was baked" in capsys.readouterr().err
    assert build(*given, "--overwrite") == 0
    open_companion = f"{MANIFEST}.sparklod.json"  # has the dates of the files
    assert {**files(web), open_companion: b""} == {**before, open_companion: b""}
    written(sky, 40, seed=3)
    capsys.readouterr()
    assert build(*given) == 1
    assert "sky.ply changed since" in capsys.readouterr().err


def test_other_outputs_have_no_detail(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(scene, "-o", tmp_path / "x.spz", "--json") == 0
    assert record_of(capsys)["detail"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "streamed-sog", "-o", "-"], "streamed-sog writes several files; name the output, such as web/"),
        (["--format", "streamed-sog", "-o", "x.spz"], f"not x.spz; name the output x/{MANIFEST}"),
        (["--format", "streamed-sog", "-o", "web"], f"and folders beside it, not web; name the output web/{MANIFEST}"),
        (["--format", "rad", "-o", MANIFEST], "--format rad writes .rad, not .json"),
        (
            ["-o", "web/other.json"],
            ".json cannot hold a tree; name the output .spz, .rad, lod-meta.json or",
        ),
        (["--levels", "50%"], "not of SPZ; name the output lod-meta.json, or add --format streamed-sog"),
        (["-o", "x.rad", "--chunk-splats", "1k"], "--chunk-splats is an option of Streamed SOG, not of RAD"),
        (["--region-extent", "3"], "--region-extent is an option of Streamed SOG, not of SPZ"),
        (["--region-min-splats", "3"], "--region-min-splats is an option of Streamed SOG, not of SPZ"),
        (["--environment", "b.ply"], "--environment is an option of Streamed SOG, not of SPZ"),
        (["--environment-beyond", "3"], "--environment-beyond is an option of Streamed SOG, not of SPZ"),
        (["-o", MANIFEST, "--spz-version", "2"], "--spz-version is an option of SPZ, not of Streamed SOG"),
        (["-o", MANIFEST, "--rad-sh", "f16"], "--rad-sh is an option of RAD, not of Streamed SOG"),
        (["-o", MANIFEST, "--compression-level", "9"], "is an option of SPZ and RAD, not of Streamed SOG"),
        (["-o", MANIFEST, "--base", "1.2"], "--base is an option of --method quick, not of quality"),
        (["-o", MANIFEST, "--method", "quick", "--growth", "1.2"], "an option of --method quality, not of quick"),
        (["-o", MANIFEST, "--environment", "b.ply", "--environment-beyond", "3"], "cannot be used with --environment"),
        (["-o", MANIFEST, "--environment-beyond", "0"], "--environment-beyond"),
        (["-o", MANIFEST, "--chunk-splats", "0"], "'0' is out of range; give 1 or more"),
        (["-o", MANIFEST, "--region-extent", "nan"], "--region-extent"),
        *((["-o", MANIFEST, "--levels", text], f"{text!r} is neither auto nor shares") for text in ("", "9%,9%", "2")),
        (["-o", MANIFEST, "--levels", "100%"], "above 0% and below 100%"),
        (["-o", MANIFEST, "--levels", "0%"], "above 0% and below 100%"),
        (["-o", MANIFEST, "--levels", ",".join(f"{share}%" for share in range(60, 44, -1))], "at most 15"),
    ],
)
def test_options_that_do_not_suit_are_refused(arguments: list[str], message: str, capsys: Capture) -> None:
    assert build("a.ply", *arguments) == 2
    assert message in capsys.readouterr().err
