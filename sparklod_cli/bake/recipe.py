"""What an output is made of: its inputs, the settings and the version of the program."""

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
from ..io import Identity, files_of, identity_of
from ..support.addresses import Place
from ..support.errors import UnreadableError
from ..support.untrusted import parse_json, quoted_value
from .settings import BakeSettings

#: Settings that name a file whose content is one of the inputs.
FILES = ("rgba", "environment", "camera_path")

#: Settings that are no part of a recipe: a message, and files whose names do not matter.
NO_PART = ("unused", *FILES)

#: How the version of the program is called in a recipe.
PROGRAM = "sparklod"


@dataclass(frozen=True)
class Recipe:
    """All that determines the bytes of an output.

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
        """32 characters that no other recipe has."""
        whole = json.dumps([self.inputs, self.settings], sort_keys=True)
        return hashlib.blake2b(whole.encode(), digest_size=16).hexdigest()

    def differences(self, former: Recipe) -> list[str]:
        """In what it differs from a former one, in words; empty where it does not."""
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

    def to_record(self) -> dict[str, Any]:
        """As values that JSON has, of which `from_record` makes it again."""
        return dataclasses.asdict(self)

    @classmethod
    def from_record(cls, found: Any) -> Recipe:
        """The recipe of `to_record`; `ValueError` where the values are of none."""
        try:
            return cls(tuple(found["inputs"]), tuple(found["names"]), dict(found["settings"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"it is no recipe: {error!r}") from None

    def to_json(self) -> bytes:
        """The text of which `from_json` makes it again."""
        return json.dumps(self.to_record(), sort_keys=True).encode()

    @classmethod
    def from_json(cls, text: bytes) -> Recipe:
        """The recipe of `to_json`; `ValueError` where the text is none."""
        return cls.from_record(parse_json(text))


def recipe_of(sources: Iterable[Place], settings: BakeSettings, **more: Any) -> Recipe:
    """The recipe of a bake that may go on later; files are told apart by size, time and a sample of their bytes.

    Args:
        sources: the inputs; - is standard input.
        settings: how it is baked.
        more: numbers and texts that matter besides.

    Raises:
        UnreadableError: an input cannot be read.
    """
    found = [identity_of(file) for source in sources for file in files_of(source)]
    found += map(_identity_of_named, files_named_in(settings))
    inputs = tuple(f"{each.bytes} {each.modified} {each.sample}" for each in found)
    return Recipe(inputs, tuple(each.name for each in found), settings_of(settings) | more)


def files_named_in(settings: BakeSettings) -> list[Place]:
    """The files that settings name, and those that belong to these."""
    named = {name: path for name in FILES if (path := getattr(settings, name)) is not None}
    sets = {"camera_path": NAMES}
    return [file for name, path in named.items() for file in files_of(path, sets.get(name, ()))]


def _identity_of_named(file: Place) -> Identity:
    """What a file is like; an error names it, as it is none of the inputs."""
    try:
        return identity_of(file)
    except UnreadableError as error:
        raise UnreadableError(f"{file} {error}") from None


def settings_of(settings: BakeSettings) -> dict[str, Any]:
    """Settings as a recipe has them."""
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
