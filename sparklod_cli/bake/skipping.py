"""Bakes that are skipped because their output exists: `--skip-existing`.

A file beside the output, NAME.sparklod.json, records the identity of the bake, with a digest of each input, and a
digest of each output file. Files of the same size and date are not read again, except with `verify`.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from ..io.files import readable
from ..io.reading import Source
from ..system.addresses import Address, Place, size_of
from ..system.errors import OutputError, UnreadableError, reason_of
from ..system.output import Output, check_writable
from ..system.untrusted import parse_json
from .flow import bake, has_published
from .identity import BakeIdentity, content_of, files_of
from .settings import Baked, BakeSettings, Resources

#: Suffix and largest size of the file beside an output.
SUFFIX, MAX_BYTES = ".sparklod.json", 1 << 24


def bake_unless_there(
    source: Source, target: Place, settings: BakeSettings, *, verify: bool = False, overwrite: bool = False, **how: Any
) -> Baked | None:
    """Bake as `bake` does, and record the identity of the bake; return None if its output exists already.

    Args:
        verify: read all inputs and output files even if their sizes and dates are those of the last bake.

    Raises:
        OutputError: the output exists and was made from other inputs or settings, and `overwrite` is not set.
        SparklodError: as `bake`.
    """
    note_path = target.parent / f"{target.name}{SUFFIX}"
    former, output = _read_note(note_path)
    if not target.exists():
        check_writable(target, overwrite=overwrite)  # before reading all inputs
    identity = BakeIdentity.of(source, settings, whole=True, former=None if verify else former)
    resources = how.get("resources") or Resources()
    is_resumed = resources.resume and has_published(source, target, settings, resources)
    if target.exists() and not target.is_dir() and not is_resumed:
        if former is None:
            differences = ["there is no record of its inputs and settings"]
        else:
            differences = identity.differences(former) or _changed_files(target, output, verify=verify)
        if not differences:
            return None
        if not overwrite:
            raise OutputError(f"{target} exists, but {'; '.join(differences)}; add --overwrite to bake it again")
    note_output = Output(note_path, overwrite=True)
    try:
        note_path.unlink(missing_ok=True)  # so that it is never beside an output of another bake
    except OSError as error:
        raise OutputError(f"cannot replace {note_path}: {reason_of(error)}") from None
    baked = bake(source, target, settings, overwrite=overwrite, **how)
    if baked.refine is None or baked.refine.is_complete:  # otherwise another run improves it further
        files = {_within(target, file): _record_of(file) for file in files_of(target)}
        note = {"bake": dataclasses.asdict(identity), "output": files}
        with note_output:
            note_output.write(note_path.name, [json.dumps(note, indent=1).encode() + b"\n"])
    return baked


def _read_note(path: Place) -> tuple[BakeIdentity | None, dict[str, Any]]:
    """Read the identity of a bake, None if missing or invalid, and the records of its output files."""
    try:
        if size_of(path) <= MAX_BYTES:
            with path.open("rb") as file:
                note = parse_json(file.read())
            return BakeIdentity.from_record(note["bake"]), dict(note["output"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None, {}


def _changed_files(target: Place, records: dict[str, Any], *, verify: bool) -> list[str]:
    """Describe each file that was added, removed or changed since the bake recorded it."""
    files = {_within(target, file): file for file in files_of(target)}

    def is_same(name: str) -> bool:
        file, record = files.get(name), records.get(name)
        if file is None or not isinstance(record, dict):
            return False
        try:
            is_untouched = not verify and record.get("stamp") == _stamp_of(file)
            return is_untouched or bool(record.get("content") == _record_of(file)["content"])
        except UnreadableError:
            return False

    return [f"{name} was changed since it was baked" for name in sorted({*files, *records}) if not is_same(name)]


def _record_of(file: Place) -> dict[str, str]:
    stamp = _stamp_of(file)
    return {"stamp": stamp, "content": stamp if isinstance(file, Address) else content_of(file)}


def _stamp_of(file: Place) -> str:
    """Return size and date of a file, or the version at an address; both change when the file is written."""
    with readable():
        if isinstance(file, Address):
            return file.version()
        status = file.stat()
        return f"{status.st_size} {status.st_mtime_ns}"


def _within(target: Place, file: Place) -> str:
    """Return the path of an output file within the folder of the output."""
    if isinstance(target, Path) and isinstance(file, Path) and file.is_relative_to(target.parent):
        return file.relative_to(target.parent).as_posix()
    return file.name
