"""Paths of commands: their parameters, names of outputs, and the check that no output replaces an input."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from ..codecs.formats import MANIFEST, META, TILESET
from ..system.addresses import Address, Place, place_of
from ..system.stdio import DASH
from .rules import flag_of

INPUT, OUTPUT = "an input", "an output"

#: Error for an output that would be named after standard input.
NAMELESS = "standard input has no name to derive one from; name the output file"


@dataclass(frozen=True)
class Folder:
    """Folder given as an output: the file is written into it, as cp and mv do."""

    path: Place


class NamedPath(click.Path):
    """Path of a file or, with `folder`, a folder that a command reads or writes.

    It is opened later, so that a bad file does not stop the others. A name of an output file that ends in a slash, or
    is an existing folder, becomes a `Folder`.

    Args:
        suffixes: the only ones that `keep_apart` allows; empty for any.
        addresses: allow s3://bucket/file and the like.
        stdin: allow -, which is standard input.
    """

    def __init__(
        self,
        *,
        output: bool = False,
        folder: bool = False,
        suffixes: Sequence[str] = (),
        addresses: bool = False,
        stdin: bool = False,
    ) -> None:
        super().__init__(path_type=Path, file_okay=not folder, readable=False)
        self.output, self.folder, self.suffixes = output, folder, suffixes
        self.addresses, self.stdin = addresses, stdin
        self.unit = "DIR" if folder else "FILE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        text = os.fsdecode(value)
        if not text:
            self.fail("the name is empty", param, ctx)
        place: Any = place_of(text)
        if isinstance(place, Path):
            place = super().convert(os.fspath(place), param, ctx)
        elif not self.addresses:
            to_do = "write a file and upload that" if self.output else "download it first"
            self.fail(f"'{place}' is an address on a network, not a path; {to_do}", param, ctx)
        if place == DASH and not (self.output or self.stdin):
            self.fail("standard input is not read here; save it to a file first", param, ctx)
        if not self.output or self.folder:
            return place
        is_folder = text.endswith(("/", os.sep)) or (isinstance(place, Path) and os.path.isdir(place))  # noqa: PTH112
        return Folder(place) if is_folder else place


def name_outputs(ctx: click.Context, source: Place | None, ending: str = "") -> None:
    """Replace each parameter that is a `Folder` by a file in it, named after an input; None if there is no input.

    The name ends in `ending`, or else in the suffix of the parameter, of --format or of the first format of tables.
    """
    from ..tables.columns import FORMS as TABLES

    for parameter in ctx.command.params:
        value = ctx.params.get(parameter.name or "")
        if source is None or not isinstance(value, Folder):
            continue
        if source == DASH:
            raise click.UsageError(f"{flag_of(ctx, parameter.name or '')} {value.path}: {NAMELESS}", ctx)
        table = f".{ctx.params.get('form') or next(iter(TABLES))}"
        suffix = ending or next(iter(getattr(parameter.type, "suffixes", ())), table)
        ctx.params[parameter.name or ""] = value.path / f"{stem_of(source)}{suffix}"


def require_suffix(flag: str, output: Place, endings: Iterable[str]) -> None:
    """Raise a `click.UsageError` if the name of an output has no suffix to choose its format.

    Standard output, pipes and devices need no suffix. `endings` are the possible suffixes and names.
    """
    if output == DASH or output.suffix or _is_stream(_status(output)):
        return
    names = ", ".join(ending if ending.startswith(".") else f"/{ending}" for ending in endings)
    raise click.UsageError(
        f"{flag} {output} has no suffix, which chooses the format; end it in {names}, or in / for a folder"
    )


def keep_apart(ctx: click.Context, stands_for: Mapping[str, Iterable[Place]] | None = None) -> None:
    """Raise a `click.UsageError` if an output is also an input or another output, or has a wrong suffix.

    Files are compared, not names, so that links and spellings do not matter. Pipes and devices are never replaced.

    Args:
        stands_for: by parameter, the files that an input names, or that are written for an output.
    """
    stands_for = stands_for or {}
    inputs: list[Place] = []
    outputs: list[Place] = []
    promised: list[tuple[click.Parameter, NamedPath, Place]] = []
    for parameter in ctx.command.params:
        kind, value, more = parameter.type, ctx.params.get(parameter.name or ""), stands_for.get(parameter.name or "")
        values = [] if value is None else list(value) if isinstance(value, tuple) else [value]
        if isinstance(kind, NamedPath) and kind.output:
            outputs += more if more is not None else [] if kind.folder else values
            promised += [(parameter, kind, path) for path in values if kind.suffixes or kind.folder]
        else:
            inputs += [*(values if isinstance(kind, NamedPath) else []), *(more or ())]
    files, places = set[tuple[int, int]](), dict[str, str]()
    written = [(path, status) for path in outputs if path != DASH and not _is_stream(status := _status(path))]
    read = [path for path in dict.fromkeys(inputs) if path != DASH]
    # An output that does not exist is no companion of an input, which would have to be opened to find that out.
    if any(status is not None for _, status in written):
        from ..cameras.camera_formats import NAMES
        from ..io.files import companions

        read += [each for path in read if isinstance(path, Path) for each in companions(path, NAMES)]
    for path in read:
        places[_place(path)] = INPUT
        status = _status(path)
        if status is not None:
            files.add((status.st_dev, status.st_ino))
    for path, status in written:
        place = _place(path)
        is_input = status is not None and (status.st_dev, status.st_ino) in files
        taken = INPUT if is_input else places.get(place)
        if taken == OUTPUT:
            raise click.UsageError(f"two outputs would be written to {path}; give each a name of its own")
        if taken is not None:
            raise click.UsageError(f"{path} is {taken}; name another output")
        places[place] = OUTPUT
    for parameter, kind, path in promised:
        if path == DASH:
            raise click.BadParameter("it cannot go to standard output; name a file or folder", ctx, parameter)
        if kind.suffixes:
            require_suffix(flag_of(ctx, parameter.name or ""), path, kind.suffixes)
        if kind.suffixes and path.suffix and path.suffix.lower() not in kind.suffixes:
            raise click.BadParameter(
                f"{str(path)!r} does not end in {' or '.join(kind.suffixes)}, which is what is written", ctx, parameter
            )


def is_same_place(one: Place, other: Place) -> bool:
    """Return whether two paths lead to the same file, by links or other spellings."""
    if DASH in (one, other):
        return False
    statuses = _status(one), _status(other)
    return _place(one) == _place(other) or (all(statuses) and os.path.samestat(*statuses))  # type: ignore[arg-type]


def _status(path: Place) -> os.stat_result | None:
    """Return the status of a file; None for a missing file or an address."""
    if isinstance(path, Address):
        return None
    try:
        return path.stat()
    except (OSError, ValueError):
        return None


def _is_stream(status: os.stat_result | None) -> bool:
    return status is not None and not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode))


def _place(path: Place) -> str:
    """Return a text that is the same for all links to a file, which need not exist, and all spellings of its path."""
    if isinstance(path, Address):
        return path.url
    place = Path(os.path.realpath(path))
    folder, other = place.parent, place.parent.name.swapcase()
    with contextlib.suppress(OSError, ValueError):
        # The folder also found by its name in the other case is on a file system that ignores case.
        if other != folder.name and folder.samefile(folder.with_name(other)):
            return str(folder / place.name.casefold())
    return str(place)


def stem_of(source: Place) -> str:
    """Return the stem for names of outputs: that of the input, or the name of its folder for a meta.json and such."""
    whole = source if isinstance(source, Address) else source.absolute()
    return whole.parent.name if source.name in (META, MANIFEST, TILESET) else whole.stem or whole.name
