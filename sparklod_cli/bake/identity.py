"""Identity of a bake: its inputs and settings, which determine the bytes of its output.

Bakes with `--skip-existing` or `--resume` compare it with that of an earlier bake.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import __version__
from ..cameras.camera_formats import NAMES
from ..io.files import companions, file_of, readable
from ..io.reading import Merged, Source, places_of
from ..model.transforms import Transform
from ..system.addresses import Address, Place
from ..system.errors import UnreadableError
from ..system.stdio import DASH, name_of
from ..system.untrusted import quoted_value
from .settings import BakeSettings

#: Settings outside of an identity: `files` are inputs, and the others occur in no bake that is skipped or resumed.
NO_PART = ("unused", "simplify", "rgba", "environment", "camera_path")

#: Name of the version of the program among the settings of an identity.
PROGRAM = "sparklod"

#: Samples of a file, and bytes of each: 4 MB of a large file, which takes milliseconds. Chosen.
SAMPLES, SAMPLE_BYTES = 64, 1 << 16

_READ_BYTES = 1 << 22


@dataclass(frozen=True)
class FileState:
    """State of an input file.

    Attributes:
        modified: nanoseconds since 1970; 0 for standard input and at an address.
        sample: digest of bytes from all over the file; at an address, of its version.
        content: digest of all bytes; empty if it was not computed.
    """

    name: str
    bytes: int
    modified: int
    sample: str
    content: str = ""

    @classmethod
    def of(cls, path: Place) -> FileState:
        """Examine a file by a sample of its bytes; raise `UnreadableError` if it cannot be read."""
        digest = _digest()
        if isinstance(path, Address):
            with readable():
                digest.update(path.version().encode())
                return cls(str(path), path.size(), 0, digest.hexdigest())
        with readable(), file_of(path) as file:
            size = file.seek(0, os.SEEK_END)
            last = max(0, size - SAMPLE_BYTES)
            for start in sorted({last * place // (SAMPLES - 1) for place in range(SAMPLES)}):
                file.seek(start)
                digest.update(file.read(SAMPLE_BYTES))
            modified = 0 if path == DASH else os.fstat(file.fileno()).st_mtime_ns
        return cls(name_of(path), size, modified, digest.hexdigest())

    @property
    def key(self) -> str:
        """Text that identifies the contents of the file."""
        return self.content or f"{self.bytes} {self.modified} {self.sample}"


@dataclass(frozen=True)
class BakeIdentity:
    """Inputs and settings of a bake.

    Attributes:
        inputs: in the order of reading; their names do not matter.
        settings: by name, as "selection.min_opacity", and the version of the program.
    """

    inputs: tuple[FileState, ...]
    settings: Mapping[str, Any]

    @classmethod
    def of(
        cls, source: Source, settings: BakeSettings, *, whole: bool = False, former: BakeIdentity | None = None
    ) -> BakeIdentity:
        """Examine the inputs of a bake; raise `UnreadableError` if one cannot be read.

        Args:
            whole: read all of each input for a digest of its content.
            former: earlier identity, whose digests are kept for inputs of the same size, date and sample.
        """
        known = {} if former is None else {dataclasses.replace(each, content=""): each for each in former.inputs}
        files = [(file, "") for place in places_of(source) for file in files_of(place)]
        for setting, place in settings.files.items():
            files += [(file, f"{file} ") for file in files_of(place, NAMES if setting == "camera_path" else ())]
        states = []
        for file, name in files:
            try:
                state = FileState.of(file)
                if whole:
                    held = known.get(state, state)
                    state = dataclasses.replace(state, content=held.content or content_of(file))
            except UnreadableError as error:  # the caller names the source
                raise UnreadableError(f"{name}{error}") from None
            states.append(state)
        settings = dataclasses.replace(settings, transform=settings.transform or Transform())
        values = {name: value for name, value in _flat("", settings) if name not in NO_PART}
        if isinstance(source, Merged):  # the rotation of each file row by row, its scale, its translation
            numbers = ((*each.rotation.flat, each.scale, *each.translation) for _, each in source.files)
            values["merged"] = [[*map(float, each)] for each in numbers]
        return cls(tuple(states), {PROGRAM: __version__, **values})

    @classmethod
    def from_record(cls, record: Any) -> BakeIdentity:
        """Read an identity from the result of `dataclasses.asdict`; raise `ValueError` for any other value."""
        try:
            return cls(tuple(FileState(**each) for each in record["inputs"]), dict(record["settings"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"not the identity of a bake: {error!r}") from None

    @property
    def digest(self) -> str:
        """Digest of the identity, 32 characters."""
        digest = _digest()
        digest.update(json.dumps([[each.key for each in self.inputs], self.settings], sort_keys=True).encode())
        return digest.hexdigest()

    def differences(self, former: BakeIdentity) -> list[str]:
        """Describe the differences from a former identity; empty without any."""
        found = []
        if len(self.inputs) != len(former.inputs):
            found.append(f"it had {len(former.inputs)} input files and has {len(self.inputs)}")
        elif changed := [a.name for a, b in zip(self.inputs, former.inputs, strict=True) if a.key != b.key]:
            found.append(f"{', '.join(changed)} changed since")
        for name in sorted({*self.settings, *former.settings}):
            before, now = former.settings.get(name), self.settings.get(name)
            if before != now:
                found.append(f"{name} was {quoted_value(before)} and is {quoted_value(now)}")
        return found


def files_of(path: Place, sets: Collection[Collection[str]] = ()) -> list[Place]:
    """Return a file and the files that it names, or the files of a folder such as an unpacked or a Streamed SOG.

    Args:
        sets: names of files that belong together, as for `read_together`.
    """
    if path == DASH or isinstance(path, Address):
        return [path]
    found = companions(path, sets)
    return [*found] if path.is_dir() else [path, *(file for file in found if file != path)]


def content_of(path: Place) -> str:
    """Compute the digest of all bytes of a file, about 0.5 GB a second."""
    digest = _digest()
    with readable(), file_of(path) as file:
        while piece := file.read(_READ_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def _digest() -> hashlib.blake2b:
    return hashlib.blake2b(digest_size=16)


def _flat(name: str, value: Any) -> Iterable[tuple[str, Any]]:
    """Yield nested settings with their names, as "selection.min_opacity", and values for JSON."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _flat(f"{name}.{field.name}" if name else field.name, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield name, value.tolist()
    else:
        yield name, json.loads(json.dumps(value, default=str))
