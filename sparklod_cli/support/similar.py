"""Suggestions for names that are spelled nearly right."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def near(name: str, known: Iterable[str], *, cutoff: float = 0.6, folder: Path | None = None) -> str:
    """Return the end of an error about an unknown name, ", did you mean ...?"; empty if no known name is similar.

    Args:
        name: the unknown name.
        known: names that exist.
        cutoff: how similar they must be, 0 to 1, as `difflib` measures it.
        folder: of the names, where they are files.
    """
    import difflib  # which takes a millisecond, and is needed after a mistake only

    found = difflib.get_close_matches(name, list(known), n=3, cutoff=cutoff)
    return f", did you mean {' or '.join(str(folder / each) if folder else each for each in found)}?" if found else ""
