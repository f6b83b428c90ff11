"""A cluster of processes on this machine, attacked by a program that has none of its credentials."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("distributed")

import distributed
import psutil

from sparklod_cli.bake.out_of_core import cluster as module
from sparklod_cli.bake.out_of_core.cluster import ClusterEngine, cluster
from sparklod_cli.bake.out_of_core.store import Store
from sparklod_cli.system.progress import silent

from .made_up import Job, tree_of

pytestmark = pytest.mark.slow

#: Seconds that somebody who has the credentials waits on a busy machine, and for how long others try.
PATIENCE, TRIES = 60, 2


def listening() -> dict[int, int]:
    """Ports on which this process and those that it started listen, with the process of each."""
    here = psutil.Process()
    return {
        connection.laddr.port: process.pid
        for process in (here, *here.children(recursive=True))
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }


@pytest.fixture(scope="module")
def attacked() -> Iterator[tuple[ClusterEngine, dict[int, int]]]:
    """An engine, and the ports on which its processes listen."""
    before, said = listening(), list[str]()
    with cluster(workers=1, say=said.append) as engine:
        yield engine, {port: pid for port, pid in listening().items() if port not in before}
    assert said == []  # no address of a dashboard


async def answered(security: Any, addresses: list[str], patience: float) -> list[str]:
    """Return the addresses at which a scheduler, nanny or worker answers a request for its identity."""

    async def is_answered(address: str) -> bool:
        server = distributed.rpc(address, timeout=patience, connection_args=security.get_connection_args("client"))
        with contextlib.suppress(OSError):
            await server.identity()
            return True
        return False

    found = await asyncio.gather(*map(is_answered, addresses))
    return [address for address, is_found in zip(addresses, found, strict=True) if is_found]


def test_no_port_answers_without_credentials(attacked: tuple[ClusterEngine, dict[int, int]], tmp_path: Path) -> None:
    engine, ports = attacked
    assert set(ports.values()) == {os.getpid(), *engine.client.run(os.getpid).values()}
    own, tls = engine.client.security, [f"tls://127.0.0.1:{port}" for port in ports]
    with module._quiet():
        assert asyncio.run(answered(own, tls, PATIENCE)) == tls  # nothing else listens
        assert asyncio.run(answered(distributed.Security.temporary(), tls, TRIES)) == []
        tcp = [address.replace("tls", "tcp") for address in tls]
        assert asyncio.run(answered(distributed.Security(), tcp, TRIES)) == []
    job, tasks = Job(Store(tmp_path)), tree_of(4)
    engine.run("building", tasks, job, silent)
    assert job.store.has(tasks[-1].name)


def test_no_port_answers_a_browser(attacked: tuple[ClusterEngine, dict[int, int]]) -> None:
    for port in attacked[1]:
        answer = b""
        with socket.create_connection(("127.0.0.1", port), PATIENCE) as browser, contextlib.suppress(ConnectionError):
            browser.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            answer = browser.recv(4)
        assert answer != b"HTTP"


def test_the_key_is_in_no_command_line_or_environment(attacked: tuple[ClusterEngine, dict[int, int]]) -> None:
    key = attacked[0].client.security.tls_worker_key.splitlines()[1]
    for pid in set(attacked[1].values()):
        process = psutil.Process(pid)
        assert key not in " ".join(process.cmdline())
        assert key not in "".join(process.environ().values())
