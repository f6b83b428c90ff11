"""The server of a site: files by their names and nothing else, in ranges, to pages of its own by default."""

from __future__ import annotations

import contextlib
import email.utils
import errno
import ipaddress
import json
import os
import re
import socket
import socketserver
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote_to_bytes

from .. import __version__
from ..io.files import open_plain
from ..system.errors import SparklodError
from .shown_files import media_type
from .site import CAMERAS, INDEX, MAX_BYTES, Site, parse_drop

#: Default address of a server: only programs of this machine can connect.
LOOPBACK = "127.0.0.1"

#: Names of this machine that a Host header may have where the server listens on loopback.
OWN_NAMES = ("localhost", LOOPBACK, "[::1]")

#: Seconds that a connection may be idle.
IDLE = 60

#: Headers of every answer.
ALWAYS = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-cache"}

#: Headers of an answer that pages of other origins may read, and of one that they may neither read nor embed.
SHARED = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
}
PRIVATE = {"Cross-Origin-Resource-Policy": "same-origin"}

#: Headers of the answer to a preflight request, with --cors.
PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, HEAD",
    "Access-Control-Allow-Headers": "Range, If-Range",
    "Access-Control-Max-Age": "600",
}

#: A Range header (RFC 9110, section 14) of one range: from a first byte to a last one, from a first on, or the last.
RANGE = re.compile(r"bytes\s*=\s*([0-9]*)\s*-\s*([0-9]*)\s*", re.IGNORECASE | re.ASCII)

#: Most digits of a number of bytes in a request; a longer number exceeds the size of any file.
DIGITS = 18

#: Receives one line about each request.
Log = Callable[[str], None]


