"""`sparklod simplify`: every format, every goal, faint splats, fitting, merged inputs and trees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.codecs.formats import WRITABLE
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import SparklodError
from tests.commands.cli import Cli
from tests.scenes import random_splats


def scene_of(name: str) -> Scene:
    return read_scene(Path(name))


@pytest.fixture
def source(cli: Cli) -> Cli:
    cli.put("scene.ply", random_splats(1000, sh_degree=1))
    return cli


@pytest.mark.parametrize("ending", WRITABLE)
def test_every_format_gets_the_same_splats(ending: str, source: Cli) -> None:
    target = f"out/small{ending}" if ending.startswith(".") else f"out/{ending}"
    source(f"simplify scene.ply --to 10% -o {target}")
    source("simplify scene.ply --to 100 -o exact.ply")
    scene, exact = scene_of(target), scene_of("exact.ply")
    assert scene.tree is None and 90 < len(scene) <= 100
    one, other = (np.sort(each.splats.center, axis=0) for each in (scene, exact))
    np.testing.assert_allclose(one, other, atol=0.01)


@pytest.mark.parametrize("target", ["small.ply", "small.spz", "small.sog", "meta.json"])
def test_a_file_has_at_most_so_many_bytes(target: str, source: Cli) -> None:
    record = source(f"simplify scene.ply --max-bytes 16kB -o {target} --json").json
    assert 15_000 < sum(Path(name).stat().st_size for name in source.made()) == record["bytes"] <= 16_000
    assert record["simplified"]["splats"] == len(scene_of(target))


def test_a_psnr_is_measured_with_the_cameras_of_a_file(source: Cli) -> None:
    source.put("cameras.csv", "x,y,z,target_x,target_y,target_z\n0,0,-6,0,0,0\n")
    record = source("simplify scene.ply --psnr 25 --camera-path cameras.csv -o small.spz --json").json
    assert record["simplified"]["psnr"] >= 25 and 1 < record["simplified"]["splats"] < 1000


def test_refine_fits_the_set_and_keeps_plain_opacities(source: Cli) -> None:
    source("simplify scene.ply --to 10% -o plain.ply")
    record = source("simplify scene.ply --to 10% --refine 40 -o fitted.ply --json").json
    report = record["simplified"]["refine"]
    (share,) = report["psnr_before"]
    assert report["psnr_after"][share] > report["psnr_before"][share]
    one, two = scene_of("plain.ply").splats, scene_of("fitted.ply").splats
    assert len(one) == len(two) and two.opacity.max() <= 1 and (one.rgb != two.rgb).any()


def test_inputs_are_selected_turned_and_merged(source: Cli) -> None:
    first, second, *_ = source("simplify scene.ply --to 50% -o small.splat").err.splitlines()
    assert first.startswith("scene.ply  1,000 splats, SH 1  ->  small.splat  500 splats (50 %), 16.0 kB, ")
    assert second.strip().startswith("SPLAT holds no reflections (SH)")
    source("simplify scene.ply one.ply --to 100% -o all.ply")
    assert len(scene_of("all.ply")) == 1001
    source("simplify scene.ply --to 100% --up -y --within 0,0,0,1 -o near.ply")
    near = scene_of("near.ply")
    assert near.up == "y" and 0 < len(near) < 1000
    assert np.linalg.norm(near.splats.center, axis=1).max() <= 1.001
    source("build-lod scene.ply -o tree.rad")
    source("simplify tree.rad --to 100 -o cut.ply")  # a cut of the tree
    assert 90 < len(scene_of("cut.ply")) <= 100


# --- Splats that are much smaller than the gaps between them ----------------------------------------------------------


def put_far_apart(cli: Cli, count: int, *, size: float = 0.01, opacity: float = 0.9) -> None:
    splats = random_splats(count, sh_degree=0)
    splats.center[:] = 3 * np.arange(3 * count).reshape(count, 3) ** 2 % 101
    splats.scale[:], splats.opacity[:] = size, opacity
    cli.put("far.ply", splats)


@pytest.mark.parametrize(
    "options",
    [
        *(f"--to 50% -o small.{suffix}" for suffix in ("ply", "sog", "spz")),
        *("--max-bytes 33 -o small.splat", "--to 1 --refine 40 -o small.ply -q"),
    ],
)
def test_a_set_that_cannot_be_seen_is_an_error(options: str, cli: Cli) -> None:
    put_far_apart(cli, 3)
    err = cli(f"simplify far.ply {options}", status=1).err
    assert "nothing could be seen of 1 splat: merged across wide gaps, their opacity is 1e-06 at most" in err
    assert "keep more splats" in err and err.count("\n") == 1 and cli.made() == []
    with pytest.raises(SparklodError, match="nothing could be seen of 1 splat"):
        sparklod.simplify(scene_of("far.ply"), to=1)


def test_merged_splats_too_faint_to_be_drawn_are_counted(cli: Cli) -> None:
    put_far_apart(cli, 40)
    done = cli("simplify far.ply --to 75% -o small.ply --json")
    faint = int(np.count_nonzero(scene_of("small.ply").splats.opacity < 0.5 / 255))
    assert done.json["simplified"]["faint"] == faint > 0
    said = "% of the splats, merged across wide gaps, are too faint to be drawn; keep"
    assert f"  {100 * faint / 30:.3g} {said}" in done.err
    put_far_apart(cli, 3, size=5, opacity=0.001)  # a scene that is faint itself
    for to in ("100%", "1"):
        assert "nothing could be seen" not in cli(f"simplify far.ply --to {to} -o small.ply -f").err
