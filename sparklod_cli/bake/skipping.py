"""Bakes that need not be done again, as their output is there: `--skip-existing`.

A file beside the output, NAME.sparklod.json, has the recipe of the output, with a digest of all that each input held,
and what tells the output. The dates of files only save reading inputs that nobody has touched since.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from ..io import Identity, content_of, files_of, identity_of, sink
from ..support.addresses import Place, size_of
from ..support.errors import OutputError
from ..support.untrusted import parse_json
from .baking import Baked, bake
from .recipe import Recipe, files_named_in, settings_of
from .settings import BakeSettings
from .sources import Source, placement_of, places_of

#: Suffix of the file beside an output, and the most bytes of it that are read.
SUFFIX, MAX_BYTES = ".sparklod.json", 1 << 24


def bake_unless_there(
    source: Source, target: Place, settings: BakeSettings, *, overwrite: bool = False, **how: Any
) -> Baked | None:
    """Bakes as `bake` does, and notes of what; None where the output of the same recipe is there.

    Args:
        source, target, settings, overwrite: as for `bake`; the output is no standard output.
        how: further arguments of `bake`.

    Raises:
        OutputError: the output is there and of another recipe, and `overwrite` is not set.
        SparklodError: as `bake`.
    """
    beside = target.parent / f"{target.name}{SUFFIX}"
    former = _former(beside)
    files = [*(file for place in places_of(source) for file in files_of(place)), *files_named_in(settings)]
    seen = [identity_of(file) for file in files]
    recipe = _recipe(source, settings, files, seen, former)
    if target.exists() and not target.is_dir():
        differences = _differences(recipe, target, former)
        if not differences:
            return None
        if not overwrite:
            raise OutputError(f"{target} is there, but {'; '.join(differences)}; add --overwrite to bake it anew")
    _remove(beside)  # so that it never stands beside an output that it does not tell of
    baked = bake(source, target, settings, overwrite=overwrite, **how)
    if baked.refine is not None and not baked.refine.is_complete:
        return baked  # another run would get farther
    inputs = [dataclasses.asdict(each) for each in seen]
    note = {"recipe": recipe.to_record(), "inputs": inputs, "output": _told(target)}
    sink(beside, overwrite=True)([json.dumps(note, indent=1).encode() + b"\n"])
    return baked


def _former(beside: Place) -> dict[str, Any]:
    """What the file beside an output says; empty where there is none that can be understood."""
    try:
        if size_of(beside) > MAX_BYTES:
            return {}
        with beside.open("rb") as file:
            found = parse_json(file.read())
        return {
            "recipe": Recipe.from_record(found["recipe"]),
            "inputs": [Identity(**each) for each in found["inputs"]],
            "output": dict(found["output"]),
        }
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _recipe(
    source: Source, settings: BakeSettings, files: list[Place], seen: list[Identity], former: dict[str, Any]
) -> Recipe:
    """The recipe of an output; inputs that are as they were last time are not read again."""
    known = {}
    if former and len(former["recipe"].inputs) == len(former["inputs"]):
        known = dict(zip(former["inputs"], former["recipe"].inputs, strict=True))
    inputs = tuple(known.get(each) or content_of(file) for file, each in zip(files, seen, strict=True))
    return Recipe(inputs, tuple(each.name for each in seen), settings_of(settings) | placement_of(source))


def _differences(recipe: Recipe, target: Place, former: dict[str, Any]) -> list[str]:
    """Why an output that is there is not that of a recipe; empty where it is."""
    if not former:
        return ["nothing tells of what it was made"]
    found = recipe.differences(former["recipe"])
    if not found and former["output"] != _told(target):
        found = ["it was changed since it was baked"]
    return found


def _told(target: Place) -> dict[str, Any]:
    """What tells an output: a digest of a sample of it, and the size of each file that it names."""
    files = files_of(target)
    return {"sample": identity_of(target).sample, "bytes": {_within(target, file): size_of(file) for file in files}}


def _within(target: Place, file: Place) -> str:
    """The name of a file of an output, with the folder that it has beside it."""
    if isinstance(target, Path) and isinstance(file, Path) and file.is_relative_to(target.parent):
        return file.relative_to(target.parent).as_posix()
    return file.name


def _remove(place: Place) -> None:
    try:
        place.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot replace {place}: {(error.strerror or str(error)).lower()}") from None
