"""Files at addresses: used as paths are, read in parts, and shown without passwords."""

from __future__ import annotations

import errno
import io
import pickle
import re
import sys
import uuid
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.system import addresses
from sparklod_cli.system.addresses import Address, place_of
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.machine import install_hint
from sparklod_cli.system.untrusted import printable

pytestmark = pytest.mark.slow


@pytest.fixture
def folder() -> Address:
    pytest.importorskip("fsspec")
    return Address(f"memory://{uuid.uuid4().hex}")


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("scan.ply", Path("scan.ply")),
        ("C:/scan.ply", Path("C:/scan.ply")),
        ("file:///tmp/two%20words.ply", Path("/tmp/two words.ply")),
        ("s3://bucket/scan.ply", Address("s3://bucket/scan.ply")),
    ],
)
def test_a_text_names_a_path_or_an_address(text: str, place: Path | Address) -> None:
    assert place_of(text) == place


def test_an_address_has_the_parts_of_a_path() -> None:
    scan = Address("s3://bucket/scans/scan.v2.ply")
    assert (scan.name, scan.stem, scan.suffix) == ("scan.v2.ply", "scan.v2", ".ply")
    assert scan.parent == Address("s3://bucket/scans")
    assert scan.parent / "other.ply" == Address("s3://bucket/scans/other.ply")
    assert scan.parent.parent.parent == Address("s3://bucket")  # there is nothing above
    signed = Address("https://host/scans/scan.ply?signature=abc")
    assert (signed.name, signed.suffix) == ("scan.ply", ".ply")
    assert signed.parent / "more" == Address("https://host/scans/more?signature=abc")


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("s3://bucket/scan.ply", "s3://bucket/scan.ply"),
        ("s3://bucket/what?.ply", "s3://bucket/what?.ply"),  # a name, not a query
        ("sftp://ann@host/scan.ply", "sftp://ann@host/scan.ply"),
        ("sftp://ann:secret@host/scan.ply", "sftp://***@host/scan.ply"),
        ("https://host/scan.ply?X-Amz-Signature=secret", "https://host/scan.ply?***"),
        ("s3://AKIA:sec/ret+secret@bucket/scan.ply", "s3://***@bucket/scan.ply"),
        ("s3://AKIA:se@cret@bucket/a@b/scan.ply", "s3://***@bucket/a@b/scan.ply"),
        ("simplecache::s3://ann:secret@host/scan.ply", "simplecache::s3://***@host/scan.ply"),
        ("zip://a.ply::s3://ann:secret@host/scan.zip", "zip://a.ply::s3://***@host/scan.zip"),
        ("simplecache::https://host/scan.ply?sig=secret", "simplecache::https://host/scan.ply?***"),
        ("abfs://box/scan.ply?sv=1&sig=secret", "abfs://box/scan.ply?***"),
        ("https://host:8080/a@b/scan.ply", "https://host:8080/a@b/scan.ply"),
    ],
)
def test_passwords_and_signatures_are_not_shown(url: str, shown: str) -> None:
    assert str(Address(url)) == shown
    assert "secret" not in repr(Address(url)) and "secret" not in f"{Address(url)}"
    assert pickle.loads(pickle.dumps(Address(url))).url == url
    assert place_of(url) == Address(url)
    assert printable(f"{url}: no such file; and '{url}'") == f"{shown}: no such file; and '{shown}'"


def test_what_is_written_is_read_wherever_in_it(folder: Address) -> None:
    file, content = folder / "a" / "scan.ply", bytes(range(256)) * 9
    assert not file.exists() and not folder.is_dir()
    assert file.write([content[:100], memoryview(content[100:])]) == len(content) == file.size()
    assert file.is_file() and file.parent.is_dir() and not file.is_dir()
    for buffering in (16, addresses.READ_AHEAD):
        with file.open(buffering=buffering) as opened:
            assert opened.read() == content and opened.read() == b""
            assert opened.seek(-10, io.SEEK_END) == len(content) - 10 and opened.read(99) == content[-10:]
            assert opened.seek(300) == 300 and opened.read(50) == content[300:350] and opened.tell() == 350
            assert opened.seek(10**6) and opened.read(1) == b""
    (folder / "b.ply").write([])
    assert folder.files() == ["a/scan.ply", "b.ply"] and (folder / "b.ply").size() == 0
    file.unlink()
    assert folder.files() == ["b.ply"] and (folder / "none").files() == []
    file.unlink(missing_ok=True)
    with pytest.raises(FileNotFoundError):
        file.unlink()


def test_nothing_appears_of_what_fails_halfway(folder: Address) -> None:
    def pieces() -> Any:
        yield b"one"
        raise ValueError("two")

    with pytest.raises(ValueError, match="two"):
        (folder / "scan.ply").write(pieces())
    assert not (folder / "scan.ply").exists()


def test_what_is_missing_is_said_as_of_a_path(folder: Address) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        (folder / "scan.ply").open()
    assert (caught.value.errno, caught.value.strerror) == (errno.ENOENT, "no such file")


@pytest.mark.parametrize("error", [RuntimeError, OSError, PermissionError])
def test_errors_of_services_are_those_of_a_system_without_passwords(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    address = Address("sftp://ann:secret@host/scan.ply")

    class Service:
        """A service whose package has errors of its own."""

        def info(self, path: str) -> Any:
            raise error(f"cannot log in to {address.url}, ANN:SECRET is no bucket")

    monkeypatch.setattr(addresses, "_system", lambda url: (Service(), "scan.ply"))
    said = r"cannot log in to sftp://\*\*\*@host/scan\.ply, \*\*\* is no bucket"
    with pytest.raises(OSError, match=said):
        address.size()


@pytest.mark.parametrize("scheme", ["s4", "dir", "reference", "zip", "simplecache::s4", "simplecache::dir"])
def test_an_address_that_nothing_opens_is_an_error(scheme: str) -> None:
    with pytest.raises((SparklodError, OSError)) as caught:
        place_of(f"{scheme}://ann:secret@host/scan.ply").open()
    assert "secret" not in str(caught.value)


def test_a_server_that_sends_whole_files_is_refused(folder: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    class Server:
        """A server that knows no ranges."""

        def cat_file(self, path: str, start: int, end: int) -> bytes:
            return bytes(1000)

    monkeypatch.setattr(addresses, "_system", lambda url: (Server(), "scan.ply"))
    with pytest.raises(OSError, match="does not send parts of files; download it first"):
        folder.read(10, 20)


def test_what_to_install_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    addresses._system.cache_clear()
    with pytest.raises(SparklodError, match=re.escape(install_hint("cloud"))):
        Address("s3://bucket/scan.ply").exists()


def test_an_unknown_scheme_is_refused(folder: Address) -> None:
    with pytest.raises(
        SparklodError,
        match=r"addresses of s4:// cannot be opened .*Protocol not known: s4.*; those of s3, gs and az can",
    ):
        Address("s4://bucket/scan.ply").exists()
