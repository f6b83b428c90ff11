"""The server of a site: sends resources of the site and nothing else, by default only to its own page."""

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

#: Names of this machine in a Host header, if the server listens on loopback.
OWN_NAMES = ("localhost", LOOPBACK, "[::1]")

#: Seconds that a connection may be idle.
IDLE = 60

#: Headers of every response.
ALWAYS = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-cache"}

#: Headers of responses that pages of other origins may read, and of responses that they may neither read nor embed.
SHARED = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
}
PRIVATE = {"Cross-Origin-Resource-Policy": "same-origin"}

#: Headers of the response to a preflight request, with --cors.
PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, HEAD",
    "Access-Control-Allow-Headers": "Range, If-Range",
    "Access-Control-Max-Age": "600",
}

#: A Range header (RFC 9110, section 14) with one range: first and last byte, first byte, or a number of last bytes.
RANGE = re.compile(r"bytes\s*=\s*([0-9]*)\s*-\s*([0-9]*)\s*", re.IGNORECASE | re.ASCII)

#: Most digits of a number of bytes in a request; longer numbers exceed the size of any file.
DIGITS = 18


class Server(ThreadingHTTPServer):
    """Serves a site, with a thread for each connection; `SparklodError` if it cannot listen.

    Args:
        port: 0 for any free port.
        cors: let pages of other origins read the files.
        log: receives a line about each request.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, site: Site, *, host: str, port: int, cors: bool, log: Callable[[str], None]) -> None:
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
        """Bind the socket, without the base class's query for the name of the machine."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    @property
    def url(self) -> str:
        """Address of the page, for a browser on this machine."""
        host = str(self.server_address[0])
        if ipaddress.ip_address(host.partition("%")[0]).is_unspecified:
            host = "::1" if ":" in host else LOOPBACK
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an unexpected error, which ends the connection, not the server."""
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
            self._send_resource()

    do_HEAD = do_GET  # noqa: N815

    def do_OPTIONS(self) -> None:
        """Send the methods and, with --cors, the headers that a page of another origin may use."""
        if self._is_ours():
            self._answer(HTTPStatus.NO_CONTENT, {"Allow": "GET, HEAD", **(PREFLIGHT if self.server.cors else {})})

    def do_POST(self) -> None:
        """Parse a camera path dropped onto the page."""
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
        """Return whether the Host header names this server, or refuse the request.

        Another site whose name resolves to this address must not read the files.
        """
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

    def _send_resource(self) -> None:
        name = os.fsdecode(unquote_to_bytes(self.path.partition("?")[0].partition("#")[0])).removeprefix("/")
        content = self.server.site.resources.get(name or INDEX)
        if content is None:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such file")
        elif isinstance(content, Path):
            self._send_file(content, media_type(name))
        else:
            self._answer(HTTPStatus.OK, {"Content-Type": media_type(name or INDEX)}, content)

    def _send_file(self, path: Path, media: str) -> None:
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
            is_partial = self.command == "GET" and self.headers.get("If-Range", tag) in (tag, modified)
            span = span_of(self.headers.get("Range") if is_partial else None, found.st_size)
            if span is None:
                self._send_span(HTTPStatus.OK, headers, file, 0, found.st_size)
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
        self, status: HTTPStatus, headers: Mapping[str, str], file: BinaryIO, first: int, count: int
    ) -> None:
        self._begin(status, {**headers, "Content-Length": str(count)})
        if self.command == "HEAD" or not count:
            return
        self.wfile.flush()
        sent = 0
        with contextlib.suppress(ConnectionError, TimeoutError):  # the browser has lost interest
            sent = self.connection.sendfile(file, first, count)
        if sent < count:  # or the file was truncated, which closing the connection reports
            self.close_connection = True

    def _refuse(self, status: HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> None:
        """Send an error and end the connection, since the body of the request may be unread."""
        self.close_connection = True
        more = {"Content-Type": "text/plain; charset=utf-8", "Connection": "close", **(headers or {})}
        self._answer(status, more, f"{text}\n".encode())

    def _answer(self, status: HTTPStatus, headers: Mapping[str, str], data: bytes | None = None) -> None:
        length = {} if data is None else {"Content-Length": str(len(data))}
        self._begin(status, {**headers, **length})
        if data is not None and self.command != "HEAD":
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
    """Return the bytes of a file that a Range header names, an empty range if it has none of them, or None for all.

    A server may ignore a header of another unit, with several ranges, or broken, and send the whole file.
    """
    found = RANGE.fullmatch(text.strip()) if text is not None else None
    if found is None or not any(found.groups()):
        return None
    digits = [each.lstrip("0") if each else None for each in found.groups()]
    first, last = (None if each is None else int(each or "0") if len(each) <= DIGITS else 10**DIGITS for each in digits)
    if first is None:
        return range(size - min(last or 0, size), size)
    if last is not None and last < first:
        return None
    return range(first, size if last is None else min(last + 1, size)) if first < size else range(0)
