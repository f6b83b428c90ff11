"""Many or large inputs of `build-lod`: memory, scratch folders, skipped and merged scenes, workers, addresses."""

from __future__ import annotations

import dataclasses
import json
import re
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.bake import estimate
from sparklod_cli.bake.flow import SCRATCH, bake
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.io.reading import Merged, read_scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.addresses import Address
from tests.commands.cli import NAMED, Cli, process
from tests.scenes import random_splats

# --- Memory -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a process and its blocks so small that the demo does not fit into a few megabytes."""
    for name in ("PROCESS", "PICTURES", "WINDOW", "FAMILIES"):
        monkeypatch.setattr(estimate, name, 0)
    monkeypatch.setattr(estimate, "LEAST_BLOCK_SPLATS", 1 << 12)


@pytest.mark.parametrize("suffix", ["spz", "rad"])
@pytest.mark.usefixtures("small_blocks")
def test_a_scene_that_does_not_fit_goes_out_of_core_and_gives_the_same_bytes(suffix: str, cli: Cli) -> None:
    cli(f"build-lod demo.ply -o whole.{suffix} --up -y")
    options = f"-o pieces.{suffix} --up -y --memory 3.2M --scratch-dir scratch --json -v"
    done = cli(f"build-lod demo.ply {options}")
    record, pieces = done.json, Path(f"pieces.{suffix}")
    assert record["blocks"] > 1 and record["scratch_bytes_read"] > 0
    assert record["scratch_bytes_written"] > pieces.stat().st_size
    assert set(record["seconds"]) >= {"read", "build", "order", "write"}
    assert re.search(
        r"demo\.ply: goes out of core, as it would take about .* MB of memory and --memory gives it 3\.2 MB;"
        r" 27,800 splats in blocks of up to 8,192, scratch of about .* MB in .*scratch",
        done.err,
    )
    assert re.search(rf"out of core in {record['blocks']} blocks; scratch: .* MB written, .* MB read", done.err)
    assert Path(f"whole.{suffix}").read_bytes() == pieces.read_bytes() and read_scene(pieces).up == "y"
    done = cli(
        "build-lod - -o piped.spz --up -y --memory 3M", "--scratch-dir", "scratch", stdin=NAMED["demo.ply"].read_bytes()
    )
    assert "standard input: goes out of core" in done.err and not Path("scratch").exists()
    assert suffix == "rad" or Path("piped.spz").read_bytes() == pieces.read_bytes()


@pytest.mark.usefixtures("small_blocks")
def test_the_default_memory_is_a_share_of_the_available_memory(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    for available, said in ((4_000_000, True), (None, False)):
        monkeypatch.setattr("sparklod_cli.system.machine.available_memory", lambda available=available: available)
        assert ("of memory and may take 3.0 MB" in cli("build-lod demo.ply -o a.spz -f").err) == said
    cli("build-lod tree-v3.spz -o a.rad --memory 1k")  # a tree is read as a whole


def test_too_little_memory_is_an_error_that_says_how_much_is_enough(cli: Cli) -> None:
    err = cli("build-lod demo.ply -o a.spz --memory 20M", status=1).err
    found = re.search(r"20.0 MB of memory is too little even out of core; give --memory (\S*) or more", err)
    assert found is not None
    cli(f"build-lod demo.ply -o a.spz --memory {found[1]}")
    assert cli.made() == ["a.spz"]


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("-o a.spz --refine 1", "--refine fits a whole tree"),
        ("-o web/lod-meta.json", "detail levels are made of a whole tree"),
        ("-o web/tileset.json", "tiles are made of a whole tree"),
    ],
)
def test_a_bake_of_a_whole_tree_names_the_memory_that_is_enough(options: str, why: str, cli: Cli) -> None:
    err = cli(f"build-lod demo.ply {options} --memory 3M", status=1).err
    assert f"demo.ply: {why}, not in blocks: " in err
    found = re.search(r"3\.0 MB are enough for [1-9][\d,]+; give --memory (\S*) or more if the machine has it", err)
    assert found is not None
    cli(f"build-lod demo.ply {options} --memory {found[1]}")


