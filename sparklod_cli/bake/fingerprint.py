"""Fingerprint of an output: its inputs, the settings and the version of the program."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import __version__
from ..cameras.formats.table import NAMES
from ..io.identity import Identity, files_of, identity_of
from ..system.addresses import Place
from ..system.errors import UnreadableError
from ..system.untrusted import quoted_value
from .settings import BakeSettings
from .sources import Source, placement_of, places_of

#: Settings that name a file whose content is one of the inputs.
FILES = ("rgba", "environment", "camera_path")

#: Settings that are no part of a fingerprint: a message, what is neither skipped nor resumed, and files whose names do
#: not matter.
NO_PART = ("unused", "simplify", *FILES)

#: How the version of the program is called in a fingerprint.
PROGRAM = "sparklod"


@dataclass(frozen=True)
class Fingerprint:
    """Fingerprint of inputs and settings, which determine the bytes of an output.

    Attributes:
        inputs: what tells the content of each file, in the order in which they are read.
        names: of these files, which are no part of what is compared.
        settings: numbers, texts and lists by name, as "selection.min_opacity"; the version of the program, too.
    """

    inputs: tuple[str, ...]
    names: tuple[str, ...]
    settings: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """32 characters that no other fingerprint has."""
        whole = json.dumps([self.inputs, self.settings], sort_keys=True)
        return hashlib.blake2b(whole.encode(), digest_size=16).hexdigest()

    def differences(self, former: Fingerprint) -> list[str]:
        """Return in what it differs from a former one, in words; empty where it does not."""
        found = []
        if len(self.inputs) != len(former.inputs):
            found.append(f"it had {len(former.inputs)} input files and has {len(self.inputs)}")
        elif self.inputs != former.inputs:
            changed = (name for name, a, b in zip(self.names, self.inputs, former.inputs, strict=True) if a != b)
            found.append(f"{', '.join(changed)} changed since")
        for name in sorted({*self.settings, *former.settings}):
            before, now = former.settings.get(name), self.settings.get(name)
            if before != now:
                found.append(f"{name} was {quoted_value(before)} and is {quoted_value(now)}")
        return found

    def to_json(self) -> bytes:
        """Return the text of which `from_record` makes it again, parsed."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True).encode()

    @classmethod
    def from_record(cls, record: Any) -> Fingerprint:
        """Return the fingerprint of its fields by name; raise `ValueError` where the values are of none."""
        try:
            return cls(tuple(record["inputs"]), tuple(record["names"]), dict(record["settings"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"it is no fingerprint: {error!r}") from None


def source_fingerprint(source: Source, settings: BakeSettings) -> Fingerprint:
    """Return the fingerprint of a bake that may go on later; size, time and a sample of its bytes tell a file.

    Args:
        source: the input; - is standard input.

    Raises:
        UnreadableError: an input cannot be read.
    """
    seen = [identity_of(file) for place in places_of(source) for file in files_of(place)]
    seen += map(_identity_of_named, files_named_in(settings))
    inputs = tuple(f"{each.bytes} {each.modified} {each.sample}" for each in seen)
    return Fingerprint(inputs, tuple(each.name for each in seen), settings_of(settings) | placement_of(source))


def files_named_in(settings: BakeSettings) -> list[Place]:
    """Return the files that settings name, and those that belong to these."""
    sets = {"camera_path": NAMES}
    return [file for name, path in settings.files.items() for file in files_of(path, sets.get(name, ()))]


def _identity_of_named(file: Place) -> Identity:
    """Return what a file is like; an error names it, as it is none of the inputs."""
    try:
        return identity_of(file)
    except UnreadableError as error:
        raise UnreadableError(f"{file} {error}") from None


def settings_of(settings: BakeSettings) -> dict[str, Any]:
    """Return settings as a fingerprint has them."""
    values = {name: value for name, value in _flat("", settings) if name not in NO_PART}
    return {PROGRAM: __version__, **values}


def _flat(name: str, value: Any) -> Iterable[tuple[str, Any]]:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _flat(f"{name}.{field.name}" if name else field.name, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield name, value.tolist()
    else:
        yield name, json.loads(json.dumps(value, default=str))
