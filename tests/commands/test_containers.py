"""RAD, Streamed SOG and 3D Tiles: written by `build-lod`, drawn by `render`, and traversed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.codecs.formats import ENVIRONMENT_FILE, RAD_ENCODINGS, RadOptions
from sparklod_cli.codecs.rad.rad_header import read_chunk_header, read_header
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from tests.commands.cli import NAMED, Cli
from tests.lod.trees import row_of_regions
from tests.part_files import write_streamed
from tests.scenes import random_splats

SMALL, TREE = "sh2.ply", "tree-v3.spz"


def scene_of(name: str) -> Scene:
    return read_scene(Path(name))


def files(folder: str) -> dict[str, bytes]:
    paths = [path for path in Path(folder).rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


# --- RAD --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of more nodes than a chunk has."""
    path = tmp_path_factory.mktemp("large") / "large.spz"
    tree = sparklod.Tree(*quick.build(random_splats(60_000, extent=50)))
    sparklod.write(path, tree, compression_level=1)
    return path


def families(scene: Scene) -> np.ndarray:
    """(N, 9) values that are the same in SPZ and RAD up to rounding, in an order independent of the nodes' order."""
    assert scene.tree is not None
    count, start = scene.tree.child_count.astype(np.int64), scene.tree.child_start.astype(np.int64)
    first = np.where(count[:, None] > 0, scene.splats.center[np.minimum(start, len(count) - 1)], 0)
    found = np.column_stack([scene.splats.center, first, count, scene.splats.opacity > 1])
    return np.array(sorted(map(tuple, np.round(found, 1).tolist())))


@pytest.mark.parametrize("options", ["--format rad", "-o sh2-lod.rad", "-o sh2-lod.RAD"])
def test_rad_is_written_where_it_is_asked_for(options: str, cli: Cli) -> None:
    err = cli(f"build-lod {SMALL} {options}").err
    (name,) = cli.made()
    baked = scene_of(name)
    assert baked.tree is not None and (baked.format, baked.header["chunked"]) == ("RAD LoD", 0)
    assert baked.tree.is_leaf.sum() == 60
    assert f"{len(baked):,} nodes, depth {baked.tree.depths().max()}, 1 chunk, " in err


def test_chunks_are_files_beside_their_header(large: Path, cli: Cli) -> None:
    record = cli(f"build-lod {large} --format rad-chunked -o many.rad --json").json
    assert cli.made() == ["many-0.radc", "many-1.radc", "many.rad"]
    assert (record["output_format"], record["chunks"]) == ("rad-chunked", 2)
    assert record["bytes"] == sum(map(len, files(".").values()))
    cli(f"build-lod {large} -o one.rad")
    one, many = scene_of("one.rad"), scene_of("many.rad")
    assert one.chunk_bytes is not None and one.chunk_bytes == many.chunk_bytes
    np.testing.assert_array_equal(one.splats.center, many.splats.center)


def test_a_tree_is_the_same_in_the_other_format(large: Path, cli: Cli) -> None:
    """Scales are rounded to other codes; those of opacities are the same in both formats."""
    before = read_scene(large)
    assert before.tree is not None
    done = cli(f"build-lod {large} -o there.rad -v --json")
    record = done.json
    assert (record["read"], record["nodes"], record["splats"]) == (len(before), len(before), before.tree.is_leaf.sum())
    assert (record["method"], record["dropped"]) == (None, {}) and "build" not in record["seconds"]
    assert "SPZ 3 LoD -> the same tree -> RAD LoD, center f32_lebytes" in done.err
    cli("build-lod there.rad -o back.spz")
    cli("build-lod there.rad --format rad-chunked -o many.rad")
    there, back = scene_of("there.rad"), scene_of("back.spz")
    assert there.tree is not None and back.tree is not None
    np.testing.assert_array_equal(families(there), families(before))
    np.testing.assert_array_equal(families(scene_of("many.rad")), families(there))
    # From RAD to SPZ, nodes keep the order that they have.
    np.testing.assert_array_equal(back.tree.child_start, there.tree.child_start)
    np.testing.assert_allclose(back.splats.center, there.splats.center, atol=1e-3)
    np.testing.assert_allclose(back.splats.opacity, there.splats.opacity, rtol=1e-5)
    np.testing.assert_allclose(np.sort(there.splats.opacity), np.sort(before.splats.opacity), rtol=1e-5)
    assert not np.array_equal(np.sort(before.splats.scale[:, 0]), np.sort(there.splats.scale[:, 0]))


