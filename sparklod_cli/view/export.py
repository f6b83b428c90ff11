"""Writes a site into a folder, from which any web server can serve it: whole or not at all."""

from __future__ import annotations

import contextlib
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from ..io import read_text
from ..io.local_files import open_plain
from ..system.errors import OutputError, SparklodError, reason_of
from ..system.output import try_place, write_file
from ..system.progress import Progress, silent
from ..system.untrusted import parse_json
from .site import GENERATOR, SETTINGS, Site

#: Names of folders that are incomplete, or about to be removed.
PARTS = ".sparklod-{}.part"

#: Bytes that are copied at a time.
PIECE = 1 << 20

#: What the folder of a site has: folders, and suffixes of files. Names of files may change from version to version.
FOLDERS, SUFFIXES = ("data", "lib"), (".html", ".css", ".js", ".json")


def check_folder(folder: Path, site: Site | None = None, *, overwrite: bool) -> None:
    """Raise an `OutputError` where a site cannot be written into a folder.

    A folder that exists is replaced only if it is empty or a site that was exported before: what else somebody keeps
    in a folder, such as the .git of the pages that it is published from, is not ours to remove.

    Args:
        site: that will be written; its files must lie elsewhere.
    """
    try:
        if folder.suffix.lower() in (".html", ".htm") and not folder.is_dir():
            raise OutputError(f"{folder} names a page, but --export writes a folder; give {folder.with_suffix('')}")
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is a file; name a folder for the site")
        if folder.is_dir() and any(folder.iterdir()):
            if not overwrite:
                raise OutputError(f"{folder} exists, add --overwrite to replace the site in it")
            if not _is_site(folder):
                raise OutputError(f"{folder} holds something else than a site of sparklod view; name another folder")
            for other in filter(_is_foreign, folder.iterdir()):
                raise OutputError(f"{folder} holds {other.name}, which is not of the site; move it away first")
        real = folder.resolve()
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from None
    try_place(folder, least=0 if site is None else _total(site))
    for content in site.resources.values() if site is not None else ():
        if isinstance(content, Path) and content.is_relative_to(real):
            raise OutputError(f"{folder} holds {content.name}, which is to be shown; name another folder")


def _is_site(folder: Path) -> bool:
    try:
        settings = parse_json(read_text(folder / SETTINGS))
    except (SparklodError, ValueError):
        return False
    return isinstance(settings, dict) and settings.get("generator") == GENERATOR


def _is_foreign(path: Path) -> bool:
    """Whether an entry of the folder of a site was put there by somebody else."""
    return path.name not in FOLDERS if path.is_dir() else path.suffix not in SUFFIXES


def export(site: Site, folder: Path, *, overwrite: bool, progress: Progress = silent) -> int:
    """Write a site and return its bytes.

    Args:
        folder: that gets it; appears when it is complete.

    Raises:
        OutputError: see `check_folder`, or the file system refused something.
    """
    check_folder(folder, site, overwrite=overwrite)
    real = folder.resolve()
    part = real.with_name(PARTS.format(secrets.token_hex(8)))
    total, done = _total(site), 0
    try:
        real.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        for name, content in site.resources.items():
            pieces = [content] if isinstance(content, bytes) else _pieces(content)
            done += write_file(part / name, pieces, overwrite=False)
            progress("export", done, total, "B")
        _replace(real, part)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {reason_of(error)}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return done


def _total(site: Site) -> int:
    return sum(_size(content) for content in site.resources.values())


def _size(content: bytes | Path) -> int:
    return len(content) if isinstance(content, bytes) else content.stat().st_size


def _pieces(path: Path) -> Iterator[bytes]:
    with open_plain(path) as file:
        while piece := file.read(PIECE):
            yield piece


def _replace(folder: Path, part: Path) -> None:
    """Give a complete folder its name; what had it before is put aside, and back where that fails."""
    if not folder.exists():
        part.rename(folder)
        return
    aside = part.with_name(PARTS.format(secrets.token_hex(8)))
    folder.rename(aside)
    try:
        part.rename(folder)
    except BaseException:
        with contextlib.suppress(OSError):
            aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)
