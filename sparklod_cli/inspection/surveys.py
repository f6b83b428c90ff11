"""`Head`, what the headers of a file tell before any splat of it is read."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Head:
    """What a report begins with.

    Attributes:
        format: name for display.
        bytes: of all files together.
        splats: as reading it gives; nodes of a tree.
        sh_degree, antialiased, up: of the splats.
    """

    format: str
    bytes: int
    splats: int
    sh_degree: int
    antialiased: bool
    up: str | None
