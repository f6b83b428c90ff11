"""Animations: frames, their order and their times."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from PIL import Image, ImageSequence

from sparklod_cli.images import pixels as animation
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.packages import install_hint

pytestmark = pytest.mark.slow

COLORS = [(250, 10, 10), (10, 250, 10), (10, 10, 250), (240, 240, 10)]


def frames(width: int = 33, height: int = 21, channels: int = 3) -> list[np.ndarray]:
    return [np.full((height, width, channels), (*color, 255)[:channels], np.uint8) for color in COLORS]


def animated(made: Sequence[np.ndarray], form: str, fps: float) -> bytes:
    return animation.animate(iter(made), len(made), form, fps)


@pytest.mark.parametrize("form", ["gif", "webp"])
def test_frames_come_in_order(form: str) -> None:
    data = animated(frames(), form, 10.0)
    with Image.open(io.BytesIO(data)) as picture:
        assert picture.size == (33, 21)
        assert picture.info["loop"] == 0
        seen, times = [], []
        for frame in ImageSequence.Iterator(picture):
            seen.append(np.asarray(frame.convert("RGB"))[10, 10])
            times.append(frame.info["duration"])
    assert np.abs(np.array(seen, int) - COLORS).max() <= 8
    assert times == [100] * 4


def test_an_animated_webp_keeps_alpha() -> None:
    made = frames(channels=4)
    for frame in made:
        frame[:10, :, 3] = np.linspace(0, 128, 33)
    with Image.open(io.BytesIO(animated(made, "webp", 10.0))) as picture:
        assert picture.convert("RGBA").getpixel((0, 5))[3] <= 4
        assert picture.convert("RGBA").getpixel((5, 15))[3] == 255


@pytest.mark.parametrize("fps", [7, 12, 24, 30, 60, 1000])
def test_times_do_not_drift(fps: float) -> None:
    for step, least in ((1, 1), (animation.GIF_STEP, animation.LEAST_STEPS)):
        times = animation._times(fps, 200, step, least)
        assert min(times) >= least * step
        assert all(time % step == 0 for time in times)
        if 1000 / fps >= least * step:
            assert abs(sum(times) - 200 * 1000 / fps) <= step


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


@pytest.mark.parametrize("made", [frames(), frames()[:1], moving(30, 3), same(5), [*same(3), *frames(64, 48)]])
def test_a_gif_has_all_of_the_time(made: list[np.ndarray]) -> None:
    with Image.open(io.BytesIO(animated(made, "gif", 7.0))) as picture:
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert sum(times) == pytest.approx(1000 / 7 * len(made), abs=5)


def test_a_gif_that_stands_still_for_longer_than_a_frame_can_last_is_an_error() -> None:
    with pytest.raises(SparklodError, match=r"^the \.gif cannot be written, write \.mp4 or fewer frames: "):
        animated([*frames()[:1] * 5, *frames()[1:2]], "gif", 1 / 600)


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


def test_a_webp_that_stands_still_has_its_time() -> None:
    made = [*same(30), *moving(4, 3)[3:]]
    with Image.open(io.BytesIO(animated(made, "webp", 10.0))) as picture:
        times = [(frame.load(), frame.info["duration"])[1] for frame in ImageSequence.Iterator(picture)]
    assert sum(times) == 100 * len(made)


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


@pytest.mark.parametrize(("form", "longest"), [("gif", 655.35), ("webp", 16777.215)])
def test_a_frame_lasts_as_long_as_its_format_can_say(form: str, longest: float) -> None:
    animation.check_animation(form, 1 / longest)
    data = animated(frames(), form, 1 / longest)
    with Image.open(io.BytesIO(data)) as picture:
        picture.seek(1)
        picture.load()
        assert picture.info["duration"] == pytest.approx(1000 * longest)
    for fps in (0.999 / longest, 1e-6, 1e-300):
        with pytest.raises(SparklodError, match=rf"^a frame of \.{form} lasts at most .* s, not .* s; raise --fps$"):
            animation.check_animation(form, fps)


@pytest.mark.parametrize("form", ["mp4", "webm"])
@pytest.mark.parametrize("size", [(64, 48), (33, 21)])
def test_a_video_has_the_frames(size: tuple[int, int], form: str) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    import imageio.v3

    data = animated(frames(*size), form, 10.0)
    video = imageio.v3.imread(data, extension=f".{form}")
    assert video.shape == (4, size[1] + size[1] % 2, size[0] + size[0] % 2, 3)
    assert np.abs(video[:, 10, 10].astype(int) - COLORS).max() <= 24
    assert imageio.v3.immeta(data, extension=f".{form}")["fps"] == pytest.approx(10)


@pytest.mark.parametrize("form", ["mp4", "webm"])
def test_a_missing_imageio_is_named(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    with pytest.raises(SparklodError, match=rf"^\.{form} needs imageio: {re.escape(install_hint('video'))}"):
        animation.check_animation(form, 30)
    animation.check_animation("gif", 30)