class Server(ThreadingHTTPServer):
    """Serves a site, a thread for each connection; port 0 is any free one; `SparklodError` if it cannot listen."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, site: Site, *, host: str, port: int, cors: bool, log: Log) -> None:
        self.site, self.cors, self.log = site, cors, log
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self.address_family = family
            super().__init__(address[:2], Handler)  # type: ignore[arg-type]
        except (OSError, UnicodeError) as error:
            raise SparklodError(_cannot_listen(host, port, error)) from None
        self.loopback = ipaddress.ip_address(str(self.server_address[0]).partition("%")[0]).is_loopback
        self.port = int(self.server_address[1])
        self.names = {*OWN_NAMES, host.lower()}

    def server_bind(self) -> None:
        """Bind the socket; unlike the base class, without asking a name server for the name of the machine."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    @property
    def url(self) -> str:
        """The address of the page, for a browser of this machine."""
        host = str(self.server_address[0])
        if ipaddress.ip_address(host.partition("%")[0]).is_unspecified:
            host = "::1" if ":" in host else LOOPBACK
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an unexpected error; it ends the connection, not the server."""
        self.log(f"a connection failed: {type(sys.exc_info()[1]).__name__}: {sys.exc_info()[1]}")


def _cannot_listen(host: str, port: int, error: OSError | UnicodeError) -> str:
    code = error.errno if isinstance(error, OSError) else None
    if code == errno.EADDRINUSE:
        return f"port {port} is in use; give another --port, or none to have a free one"
    if code == errno.EACCES:
        return f"port {port} cannot be used without more rights; give a --port above 1023"
    if isinstance(error, (socket.gaierror, UnicodeError)) or code == errno.EADDRNOTAVAIL:
        return f"{host!r} is no address of this machine; give --host {LOOPBACK}, or 0.0.0.0 for all of its addresses"
    return f"cannot listen on {host}, port {port}: {(error.strerror or str(error)).lower()}"


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of a connection."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version = f"sparklod/{__version__}"
    sys_version = ""
    timeout = IDLE

    def do_GET(self) -> None:
        if self._is_ours():
            self._send_resource(body=True)

    def do_HEAD(self) -> None:
        if self._is_ours():
            self._send_resource(body=False)

    def do_OPTIONS(self) -> None:
        """Send the headers and methods that a page of another origin may use."""
        if self._is_ours():
            self._answer(HTTPStatus.NO_CONTENT, {"Allow": "GET, HEAD", **(PREFLIGHT if self.server.cors else {})})

    def do_POST(self) -> None:
        """Parse a camera path that was dropped onto our page."""
        if not self._is_ours():
            return
        if self.path != f"/{CAMERAS}":
            self._refuse(HTTPStatus.METHOD_NOT_ALLOWED, "nothing is posted here")
        elif not self._is_of_our_page():
            self._refuse(HTTPStatus.FORBIDDEN, "only the page of this server may post")
        elif (body := self._body()) is not None:
            status = HTTPStatus.OK
            try:
                answer = parse_drop(body, self.server.site.cameras)
            except SparklodError as error:
                status, answer = HTTPStatus.UNPROCESSABLE_ENTITY, {"error": str(error)}
            self._answer(status, {"Content-Type": "application/json"}, json.dumps(answer).encode())

    def _body(self) -> bytes | None:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()) or "Transfer-Encoding" in self.headers:
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "the request has no Content-Length")
        elif len(length) > DIGITS or int(length) > MAX_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MAX_BYTES >> 20} MiB are read")
        else:
            body = self.rfile.read(int(length))
            if len(body) == int(length):
                return body
            self._refuse(HTTPStatus.BAD_REQUEST, "the request was cut short")
        return None

    def _is_ours(self) -> bool:
        """Whether the request names this server: a page elsewhere whose name leads here must not read our files."""
        if not self.server.loopback:
            return True
        host, _, port = self.headers.get("Host", "").lower().rpartition(":")
        if not port.isdigit():  # of a browser, where the port is that of HTTP
            host, port = f"{host}:{port}".lstrip(":"), "80"
        if host in self.server.names and port == str(self.server.port):
            return True
        self._refuse(HTTPStatus.MISDIRECTED_REQUEST, "this server is not called that")
        return False

    def _is_of_our_page(self) -> bool:
        origin, site = self.headers.get("Origin"), self.headers.get("Sec-Fetch-Site", "same-origin")
        own = origin is None or origin.lower() == f"http://{self.headers.get('Host', '').lower()}"
        return own and site == "same-origin" and self.headers.get("Content-Type") == "application/json"

    def _send_resource(self, *, body: bool) -> None:
        name = os.fsdecode(unquote_to_bytes(self.path.partition("?")[0].partition("#")[0])).removeprefix("/")
        content = self.server.site.resources.get(name or INDEX)
        if content is None:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")
        elif isinstance(content, Path):
            self._send_file(content, media_type(name), body=body)
        else:
            self._answer(HTTPStatus.OK, {"Content-Type": media_type(name or INDEX)}, content, body=body)

    def _send_file(self, path: Path, media: str, *, body: bool) -> None:
        try:
            file = open_plain(path)
        except OSError:
            self._refuse(HTTPStatus.NOT_FOUND, "the file is gone")
            return
        with file:
            found = os.fstat(file.fileno())
            tag = f'"{found.st_mtime_ns:x}-{found.st_size:x}"'
            modified = email.utils.formatdate(found.st_mtime, usegmt=True)
            headers = {"Content-Type": media, "Accept-Ranges": "bytes", "ETag": tag, "Last-Modified": modified}
            if tag in (each.strip().removeprefix("W/") for each in self.headers.get("If-None-Match", "").split(",")):
                self._answer(HTTPStatus.NOT_MODIFIED, headers)
                return
            wanted = self.headers.get("Range") if body else None  # a range has a meaning for GET only
            if self.headers.get("If-Range", tag) not in (tag, modified):
                wanted = None
            span = span_of(wanted, found.st_size)
            if span is None:
                self._send_span(HTTPStatus.OK, headers, file if body else None, 0, found.st_size)
            elif not span:
                self._refuse(
                    HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                    f"the file has {found.st_size} bytes",
                    {"Content-Range": f"bytes */{found.st_size}"},
                )
            else:
                headers["Content-Range"] = f"bytes {span.start}-{span[-1]}/{found.st_size}"
                self._send_span(HTTPStatus.PARTIAL_CONTENT, headers, file, span.start, len(span))

    def _send_span(
        self, status: HTTPStatus, headers: Mapping[str, str], file: BinaryIO | None, first: int, count: int
    ) -> None:
        self._begin(status, {**headers, "Content-Length": str(count)})
        if file is None or not count:
            return
        self.wfile.flush()
        sent = 0
        with contextlib.suppress(ConnectionError, TimeoutError):  # the browser wants no more of it
            sent = self.connection.sendfile(file, first, count)
        if sent < count:  # the file has become shorter, too: the closed connection reports it
            self.close_connection = True

    def _refuse(self, status: HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> None:
        """Send an error; its body may be unread, so the connection ends."""
        self.close_connection = True
        more = {"Content-Type": "text/plain; charset=utf-8", "Connection": "close", **(headers or {})}
        self._answer(status, more, f"{text}\n".encode(), body=self.command != "HEAD")

    def _answer(
        self, status: HTTPStatus, headers: Mapping[str, str], data: bytes | None = None, *, body: bool = True
    ) -> None:
        length = {} if data is None else {"Content-Length": str(len(data))}
        self._begin(status, {**headers, **length})
        if data is not None and body:
            with contextlib.suppress(ConnectionError, TimeoutError):
                self.wfile.write(data)

    def _begin(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        for name, value in {**ALWAYS, **(SHARED if self.server.cors else PRIVATE), **headers}.items():
            self.send_header(name, value)
        with contextlib.suppress(ConnectionError, TimeoutError):
            self.end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        self.server.log(f"{self.address_string()} {format % arguments}")


def span_of(text: str | None, size: int) -> range | None:
    """Return the bytes of a file that a Range header names, empty if the file has none of them; None for all of them.

    The whole file is sent without a header, and where a server may ignore it: of another unit, with several ranges, or
    broken.
    """
    found = RANGE.fullmatch(text.strip()) if text is not None else None
    if found is None:
        return None
    first, last = found.groups()
    if first:
        begin = _number(first)
        end = _number(last) if last else max(begin, size)
        if end < begin:
            return None
        return range(begin, max(begin, min(end + 1, size)))
    if last:
        return range(size - min(_number(last), size), size)
    return None


def _number(digits: str) -> int:
    digits = digits.lstrip("0")
    return int(digits or "0") if len(digits) <= DIGITS else 10**DIGITS