@pytest.mark.parametrize("foreign", [False, True])
def test_only_another_container_keeps_every_byte_of_the_chunks(large: Path, foreign: bool, cli: Cli) -> None:
    if foreign:  # other encodings and ranges than ours, and a palette
        shutil.copytree(NAMED["sh3-rad"], "many")
        cli("build-lod many/sh3.rad --format rad -o whole.rad")
        many = "many/sh3.rad"
    else:
        cli(f"build-lod {large} --cluster-sh 100 --rad-scales f32 -o whole.rad")
        cli("build-lod whole.rad --format rad-chunked -o many/x.rad")
        many = "many/x.rad"
    chunks = [path.read_bytes() for path in sorted(Path("many").glob("*.radc"))]
    assert Path("whole.rad").read_bytes().endswith(b"".join(chunks))
    cli(f"build-lod {many} --format rad -o back.rad")
    assert Path("back.rad").read_bytes() == Path("whole.rad").read_bytes()
    assert np.array_equal(families(scene_of(many)), families(scene_of("whole.rad")))


@pytest.mark.parametrize("name", RAD_ENCODINGS)
def test_every_encoding_reaches_the_file_and_the_report(name: str, cli: Cli) -> None:
    for encoding in RAD_ENCODINGS[name]:
        record = cli(f"build-lod {SMALL} -o {encoding}.rad --rad-{name} {encoding} --json").json
        assert record["encodings"][name] == encoding
        with Path(f"{encoding}.rad").open("rb") as file:
            read_header(file)
            written = {each.name: each.encoding for each in read_chunk_header(file).properties}
        assert written["sh1" if name == "sh" else name] == encoding
    if name == "scales":  # with another container, too
        cli("build-lod ln_0r8.rad --format rad-chunked --rad-scales f32 -o y.rad")
        coding = scene_of("y.rad").coding
        assert coding is not None and coding.scales[0][0] == ""


@pytest.mark.parametrize(("value", "encoding"), [(5e4, "f16"), (1e6, "f32")])
@pytest.mark.parametrize("column", ["rgb", "sh"])
def test_the_encoding_that_is_advised_holds_the_values(column: str, value: float, encoding: str, cli: Cli) -> None:
    splats = random_splats(400, sh_degree=1)
    getattr(splats, column)[3] = value
    sparklod.write(cli.folder / "bright.rad", Scene(splats), rad=RadOptions(rgb="f32", sh="f32"))
    err = cli("build-lod bright.rad -o a.rad --rad-rgb r8 --rad-sh s8 -v").err
    assert f"--rad-{column} {encoding} keeps them" in err
    err = cli(f"build-lod bright.rad -o a.rad -f -v --rad-rgb {encoding} --rad-sh {encoding}").err
    assert "keeps them" not in err


def test_limits_of_rad_encodings(cli: Cli) -> None:
    splats = random_splats(40)
    splats.center[3] = 1e6
    cli.put("far.rad", splats)
    said = "coordinates reach 1e+06, and f16 holds less than 65504"
    assert said in cli("build-lod far.rad -o a.rad --rad-center f16", status=1).err
    record = cli("build-lod one.ply -o b.rad --max-sh 0 --cluster-sh --json").json  # a palette without SH
    assert record["sh_codes"] is None and "sh" not in record["encodings"]


# --- Streamed SOG -----------------------------------------------------------------------------------------------------


def manifest(folder: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path(folder, "lod-meta.json").read_text())
    return found


def regions(node: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for child in node["children"] for each in regions(child)] if "children" in node else [node]


@pytest.fixture
def town(cli: Cli) -> Cli:
    """A plain scene of several regions, and a sky around it."""
    cli.put("town.ply", random_splats(3_000, extent=30, sh_degree=1))
    cli.put("sky.ply", random_splats(70, extent=100, sh_degree=1))
    return cli


def test_the_report_of_levels_is_that_of_the_files(town: Cli) -> None:
    options = "--levels 50%,20%,5% --region-min-splats 200 --region-extent 8 --chunk-splats 900"
    done = town(f"build-lod town.ply -o web/lod-meta.json --json {options}")
    record, found = done.json, manifest("web")
    detail, counts = record["detail"], found["counts"]
    assert (record["output_format"], record["method"], record["splats"]) == ("streamed-sog", "quality", 3_000)
    assert record["bytes"] == sum(map(len, files("web").values()))
    assert [level["splats"] for level in detail["levels"]] == counts
    assert counts[0] == 3_000 and found["count"] == sum(counts)
    np.testing.assert_allclose(np.divide(counts, 3_000), [1, 0.5, 0.2, 0.05], atol=0.01)
    np.testing.assert_allclose([level["share"] for level in detail["levels"]], np.divide(counts, 3_000))
    leaves = regions(found["tree"])
    assert detail["regions"] == len(leaves) > 4
    worst = np.max([leaf["errors"] for leaf in leaves], axis=0)
    np.testing.assert_allclose([level["worst_error"] for level in detail["levels"]], worst, rtol=1e-6)
    assert detail["levels"][0]["worst_error"] == 0 < detail["levels"][1]["worst_error"]
    chunks = [json.loads(path.read_text())["count"] for path in Path("web").glob("*/meta.json")]
    assert detail["chunks"] == len(chunks) == len(found["filenames"]) > 4 and sum(chunks) == found["count"]
    assert detail["environment"] == 0 and "environment" not in found
    assert {"read", "build", "levels", "errors", "write"} <= set(record["seconds"])
    assert f"4 detail levels of {len(leaves)} regions, {len(chunks)} chunk files, " in done.err
    assert f"levels below full detail: {counts[1]:,} splats (" in done.err


