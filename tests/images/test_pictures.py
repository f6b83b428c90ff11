"""Pixels, contact sheets, animations, and the pictures of a path."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image, ImageDraw, ImageSequence

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.sources import CameraPath, single_views
from sparklod_cli.images import pixels, sequence
from sparklod_cli.images.picture_files import output_for
from sparklod_cli.images.pixels import cells, check_animation, grid, sheet
from sparklod_cli.images.sequence import PictureSettings, WrittenPictures, write_pictures
from sparklod_cli.model.instances import instances_of
from sparklod_cli.render.color_scales import VIRIDIS, smooth
from sparklod_cli.render.render_settings import RenderSettings
from sparklod_cli.render.renderer import DrawnPicture, Renderer, averaged
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.machine import install_hint
from sparklod_cli.viewers.scenes import CutFinder, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.conftest import FIXTURES

UNIT = st.floats(0, 1, width=32)
COLORS = st.tuples(UNIT, UNIT, UNIT)


@st.composite
def images(draw: st.DrawFn) -> np.ndarray:
    """Premultiplied, as backends draw them."""
    image = draw(hnp.arrays(np.float32, (3, 4, 4), elements=UNIT))
    image[..., :3] *= image[..., 3:]
    return image


@given(images(), COLORS)
def test_a_background_shows_through_transparency(image: np.ndarray, color: tuple[float, float, float]) -> None:
    result = pixels.over(image, color)
    alpha = image[..., 3:].astype(np.float64)
    assert np.allclose(result[..., :3], image[..., :3] + (1 - alpha) * color, atol=1e-6)
    assert (result[..., 3] == 1).all()
    assert pixels.eight_bits(result).shape == (3, 4, 3)
    assert pixels.over(image, None) is image


@given(images(), COLORS)
def test_straight_alpha_over_a_background_is_the_same_picture(image: np.ndarray, color: tuple[float, ...]) -> None:
    opaque = pixels.eight_bits(pixels.over(image, color))
    codes = pixels.eight_bits(image).astype(np.float64)
    if codes.shape[2] == 3:
        codes = np.dstack([codes, np.full(codes.shape[:2], 255.0)])
    alpha = codes[..., 3:] / 255
    again = codes[..., :3] * alpha + 255 * (1 - alpha) * np.array(color)
    # Half a step of colour, of alpha and of the result.
    assert np.abs(again - opaque).max() <= 1.5 + 1e-3


def test_codes_are_rounded_and_clipped() -> None:
    values = np.array([-1, 0, 0.4 / 255, 0.6 / 255, 254.4 / 255, 254.6 / 255, 1, 7], np.float32)
    image = np.dstack([values[None]] * 3 + [np.ones((1, 8), np.float32)])
    assert pixels.eight_bits(image)[0, :, 0].tolist() == [0, 0, 0, 1, 254, 255, 255, 255]
    clear = pixels.eight_bits(np.zeros((2, 2, 4), np.float32))
    assert clear.shape == (2, 2, 4)
    assert not clear.any()


@pytest.mark.parametrize("times", [1, 2, 3, 4])
def test_supersampling_takes_the_mean_of_squares(times: int) -> None:
    fine = np.random.default_rng(0).random((3 * times, 2 * times, 4)).astype(np.float32)
    coarse = averaged(fine, times)
    for row in range(3):
        for column in range(2):
            square = fine[row * times : (row + 1) * times, column * times : (column + 1) * times]
            assert np.allclose(coarse[row, column], square.mean(axis=(0, 1)), atol=1e-6)


@given(images(), images(), st.floats(0.5, 100))
def test_a_difference_is_absolute_and_clipped(a: np.ndarray, b: np.ndarray, gain: float) -> None:
    a, b = (pixels.over(image, (0, 0, 0)) for image in (a, b))
    apart = pixels.difference(a, b, gain)
    assert np.array_equal(apart, pixels.difference(b, a, gain))
    assert np.allclose(apart[..., :3], np.minimum(gain * np.abs(a[..., :3] - b[..., :3]), 1), atol=1e-4)
    assert not pixels.difference(a, a, gain)[..., :3].any()


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("form", ["png", "webp"])
def test_files_hold_every_pixel(form: str, channels: int) -> None:
    codes = np.random.default_rng(1).integers(0, 256, (20, 30, channels)).astype(np.uint8)
    with Image.open(io.BytesIO(pixels.encode(codes, form))) as picture:
        assert picture.format == form.upper()
        assert np.array_equal(np.asarray(picture), codes)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_color_scale_is_added_at_the_right(channels: int) -> None:
    bar = smooth("numbers", VIRIDIS, [(0.0, "0"), (1.0, "12 or more")], 0, 12)
    codes = np.full((360, 640, channels), 255, np.uint8)
    result = pixels.with_scale(codes, bar)
    assert result.shape == (360, 640 + pixels.scale_width(640, 360), channels)
    assert np.array_equal(result[:, :640], codes), "it hides nothing"
    assert (result[:, 640:, :3] != 255).any(axis=2).all()
    assert (result[:, 640:, 3:] == 255).all()
    flat = result[..., :3].reshape(-1, 3).astype(int)
    for color in (bar.ramp[0], bar.ramp[-1]):
        assert np.abs(flat - color).max(axis=1).min() <= 3
    small = codes[:100, :100]
    assert pixels.with_scale(small, bar) is small
    assert pixels.scale_width(100, 100) == 0


@pytest.mark.parametrize("size", [1e-4, 3e-3, 0.02, 0.3, 1.0])
def test_a_gain_shows_differences_and_cuts_few(size: float) -> None:
    random = np.random.default_rng(3)
    a = np.full((60, 80, 4), 0.5, np.float32)
    b = a.copy()
    b[20:40, :, :3] += size * random.uniform(-0.5, 0.5, (20, 80, 3)).astype(np.float32)
    gain = pixels.gain_for([pixels.apart(a, b), pixels.apart(a, a)])
    shown = pixels.difference(a, b, gain)[..., :3]
    assert gain in pixels.GAINS
    assert (shown[20:40] < 1).all(axis=2).mean() >= 0.98
    assert shown.max() > 0.39 or gain == pixels.GAINS[-1]
    assert not shown[:20].any()
    assert pixels.gain_for([pixels.apart(a, a)]) == 1


def pictures(count: int, width: int, height: int, channels: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(count)
    return [rng.integers(0, 256, (height, width, channels)).astype(np.uint8) for _ in range(count)]


@pytest.mark.parametrize("size", [(64, 36), (30, 90), (1, 1)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 12])
def test_cells_are_the_pictures(count: int, size: tuple[int, int]) -> None:
    width, height = size
    made = pictures(count, width, height)
    whole = sheet(made, [f"a caption that is rather long, of number {n}" for n in range(count)])
    places = cells(count, size)
    assert len(set(places)) == count
    for (x, y), picture in zip(places, made, strict=True):
        assert np.array_equal(whole[y : y + height, x : x + width], picture)
    columns, rows = grid(count, size)
    assert (columns - 1) * rows < count <= columns * rows or columns * (rows - 1) < count <= columns * rows


def test_one_picture_with_alpha_gives_the_sheet_alpha() -> None:
    plain, clear = pictures(1, 20, 20)[0], pictures(1, 20, 20, channels=4)[0]
    whole = sheet([plain, clear], ["one", "two\n\0"])
    (ax, ay), (bx, by) = cells(2, (20, 20))
    assert whole.shape[2] == 4
    assert np.array_equal(whole[ay : ay + 20, ax : ax + 20, :3], plain)
    assert (whole[ay : ay + 20, ax : ax + 20, 3] == 255).all()
    assert np.array_equal(whole[by : by + 20, bx : bx + 20], clear)


def test_a_caption_of_any_length_is_written_and_takes_few_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = []
    measure = ImageDraw.ImageDraw.textlength

    def counted(self: Any, text: str, *rest: Any, **named: Any) -> float:
        lengths.append(len(text))
        return measure(self, text, *rest, **named)

    monkeypatch.setattr(ImageDraw.ImageDraw, "textlength", counted)
    made = pictures(2, 300, 200)
    sheets = [sheet(made, captions) for captions in (["", ""], ["fits", ""], ["name " * 200_000, "\x07" * 8_000])]
    assert len({each.shape for each in sheets}) == 1
    assert len({each.tobytes() for each in sheets}) == 3
    assert len(lengths) < 50
    assert max(lengths) <= 302


# Animations

COLORED = [(250, 10, 10), (10, 250, 10), (10, 10, 250), (240, 240, 10)]


def frames(width: int = 33, height: int = 21, channels: int = 3) -> list[np.ndarray]:
    return [np.full((height, width, channels), (*color, 255)[:channels], np.uint8) for color in COLORED]


def animated(made: Sequence[np.ndarray], form: str, fps: float) -> bytes:
    return pixels.animate(iter(made), len(made), form, fps)


def durations(data: bytes) -> list[int]:
    with Image.open(io.BytesIO(data)) as picture:
        return [(frame.load(), frame.info["duration"])[1] for frame in ImageSequence.Iterator(picture)]


@pytest.mark.slow
@pytest.mark.parametrize("form", ["gif", "webp"])
def test_frames_come_in_order(form: str) -> None:
    data = animated(frames(), form, 10.0)
    with Image.open(io.BytesIO(data)) as picture:
        assert picture.size == (33, 21)
        assert picture.info["loop"] == 0
        seen = [np.asarray(frame.convert("RGB"))[10, 10] for frame in ImageSequence.Iterator(picture)]
    assert np.abs(np.array(seen, int) - COLORED).max() <= 8
    assert durations(data) == [100] * 4


def moving(count: int, channels: int) -> list[np.ndarray]:
    """A square that moves over a gradient or over nothing, and stands still at times."""
    made = []
    for number in range(count):
        frame = np.zeros((48, 64, channels), np.uint8)
        if channels == 3:
            frame[..., 0] = np.linspace(0, 255, 64)
        at = 2 * (number // 3 if number % 20 < 12 else 4)
        frame[at : at + 16, at : at + 24] = (40, 200, 90, 255)[:channels]
        made.append(frame)
    return made


def same(count: int) -> list[np.ndarray]:
    return moving(1, 3) * count


@pytest.mark.slow
@pytest.mark.parametrize("fps", [7.0, 12.0, 24.0, 30.0])
@pytest.mark.parametrize("made", [frames(), frames()[:1], moving(30, 3), same(5), [*same(3), *frames(64, 48)]])
def test_a_gif_has_all_of_the_time(made: list[np.ndarray], fps: float) -> None:
    assert sum(durations(animated(made, "gif", fps))) == pytest.approx(1000 / fps * len(made), abs=5)


@pytest.mark.slow
def test_a_gif_that_stands_still_for_longer_than_a_frame_can_last_is_an_error() -> None:
    with pytest.raises(SparklodError, match=r"^the \.gif cannot be written, write \.mp4 or fewer frames: "):
        animated([*frames()[:1] * 5, *frames()[1:2]], "gif", 1 / 600)


@pytest.mark.slow
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("count", [9, 20, 47])
def test_a_webp_shows_each_frame_as_drawn(count: int, channels: int) -> None:
    made = moving(count, channels)
    shown, times = [], []
    with Image.open(io.BytesIO(animated(made, "webp", 10.0))) as picture:
        assert picture.size == (64, 48) and picture.info["loop"] == 0
        for frame in ImageSequence.Iterator(picture):
            frame.load()
            shown += [np.asarray(frame.convert("RGBA"), int)] * round(frame.info["duration"] / 100)
            times.append(frame.info["duration"])
    assert sum(times) == 100 * count and len(shown) == count
    for number, (seen, expected) in enumerate(zip(shown, made, strict=True)):
        if channels == 4:
            np.testing.assert_array_equal(seen[..., 3], expected[..., 3], err_msg=str(number))
        covered = seen[..., 3] > 0
        assert np.abs(seen[..., :3] - expected[..., :3])[covered].mean() < 8, number


PEAK = """
import re, sys
from pathlib import Path
import numpy as np
from sparklod_cli.images.pixels import animate

