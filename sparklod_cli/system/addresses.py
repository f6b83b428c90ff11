"""Files at addresses such as s3://bucket/scan.ply, which fsspec opens and which are used like paths.

The text of an address omits its passwords and signatures, which are never shown.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import posixpath
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote, urlsplit

from .errors import SparklodError, optional_import
from .untrusted import redacted, without_secrets

#: Beginning of an address, maybe a chained one (simplecache::s3://). A letter and a colon are a drive of Windows.
ADDRESS = re.compile(r"((?:[A-Za-z][A-Za-z0-9+.-]*::)*[A-Za-z][A-Za-z0-9+.-]+)://")

#: Bytes of a request if callers read less at a time; a request takes as long as reading some megabytes.
READ_AHEAD = 1 << 23


@dataclass(frozen=True)
class Address:
    """File or folder that fsspec opens, with attributes and methods of a `Path`.

    Methods raise `OSError`, or `SparklodError` if a package is missing.

    Attributes:
        url: the address with its passwords, which its text omits.
    """

    url: str

    def __str__(self) -> str:
        return redacted(self.url)

    def __repr__(self) -> str:
        return f"Address({str(self)!r})"

    def __truediv__(self, name: str) -> Address:
        path, query = _cut(self.url)
        return Address(f"{path.rstrip('/')}/{name}{query}")

    @property
    def scheme(self) -> str:
        """Scheme that names the service; the last scheme of a chained address (simplecache::https://)."""
        return self.url.split("://", 1)[0].rpartition("::")[2].lower()

    @property
    def is_read_only(self) -> bool:
        """Whether its service only reads files."""
        return self.scheme in ("http", "https")

    @property
    def name(self) -> str:
        return posixpath.basename(_cut(self.url)[0].rstrip("/").split("://", 1)[-1])

    @property
    def suffix(self) -> str:
        return Path(self.name).suffix

    @property
    def stem(self) -> str:
        return Path(self.name).stem

    @property
    def parent(self) -> Address:
        path, query = _cut(self.url)
        scheme, rest = path.split("://", 1)
        folder = rest.rstrip("/").rpartition("/")[0]
        return Address(f"{scheme}://{folder}{query}") if folder else self

    def exists(self) -> bool:
        with self._opened() as (system, path):
            return bool(system.exists(path))

    def is_file(self) -> bool:
        with self._opened() as (system, path):
            return bool(system.isfile(path))

    def is_dir(self) -> bool:
        with self._opened() as (system, path):
            return bool(system.isdir(path))

    def size(self) -> int:
        with self._opened() as (system, path):
            size = system.info(path)["size"]
        if size is None:
            raise OSError(f"the size of {self} is unknown; download it first")
        return int(size)

    def version(self) -> str:
        """Return a text that changes when the file does."""
        with self._opened() as (system, path):
            return str(system.ukey(path))

    def open(
        self, mode: Literal["rb"] = "rb", buffering: int = READ_AHEAD, *, size: int | None = None
    ) -> io.BufferedReader:
        """Open the file for reading; a known `size` in bytes saves a request."""
        return io.BufferedReader(RangedFile(self.read, self.size() if size is None else size), buffering)

    def read(self, start: int, stop: int) -> bytes:
        with self._opened() as (system, path):
            data = bytes(system.cat_file(path, start=start, end=stop))
        if len(data) > stop - start:
            raise OSError("its server does not send parts of files; download it first")
        return data

    def write(self, pieces: Iterable[bytes | memoryview]) -> int:
        """Write the file and return its size in bytes; only a complete file is sent."""
        import tempfile  # as every command loads this module

        with tempfile.NamedTemporaryFile(prefix="sparklod-") as file:
            size = sum(map(file.write, pieces))
            file.flush()
            self.send(file.name)
        return size

    def send(self, file: str) -> None:
        """Copy a local file to the address, where it appears when it is complete."""
        with self._opened() as (system, path):
            system.put_file(file, path)

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            with self._opened() as (system, path):
                system.rm_file(path)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def files(self) -> list[str]:
        """Return the names of all files below this folder, relative to it."""
        with self._opened() as (system, path):
            try:
                found = system.find(path)
            except FileNotFoundError:
                return []
            root = path.rstrip("/") + "/"
            return sorted(str(each).removeprefix(root) for each in found)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[Any, str]]:
        """Yield the file system of the address and the path there; errors inside name the address."""
        system, path = _system(self.url)
        try:
            yield system, path
        except SparklodError:
            raise
        except FileNotFoundError:
            raise FileNotFoundError(errno.ENOENT, "no such file", str(self)) from None
        except PermissionError as error:
            raise PermissionError(errno.EACCES, f"no permission ({self._shown(error)})", str(self)) from None
        except OSError as error:
            raise OSError(error.errno or errno.EIO, self._shown(error.strerror or error), str(self)) from None
        except Exception as error:  # packages of services raise their own errors
            raise OSError(errno.EIO, f"{type(error).__name__}: {self._shown(error)}", str(self)) from None

    def _shown(self, error: Exception | str) -> str:
        return without_secrets(str(error), self.url)


class RangedFile(io.RawIOBase):
    """Seekable file of `size` bytes, which the function `read(start, stop)` requests when needed."""

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read, self._size, self._at = read, size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = max(0, offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence])
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        stop = min(self._at + len(view), self._size)
        if stop <= self._at:
            return 0
        data = self._read(self._at, stop)
        view[: len(data)] = data
        self._at += len(data)
        return len(data)


#: A file or folder, wherever it is.
Place = Path | Address


def place_of(text: str) -> Place:
    """Parse an address or a path; file:// is a path."""
    match = ADDRESS.match(text)
    if match is None:
        return Path(text)
    if match[1].lower() == "file":
        return Path(unquote(urlsplit(text).path))
    return Address(text)


def absolute(place: Place) -> Place:
    """Return a place for processes with another current folder; - stays as it is."""
    return place if isinstance(place, Address) or str(place) == "-" else place.absolute()


def size_of(place: Place) -> int:
    """Return the size of a local or remote file in bytes."""
    return place.size() if isinstance(place, Address) else place.stat().st_size


def _cut(url: str) -> tuple[str, str]:
    """Split an address before its query, which only addresses of the web have."""
    if not url.lower().rpartition("::")[2].startswith(("http://", "https://")):
        return url, ""
    path, mark, query = url.partition("?")
    return path, mark + query


@functools.lru_cache(maxsize=64)
def _system(url: str) -> tuple[Any, str]:
    """Return the file system that opens an address, and the path there."""
    with optional_import("addresses need fsspec and the package of their service", "cloud"):
        import fsspec

        try:
            # Other processes write at the same time, so cached lists of files would be outdated.
            system, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except ImportError:
            raise
        except Exception as error:  # each package of a service parses addresses in its own way
            reason = f"{type(error).__name__}: {without_secrets(str(error), url)}"
            scheme = url.split("://", 1)[0]
            raise SparklodError(
                f"addresses of {scheme}:// cannot be opened ({reason}); those of s3, gs and az can"
            ) from None
    return system, path
