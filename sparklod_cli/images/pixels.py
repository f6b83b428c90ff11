"""Conversion of float images to 8-bit pixels and encoded pictures, contact sheets and animations; text on pictures.

Pillow writes GIF and WebP, imageio of the extra `video` MP4 and WebM.
"""

from __future__ import annotations

import bisect
import io
import math
import struct
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from ..system.errors import SparklodError, optional_import
from ..system.untrusted import printable
from .picture_files import JPEG_QUALITY

if TYPE_CHECKING:
    from ..render.color_scales import Coloring
    from ..render.rasterizer import Image

#: Colours of pictures with text: background, titles, other text, and thin lines.
BACKGROUND, INK, FAINT, LINE = "#0f141b", "#e6edf3", "#9aa7b4", "#7d8996"

#: Most characters of a title that fit into the width of a picture.
MAX_TITLE = 120

#: Least legible size of Pillow's font, pixels.
MIN_LETTERS = 7

Font = Any


def font(unit: float, size: float) -> Font:
    """Return Pillow's font in a size given in units, which are pixels."""
    return ImageFont.load_default(size=max(MIN_LETTERS, size * unit))


def write_title(draw: ImageDraw.ImageDraw, unit: float, title: str, lines: Sequence[tuple[str, str]]) -> None:
    """Write a title and lines of text with their colours at the upper left of a picture.

    `unit` is a thousandth of the picture's height, in pixels.
    """
    left, top = 40 * unit, 30 * unit
    draw.text((left, top), printable(title, MAX_TITLE), INK, font(unit, 32))
    for number, (line, color) in enumerate(lines):
        draw.text((left, top + (46 + 26 * number) * unit), line, color, font(unit, 19))


def write_scale(image: Pillow.Image, draw: ImageDraw.ImageDraw, unit: float, coloring: Coloring) -> None:
    """Draw a colour scale at the right of a picture, in units as in `write_title`."""
    left, right = image.width - 170 * unit, image.width - 146 * unit
    top, bottom = 0.26 * image.height, 0.84 * image.height
    draw.text((left, top - 18 * unit), coloring.title, INK, font(unit, 21), anchor="ls")
    height = max(1, round(bottom - top))
    rows = np.arange(height)[::-1] * len(coloring.ramp) // height
    bar = np.broadcast_to(coloring.ramp[rows][:, None], (height, max(1, round(right - left)), 3))
    image.paste(Pillow.fromarray(np.ascontiguousarray(bar)), (round(left), round(top)))
    for place, text in coloring.marks:
        y = bottom - place * (bottom - top)
        draw.line([(right, y), (right + 6 * unit, y)], LINE, max(1, round(unit)))
        draw.text((right + 12 * unit, y), text, FAINT, font(unit, 17), anchor="lm")


#: (H, W, 3), or (H, W, 4) with straight alpha: red, green and blue are not multiplied by it.
Pixels = NDArray[np.uint8]

#: Red, green and blue, 0..1.
Color = tuple[float, float, float]

#: Deflate level of PNG, 1 to 9: higher levels take twice as long and save a few percent.
PNG_LEVEL = 4

#: Height in pixels of a picture whose colour scale has its full size; the least size of a scale as a share of that; and
#: width and height of the smallest picture with a scale.
WHOLE_HEIGHT, LEAST_UNIT, LEAST_PICTURE = 1000, 0.62, (400, 240)

#: Width of the panel with the colour scale, in pixels at `WHOLE_HEIGHT`.
SCALE_WIDTH = 190

#: Gains among which `gain_for` chooses.
GAINS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)

#: Ends of the colour scale of differences.
GRAYS = ("000000", "ffffff")


def over(image: Image, background: Color | None) -> Image:
    """Composite an image over a background; return it with alpha 1, or unchanged if the background is None."""
    if background is None:
        return image
    through = 1 - image[..., 3:]
    rgb = image[..., :3] + through * np.asarray(background, np.float32)
    return np.concatenate([rgb, np.ones_like(through)], axis=2)


def eight_bits(image: Image) -> Pixels:
    """Divide the colours of an image by alpha and round to 8 bits; return (H, W, 3) if alpha is 1 everywhere."""
    alpha = image[..., 3:]
    values = image[..., :3]
    if not (alpha == 1).all():
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.concatenate([np.where(alpha > 0, values / alpha, 0), alpha], axis=2)
    codes: Pixels = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return codes


def difference(a: Image, b: Image, gain: float) -> Image:
    """Return an image of alpha 1 with the absolute differences of two images, multiplied by `gain`."""
    amplified = np.clip(gain * apart(a, b), 0, 1)
    return np.concatenate([amplified, np.ones_like(a[..., 3:])], axis=2).astype(np.float32)


def scale_width(width: int, height: int) -> int:
    """Return the pixels that a colour scale adds to the width of a picture; 0 if the picture is too small for one."""
    if width < LEAST_PICTURE[0] or height < LEAST_PICTURE[1]:
        return 0
    return round(SCALE_WIDTH * _unit(width, height))