def frames():
    for number in range(int(sys.argv[2])):
        frame = np.zeros((768, 1024, 3), np.uint8)
        frame[: 8 * (number % 90) + 8] = 200
        yield frame

animate(frames(), int(sys.argv[2]), sys.argv[1], 10.0)
# What `getrusage` says of a new process is no less than its parent took.
print(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is in other units elsewhere")
@pytest.mark.parametrize("form", ["gif", "webp"])
def test_memory_does_not_grow_with_the_number_of_frames(form: str) -> None:
    """40 more frames of 2.4 MB, or 3.1 MB in Pillow, take no more than a few; a GIF holds a byte a pixel, 31 MB."""
    few, many = (
        int(
            subprocess.run([sys.executable, "-c", PEAK, form, count], capture_output=True, check=True, text=True).stdout
        )
        for count in ("45", "85")
    )
    assert many - few < (40_000 if form == "gif" else 20_000)


@pytest.mark.slow
@pytest.mark.parametrize(("form", "longest"), [("gif", 655.35), ("webp", 16777.215)])
def test_a_frame_lasts_as_long_as_its_format_can_say(form: str, longest: float) -> None:
    check_animation(form, 1 / longest)
    data = animated(frames(), form, 1 / longest)
    with Image.open(io.BytesIO(data)) as picture:
        picture.seek(1)
        picture.load()
        assert picture.info["duration"] == pytest.approx(1000 * longest)
    for fps in (0.999 / longest, 1e-6, 1e-300):
        with pytest.raises(SparklodError, match=rf"^a frame of \.{form} lasts at most .* s, not .* s; raise --fps$"):
            check_animation(form, fps)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["mp4", "webm"])
