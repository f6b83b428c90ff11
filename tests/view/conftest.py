"""Sites that are served in this process."""

from __future__ import annotations

import contextlib
import http.client
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.api import sites
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.view.server import Server
from sparklod_cli.view.site import FILES, LICENSES, MODULES, VERSIONS, Site
from tests.conftest import FIXTURES
from tests.part_files import tiled
from tests.scenes import random_splats

TREE = FIXTURES / "golden" / "tree-v3.spz"
CHUNKED = FIXTURES / "golden" / "sh3-rad" / "sh3.rad"


@dataclass(frozen=True)
class Answer:
    """What a server said."""

    status: int
    headers: Mapping[str, str]
    body: bytes


def prepared(paths: Sequence[Path], *, served: bool = True, **options: Any) -> Site:
    """The site of some files."""
    return sites.prepare(paths, served=served, threads=1, **options)


@contextlib.contextmanager
def serving(
    site: Site, *, host: str = "127.0.0.1", port: int = 0, cors: bool = False, log: list[str] | None = None
) -> Iterator[Server]:
    """A server of a site, in a thread of its own."""
    lines = [] if log is None else log
    with Server(site, host=host, port=port, cors=cors, log=lines.append) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(server: Server, target: str, method: str = "GET", body: bytes | None = None, **headers: str | None) -> Answer:
    """Sends a request, its target exactly as it is given; a header of None is left out, - stands for _."""
    named = {"Host": f"127.0.0.1:{server.port}"}
    named |= {name.replace("_", "-"): value for name, value in headers.items() if value is not None}
    if headers.get("Host", "") is None:
        del named["Host"]
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=10)  # type: ignore[misc]
    with contextlib.closing(connection):
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        if body is not None:
            named.setdefault("Content-Length", str(len(body)))
        for name, value in named.items():
            connection.putheader(name, value)
        connection.endheaders(body)
        response = connection.getresponse()
        return Answer(response.status, dict(response.getheaders()), response.read())


@pytest.fixture(scope="session")
def tileset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3D Tiles of several levels."""
    return tiled(random_splats(300), tmp_path_factory.mktemp("tiles"), TileSettings(tile_splats=40))


@pytest.fixture(scope="session")
def site() -> Site:
    """A tree, and a RAD file whose chunks are files of their own."""
    return prepared([TREE, CHUNKED])


@pytest.fixture(scope="session")
def server(site: Site) -> Iterator[Server]:
    """A server of `site`."""
    with serving(site) as server:
        yield server


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    """A folder whose node_modules looks as if all packages of `VERSIONS` were installed."""
    root = tmp_path / "packages" / "node_modules"
    for package, version in VERSIONS.items():
        (root / package).mkdir(parents=True)
        (root / package / "package.json").write_text(f'{{"version": "{version}"}}')
        (root / package / LICENSES[package in FILES]).write_text(f"license of {package}")
    named = [(package, pattern.replace("*", "one")) for package, patterns in FILES.items() for pattern in patterns]
    for package, path in (*MODULES, *named):
        (root / package / path).parent.mkdir(parents=True, exist_ok=True)
        (root / package / path).write_text(f"// {package} {path}")
    return root.parent
