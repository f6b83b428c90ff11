"""Pictures whose look can be worked out: styles, colours by a quantity, depth and overdraw; the choice of a device."""

from __future__ import annotations

import dataclasses
import importlib.util
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from sparklod_cli.fitting.fit_settings import FitSettings
from sparklod_cli.render.color_scales import nice_step, ticks
from sparklod_cli.render.cuda.card import card_errors, on_card
from sparklod_cli.render.rasterizer import draw, shade
from sparklod_cli.render.render_settings import COLOR_BY, DEVICES, STYLES, RasterSettings, RenderSettings, uses_card
from sparklod_cli.render.renderer import BILLBOARD_ALPHA, DrawnPicture, Renderer
from sparklod_cli.system.errors import BackendError, SparklodError
from sparklod_cli.viewers.scenes import CutFinder
from tests.cards import MISSING
from tests.conftest import FIXTURES, Capture
from tests.render.drawables import balls, camera, plain
from tests.scenes import random_splats

RED, GREEN, _ = np.eye(3)
MIDDLE = (24, 32)


def drawn(source: CutFinder, **how: object) -> DrawnPicture:
    return Renderer(source, RenderSettings(**how), [camera()]).draw(camera())


def column_of(x: float, z: float = 0.0) -> int:
    """The column of a picture in which `camera` sees a point at (x, 0, z)."""
    return int(32 + camera().focal[0] * x / (5 - z))


def test_splats_are_those_of_the_backend_and_several_threads_draw_the_same() -> None:
    splats, at = random_splats(300, sh_degree=2), camera()
    expected = draw(shade([(splats, np.eye(4))], at), at, RasterSettings())
    renderer = Renderer(plain(splats), RenderSettings(), [at])
    with ThreadPoolExecutor(4) as pool:
        for picture in pool.map(renderer.draw, [at] * 12):
            assert np.array_equal(picture.image, expected)


def test_supersampling_is_the_mean_of_a_finer_picture() -> None:
    splats = plain(balls((0, 0, 0), size=0.8))
    coarse, fine = (drawn(splats, supersample=times).image for times in (1, 4))
    assert fine.shape == coarse.shape
    # A splat much larger than a pixel is hardly blurred by it.
    assert np.abs(coarse - fine).max() < 0.02


def test_a_point_is_an_opaque_pixel() -> None:
    image = drawn(plain(balls((0.001, -0.001, 0), rgb=RED, opacity=0.3)), style="points").image
    assert image[MIDDLE].tolist() == [1, 0, 0, 1]
    assert np.count_nonzero(image[..., 3]) == 1


NEAR, FAR = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
GREEN_OVER_RED = BILLBOARD_ALPHA * (1 - BILLBOARD_ALPHA) * RED + BILLBOARD_ALPHA * GREEN


@pytest.mark.parametrize("centers", [(NEAR, FAR), (FAR, NEAR)])
def test_points_and_billboards_are_in_the_order_of_the_file(centers: tuple[tuple[float, float, float], ...]) -> None:
    source = plain(balls(*centers, rgb=[RED, GREEN]))
    assert np.array_equal(drawn(source, style="points").image[MIDDLE][:3], GREEN)
    image = drawn(source, style="billboards").image
    assert np.allclose(image[MIDDLE], [*GREEN_OVER_RED, 1 - (1 - BILLBOARD_ALPHA) ** 2])


@pytest.mark.parametrize("sort", ["radial", "z"])
def test_sorted_billboards_have_the_nearest_on_top(sort: str) -> None:
    for centers, rgb in (((FAR, NEAR), [RED, GREEN]), ((NEAR, FAR), [GREEN, RED])):
        source, raster = plain(balls(*centers, rgb=rgb)), RasterSettings(sort=sort)
        image = drawn(source, style="sorted-billboards", raster=raster).image
        assert np.allclose(image[MIDDLE][:3], GREEN_OVER_RED)


def test_a_billboard_is_as_wide_as_its_splat() -> None:
    at = camera(640, 480)
    image = Renderer(plain(balls((0, 0, 0), size=0.5)), RenderSettings(style="billboards"), [at]).draw(at).image
    radius = 0.5 * at.focal[0] / 5
    assert np.count_nonzero(image[240, :, 3]) == pytest.approx(2 * radius, abs=2)
    assert np.count_nonzero(image[..., 3]) == pytest.approx(np.pi * radius**2, rel=0.02)
    assert set(np.unique(image[..., 3])) == {0.0, np.float32(BILLBOARD_ALPHA)}


