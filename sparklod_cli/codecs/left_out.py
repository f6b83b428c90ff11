"""Reader's notes on a scene, such as those that name the data of a file that the reader leaves out."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from ..system.printable import printable

#: Names, or families of them, in a note, and characters of each at most: the file chooses both. Chosen.
MOST_NAMED, MOST_NAME = 8, 40

#: Properties that say nothing of a splat: normals, colours for viewers of point clouds, the state of an editor.
HARMLESS = {"nx", "ny", "nz", "normal_x", "normal_y", "normal_z", "normals", "red", "green", "blue", "alpha", "state"}

#: Members of a family, names that count up, from which its first and last name stand for all.
FAMILY = 3

#: A name with a number at its end, of few enough digits to count with.
_COUNTED = re.compile(r"(.*?)(0|[1-9][0-9]{0,8})", re.DOTALL)


class Note(str):
    """A note on a scene, with the code of the finding that `inspect` makes of it; None for no finding.

    A plain text is a note on data that the reader leaves out.
    """

    code: str | None

    def __new__(cls, text: str, code: str | None = None) -> Note:
        note = super().__new__(cls, text)
        note.code = code
        return note


def code_of(note: str) -> str | None:
    """Return the code of the finding that a note is; None for no finding."""
    return note.code if isinstance(note, Note) else "container.left-out"


def left_out(noun: str, plural: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the note that names data, such as "its properties label and motion_0 to motion_8 are left out".

    Args:
        noun, plural: what the names are of.
        names: in any order; without any there is no note.
    """
    every = sorted(set(names), key=_counted)
    if not every:
        return ()
    shown = list(_families(every))
    more = len(shown) - MOST_NAMED
    shown = [*shown[:MOST_NAMED], f"{more:,} more"] if more > 0 else shown
    text = " and ".join(filter(None, (", ".join(shown[:-1]), shown[-1])))
    return (f"its {noun} {text} is left out" if len(every) == 1 else f"its {plural} {text} are left out",)


def _families(names: list[str]) -> Iterator[str]:
    """Yield the names, and the first and the last of runs of names that count up one by one."""
    run: list[str] = []
    for name in [*names, ""]:  # which ends the last run
        start, number = _counted(name)
        if run and number >= 0 and _counted(run[-1]) == (start, number - 1):
            run.append(name)
            continue
        ends = [printable(each, MOST_NAME) for each in run]
        yield from ends if len(run) < FAMILY else [f"{ends[0]} to {ends[-1]}"]
        run = [name]


def _counted(name: str) -> tuple[str, int]:
    """Return a name without the number at its end, and that number; -1 for none."""
    match = _COUNTED.fullmatch(name)
    return (match[1], int(match[2])) if match else (name, -1)