def test_existing_scenes_are_skipped_if_their_inputs_did_not_change(cli: Cli) -> None:
    for name in "ab":
        cli.put(f"{name}.ply", NAMED["sh2.ply"].read_bytes())
    line = "build-lod a.ply b.ply --output-dir web --skip-existing --json -f"
    assert [record.get("skipped") for record in cli(line).records] == [None, None]
    cli.put("b.ply", NAMED["sh3.ply"].read_bytes())
    done = cli(line)
    first, second = done.records
    assert first == {"schema_version": 1, "input": "a.ply", "output": "web/a-lod.spz", "skipped": True}
    assert second["sh_degree"] == 3 and "a.ply  ->  web/a-lod.spz  exists already" in done.err
    cli("build-lod --skip-existing a.ply -o c.spz")  # its value follows an equals sign only
    before = Path("c.spz").stat().st_mtime_ns
    for option in ("--skip-existing", "--skip-existing=verify"):
        cli(f"build-lod {option} -o c.spz -- a.ply")
    assert Path("c.spz").stat().st_mtime_ns == before
    assert "goes on" not in cli("build-lod sh1.ply --resume").err  # with nothing to resume
    assert not list(Path().rglob(f"*{SCRATCH}"))


@pytest.mark.slow
def test_scenes_side_by_side_are_those_of_one_after_the_other(cli: Cli) -> None:
    pytest.importorskip("cryptography")
    pytest.importorskip("distributed")
    for number in range(3):
        cli.put(f"small-{number}.ply", NAMED["sh2.ply"].read_bytes())
    cli.put("broken.ply", b"ply\nnonsense\nend_header\n")
    inputs = "small-0.ply broken.ply one.ply small-1.ply small-2.ply"
    cli(f"build-lod {inputs} --output-dir alone", status=1)
    done = process(f"build-lod {inputs} --output-dir beside --workers 2 --json", text=True)
    assert done.returncode == 1, done.stderr
    made = sorted(path.name for path in Path("alone").iterdir())
    assert made == ["one-lod.spz", "small-0-lod.spz", "small-1-lod.spz", "small-2-lod.spz"]
    assert all(Path("beside", name).read_bytes() == Path("alone", name).read_bytes() for name in made)
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert [record["input"] for record in records] == inputs.split()
    assert ["error" in record for record in records] == [False, True, False, False, False]
    lines = [line for line in done.stderr.splitlines() if not line.startswith("baking: ")]  # progress
    assert "error: broken.ply: bad PLY header" in lines[1] and len(lines) == 5, done.stderr
    err = cli("build-lod one.ply sh0.ply --workers 1 --output-dir /proc/a", status=1).err
    assert err.count("cannot write /proc/a/") == 2


# --- Merged scenes ----------------------------------------------------------------------------------------------------

#: Where an instances file puts the second tile and the third, which is the first one again.
PLACES = (
    {"translation": [30, 0, -5], "rotation": [0.1, 0.7, 0, 0.7], "scale": 1.5},
    {"matrix": [0, -2, 0, 9, 2, 0, 0, 8, 0, 0, 2, 7, 0, 0, 0, 1]},
)
SECOND = dataclasses.replace(Transform.from_quat(PLACES[0]["rotation"]), scale=1.5, translation=np.array([30.0, 0, -5]))
THIRD = Transform.from_parts(rotate=(0, 0, 90), scale=2, translate=(9, 8, 7))
EXACT = " ".join(f"--rad-{name}=f32" for name in ("center", "scales", "alpha", "rgb", "orientation", "sh"))