@pytest.mark.parametrize("style", STYLES)
def test_splats_outside_near_and_far_are_not_drawn(style: str) -> None:
    source = plain(balls((0, 0, 0)))
    for raster in (RasterSettings(near=5.1), RasterSettings(far=4.9)):
        assert not drawn(source, style=style, raster=raster).image.any()
    assert drawn(source, style=style, raster=RasterSettings(near=4.9, far=5.1)).image.any()
    assert not drawn(plain(balls((0, 0, 9))), style=style).image.any()


@pytest.mark.parametrize("by", ["lod-opacity", "size", "chunk"])
def test_colours_are_those_of_the_scale(by: str) -> None:
    first, second = balls((-1.0, 0.0, 0.0), opacity=1.0, size=0.25), balls((1.0, 0.0, 0.0), opacity=30.0, size=0.4)
    renderer = Renderer(plain(first, second), RenderSettings(color_by=by), [camera()])
    assert renderer.scale is not None
    image, d = renderer.draw(camera()).image, np.sqrt(1 + np.e * np.log(30))
    values = {"lod-opacity": (1.0, d), "chunk": (0, 1), "size": (0.5, 2 * 0.4 * (1 + 0.7 * (d - 1)))}
    for x, value in zip((-1, 1), values[by], strict=True):
        pixel = image[24, column_of(x)]
        assert pixel[3] > 0.8
        assert np.allclose(pixel[:3] / pixel[3], renderer.scale.rgb(np.array(value)) / 255, atol=0.01)


def test_color_by_ignores_spherical_harmonics() -> None:
    splats = random_splats(200, sh_degree=3)
    dark = dataclasses.replace(splats, rgb=np.zeros_like(splats.rgb), sh=np.zeros_like(splats.sh))
    images = [drawn(plain(each), color_by="size").image for each in (splats, dark)]
    assert np.array_equal(*images)


def test_color_by_level_needs_a_tree() -> None:
    with pytest.raises(SparklodError, match="no file is a Level-of-Detail tree"):
        drawn(plain(balls((0, 0, 0))), color_by="level")


@pytest.mark.parametrize("style", STYLES)
def test_depth_is_how_far_along_the_axis(style: str) -> None:
    result = drawn(plain(balls((0, 0, 2), (2.4, 0, -1), size=0.2)), color_by="depth", style=style)
    assert result.values is not None
    assert result.values[MIDDLE] == pytest.approx(3, rel=1e-4)
    assert result.values[24, column_of(2.4, -1)] == pytest.approx(6, rel=1e-4)
    assert np.isnan(result.values[0, 0])
    assert not result.image[0, 0].any()


def test_a_color_scale_spans_all_cameras() -> None:
    near, far = camera(z=3.0), camera(z=30.0)
    scale = Renderer(plain(balls((0, 0, 0), (0.1, 0, 0))), RenderSettings(color_by="depth"), [near, far]).scale
    assert scale is not None
    assert (scale.low, scale.high) == pytest.approx((3, 30))
    for by in ("overdraw", "size"):
        renderer = Renderer(plain(random_splats(500)), RenderSettings(color_by=by), [near, far])
        before = renderer.scale
        renderer.draw(near)
        assert renderer.scale is before


def test_depth_is_the_mean_by_what_is_seen() -> None:
    result = drawn(plain(balls((0, 0, 1), (0, 0, -1), opacity=0.5)), color_by="depth")
    assert result.values is not None
    # In front 0.5, behind it half of what is left.
    assert result.values[MIDDLE] == pytest.approx((0.5 * 4 + 0.25 * 6) / 0.75, rel=0.02)


def test_overdraw_counts_splats_a_pixel() -> None:
    source = plain(balls((0, 0, 1), (0, 0, 0), (0, 0, -1), (1.5, 0, 0), size=0.2))
    result = drawn(source, color_by="overdraw")
    assert result.values is not None
    assert result.values[MIDDLE] == 3
    assert result.values[24, column_of(1.5)] == 1
    assert result.values[0, 0] == 0
    assert np.array_equal(result.image[..., 3], result.values > 0)


@pytest.mark.parametrize("profile", ["spark", "shifted"])
def test_overdraw_is_where_something_is_drawn(profile: str) -> None:
    splats = random_splats(40, seed=4)
    splats.opacity[::4] = 20  # merged ones, too
    at, raster = camera(200, 150), RasterSettings(profile=profile)
    counted, image = (
        Renderer(plain(splats), RenderSettings(raster=raster, color_by=by), [at]).draw(at) for by in ("overdraw", None)
    )
    assert counted.values is not None
    differ = (counted.values > 0) != (image.image[..., 3] > 0)
    # At the very edge of a splat the last bit decides.
    assert differ.mean() < 1e-3
    assert 0.02 < (counted.values > 0).mean() < 0.98


