"""Animations: GIF and WebP, which Pillow writes, and MP4 and WebM, which need the extra `video`."""

from __future__ import annotations

import functools
import io
import itertools
from collections.abc import Callable, Iterable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from ..support.errors import SparklodError
from ..support.progress import Progress, silent
from .pixels import Pixels

#: What animations are written as.
ANIMATIONS = ("gif", "webp", "mp4", "webm")

#: GIF counts time in hundredths of a second, and what plays it slows down where a frame is shorter than this.
GIF_STEP, GIF_LEAST = 10, 2

#: Milliseconds that a frame lasts at most: 16 bits of hundredths in GIF, 24 bits in WebP; of videos, what ffmpeg takes.
LONGEST = {"gif": 10 * 0xFFFF, "webp": 0xFFFFFF, "mp4": 1_000_000, "webm": 1_000_000}

#: Quality of WebP, 0 to 100, of H.264, 51 to 0, and of VP9, 63 to 0: what is lost is hardly seen.
WEBP_QUALITY, H264_QUALITY, VP9_QUALITY = 90, 16, 24

#: What ffmpeg is told for each video, besides the codec. VP9 takes its quality as it is only without a bit rate, and
#: uses more than one processor only where rows are coded side by side.
VIDEOS = {
    "mp4": ("libx264", ["-crf", str(H264_QUALITY), "-preset", "medium", "-movflags", "+faststart"]),
    "webm": (
        "libvpx-vp9",
        ["-crf", str(VP9_QUALITY), "-b:v", "0", "-deadline", "good", "-cpu-used", "3", "-row-mt", "1"],
    ),
}


def check(form: str, fps: float) -> None:
    """Raises a `SparklodError` where an animation cannot be written, before work goes into it."""
    if form in VIDEOS:
        load_imageio(form)
    longest = LONGEST[form] / 1000
    if 1 / fps > longest:
        raise SparklodError(f"a frame of .{form} lasts {longest:,.3f} s at most, not {1 / fps:,.7g} s; see --fps")


def load_imageio(form: str) -> ModuleType:
    """Imports imageio, with the ffmpeg that writes videos of a form.

    Raises:
        SparklodError: it is not installed.
    """
    try:
        import imageio.v2
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise SparklodError(f".{form} is written by imageio: pip install 'sparklod[video]' ({error})") from None
    module: ModuleType = imageio.v2
    return module


def animate(frames: Iterable[Pixels], form: str, fps: float, progress: Progress = silent) -> bytes:
    """The bytes of an animation that is repeated for ever, or of a video.

    Args:
        frames: at least one, all of one size; with alpha for "webp" only.
        form: one of `ANIMATIONS`.
        fps: frames a second.
        progress: is told how many frames are written, where that begins when all of them are there: those of videos
            are written as they come.

    Raises:
        SparklodError: videos cannot be written here.
    """
    out = io.BytesIO()
    if form in VIDEOS:
        _write_video(out, frames, form, fps)
    elif form == "gif":
        pictures = (Image.fromarray(frame).convert("P", palette=Image.Palette.ADAPTIVE, colors=256) for frame in frames)
        _write_images(out, "GIF", pictures, _times(fps, GIF_STEP, GIF_LEAST), progress)
    else:
        pictures = (Image.fromarray(frame) for frame in frames)
        _write_images(out, "WEBP", pictures, _times(fps, 1, 1), progress, quality=WEBP_QUALITY, method=4)
    return out.getvalue()


def _times(fps: float, step: int, least: int) -> Iterator[int]:
    """Milliseconds of each frame in whole steps, which do not drift from the time that has passed."""
    shown = 0
    for number in itertools.count(1):
        end = max(round(1000 * number / (fps * step)), shown + least)
        yield (end - shown) * step
        shown = end


def _write_images(
    out: io.BytesIO, name: str, pictures: Iterable[Image.Image], times: Iterator[int], progress: Progress, **how: Any
) -> None:
    first, *others = every = list(pictures)
    durations = list(itertools.islice(times, len(every)))
    for number, picture in enumerate(every):
        # What Pillow does with a picture before it writes it, and all that it tells of how far it is.
        picture.seek = functools.partial(_sought, picture.seek, progress, number, len(every))  # type: ignore[method-assign]
    first.save(out, name, save_all=True, append_images=others, duration=durations, loop=0, **how)


def _sought(seek: Callable[[int], None], progress: Progress, number: int, total: int, frame: int) -> None:
    seek(frame)
    progress("encoding", number + 1, total, "frame")


def _write_video(out: io.BytesIO, frames: Iterable[Pixels], form: str, fps: float) -> None:
    imageio = load_imageio(form)
    codec, tuned = VIDEOS[form]
    settings = {"codec": codec, "quality": None, "pixelformat": "yuv420p", "macro_block_size": 1}
    with imageio.get_writer(out, format=f".{form}", mode="I", fps=fps, output_params=tuned, **settings) as writer:
        for frame in frames:
            # Its colours are kept for every second pixel, so sides are even: the last row and column are repeated.
            odd = [(0, side % 2) for side in frame.shape[:2]]
            even = np.pad(frame, (*odd, (0, 0)), mode="edge")
            try:
                writer.append_data(even)
            except OSError as error:  # its text is what ffmpeg says, at length
                raise SparklodError(f"ffmpeg cannot write it: {str(error).strip().splitlines()[-1]}") from None