@pytest.fixture
def tiles(cli: Cli) -> list[Splats]:
    """Two files, tile-0.ply and tile-1.ply, and city.json, which places them."""
    found = [random_splats(300, sh_degree=degree) for degree in (1, 0)]
    for number, splats in enumerate(found):
        splats.scale[:] *= 8
        cli.put(f"tile-{number}.ply", splats)
    put_city(cli)
    return found


def put_city(cli: Cli, **more: Any) -> None:
    first, second = {"file": "tile-0.ply", **more}, {"file": "tile-1.ply", **PLACES[0]}
    cli.put("city.json", json.dumps({"instances": [first, second, {"file": "tile-0.ply", **PLACES[1]}]}))


def together(tiles: list[Splats], *transforms: Transform) -> Splats:
    """Return the splats of the tiles, the first one again at the end, each transformed."""
    parts = []
    for splats, transform in zip([*tiles, tiles[0]], transforms, strict=False):
        sh = np.zeros((len(splats), 3, 3), np.float32)
        sh[:, : splats.sh.shape[1]] = splats.sh
        parts.append(transform.apply(dataclasses.replace(splats, sh=sh)))
    return Splats.concat(parts)


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_merged_files_give_the_tree_of_one_that_holds_them_all(method: str, tiles: list[Splats], cli: Cli) -> None:
    cli.put("whole.ply", together(tiles, Transform(), Transform()))
    one = cli(f"build-lod whole.ply -o one.rad --method {method} --json").json
    many = cli(f"build-lod tile-0.ply tile-1.ply --merge -o many.rad --method {method} --json").json
    assert Path("many.rad").read_bytes() == Path("one.rad").read_bytes()
    assert many["inputs"] == ["tile-0.ply", "tile-1.ply"] and "input" not in many
    assert (many["read"], many["splats"], many["sh_degree"], many["nodes"]) == (600, 600, 1, one["nodes"])


def test_merged_files_out_of_core_give_the_same_tree(tiles: list[Splats], cli: Cli) -> None:
    merged = Merged.of([Path("tile-0.ply"), NAMED["sh3-v3.spz"], Path("tile-1.ply")])
    for name, resources in (("in.spz", None), ("out.spz", Resources(block_splats=128))):
        bake(merged, Path(name), BakeSettings(), resources=resources)
    assert Path("out.spz").read_bytes() == Path("in.spz").read_bytes()


def test_an_instances_file_places_its_files(tiles: list[Splats], cli: Cli) -> None:
    for flags in ("", "--merge"):
        record = cli(f"build-lod --scene city.json {flags} -o city.rad -f --json {EXACT}").json
        assert [Path(name).name for name in record["inputs"]] == ["tile-0.ply", "tile-1.ply", "tile-0.ply"]
    scene = read_scene(Path("city.rad"))
    assert scene.tree is not None
    found, expected = scene.splats.take(scene.tree.is_leaf), together(tiles, Transform(), SECOND, THIRD)
    found, expected = (each.take(np.lexsort(np.round(each.center, 3).T)) for each in (found, expected))
    for column in COLUMNS:
        one, other = getattr(found, column), getattr(expected, column)
        if column == "quat_xyzw":
            one = one * np.sign(np.einsum("ij,ij->i", one, other))[:, None]
        np.testing.assert_allclose(one, other, atol=2e-4, rtol=2e-4, err_msg=column)
    for name, source in (("one", "--scene city.json"), ("other", "city.rad")):
        cli(f"render {source} --look-at 40,20,60:10,3,0 --size 200x150 --full -o {name}.png")
    one, other = (np.asarray(Image.open(f"{name}.png"), np.int64) for name in ("one", "other"))
    assert one.std() > 5 and np.abs(one - other).max() <= 2


