"""`sparklod simplify`: every format, every goal, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.codecs.formats import WRITABLE
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import SparklodError
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes(b"".join(ply.encode(Scene(random_splats(1000, sh_degree=1)))))
    return path


def simplify(*arguments: object) -> int:
    return run(["simplify", *map(str, arguments)])


@pytest.mark.parametrize("ending", WRITABLE)
def test_every_format_gets_the_same_splats(ending: str, source: Path, tmp_path: Path) -> None:
    target = tmp_path / "out" / (ending if not ending.startswith(".") else f"small{ending}")
    assert simplify(source, "--to", "10%", "-o", target) == 0
    scene = read_scene(target)
    assert scene.tree is None
    assert 90 < len(scene.splats) <= 100
    assert simplify(source, "--to", "100", "-o", tmp_path / "exact.ply") == 0
    exact = np.sort(read_scene(tmp_path / "exact.ply").splats.center, axis=0)
    np.testing.assert_allclose(np.sort(scene.splats.center, axis=0), exact, atol=0.01)


@pytest.mark.parametrize("ending", [".ply", ".spz", ".sog", "meta.json"])
def test_a_file_is_at_most_so_large(ending: str, source: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "out" / (ending if not ending.startswith(".") else f"small{ending}")
    assert simplify(source, "--max-bytes", "16kB", "-o", target, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    size = sum(path.stat().st_size for path in target.parent.iterdir())
    assert 15_000 < size == record["bytes"] <= 16_000
    assert record["simplified"]["splats"] == len(read_scene(target))


def test_a_psnr_is_measured_with_the_cameras_that_are_named(source: Path, tmp_path: Path, capsys: Capture) -> None:
    cameras = tmp_path / "cameras.csv"
    cameras.write_text("x,y,z,target_x,target_y,target_z\n0,0,-6,0,0,0\n")
    target = tmp_path / "small.spz"
    assert simplify(source, "--psnr", "25", "--camera-path", cameras, "-o", target, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["simplified"]["psnr"] >= 25
    assert 1 < record["simplified"]["splats"] < 1000


def test_refine_fits_the_set_and_keeps_plain_opacities(source: Path, tmp_path: Path, capsys: Capture) -> None:
    plain, fitted = tmp_path / "plain.ply", tmp_path / "fitted.ply"
    assert simplify(source, "--to", "10%", "-o", plain) == 0
    capsys.readouterr()
    assert simplify(source, "--to", "10%", "--refine", "40", "-o", fitted, "--json") == 0
    report = json.loads(capsys.readouterr().out)["simplified"]["refine"]
    (share,) = report["psnr_before"]
    assert report["psnr_after"][share] > report["psnr_before"][share]
    one, two = read_scene(plain), read_scene(fitted)
    assert len(one) == len(two)
    assert two.splats.opacity.max() <= 1
    assert (one.splats.rgb != two.splats.rgb).any()


def test_one_line_says_what_was_written(source: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "small.splat"
    assert simplify(source, "--to", "50%", "-o", target) == 0
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith(f"{source}  1,000 splats, SH 1  ->  {target}  500 splats (50 %), 16.0 kB, ")
    assert second.strip().startswith("SPLAT holds no reflections (SH)")


def far_apart(path: Path, count: int, *, size: float = 0.01, opacity: float = 0.9) -> Path:
    """Writes splats that are much smaller than the gaps between them."""
    splats = random_splats(count, sh_degree=0)
    splats.center[:] = 3 * np.arange(3 * count).reshape(count, 3) ** 2 % 101
    splats.scale[:], splats.opacity[:] = size, opacity
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    return path


@pytest.mark.parametrize(
    ("name", "goal", "most"),
    [*[(f"small{ending}", "--to", "50%") for ending in (".ply", ".sog", ".spz")], ("small.splat", "--max-bytes", "33")],
)
def test_a_set_of_which_nothing_is_seen_is_an_error(
    name: str, goal: str, most: str, tmp_path: Path, capsys: Capture
) -> None:
    source, target = far_apart(tmp_path / "far.ply", 3), tmp_path / name
    assert simplify(source, goal, most, "-o", target) == 1
    err = capsys.readouterr().err
    assert "nothing could be seen of 1 splat: merged across wide gaps, their opacity is 1e-06 at most" in err
    assert "keep more splats" in err and err.count("\n") == 1
    assert not target.exists()
    with pytest.raises(SparklodError, match="nothing could be seen of 1 splat"):
        sparklod.simplify(read_scene(source), to=1)


def test_nothing_is_fitted_of_which_nothing_is_seen(tmp_path: Path, capsys: Capture) -> None:
    source = far_apart(tmp_path / "far.ply", 3)
    assert simplify(source, "--to", "1", "--refine", "40", "-o", tmp_path / "small.ply") == 1
    assert "nothing could be seen of 1 splat" in capsys.readouterr().err


def test_merged_splats_too_faint_to_be_drawn_are_counted(tmp_path: Path, capsys: Capture) -> None:
    source, target = far_apart(tmp_path / "far.ply", 40), tmp_path / "small.ply"
    assert simplify(source, "--to", "75%", "-o", target, "--json") == 0
    out, err = capsys.readouterr()
    faint = int(np.count_nonzero(read_scene(target).splats.opacity < 0.5 / 255))
    assert json.loads(out)["simplified"]["faint"] == faint > 0
    assert f"  {100 * faint / 30:.3g} % of the splats, merged across wide gaps, are too faint to be drawn; keep" in err


def test_a_scene_that_is_faint_itself_is_simplified(tmp_path: Path, capsys: Capture) -> None:
    source, target = far_apart(tmp_path / "faint.ply", 3, size=5, opacity=0.001), tmp_path / "small.ply"
    assert simplify(source, "--to", "100%", "-o", target) == 0
    assert "faint to be drawn" not in capsys.readouterr().err
    assert simplify(source, "--to", "1", "-o", target, "-f") == 0


def test_several_inputs_are_one_scene(source: Path, tmp_path: Path) -> None:
    other, target = FIXTURES / "one.ply", tmp_path / "all.ply"
    assert simplify(source, other, "--to", "100%", "-o", target) == 0
    assert len(read_scene(target)) == 1001


def test_a_tree_is_cut_as_it_is(source: Path, tmp_path: Path, capsys: Capture) -> None:
    tree, target = tmp_path / "tree.rad", tmp_path / "small.ply"
    assert run(["build-lod", str(source), "-o", str(tree)]) == 0
    assert simplify(tree, "--to", "100", "-o", target) == 0
    assert 90 < len(read_scene(target)) <= 100
    assert simplify(tree, "--to", "100", "--min-opacity", "0.1", "-o", target, "-f") == 1
    assert "leave out --min-opacity" in capsys.readouterr().err


def test_selection_and_axes_are_those_of_build_lod(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "small.ply"
    assert simplify(source, "--to", "100%", "--up", "-y", "--within", "0,0,0,1", "-o", target) == 0
    scene = read_scene(target)
    assert scene.up == "y" and 0 < len(scene) < 1000
    assert np.linalg.norm(scene.splats.center, axis=1).max() <= 1.001


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--to", "1%"), "Missing option '-o' / '--output'"),
        (("-o", "x.ply"), "say how many splats to keep: give one of --to, --max-bytes and --psnr"),
        (("--to", "1%", "--psnr", "30", "-o", "x.ply"), "--to and --psnr cannot be used together"),
        (("--to", "ten", "-o", "x.ply"), "'ten' is neither a share such as 5% nor a count"),
        (("--to", "1%", "-o", "x.npz"), "--output writes .ply"),
        (("--to", "1%", "-o", "x"), "has no suffix, which chooses the format"),
        (
            ("--to", "1%", "-o", "x.ply", "--camera-path", "c.csv"),
            "--camera-path can only be used with --psnr or --refine",
        ),
        (("--max-bytes", "1MB", "-o", "x.ply", "--refine"), "--max-bytes cannot be used with --refine"),
        (("--to", "1%", "-o", "x.ply", "--spz-version", "2"), "--spz-version is an option of SPZ, not of PLY"),
        (("--to", "1%", "-o", "x.ply", "--cluster-sh"), "--cluster-sh is an option of RAD and SOG, not of PLY"),
        (("--to", "1%", "-o", "-", "--json"), "cannot both go to standard output"),
        (("-", "--to", "1%", "-o", "x.ply"), "standard input cannot be merged"),
    ],
)
def test_contradictions_are_refused(
    arguments: tuple[str, ...],
    text: str,
    source: Path,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("c.csv").write_text("x\n")
    assert simplify(source, *arguments) == 2
    assert text in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.glob("x*"))


def test_an_output_is_replaced_only_if_told(source: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "small.ply"
    target.write_bytes(b"precious")
    assert simplify(source, "--to", "1%", "-o", target) == 1
    assert "exists, add --overwrite" in capsys.readouterr().err
    assert target.read_bytes() == b"precious"


@pytest.mark.parametrize(("inputs", "named"), [(["cut.ply"], "cut.ply"), (["one.ply", "cut.ply"], "cut.ply")])
def test_errors_name_the_input(inputs: list[str], named: str, tmp_path: Path, capsys: Capture) -> None:
    data = (FIXTURES / "one.ply").read_bytes()
    (tmp_path / "one.ply").write_bytes(data)
    (tmp_path / "cut.ply").write_bytes(data[:50])
    paths = [str(tmp_path / name) for name in inputs]
    assert run(["simplify", *paths, "-o", str(tmp_path / "out.spz"), "--to", "1k"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"error: {tmp_path / named}: the PLY header does not end"
