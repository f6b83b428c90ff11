"""Pictures, differences and reports of `sparklod render`."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.images.metrics import psnr
from sparklod_cli.render.render_settings import BACKENDS, COLOR_BY, STYLES
from tests.commands.render.runs import AT, DEMO, PLAIN, SIZE, TOWN, TREE, floats, pixels, render
from tests.conftest import FIXTURES, Capture

pytestmark = pytest.mark.slow


def test_a_tree_is_drawn_to_a_png(built: Path, tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "preview.png"
    assert render(built, "--budget", "5k", "--size", "320x180", "-o", output) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"{output}  320 x 180, ")
    assert err.count("\n") == 1
    image = pixels(output)
    assert image.shape == (180, 320, 3)
    assert image.any(axis=2).mean() > 0.2
    assert [path.name for path in tmp_path.iterdir()] == ["preview.png"]


def test_without_a_name_the_picture_is_beside_the_scene_and_has_its_name(tmp_path: Path) -> None:
    plain, town = tmp_path / "plain.ply", tmp_path / "town 100%.spz"
    shutil.copy(PLAIN, plain)
    shutil.copy(TOWN, town)
    assert render(plain, *SIZE, "-q") == 0
    assert render(town, plain, *SIZE, "-q", "--orbit", 2, "--budget", "1k") == 0
    made = {"plain.png", "town 100_.0000.png", "town 100_.0001.png"}
    assert {path.name for path in tmp_path.glob("*.png")} == made
    assert render(plain, *SIZE, "-q") == 1
    assert render(plain, *SIZE, "-q", "--overwrite") == 0
    folder = tmp_path / "unpacked"
    with zipfile.ZipFile(FIXTURES / "golden" / "sh2-v1.sog") as archive:
        archive.extractall(folder)
    assert render(folder, *SIZE, "-q") == render(folder / "meta.json", *SIZE, "-q") == 0
    assert (tmp_path / "unpacked.png").is_file()
    assert (folder / "unpacked.png").is_file()


@pytest.mark.parametrize(
    "file", [*sorted(FIXTURES.glob("golden/*")), *sorted(FIXTURES.glob("*.ply"))], ids=lambda p: p.name
)
def test_every_format_is_drawn(file: Path, tmp_path: Path) -> None:
    if file.suffix not in (".ply", ".spz", ".splat", ".ksplat", ".sog") or file.stem in ("huge", "flat", "points"):
        pytest.skip("not a scene to look at")
    assert render(file, "--size", "64x48", "-q", "-o", tmp_path / "x.png") == 0


def test_the_leaves_of_a_tree_are_the_scene_that_it_was_made_of(built: Path, tmp_path: Path) -> None:
    how = ("--size", "320x180", *AT, "-q")
    assert render(DEMO, *how, "-o", tmp_path / "plain.npy") == 0
    assert render(built, *how, "--full", "-o", tmp_path / "tree.npy") == 0
    assert render(DEMO, *how, "--through", "spz", "-o", tmp_path / "rounded.npy") == 0
    assert render(built, *how, "--budget", 500, "-o", tmp_path / "cut.npy") == 0
    plain, tree, rounded, cut = (floats(tmp_path / f"{name}.npy") for name in ("plain", "tree", "rounded", "cut"))
    assert psnr(plain, tree) > 45
    assert psnr(rounded, tree) > psnr(plain, tree)
    assert psnr(plain, cut) < psnr(plain, tree) - 10


def test_floats_are_premultiplied_and_pixels_are_not(tmp_path: Path) -> None:
    how = (DEMO, *SIZE, *AT, "-q")
    assert render(*how, "-o", tmp_path / "x.npy") == 0
    image = floats(tmp_path / "x.npy")
    assert image.shape == (90, 160, 4)
    assert (image[..., :3].max(axis=2) <= image[..., 3] + 1e-5).all()
    alpha = image[..., 3:]
    for color, rgb in (
        ("black", (0, 0, 0)),
        ("white", (1, 1, 1)),
        ("#ff8000", (1, 128 / 255, 0)),
        ("#f80", (1, 136 / 255, 0)),
    ):
        assert render(*how, "--background", color, "-o", tmp_path / "x.png", "--overwrite") == 0
        expected = np.rint(255 * np.clip(image[..., :3] + (1 - alpha) * np.array(rgb), 0, 1))
        assert np.abs(pixels(tmp_path / "x.png") - expected).max() <= 1
    assert render(*how, "--background", "white", "-o", tmp_path / "x.npy", "--overwrite") == 0
    assert np.allclose(floats(tmp_path / "x.npy")[..., :3], image[..., :3] + (1 - alpha), atol=1e-6)
    for said in (("--alpha",), ("--background", "transparent")):
        for name in ("x.png", "x.webp"):
            assert render(*how, *said, "-o", tmp_path / name, "--overwrite") == 0
            codes = pixels(tmp_path / name)
            assert codes.shape == (90, 160, 4)
            assert np.abs(codes[..., 3] - 255 * image[..., 3]).max() <= 0.51
            solid = image[..., 3] > 0.05
            assert np.abs(codes[solid][:, :3] - np.clip(255 * image[solid][:, :3] / alpha[solid], 0, 255)).max() <= 0.6


def test_standard_output_is_a_png(capfdbinary: pytest.CaptureFixture[bytes], tmp_path: Path) -> None:
    assert render(PLAIN, *SIZE, "-o", "-", "-q") == 0
    out, err = capfdbinary.readouterr()
    assert err == b""
    assert render(PLAIN, *SIZE, "-o", tmp_path / "x.png", "-q") == 0
    assert out == (tmp_path / "x.png").read_bytes()


def test_two_renders_give_the_same_bytes(tmp_path: Path) -> None:
    made = set()
    for threads in (1, 2):
        assert render(TOWN, PLAIN, *SIZE, "--threads", threads, "-o", tmp_path / f"{threads}.png", "-q") == 0
        made.add((tmp_path / f"{threads}.png").read_bytes())
    assert len(made) == 1


@pytest.mark.parametrize("by", COLOR_BY)
def test_color_by_draws_a_color_scale(by: str, tmp_path: Path) -> None:
    how = (TOWN, "--budget", "4k", "--size", "480x270", "-q", "--color-by", by)
    assert render(*how, "-o", tmp_path / "bar.png") == 0
    assert render(*how, "--no-bar", "-o", tmp_path / "no.png") == 0
    bar, no = pixels(tmp_path / "bar.png"), pixels(tmp_path / "no.png")
    assert no.any()
    assert bar.shape[1] > no.shape[1] == 480
    assert np.array_equal(bar[:, :480], no), "it hides nothing"
    assert render(*how, "-o", tmp_path / "x.npy") == 0
    image = floats(tmp_path / "x.npy")
    assert image.shape == ((270, 480) if by in ("overdraw", "depth") else (270, 480, 4))


@pytest.mark.parametrize("style", STYLES)
def test_every_style_draws_something(style: str, tmp_path: Path) -> None:
    assert render(TOWN, "--budget", "4k", *SIZE, "-q", "--style", style, "-o", tmp_path / "x.png") == 0
    assert pixels(tmp_path / "x.png").any()


def test_every_file_of_an_instances_file_is_drawn(tmp_path: Path, capsys: Capture) -> None:
    shutil.copy(TREE, tmp_path / "tree.spz")
    shutil.copy(PLAIN, tmp_path / "plain.ply")
    scene = tmp_path / "scene.json"
    how = (*SIZE, "--look-at", "0,0,-9:0,0,0", "--json", "-q")
    counts = []
    for instances in ([{"file": "tree.spz"}], [{"file": "tree.spz"}, {"file": "plain.ply", "translation": [3, 0, 0]}]):
        scene.write_text(json.dumps({"instances": instances}))
        assert render("--scene", scene, *how, "-o", tmp_path / f"{len(instances)}.png") == 0
        counts.append(json.loads(capsys.readouterr().out)["frames"][0]["splats"])
    assert counts[1] > counts[0]
    one, two = (pixels(tmp_path / f"{n}.png") for n in (1, 2))
    assert (one != two).any()


def test_a_scene_of_any_size_is_seen_from_where_it_fits(tmp_path: Path) -> None:
    scene = tmp_path / "scene.json"
    shutil.copy(PLAIN, tmp_path / "plain.ply")
    images = []
    for scale in (1e-4, 1, 1e5):
        scene.write_text(json.dumps({"instances": [{"file": "plain.ply", "scale": scale}]}))
        assert render("--scene", scene, *SIZE, "-o", tmp_path / f"{scale}.npy", "-q") == 0
        images.append(floats(tmp_path / f"{scale}.npy"))
    for image in images:
        assert psnr(images[1], image) > 35


@pytest.mark.parametrize("backend", ["osmesa", "open3d"])
def test_other_backends_draw_or_say_what_is_missing(backend: str, tmp_path: Path, capsys: Capture) -> None:
    code = render(PLAIN, *SIZE, "--backend", backend, "-o", tmp_path / "x.png")
    err = capsys.readouterr().err
    if code == 0:
        assert pixels(tmp_path / "x.png").any()
    else:
        assert code == 1
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


def test_every_backend_can_be_named_but_that_which_a_device_names(capsys: Capture) -> None:
    assert render("--help-all") == 0
    said = capsys.readouterr().out
    assert f"[{'|'.join(BACKENDS)}]" in said
