"""Inputs of a bake: a file, or several that are merged into one scene."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..codecs.reader import Reader
from ..io import PlacedFile, open_reader, open_readers
from ..model.instances import Instance
from ..model.transforms import Transform
from ..system.addresses import Place, absolute
from ..system.units import count_of


@dataclass(frozen=True, eq=False)
class Merged:
    """Several files, with where each stands, that are one scene; one may be named more than once."""

    files: tuple[PlacedFile, ...]

    @classmethod
    def of(cls, places: Sequence[Place]) -> Merged:
        """Return files where their own coordinates put them."""
        return cls(tuple(PlacedFile(place) for place in places))

    @classmethod
    def of_instances(cls, instances: Sequence[Instance]) -> Merged:
        """Return the files of instances, where these stand."""
        return cls(tuple(PlacedFile(each.file, each.transform) for each in instances if each.file is not None))

    def __str__(self) -> str:
        return count_of(len(self.files), "file")


#: A file, which may be standard input (-), or several.
Source = Place | Merged


def places_of(source: Source) -> list[Place]:
    """Return the files of a source, in order."""
    return [each.file for each in source.files] if isinstance(source, Merged) else [source]


def absolute_source(source: Source) -> Source:
    """Return the same source for processes whose working folders are others."""
    if not isinstance(source, Merged):
        return absolute(source)
    return Merged(tuple(dataclasses.replace(each, file=absolute(each.file)) for each in source.files))


def placement_of(source: Source) -> dict[str, Any]:
    """Return where the files of a source stand, as a recipe has it; nothing for a single file."""
    if not isinstance(source, Merged):
        return {}
    return {"merged": [_numbers(each.transform) for each in source.files]}


def _numbers(transform: Transform) -> list[float]:
    """Return the rotation row by row, the scale, the translation."""
    return [float(each) for each in (*transform.rotation.flat, transform.scale, *transform.translation)]


def open_source(
    source: Source, *, scratch: Path | None = None, threads: int = 1
) -> contextlib.AbstractContextManager[Reader]:
    """Return the context in which a source is open; see `io.open_reader`, or `io.open_readers` of several files."""
    if isinstance(source, Merged):
        return open_readers(source.files, scratch=scratch, threads=threads)
    return open_reader(source, scratch=scratch, threads=threads)