def test_levels_are_of_a_quality_tree_unless_another_one_is_named(town: Cli) -> None:
    for name, options in (("none", "--threads 1"), ("quality", "--method quality"), ("quick", "--method quick")):
        record = town(f"build-lod town.ply -o {name}/lod-meta.json --json {options}").json
        assert record["method"] == ("quick" if name == "quick" else "quality")
    assert files("none") == files("quality") != files("quick")  # whatever the threads
    town("build-lod town.ply -o town-lod.rad --method quality --rad-center f32")
    record = town("build-lod town-lod.rad --format streamed-sog --json").json
    assert (record["method"], record["splats"], manifest("town-lod")["counts"][0]) == (None, 3_000, 3_000)
    assert "build" not in record["seconds"]
    town("build-lod town.ply sky.ply --merge -o both/lod-meta.json")
    assert manifest("both")["counts"][0] == 3_070


def test_an_environment_is_a_file_or_the_splats_far_away(town: Cli) -> None:
    done = town("build-lod town.ply -o file/lod-meta.json --environment sky.ply --json --translate 5,0,0")
    sky, moved = scene_of("sky.ply"), scene_of(f"file/{ENVIRONMENT_FILE}")
    assert done.json["detail"]["environment"] == 70 == len(moved) and ", environment of 70 splats" in done.err
    lowest = sky.splats.center.min(axis=0) + np.array([5, 0, 0])
    np.testing.assert_allclose(moved.splats.center.min(axis=0), lowest, rtol=1e-3)
    record = town("build-lod town.ply -o far/lod-meta.json --environment-beyond 20 --json").json
    far = len(scene_of(f"far/{ENVIRONMENT_FILE}"))
    assert 0 < record["detail"]["environment"] == far < 3_000
    assert manifest("far")["counts"][0] + far == 3_000 == record["splats"] + far
    for source in ("far", "far/lod-meta.json"):  # full detail and the environment are read
        assert town(f"build-lod {source} -o x.spz -f --json").json["read"] == 3_000
    record = town("build-lod town.ply -o none/lod-meta.json --environment-beyond 1e4 --json").json
    assert record["detail"]["environment"] == 0
    err = town("build-lod town.ply -o all/lod-meta.json --environment-beyond 1e-3", status=1).err
    assert "no splat is within 0.001 of the middle of the scene" in err


# --- Views of Streamed SOG: six regions of 64, 32 and 16 splats, and 5 splats around them -----------------------------

AT, FULL = "--look-at 0,0,-6:0,0,0 --size 48x32", 6 * 64 + 5


@pytest.fixture
def web(cli: Cli) -> Cli:
    write_streamed(cli.folder / "web", row_of_regions(environment=5))
    cli.inputs.add("web")
    return cli


def test_levels_are_drawn_by_budget_and_distance(web: Cli) -> None:
    twice = [{"file": "web"}, {"file": "web/lod-meta.json", "translation": [3, 0, 0]}]
    web.put("twice.json", json.dumps({"instances": twice}))
    for line, least, most in (
        *((f"{path} --budget 200", 150, 205) for path in ("web", "web/lod-meta.json")),
        *((f"web {options}", FULL, FULL) for options in ("", "--full")),
        ("web --budget 1", 6 * 16 + 5, 6 * 16 + 5),
        ("web --budget-mode limit --lod-base-distance 0.1", 6 * 16 + 5, 6 * 16 + 5),
        ("web --budget-mode limit --lod-base-distance 1000", FULL, FULL),
        ("--scene twice.json --full", 2 * FULL, 2 * FULL),
        ("--scene twice.json --budget 400", 200, 400 + 10),
    ):
        (frame,) = web(f"render {line} {AT} -o x.png -f --json").json["frames"]
        assert least <= frame["splats"] <= most, line


