"""Animations: frames, their order and their times."""

from __future__ import annotations

import io
import itertools
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image, ImageSequence

from sparklod_cli.images import animation
from sparklod_cli.support.errors import SparklodError

COLORS = [(250, 10, 10), (10, 250, 10), (10, 10, 250), (240, 240, 10)]


def frames(width: int = 33, height: int = 21, channels: int = 3) -> list[np.ndarray]:
    return [np.full((height, width, channels), (*color, 255)[:channels], np.uint8) for color in COLORS]


@pytest.mark.parametrize("form", ["gif", "webp"])
def test_frames_come_in_order(form: str) -> None:
    data = animation.animate(iter(frames()), form, 10.0)
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
    with Image.open(io.BytesIO(animation.animate(made, "webp", 10.0))) as picture:
        assert picture.convert("RGBA").getpixel((0, 5))[3] <= 4
        assert picture.convert("RGBA").getpixel((5, 15))[3] == 255


@pytest.mark.parametrize("fps", [7, 12, 24, 30, 60, 1000])
def test_times_do_not_drift(fps: float) -> None:
    for step, least in ((1, 1), (animation.GIF_STEP, animation.GIF_LEAST)):
        times = list(itertools.islice(animation._times(fps, step, least), 200))
        assert min(times) >= least * step
        assert all(time % step == 0 for time in times)
        if 1000 / fps >= least * step:
            assert abs(sum(times) - 200 * 1000 / fps) <= step


@pytest.mark.parametrize("form", ["gif", "webp"])
def test_encoding_tells_how_far_it_is(form: str) -> None:
    told: list[tuple[str, int, int]] = []

    def drawn() -> Iterator[np.ndarray]:
        for frame in frames():
            assert not told, "all are drawn before the first is written"
            yield frame

    animation.animate(drawn(), form, 10.0, lambda stage, done, total, unit: told.append((stage, done, total)))
    assert list(dict.fromkeys(told)) == [("encoding", number, 4) for number in (1, 2, 3, 4)]


@pytest.mark.parametrize(("form", "longest"), [("gif", 655.35), ("webp", 16777.215)])
def test_a_frame_lasts_as_long_as_its_format_can_say(form: str, longest: float) -> None:
    animation.check(form, 1 / longest)
    data = animation.animate(frames(), form, 1 / longest)
    with Image.open(io.BytesIO(data)) as picture:
        picture.seek(1)
        picture.load()
        assert picture.info["duration"] == pytest.approx(1000 * longest)
    for fps in (0.999 / longest, 1e-6, 1e-300):
        with pytest.raises(SparklodError, match=rf"^a frame of \.{form} lasts at most .* s, not .* s; raise --fps$"):
            animation.check(form, fps)


@pytest.mark.parametrize("form", ["mp4", "webm"])
@pytest.mark.parametrize("size", [(64, 48), (33, 21)])
def test_a_video_has_the_frames(size: tuple[int, int], form: str) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    import imageio.v3

    data = animation.animate(frames(*size), form, 10.0)
    video = imageio.v3.imread(data, extension=f".{form}")
    assert video.shape == (4, size[1] + size[1] % 2, size[0] + size[0] % 2, 3)
    assert np.abs(video[:, 10, 10].astype(int) - COLORS).max() <= 24
    assert imageio.v3.immeta(data, extension=f".{form}")["fps"] == pytest.approx(10)


@pytest.mark.parametrize("form", ["mp4", "webm"])
def test_a_missing_imageio_is_named(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)
    with pytest.raises(SparklodError, match=rf"^\.{form} is written by imageio: pip install 'sparklod\[video\]'"):
        animation.check(form, 30)
    animation.check("gif", 30)
