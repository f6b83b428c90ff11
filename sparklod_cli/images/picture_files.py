"""Formats of pictures, and their destination: a file, a file per frame, an animation or a contact sheet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..system.output import check_writable

#: Quantities by which `inspect` can colour a picture.
PLOT_BY = ("level", "opacity", "size", "chunk")

#: Formats of single pictures, of animations, and of contact sheets.
STILL = ("png", "jpg", "webp", "npy")
MOVING = ("webp", "gif", "mp4", "webm")
SHEETS = ("png", "jpg", "webp")

#: Formats by suffix, where the two differ.
SUFFIXES = {"jpeg": "jpg"}

#: Quality of JPEG, 1 to 100: losses are hardly visible.
JPEG_QUALITY = 92

#: Width and height of a thumbnail in pixels, and its supersampling factor.
THUMBNAIL_SIZE, THUMBNAIL_SUPERSAMPLE = (512, 512), 2

#: Formats with an alpha channel.
WITH_ALPHA = ("png", "webp", "npy")

#: The placeholder for the frame number in a file name.
NUMBER = re.compile(r"%(?:0\d{1,2})?d")


@dataclass(frozen=True)
class PictureOutput:
    """The destination of pictures.

    Attributes:
        name: path of the file, or of a file per frame with a placeholder for its number; None for standard output.
        form: the format, one of `STILL` or `MOVING`.
        kind: "picture", "frames", "animation" or "sheet".
    """

    name: Path | None
    form: str
    kind: str

    def paths(self, numbers: Sequence[int]) -> list[Path]:
        """Return the files of numbered frames: one file if they share it, none for standard output."""
        if self.name is None or self.kind != "frames":
            return [] if self.name is None else [self.name]
        before, place, after = re.split(f"({NUMBER.pattern})", self.name.name)
        return [self.name.with_name(f"{before}{place % number}{after}") for number in numbers]

    def check(self, numbers: Sequence[int], *, overwrite: bool) -> None:
        """Raise an `OutputError` if files of these frames exist and `overwrite` is not set, or cannot be written."""
        for path in self.paths(numbers):
            check_writable(path, overwrite=overwrite, tried=False)
        for path in self.paths([0]):
            check_writable(path, overwrite=True)


def output_for(name: Path | None, default: Path, cameras: int, *, sheet: bool) -> PictureOutput:
    """Return the destination of the pictures of some cameras; `ValueError` if the name does not fit their number.

    `name` is the requested path; "-" for standard output; None for a path derived from `default`, which has no suffix.
    """
    several = cameras > 1 and not sheet
    if name is not None and str(name) == "-":
        if several:
            raise ValueError(f"standard output takes one picture, not {cameras:,}; name a file with --output")
        return PictureOutput(None, "png", "sheet" if sheet else "picture")
    if name is None:
        name = default.with_name(f"{default.name.replace('%', '_')}{'.%04d' if several else ''}.png")
    form = name.suffix.lower().removeprefix(".")
    form = SUFFIXES.get(form, form)
    if form not in STILL + MOVING:
        raise ValueError(f"--output {name} does not end in {_suffixes(dict.fromkeys(STILL + MOVING))}")
    places = len(NUMBER.findall(name.name))
    if sheet:
        if form not in SHEETS or places:
            raise ValueError(f"a contact sheet is one {_suffixes(SHEETS)}, which --output {name} is not")
        return PictureOutput(name, form, "sheet")
    if places:
        if places > 1 or form not in STILL:
            stills = _suffixes(STILL, "out.%04d")
            raise ValueError(f"--output {name} does not name frames; write {stills}")
        return PictureOutput(name, form, "frames")
    if form not in STILL or (several and form in MOVING):
        return PictureOutput(name, form, "animation")
    if several:
        raise ValueError(
            f"--output {name} is one picture, and there are {cameras:,} cameras: write frames"
            f" ({name.stem}.%04d{name.suffix}), an animation ({_suffixes(MOVING)}) or a --sheet"
        )
    return PictureOutput(name, form, "picture")


def _suffixes(forms: Sequence[str] | dict[str, None], stem: str = "") -> str:
    *some, last = (f"{stem}.{form}" for form in forms)
    return f"{', '.join(some)} or {last}"