def test_pictures_of_levels_frames_and_sheets(web: Cli) -> None:
    views = "--view 0,0,-6:0,0,0 --view 3,0,-6:0,0,0 --size 48x32"
    for options in (
        *(f"{AT} --color-by {by} -o {by}.png" for by in ("level", "chunk")),
        f"{views} -o sheet.png",
        "--orbit 2 --size 48x32 -o frame.%d.png",
        f"{AT} --after 1s --bandwidth 100kbit -o after.png",
    ):
        web(f"render web --budget 200 -q {options}")
    assert len(web.made()) == 6
    done = web(f"render web {AT} --budget 30%,100% --compare --json -q --assert 30%:psnr<60")
    coarse, full = done.json["budgets"]
    assert done.json["leaves"] == FULL == full["selected"] and coarse["psnr"] < 60 < full["psnr"] == 100


def test_traverse_writes_rows_and_a_summary_of_levels(web: Cli) -> None:
    path = "--keyframes '0,0,-6:0,0,40 0,0,16:0,0,40' --seconds 4 --every 10"
    asserts = "--assert selected<=205 --assert level_max<=2"
    rows = web(f"traverse web {path} --budget 200 --per-instance --no-timing {asserts}").rows
    assert {row["instance"] for row in rows} == {"total", "web"}
    assert all(row["pixel_scale_limit"] == row["frontier"] == "" for row in rows)
    summary = web(f"traverse web {path} --bandwidth 500kbit --latency 20ms --json --assert first_picture_s<5").json
    assert summary["loading"]["resident_all_bytes"] >= summary["loading"]["resident_90_bytes"] > 0
    assert "pixel_scale_min" not in summary["quantities"]


# --- 3D Tiles ---------------------------------------------------------------------------------------------------------


def test_the_report_of_tiles_is_that_of_the_files(cli: Cli) -> None:
    cli.put("town.ply", random_splats(2_000, extent=4, sh_degree=1))
    record = cli("build-lod town.ply -o new/tileset.json --tile-splats 100 --json").json
    made, tiles = read_parts(Path("new")), record["tiles"]
    assert (record["output_format"], record["method"], record["splats"]) == ("3d-tiles", "quality", 2_000)
    assert record["bytes"] == sum(map(len, files("new").values()))
    assert tiles["tiles"] == made.tiles == len(list(Path("new").glob("tiles/*.glb")))
    assert tiles["levels"] == len(tiles["splats"]) == made.level.max() + 1
    assert tiles["splats"][-1] == 2_000 and tiles["splats"][0] == made.counts[0] <= 100
    assert tiles["error"] == made.errors[0] and not tiles["georeferenced"]
    np.testing.assert_array_equal(made.transform, np.eye(4))
    cli("build-lod new -o again.spz")
    cli("convert again.spz leaves.ply")
    assert len(scene_of("leaves.ply")) == len(scene_of("new"))
    cli("build-lod new/tileset.json -o web/lod-meta.json")


def test_a_small_scene_or_tree_becomes_tiles(cli: Cli) -> None:
    assert "1 tile of 1 level" in cli("build-lod one.ply --format 3d-tiles").err
    cli("build-lod one.ply --format 3d-tiles -o tileset.json --glb-profile khronos")
    assert scene_of("one-lod").format == "3D Tiles 1.1 of GLB SPZ 3" and scene_of(".").format == "3D Tiles 1.1 of GLB"
    cli(f"build-lod {TREE} -o tree/tileset.json --tile-splats 1")
    tree = scene_of(TREE).tree
    assert tree is not None and len(scene_of("tree")) == np.count_nonzero(tree.is_leaf)


@pytest.mark.parametrize(
    ("options", "origin"),
    [
        ("--lat 0 --lon 0", [6_378_137, 0, 0]),
        ("--lat 0 --lon 90 --height 100 --heading 45", [0, 6_378_237, 0]),
        ("--transform '1 0 0 0 0 1 0 0 0 0 1 0 7 8 9 1'", [7, 8, 9]),
    ],
)
def test_a_tileset_stands_where_it_is_put(options: str, origin: list[float], cli: Cli) -> None:
    cli(f"build-lod {SMALL} -o tileset.json {options}")
    np.testing.assert_allclose(read_parts(Path()).transform[:3, 3], origin, atol=1e-6)


def test_tiles_are_turned_once(cli: Cli) -> None:
    """By --up, or by the note of a tree whose splats stay as they are: the boxes are the same, and y up in content."""
    cli(f"build-lod {SMALL} --up z -o turned/tileset.json --method quick")
    cli(f"build-lod {SMALL} --up z -o tree.rad --rad-center f32")
    cli("build-lod tree.rad -o kept/tileset.json")
    z = scene_of(SMALL).splats.center[:, 2]
    for name in ("turned", "kept"):
        assert read_parts(Path(name)).up == "y"
        box = json.loads(Path(name, "tileset.json").read_text())["root"]["boundingVolume"]["box"]
        assert box[2] - box[11] <= z.min() and z.max() <= box[2] + box[11]