def _unit(width: int, height: int) -> float:
    return max(LEAST_UNIT, min(height / WHOLE_HEIGHT, width / (1.6 * WHOLE_HEIGHT)))


def with_scale(pixels: Pixels, bar: Coloring) -> Pixels:
    """Add a colour scale at the right of a picture; return a picture that is too small for one unchanged."""
    height, width = pixels.shape[:2]
    wider = scale_width(width, height)
    if not wider:
        return pixels
    panel = np.empty((height, wider, pixels.shape[2]), np.uint8)
    panel[...] = [*bytes.fromhex(BACKGROUND[1:]), 255][: pixels.shape[2]]
    picture = Pillow.fromarray(np.concatenate([pixels, panel], axis=1))
    write_scale(picture, ImageDraw.Draw(picture), _unit(width, height), bar)
    return np.asarray(picture)


def apart(a: Image, b: Image) -> Image:
    """Return (H, W, 3) absolute differences of two images of alpha 1, 0..1."""
    return np.abs(np.clip(a[..., :3], 0, 1) - np.clip(b[..., :3], 0, 1))


def gain_for(differences: Sequence[Image]) -> float:
    """Return the largest of `GAINS` that clips at most 1 % of the differing pixels; 1 if no pixel differs.

    `differences` are arrays of `apart`.
    """
    largest = np.concatenate([each.max(axis=2).ravel() for each in differences])
    differing = largest[largest > 0]
    if not len(differing):
        return GAINS[0]
    most = 1 / float(np.percentile(differing, 99))
    return next((gain for gain in reversed(GAINS) if gain <= most), GAINS[0])


def difference_bar(gain: float) -> Coloring:
    """Return the colour scale of an image of `difference`."""
    from ..render.color_scales import smooth  # most pictures have no scale

    marks = [(0.0, "0"), (0.5, f"{0.5 / gain:.3g}"), (1.0, f"{1 / gain:.3g}" + " or more" * (gain > 1))]
    return smooth("difference", GRAYS, marks, 0, 1 / gain)


def encode(pixels: Pixels, form: str, jpeg_quality: int = JPEG_QUALITY) -> bytes:
    """Encode a picture as "png", lossless "webp" or, without alpha, "jpg"."""
    out = io.BytesIO()
    picture = Pillow.fromarray(pixels)
    if form == "jpg":
        picture.save(out, "JPEG", quality=jpeg_quality, subsampling="4:4:4", optimize=True)
    elif form == "webp":
        picture.save(out, "WEBP", lossless=True, exact=True, method=2)
    else:
        picture.save(out, "PNG", compress_level=PNG_LEVEL)
    return out.getvalue()


def encode_floats(values: NDArray[np.float32]) -> bytes:
    """Encode an array as .npy."""
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()


#: Pixels between and around the pictures of a sheet; height of a caption and of its letters below a picture 720 pixels
#: high.
GAP, CAPTION, LETTERS = 8, 34, 20

#: Width over height that a sheet approximates, of most screens.
ASPECT = 1.6


def grid(count: int, size: tuple[int, int]) -> tuple[int, int]:
    """Return columns and rows for pictures of a size: the grid without an empty row that is closest to `ASPECT`."""
    shapes = [(columns, math.ceil(count / columns)) for columns in range(1, count + 1)]
    return min(shapes, key=lambda shape: abs(math.log(shape[0] * size[0] / (shape[1] * size[1]) / ASPECT)))