@pytest.mark.parametrize("by", [by for by in COLOR_BY if by != "level"])
def test_nothing_in_view_is_an_empty_picture(by: str) -> None:
    result = drawn(plain(balls((0, 0, 50))), color_by=by)
    assert not result.image.any()


@given(st.floats(1e-12, 1e12))
def test_a_nice_step_is_1_2_or_5_and_not_much_more_than_asked_for(least: float) -> None:
    step = nice_step(least)
    assert least * (1 - 1e-6) <= step <= 2.5 * least * (1 + 1e-6)
    assert f"{step:.0e}"[0] in "125"


def test_ticks_are_the_round_numbers_in_a_range() -> None:
    assert [text for _, text in ticks(-0.31, 0.52, 0.15)] == ["-0.2", "0.0", "0.2", "0.4"]
    assert [text for _, text in ticks(-3, 12, 4)] == ["0", "5", "10"]
    assert [text for _, text in ticks(0, 3e9, 1e9)] == ["0", "1e+09", "2e+09", "3e+09"]


# Devices

without_card = pytest.mark.skipif(not MISSING, reason="there is a card")


@without_card
def test_a_card_is_used_only_if_requested_or_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    messages: list[str] = []
    assert not uses_card("cpu")
    assert FitSettings().device == "cpu"
    with pytest.raises(ValueError, match="device"):
        FitSettings(device="gpu")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert not uses_card("auto", messages.append)
    assert not messages  # the extra is not installed
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert not uses_card("auto", messages.append)
    assert [message.startswith("uses the processor: ") for message in messages] == [True]


@without_card
def test_what_the_extra_brings_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    monkeypatch.delattr(numba, "cuda", raising=False)
    monkeypatch.setitem(sys.modules, "numba.cuda", None)
    with pytest.raises(BackendError, match=r"needs numba-cuda: .*install"):
        uses_card("cuda")


class Context:
    """Memory of a card of 10 GB, of which 4 are free."""

    def get_memory_info(self) -> tuple[int, int]:
        return 4 * 10**9, 10 * 10**9


@without_card
def test_too_little_memory_is_one_line_with_the_splats_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    from numba import cuda

    def device_array(*arguments: object) -> None:
        raise RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")

    monkeypatch.setattr(cuda, "device_array", device_array)
    monkeypatch.setattr(cuda, "current_context", Context)
    for size, fits in ((4.1e9, "990,000"), (14e9, "500,000")):
        with pytest.raises(BackendError) as error, card_errors(1_000_000):
            on_card(int(size / 4))
        assert str(error.value).startswith(f"the card has too little memory for 1,000,000 splats; about {fits} fit, or")
    with pytest.raises(BackendError, match="; fewer fit"), card_errors(5):
        raise type("OutOfMemoryError", (Exception,), {})  # of cupy


@without_card
@pytest.mark.parametrize("device", DEVICES)
def test_commands_take_a_device(device: str, tmp_path: Path, capsys: Capture) -> None:
    output, file = tmp_path / "out.png", str(FIXTURES / "sh1.ply")
    status = run(["render", file, "--size", "16x16", "--device", device, "-o", str(output), "-q"])
    assert status == (device == "cuda")
    assert output.exists() == (device != "cuda")
    assert len(capsys.readouterr().err.splitlines()) == (device == "cuda")


@without_card
@pytest.mark.parametrize("backend", ["osmesa", "open3d"])
def test_only_the_reference_takes_a_device(backend: str, tmp_path: Path, capsys: Capture) -> None:
    output, file = tmp_path / "out.png", FIXTURES / "sh1.ply"
    assert run(["render", str(file), "--backend", backend, "--device", "cuda", "-o", str(output)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"error: --device cannot be used with --backend {backend}"
    camera = sparklod.Camera.look_at([0, 0, -3], [0, 0, 0], fov_y=50, size=(8, 8))
    settings = sparklod.RenderSettings(backend=backend, device="cuda")
    with pytest.raises(ValueError, match=f"on cards, not {backend}"):
        sparklod.render(sparklod.read(file), camera, settings=settings)


@without_card
def test_no_module_of_a_card_is_imported_without_one(tmp_path: Path) -> None:
    program = """
import sys
from sparklod_cli.cli import run
assert run(["render", sys.argv[1], "--size", "16x16", "-o", sys.argv[2], "-q"]) == 0
print([name for name in sys.modules if "jit_cuda" in name or "render.cuda" in name or name == "cupy"])
"""
    arguments = [sys.executable, "-c", program, str(FIXTURES / "sh1.ply"), str(tmp_path / "out.png")]
    assert subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.strip() == "[]"
