"""Bakes that need not be done again, as their output is there: `--skip-existing`.

A file beside the output, NAME.sparklod.json, has the fingerprint of the output, with a digest of all that each input
held, and a digest of each file of the output. Dates only save reading files that nobody has touched since; with
`verify`, all are read.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from ..io.identity import Identity, content_of, files_of, identity_of, stamp_of
from ..io.writing import check_writable, sink
from ..system.addresses import Address, Place, size_of
from ..system.errors import OutputError, UnreadableError
from ..system.untrusted import parse_json
from .fingerprint import Fingerprint, files_named_in, settings_of
from .flow import bake, has_published
from .records import Baked
from .settings import BakeSettings, Resources
from .sources import Source, placement_of, places_of

#: Suffix of the file beside an output, and the most bytes of it that are read.
SUFFIX, MAX_BYTES = ".sparklod.json", 1 << 24


def bake_unless_there(
    source: Source, target: Place, settings: BakeSettings, *, verify: bool = False, overwrite: bool = False, **how: Any
) -> Baked | None:
    """Bake as `bake` does, and notes of what; None where the output of the same fingerprint is there.

    Args:
        verify: read all of the inputs and of the output, also where size and date are those of the last bake.

    Raises:
        OutputError: the output is there and of another recipe, and `overwrite` is not set.
        SparklodError: as `bake`.
    """
    note_path = target.parent / f"{target.name}{SUFFIX}"
    former = _former(note_path)
    if not target.exists():
        check_writable(target, overwrite=overwrite)  # before all inputs are read
    files = [*(file for place in places_of(source) for file in files_of(place)), *files_named_in(settings)]
    seen = [identity_of(file) for file in files]
    fingerprint = _fingerprint(source, settings, files, seen, {} if verify else former)
    if (
        target.exists()
        and not target.is_dir()
        and not has_published(source, target, settings, how.get("resources") or Resources())
    ):
        differences = _differences(fingerprint, target, former, verify=verify)
        if not differences:
            return None
        if not overwrite:
            raise OutputError(f"{target} is there, but {'; '.join(differences)}; add --overwrite to bake it anew")
    write_note = sink(note_path, overwrite=True)
    _remove(note_path)  # so that it never stands beside an output that it does not tell of
    baked = bake(source, target, settings, overwrite=overwrite, **how)
    if baked.refine is not None and not baked.refine.is_complete:
        return baked  # another run would get farther
    inputs = [dataclasses.asdict(each) for each in seen]
    note = {
        "recipe": dataclasses.asdict(fingerprint),
        "inputs": inputs,
        "output": {_within(target, file): _record_of(file) for file in files_of(target)},
    }
    write_note([json.dumps(note, indent=1).encode() + b"\n"])
    return baked


def _former(note_path: Place) -> dict[str, Any]:
    """Return what the file beside an output says; empty where there is none that can be understood."""
    try:
        if size_of(note_path) > MAX_BYTES:
            return {}
        with note_path.open("rb") as file:
            found = parse_json(file.read())
        return {
            "recipe": Fingerprint.from_record(found["recipe"]),
            "inputs": [Identity(**each) for each in found["inputs"]],
            "output": dict(found["output"]),
        }
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _fingerprint(
    source: Source, settings: BakeSettings, files: list[Place], seen: list[Identity], former: dict[str, Any]
) -> Fingerprint:
    """Return the fingerprint of an output; inputs that are as they were last time are not read again."""
    known = {}
    if former and len(former["recipe"].inputs) == len(former["inputs"]):
        known = dict(zip(former["inputs"], former["recipe"].inputs, strict=True))
    inputs = tuple(known.get(each) or content_of(file) for file, each in zip(files, seen, strict=True))
    return Fingerprint(inputs, tuple(each.name for each in seen), settings_of(settings) | placement_of(source))


def _differences(fingerprint: Fingerprint, target: Place, former: dict[str, Any], *, verify: bool) -> list[str]:
    """Return why an output that is there is not that of a recipe; empty where it is."""
    if not former:
        return ["nothing tells of what it was made"]
    found = fingerprint.differences(former["recipe"])
    if found:
        return found
    files, records = {_within(target, file): file for file in files_of(target)}, former["output"]
    names = sorted({*files, *records})
    changed = (name for name in names if not _is_same(files.get(name), records.get(name), verify=verify))
    return [f"{name} was changed since it was baked" for name in changed]


def _record_of(file: Place) -> dict[str, str]:
    """Return size and date of a file of an output, and a digest of all of it; at an address, its version."""
    stamp = stamp_of(file)
    return {"stamp": stamp, "content": stamp if isinstance(file, Address) else content_of(file)}


def _is_same(file: Place | None, record: Any, *, verify: bool) -> bool:
    """Return True if a file of an output is the one of a record; it is read where size or date differ, or to verify."""
    if file is None or not isinstance(record, dict):
        return False
    try:
        if not verify and record.get("stamp") == stamp_of(file):
            return True
        return bool(record.get("content") == _record_of(file)["content"])
    except UnreadableError:
        return False


def _within(target: Place, file: Place) -> str:
    """Return the name of a file of an output, with the folder that it has beside it."""
    if isinstance(target, Path) and isinstance(file, Path) and file.is_relative_to(target.parent):
        return file.relative_to(target.parent).as_posix()
    return file.name


def _remove(place: Place) -> None:
    try:
        place.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot replace {place}: {(error.strerror or str(error)).lower()}") from None