def cells(count: int, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the upper left pixel of each picture of a sheet."""
    columns, _ = grid(count, size)
    width, height = size[0] + GAP, size[1] + GAP + _caption_height(size)
    return [(GAP + number % columns * width, GAP + number // columns * height) for number in range(count)]


def sheet(pictures: Sequence[Pixels], captions: Sequence[str]) -> Pixels:
    """Arrange pictures of one size, at least one, on a sheet, with captions cut to the width of a picture.

    The sheet has alpha if any picture has.
    """
    height, width = pictures[0].shape[:2]
    size = (width, height)
    columns, rows = grid(len(pictures), size)
    below = _caption_height(size)
    whole = (columns * (width + GAP) + GAP, rows * (height + GAP + below) + GAP)
    channels = max(picture.shape[2] for picture in pictures)
    image = Pillow.new("RGB" if channels == 3 else "RGBA", whole, BACKGROUND)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=max(12, LETTERS * below / CAPTION))
    places = cells(len(pictures), size)
    for (x, y), caption in zip(places, captions, strict=True):
        draw.text((x, y + height + below / 2), _fitting(caption, width, draw, font), FAINT, font, anchor="lm")
    pixels = np.array(image)
    for (x, y), picture in zip(places, pictures, strict=True):
        pixels[y : y + height, x : x + width, : picture.shape[2]] = picture
    return pixels


def _caption_height(size: tuple[int, int]) -> int:
    return max(18, round(CAPTION * min(1.5, size[1] / 720)))


def _fitting(text: str, width: int, draw: ImageDraw.ImageDraw, font: Font) -> str:
    # A letter is at least a pixel wide, so more letters cannot fit, and measuring them would take long.
    marks = text[: width + 1]
    text = "".join(mark if mark.isprintable() else "\N{REPLACEMENT CHARACTER}" for mark in marks)

    def cut(length: int) -> str:
        return text[:length].rstrip() + "…"

    if draw.textlength(text, font=font) <= width:
        return text
    longest = bisect.bisect_left(
        range(1, len(text)), True, key=lambda length: draw.textlength(cut(length), font=font) > width
    )
    return cut(longest) if longest else ""


#: Unit in ms of the durations in a GIF, and the fewest units that players do not slow down.
GIF_STEP, LEAST_STEPS = 10, 2

#: Longest duration of a frame in ms: 16 bits of hundredths in GIF, 24 bits of ms in WebP, ffmpeg's limit for videos.
LONGEST_FRAME = {"gif": GIF_STEP * 0xFFFF, "webp": 0xFFFFFF, "mp4": 1_000_000, "webm": 1_000_000}

#: Quality of WebP (0 to 100), rate factors of H.264 (51 to 0) and VP9 (63 to 0): losses are hardly visible.
WEBP_QUALITY, H264_QUALITY, VP9_QUALITY = 90, 16, 24

#: Flag for alpha in a WebP header. libwebp omits it where only cropped edges are transparent.
WEBP_ALPHA = 0x10

#: Codec and options of ffmpeg for each kind of video. VP9 honours its rate factor only with a bit rate of 0, and uses
#: several processors only with -row-mt.
VIDEOS = {
    "mp4": ("libx264", ["-crf", str(H264_QUALITY), "-preset", "medium", "-movflags", "+faststart"]),
    "webm": (
        "libvpx-vp9",
        ["-crf", str(VP9_QUALITY), "-b:v", "0", "-deadline", "good", "-cpu-used", "3", "-row-mt", "1"],
    ),
}


def check_animation(form: str, fps: float) -> None:
    """Raise a `SparklodError`, before any frame is drawn, if an animation cannot be written."""
    if form in VIDEOS:
        load_imageio(form)
    longest = LONGEST_FRAME[form] / 1000
    if 1 / fps > longest:
        raise SparklodError(f"a frame of .{form} lasts at most {longest:,.3f} s, not {1 / fps:,.7g} s; raise --fps")


def load_imageio(form: str) -> ModuleType:
    """Import imageio, and check that its ffmpeg is installed; `SparklodError` for the video format if it is not."""
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
    """Encode an endlessly looping animation ("gif", "webp") or a video ("mp4", "webm").

    Consumes frames while it encodes; of a GIF it keeps a byte per pixel of each.

    Args:
        frames: `count` pictures of one size, with alpha for "webp" only.
        fps: frames per second.

    Raises:
        SparklodError: imageio is not installed, ffmpeg fails, or the animation is too large for its format.
    """
    out = io.BytesIO()
    if form in VIDEOS:
        _write_video(out, frames, form, fps)
        return out.getvalue()
    times = _times(fps, count, *((GIF_STEP, LEAST_STEPS) if form == "gif" else (1, 1)))
    try:
        if form == "gif":
            palette = Pillow.Palette.ADAPTIVE
            pictures = (Pillow.fromarray(frame).convert("P", palette=palette, colors=256) for frame in frames)
            next(pictures).save(out, "GIF", save_all=True, append_images=pictures, duration=times, loop=0)
        else:
            film = _lazy_film(frames, count)
            film.save(out, "WEBP", save_all=True, duration=times, loop=0, quality=WEBP_QUALITY, method=4)
    except (OSError, OverflowError, struct.error) as error:
        raise SparklodError(f"the .{form} cannot be written, write .mp4 or fewer frames: {error}") from None
    data = bytearray(out.getvalue())
    if form == "webp" and data[12:16] == b"VP8X" and film.mode == "RGBA":
        data[20] |= WEBP_ALPHA
    return bytes(data)


def _lazy_film(frames: Iterable[Pixels], count: int) -> Pillow.Image:
    """Return a picture that takes the next frame when Pillow seeks it, so that only one frame is in memory."""
    pictures = (Pillow.fromarray(frame) for frame in frames)
    film = next(pictures).copy()

    def seek(frame: int) -> None:
        if frame:
            film.paste(next(pictures))

    vars(film).update(n_frames=count, seek=seek)
    return film


def _times(fps: float, count: int, step: int, least: int) -> list[int]:
    """Return durations of the frames in ms, in whole steps whose sum does not drift from the true time."""
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
            try:
                writer.append_data(np.pad(frame, (*odd, (0, 0)), mode="edge"))
            except OSError as error:  # its text is the whole log of ffmpeg
                raise SparklodError(f"ffmpeg cannot write it: {str(error).strip().splitlines()[-1]}") from None
