"""Animations: GIF and WebP by Pillow, MP4 and WebM by imageio of the extra `video`."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator
from types import ModuleType

import numpy as np
from PIL import Image

from ..support.errors import SparklodError
from ..support.optional import optional_import
from . import animated_webp, gif
from .pixels import Pixels

#: Longest duration of a frame, ms: 16 bits of hundredths in GIF, 24 bits of ms in WebP, ffmpeg's limit for videos.
LONGEST = {"gif": gif.STEP * gif.MOST_STEPS, "webp": animated_webp.LONGEST, "mp4": 1_000_000, "webm": 1_000_000}

#: Quality of WebP (0 to 100), rate factors of H.264 (51 to 0) and VP9 (63 to 0): losses are hardly visible.
WEBP_QUALITY, H264_QUALITY, VP9_QUALITY = 90, 16, 24

#: Codec and options of ffmpeg for each kind of video. VP9 obeys its rate factor only with a bit rate of 0, and uses
#: several processors only with -row-mt.
VIDEOS = {
    "mp4": ("libx264", ["-crf", str(H264_QUALITY), "-preset", "medium", "-movflags", "+faststart"]),
    "webm": (
        "libvpx-vp9",
        ["-crf", str(VP9_QUALITY), "-b:v", "0", "-deadline", "good", "-cpu-used", "3", "-row-mt", "1"],
    ),
}


def check(form: str, fps: float) -> None:
    """Raises a `SparklodError` if an animation cannot be written; called before any frame is drawn."""
    if form in VIDEOS:
        load_imageio(form)
    longest = LONGEST[form] / 1000
    if 1 / fps > longest:
        raise SparklodError(f"a frame of .{form} lasts at most {longest:,.3f} s, not {1 / fps:,.7g} s; raise --fps")


def load_imageio(form: str) -> ModuleType:
    """Imports imageio with its ffmpeg, which writes videos of a form.

    Raises:
        SparklodError: it is not installed.
    """
    with optional_import(f".{form} is written by imageio", "video"):
        import imageio.v2
        import imageio_ffmpeg

        try:
            imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:  # its wheel came without the program
            raise ImportError(error) from None
    module: ModuleType = imageio.v2
    return module


def animate(frames: Iterable[Pixels], form: str, fps: float) -> Iterator[bytes]:
    """The bytes of an animation in an endless loop ("gif", "webp") or of a video ("mp4", "webm"), piece by piece.

    Frames are encoded as they come; the memory that takes does not depend on their number, but for the bytes of videos.

    Args:
        frames: at least one, all of one size; with alpha for "webp" only.
        form: one of `defaults.MOVING`.
        fps: frames per second.

    Raises:
        SparklodError: videos cannot be written here, or the animation is too large for its format.
    """
    if form in VIDEOS:
        out = io.BytesIO()
        _write_video(out, frames, form, fps)
        yield out.getvalue()
    elif form == "gif":
        pictures = (Image.fromarray(frame).convert("P", palette=Image.Palette.ADAPTIVE, colors=256) for frame in frames)
        yield from gif.written(pictures, _times(fps, gif.STEP, gif.LEAST_STEPS))
    else:
        pictures = (Image.fromarray(frame) for frame in frames)
        yield from animated_webp.written(pictures, _times(fps, 1, 1), quality=WEBP_QUALITY, method=4)


def _times(fps: float, step: int, least: int) -> Iterator[int]:
    """Durations of the frames in ms, in whole steps whose sum does not drift from the true time."""
    elapsed = 0
    for number in itertools.count(1):
        end = max(round(1000 * number / (fps * step)), elapsed + least)
        yield (end - elapsed) * step
        elapsed = end


def _write_video(out: io.BytesIO, frames: Iterable[Pixels], form: str, fps: float) -> None:
    imageio = load_imageio(form)
    codec, tuned = VIDEOS[form]
    settings = {"codec": codec, "quality": None, "pixelformat": "yuv420p", "macro_block_size": 1}
    with imageio.get_writer(out, format=f".{form}", mode="I", fps=fps, output_params=tuned, **settings) as writer:
        for frame in frames:
            # yuv420p has colours for every second pixel, so odd sides get their last row or column twice.
            odd = [(0, side % 2) for side in frame.shape[:2]]
            even = np.pad(frame, (*odd, (0, 0)), mode="edge")
            try:
                writer.append_data(even)
            except OSError as error:  # its text is the whole log of ffmpeg
                raise SparklodError(f"ffmpeg cannot write it: {str(error).strip().splitlines()[-1]}") from None
