"""TUM trajectories of SLAM benchmarks and evo: one pose per line, `timestamp tx ty tz qx qy qz qw`."""

from __future__ import annotations

from collections.abc import Iterator

from ...system.errors import CameraPathError
from ..frame import Frame, Settings
from .source import Files, Parsed, finite, posed

COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def recognises(files: Files) -> bool:
    """Return whether its first line that is not a comment has eight numbers."""
    words = next(_rows((files.text or "").splitlines()), (0, []))[1]
    try:
        return len([float(word) for word in words]) == len(COLUMNS)
    except ValueError:
        return False


def parse(files: Files, settings: Settings) -> Parsed:
    """Return its poses, one per line."""
    return Parsed([_frame(words, f"line {number}") for number, words in _rows(files.lines())])


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield number, words


def _frame(words: list[str], way: str) -> Frame:
    if len(words) != len(COLUMNS):
        raise CameraPathError(f"{way} has {len(words)} values, not {' '.join(COLUMNS)}")
    time, *position, x, y, z, w = (finite(word, f"{name} of {way}") for name, word in zip(COLUMNS, words, strict=True))
    return Frame(posed([w, x, y, z], position, way), time=time)
