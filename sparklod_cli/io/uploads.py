"""Writes outputs at addresses: each object appears when all of it was sent, and a header after its chunks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence

from ..support.addresses import Address
from ..support.errors import OutputError
from .names import number_of, reason_of

#: Schemes of addresses that are only read.
READ_ONLY = ("http", "https")


def check_address(address: Address, *, overwrite: bool) -> None:
    """Raises `OutputError` where an output cannot be written, as far as that can be told without writing it."""
    scheme = address.url.split("://", 1)[0].lower()
    if scheme in READ_ONLY:
        raise OutputError(f"cannot write {address}: {scheme}:// is for reading; write a file and upload that")
    try:
        if not overwrite and address.is_file():
            raise _taken(address)
    except OSError as error:
        raise OutputError(f"cannot write {address}: {reason_of(error)}") from None


def upload(address: Address, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Writes a file, and returns its size.

    Raises:
        OutputError: it exists and `overwrite` is not set, or it cannot be sent.
    """
    check_address(address, overwrite=overwrite)
    try:
        return address.write(pieces)
    except OSError as error:
        raise OutputError(f"cannot write {address}: {reason_of(error)}") from None


def chunks_at(address: Address) -> list[Address]:
    """The files beside a header that are called as those that it names would be."""
    try:
        names = [name for name in address.parent.files() if "/" not in name]
    except OSError as error:
        raise OutputError(f"cannot list {address.parent}: {reason_of(error)}") from None
    found = {number_of(name, address.name): address.parent / name for name in names}
    return [found[number] for number in sorted(number for number in found if number is not None)]


def upload_together(address: Address, files: Iterable[tuple[str, Iterable[bytes]]], *, overwrite: bool) -> int:
    """Writes the files that a header names, and then the header; returns their size.

    If something fails, what was sent is removed, so that no header names files that are not there. Where files are
    replaced, the old header is removed first for the same reason: services replace one object at a time.

    Args:
        address: of the header.
        files: names and contents; the last is the header, whose name is that of `address`.
        overwrite: replace existing files, and remove those of a larger output.

    Raises:
        OutputError: a file exists and `overwrite` is not set, or one cannot be sent.
    """
    check_together(address, overwrite=overwrite)
    placed = ((address.name if number_of(name, address.name) is None else name, pieces) for name, pieces in files)
    return send_together(address, placed, former=chunks_at(address), overwrite=overwrite)


def send_together(
    address: Address, files: Iterable[tuple[str, Iterable[bytes]]], *, former: Sequence[Address], overwrite: bool
) -> int:
    """As `upload_together`, of files with any names.

    Args:
        address: of the file that names the others.
        files: names, with the folders that they are in there, and contents; the last is that of `address`.
        former: files of a former output, which are removed where no new one has their name.
        overwrite: replace the file at `address`.

    Raises:
        OutputError: as `upload_together`.
    """
    check_address(address, overwrite=overwrite)
    sent, size = list[Address](), 0
    try:
        address.unlink(missing_ok=True)
        for name, pieces in files:
            place = address if name == address.name else address.parent / name
            sent.append(place)
            size += place.write(pieces)
        for outdated in former:
            if outdated not in sent:
                outdated.unlink(missing_ok=True)
    except BaseException as error:
        for place in reversed(sent):
            with contextlib.suppress(OSError):
                place.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {address}: {reason_of(error)}") from None
        raise
    return size


def check_together(address: Address, *, overwrite: bool) -> None:
    """As `check_address`, of a header and the files that it names."""
    check_address(address, overwrite=overwrite)
    for each in [] if overwrite else chunks_at(address):
        raise _taken(each)


def _taken(address: Address) -> OutputError:
    return OutputError(f"{address} exists, add --overwrite to replace it")
