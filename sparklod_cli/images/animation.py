"""Animations: GIF and WebP by Pillow, MP4 and WebM by imageio of the extra `video`."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable
from types import ModuleType

import numpy as np
from PIL import Image

from ..system.errors import SparklodError
from ..system.optional import optional_import
from .pixels import Pixels

#: Durations of the frames of a GIF: steps in ms, and the fewest steps that players do not slow down.
GIF_STEP, LEAST_STEPS = 10, 2

#: Longest duration of a frame, ms: 16 bits of hundredths in GIF, 24 bits of ms in WebP, ffmpeg's limit for videos.
LONGEST = {"gif": GIF_STEP * 0xFFFF, "webp": 0xFFFFFF, "mp4": 1_000_000, "webm": 1_000_000}

#: Quality of WebP (0 to 100), rate factors of H.264 (51 to 0) and VP9 (63 to 0): losses are hardly visible.
WEBP_QUALITY, H264_QUALITY, VP9_QUALITY = 90, 16, 24

#: Flag of a WebP that it has alpha. libwebp omits it where only cropped edges are transparent.
WEBP_ALPHA = 0x10

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
    """Raise a `SparklodError` if an animation cannot be written; called before any frame is drawn."""
    if form in VIDEOS:
        load_imageio(form)
    longest = LONGEST[form] / 1000
    if 1 / fps > longest:
        raise SparklodError(f"a frame of .{form} lasts at most {longest:,.3f} s, not {1 / fps:,.7g} s; raise --fps")


def load_imageio(form: str) -> ModuleType:
    """Import imageio with its ffmpeg, which writes videos of a form; `SparklodError` if it is not installed."""
    with optional_import(f".{form} needs imageio", "video"):
        import imageio.v2
        import imageio_ffmpeg

        try:
            imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:  # its wheel came without the program
            raise ImportError(error) from None
    module: ModuleType = imageio.v2
    return module


def animate(frames: Iterable[Pixels], count: int, form: str, fps: float) -> bytes:
    """Return the bytes of an animation in an endless loop ("gif", "webp") or of a video ("mp4", "webm").

    Frames are taken as they are encoded; a GIF's are held, a byte a pixel, until the last.

    Args:
        frames: at least one, all of one size; with alpha for "webp" only.
        form: one of `defaults.MOVING`.

    Raises:
        SparklodError: videos cannot be written here, or the animation is too large for its format.
    """
    out = io.BytesIO()
    if form in VIDEOS:
        _write_video(out, frames, form, fps)
        return out.getvalue()
    step, least = (GIF_STEP, LEAST_STEPS) if form == "gif" else (1, 1)
    times = _times(fps, count, step, least)
    try:
        if form == "gif":
            palette = Image.Palette.ADAPTIVE
            pictures = (Image.fromarray(frame).convert("P", palette=palette, colors=256) for frame in frames)
            next(pictures).save(out, "GIF", save_all=True, append_images=pictures, duration=times, loop=0)
        else:
            film = _film(frames, count)
            film.save(out, "WEBP", save_all=True, duration=times, loop=0, quality=WEBP_QUALITY, method=4)
    except (OSError, OverflowError, struct.error) as error:
        raise SparklodError(f"the .{form} cannot be written, write .mp4 or fewer frames: {error}") from None
    data = bytearray(out.getvalue())
    if form == "webp" and data[12:16] == b"VP8X" and film.mode == "RGBA":
        data[20] |= WEBP_ALPHA
    return bytes(data)


def _film(frames: Iterable[Pixels], count: int) -> Image.Image:
    """Return a picture whose frames are drawn as Pillow seeks them, so that they are not all in memory."""
    pictures = (Image.fromarray(frame) for frame in frames)
    film = next(pictures).copy()

    def seek(frame: int) -> None:
        if frame:
            film.paste(next(pictures))

    vars(film).update(n_frames=count, seek=seek)
    return film


def _times(fps: float, count: int, step: int, least: int) -> list[int]:
    """Durations of the frames in ms, in whole steps whose sum does not drift from the true time."""
    times, elapsed = [], 0
    for number in range(1, count + 1):
        end = max(round(1000 * number / (fps * step)), elapsed + least)
        times.append((end - elapsed) * step)
        elapsed = end
    return times


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
