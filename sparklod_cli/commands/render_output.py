"""Where the pictures of `sparklod render` go, and as what."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from ..io import check_writable

#: Forms of single pictures, and of several in one file.
STILL, MOVING = ("png", "webp", "npy"), ("webp", "gif", "mp4")

#: What the number of a frame stands for in a name.
NUMBER = re.compile(r"%(?:0\d{1,2})?d")


@dataclass(frozen=True)
class Output:
    """Where pictures go.

    Attributes:
        name: of the file; of many, with a place for the number; None for standard output.
        form: one of `STILL` or `MOVING`.
        kind: "picture", "frames", "animation" or "sheet".
    """

    name: Path | None
    form: str
    kind: str

    def path(self, number: int = 0) -> Path:
        """Of the file, or of that of a frame."""
        assert self.name is not None
        if self.kind != "frames":
            return self.name
        return self.name.with_name(NUMBER.sub(lambda match: match[0] % number, self.name.name))

    def paths(self, numbers: Sequence[int]) -> list[Path]:
        """Of all files that will be written."""
        if self.name is None:
            return []
        return [self.path(number) for number in (numbers if self.kind == "frames" else [0])]

    def check(self, numbers: Sequence[int], *, overwrite: bool) -> None:
        """Raises an `OutputError` where one cannot be written, before work goes into it."""
        for path in self.paths(numbers):
            check_writable(path, overwrite=overwrite)


def output_for(name: Path | None, default: str, cameras: int, *, sheet: bool) -> Output:
    """Where the pictures of some cameras go.

    Args:
        name: that was asked for; None for one made of `default`, in the current directory.
        default: the name of the scene.
        cameras: how many there are.
        sheet: all in one picture.

    Raises:
        click.UsageError: they do not fit into what was asked for.
    """
    several = cameras > 1 and not sheet
    if name is not None and str(name) == "-":
        if several:
            raise click.UsageError(f"standard output takes one picture, not {cameras:,}; see --output")
        return Output(None, "png", "sheet" if sheet else "picture")
    if name is None:
        name = Path(f"{default.replace('%', '_')}{'.%04d' if several else ''}.png")
    form = name.suffix.lower().removeprefix(".")
    if form not in STILL + MOVING:
        known = ", ".join(f".{each}" for each in dict.fromkeys(STILL + MOVING))
        raise click.UsageError(f"--output {name} is none of {known}")
    places = len(NUMBER.findall(name.name))
    if sheet:
        if form not in ("png", "webp") or places:
            raise click.UsageError(f"a contact sheet is one .png or .webp, which --output {name} is not")
        return Output(name, form, "sheet")
    if places:
        if places > 1 or form not in STILL:
            raise click.UsageError(f"--output {name} does not name frames, as out.%04d.png, .webp or .npy would")
        return Output(name, form, "frames")
    if form in ("gif", "mp4") or (several and form in MOVING):
        return Output(name, form, "animation")
    if several:
        raise click.UsageError(
            f"--output {name} is one picture and there are {cameras:,} cameras: write frames"
            f" ({name.stem}.%04d{name.suffix}), an animation (.mp4, .gif, .webp) or a --sheet"
        )
    return Output(name, form, "picture")