@pytest.mark.parametrize("size", [(64, 48), (33, 21)])
def test_a_video_has_the_frames(size: tuple[int, int], form: str) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    import imageio.v3

    data = animated(frames(*size), form, 10.0)
    video = imageio.v3.imread(data, extension=f".{form}")
    assert video.shape == (4, size[1] + size[1] % 2, size[0] + size[0] % 2, 3)
    assert np.abs(video[:, 10, 10].astype(int) - COLORED).max() <= 24
    assert imageio.v3.immeta(data, extension=f".{form}")["fps"] == pytest.approx(10)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["mp4", "webm"])
def test_a_missing_imageio_is_named(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    with pytest.raises(SparklodError, match=rf"^\.{form} needs imageio: {re.escape(install_hint('video'))}"):
        check_animation(form, 30)
    check_animation("gif", 30)


# Pictures of a path: each is drawn once, and comes out the same, whatever is computed before

TOWN = FIXTURES / "traverse" / "town.spz"


def path_of(count: int) -> CameraPath:
    views = [((float(number), -3.0, 9.0), (0.0, 0.0, 0.0)) for number in range(count)]
    return single_views(views, Settings(size=(48, 32)))


def finder(budget: int = 900) -> CutFinder:
    return CutFinder(read_scenes(instances_of([TOWN])), LodSettings(budget))


def written(path: Path, count: int, settings: RenderSettings | None = None, **options: Any) -> WrittenPictures:
    """Pictures of a town, one by one so that they can be counted."""
    look, output = PictureSettings(background=(0.0, 0.0, 0.0), jobs=1), output_for(path, Path("x"), count, sheet=False)
    return write_pictures(finder(), path_of(count), output, settings or RenderSettings(), look, **options)


@pytest.fixture
def on_draw(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Call a function before each picture that is drawn."""
    draw = Renderer.draw

    def observe(called: Callable[[], object]) -> None:
        def drawn(self: Renderer, camera: Any) -> DrawnPicture:
            called()
            return draw(self, camera)

        monkeypatch.setattr(Renderer, "draw", drawn)

    return observe


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_difference_draws_every_picture_once(count: int, tmp_path: Path, on_draw: Any) -> None:
    drawn: list[int] = []
    on_draw(lambda: drawn.append(0))
    pictures = written(tmp_path / "x.%d.png", count, reference=finder(3000))
    assert len(drawn) == 2 * count
    assert pictures.gain is not None and pictures.gain > 1
    assert len(pictures.frames) == count
    assert pictures.bytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    assert not pictures.empty


def test_pictures_too_large_to_cache_come_out_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = []
    for folder, most in ((tmp_path / "cached", sequence.CACHED_PIXELS), (tmp_path / "drawn-again", 0)):
        folder.mkdir()
        monkeypatch.setattr(sequence, "CACHED_PIXELS", most)
        written(folder / "x.%d.png", 3, reference=finder(3000))
        files.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert files[0] == files[1]
    assert len(files[0]) == 3


def test_progress_counts_the_cuts_of_a_color_scale(tmp_path: Path) -> None:
    steps: list[tuple[str, int, int, str]] = []
    settings = RenderSettings(color_by="level")
    written(tmp_path / "x.%d.png", 40, settings, progress=lambda *each: steps.append(each))
    colours = [each[1:] for each in steps if each[0] == "colours"]
    assert colours == [(number, 14, "cut") for number in range(1, 15)]
    assert steps[-1] == ("drawing", 40, 40, "frame")


@pytest.mark.parametrize("name", ["x.gif", "x.webp"])
def test_an_interrupted_animation_leaves_the_former_file_alone(name: str, tmp_path: Path, on_draw: Any) -> None:
    (tmp_path / name).write_bytes(b"before")
    left = iter(range(30))

    def interrupt() -> None:
        if next(left) == 29:
            raise KeyboardInterrupt

    on_draw(interrupt)
    with pytest.raises(KeyboardInterrupt):
        written(tmp_path / name, 40, overwrite=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"before"]


@pytest.mark.parametrize("name", ["x.gif", "x.webp"])
def test_an_animation_is_written_while_frames_are_drawn(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_draw: Any
) -> None:
    """No more frames wait than are encoded together."""
    events: list[str] = []
    animate = sequence.animate
    monkeypatch.setattr(
        sequence, "animate", lambda frames, *rest: animate((events.append("taken") or each for each in frames), *rest)
    )
    on_draw(lambda: events.append("draw"))
    written(tmp_path / name, 40)
    ahead = [events[:at].count("draw") - events[:at].count("taken") for at in range(len(events))]
    assert events.count("taken") == 40 and max(ahead) <= 3