def test_selection_goes_by_the_places_of_the_files(tiles: list[Splats], cli: Cli) -> None:
    radius = 1.01 * 1.5 * float(np.linalg.norm(tiles[1].center, axis=1).max())
    distance = np.linalg.norm(together(tiles, Transform(), SECOND, THIRD).center - SECOND.translation, axis=1)
    near = int((distance <= radius).sum())
    options = f"--within 30,0,-5,{radius} --translate 0,99,0"  # the second comes after the first
    record = cli(f"build-lod --scene city.json -o a.spz --json {options}").json
    assert (record["read"], record["splats"]) == (900, near) and near >= 300
    put_city(cli, lod_scale=2)
    said = "lod_scale and foveation of instances are for viewers, and no part of a tree"
    assert said in cli("build-lod --scene city.json -o b.spz").err


# --- Addresses --------------------------------------------------------------------------------------------------------


@pytest.fixture
def remote() -> Address:
    """A folder at an address, with scan.ply."""
    pytest.importorskip("fsspec")
    folder = Address(f"memory://{uuid.uuid4().hex}")
    (folder / "scan.ply").write([NAMED["sh2.ply"].read_bytes()])
    return folder


def content(place: Address) -> bytes:
    with place.open() as file:
        return file.read()


@pytest.mark.slow
@pytest.mark.parametrize("form", ["spz", "rad", "rad-chunked"])
def test_the_bytes_at_an_address_are_those_of_a_path(form: str, remote: Address, cli: Cli) -> None:
    scan = remote / "scan.ply"
    cli.put("scan.ply", NAMED["sh2.ply"].read_bytes())
    cli(f"build-lod scan.ply --format {form}")
    line = f"build-lod {scan.url} --format {form} --json"
    record = cli(line).json
    output = remote / f"scan-lod.{form[:3]}"
    assert (record["input"], record["output"]) == (scan.url, output.url)
    assert remote.files() == sorted([*cli.made(), "scan.ply"])
    assert all(content(remote / name) == Path(name).read_bytes() for name in cli.made())
    assert f"{output} exists, add --overwrite to replace it" in cli(line, status=1).err
    cli(f"{line} --overwrite")
    assert (
        f"{output} is an input; name another output" in cli(f"build-lod {output.url} -o {output.url} -f", status=2).err
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sh1-ascii.ply", "sh3-v2.sog", "hand-v4.spz", "sh0.splat"])
def test_each_way_of_reading_works_at_an_address(name: str, remote: Address, cli: Cli) -> None:
    (remote / name).write([NAMED[name].read_bytes()])
    cli(f"build-lod {(remote / name).url} -o at.spz")
    cli(f"build-lod {name} -o path.spz")
    assert Path("at.spz").read_bytes() == Path("path.spz").read_bytes()


@pytest.mark.slow
def test_outputs_go_into_folders_at_an_address(remote: Address, cli: Cli) -> None:
    cli(f"build-lod sh2.ply --output-dir {(remote / 'web').url}")
    assert remote.files() == ["scan.ply", "web/sh2-lod.spz"]
    tree, meta = (remote / "web/sh2-lod.spz").url, remote / "sog/meta.json"
    cli(f"convert {tree} file://{cli.folder}/back.ply")
    assert cli.made() == ["back.ply"]
    cli(f"convert {tree} {meta.url}")
    names = "means_l.webp means_u.webp meta.json quats.webp scales.webp sh0.webp shN_centroids.webp shN_labels.webp"
    assert meta.parent.files() == names.split()
    cli(f"convert {tree} {meta.url}", status=1)
    cli(f"convert {tree} {meta.url} -f")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "status", "said"),
    [
        ("build-lod memory://none/none.ply", 1, "memory://none/none.ply: cannot be read: no such file"),
        ("build-lod sh2.ply -o https://host/x.spz?secret=1", 1, "cannot write https://host/x.spz?***: https:// is for"),
        ("build-lod s4://bucket/scan.ply", 1, "addresses of s4:// cannot be opened"),
        ("build-lod sh2.ply -o memory://a/scan.png", 2, "written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .png"),
    ],
)
def test_addresses_that_cannot_be_read_or_written(line: str, status: int, said: str, cli: Cli) -> None:
    pytest.importorskip("fsspec")
    assert said in cli(line, status=status).err
